"""Alarm node: evaluates rules on monitoring records and queue states, publishes alarms and notifies of them."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from scan2sim.services import default_outbox
from scan2sim.services.monitoring.events import rules
from scan2sim.services.monitoring.events.broker_contact import BrokerContact, NoBroker
from scan2sim.services.monitoring.events.bus import Bus
from scan2sim.services.monitoring.events.notify import Notifier
from scan2sim.services.monitoring.events.rule_evaluator import RuleEvaluator
from scan2sim.services.monitoring.events.schema import RECORD, Alarm, AlarmCommand, QueueState
from scan2sim.services.monitoring.node.monitor import ros
from scan2sim.services.monitoring.settings.bus import AlarmsParams

log = logging.getLogger(__name__)

SAVE_INTERVAL_S = 10.0
"""Seconds between two savings of when nodes were heard last; a change of alarms is saved at once."""


class AlarmsNode(ros.Node):  # type: ignore[misc]
    """Evaluates alarm rules on everything that is published on the bus.

    Its state is in a file, so that a restarted node neither raises what it has raised, nor forgets to clear it.
    """

    def __init__(self, params: AlarmsParams, notify: Callable[[Alarm], None], node_name: str = "alarms") -> None:
        """`notify` is called with every alarm that isn't muted, in addition to its publication on the bus."""
        known, notified = rules.read(params.rules)
        contact = BrokerContact if params.kafka_bootstrap_servers else NoBroker
        self._contact = contact(time.time(), params.records_topic, params.events_topic)
        self._evaluator = RuleEvaluator(known, self._contact)
        self._state = params.state or default_outbox.state_folder("alarms") / f"{params.rules.resolve().stem}.json"
        seen = _restore(self._evaluator, self._state)
        self._saved = 0.0
        self._lock, self._file_lock = threading.Lock(), threading.Lock()  # records arrive in other threads than timers
        super().__init__(node_name)
        self._notify, self._notifier = notify, Notifier(notified, f"{self.get_namespace()}/{node_name}")
        self._bus = Bus(
            self, params, records=True, seen=seen,
            reached=lambda: self._contact.reached(time.time()),
            assigned=lambda topic: self._contact.assigned(topic, time.time()),
        )  # fmt: skip
        self._bus.events.on(RECORD, self._check_record)
        self._bus.events.on("queue", self._check_queue)
        self._bus.events.on("alarm_command", self._command)
        self._bus.start()
        self.create_timer(1.0, self._check_silence)

    def _check_record(self, record: Mapping[str, Any]) -> None:
        self._publish(lambda now: self._evaluator.check_record(record, now))

    def _check_queue(self, state: QueueState) -> None:
        self._publish(lambda now: self._evaluator.check_queue(state, now))

    def _check_silence(self) -> None:
        self._publish(self._evaluator.check_silence)
        if time.monotonic() > self._saved + SAVE_INTERVAL_S:
            self._save()

    def _command(self, command: AlarmCommand) -> None:
        self._publish(lambda now: self._evaluator.command(command, now))

    def _publish(self, evaluate: Callable[[float], list[Alarm]]) -> None:
        with self._lock:
            alarms = evaluate(time.time())
        for alarm in alarms:
            self._bus.events.send("alarm", alarm)
            if alarm.muted_until < time.time():
                self._notify(alarm)
                self._notifier.add(alarm)
        if alarms:  # saved before they are sent: what arrived somewhere isn't raised again by a restarted node
            self._save()
            self._notifier.send()

    def _save(self) -> None:
        """Replace the state file."""
        self._saved = time.monotonic()
        temporary = self._state.with_suffix(".tmp")
        try:
            with self._file_lock:
                with self._lock:
                    text = json.dumps(self._evaluator.saved() | {"seen": self._bus.events.deduplicator.saved()})
                temporary.write_text(text, encoding="utf-8")
                temporary.replace(self._state)
        except OSError as error:
            log.warning("the state of the alarms can't be saved: %s", error)

    def destroy_node(self) -> Any:
        """Leave the bus and destroy the node."""
        self._save()
        self._bus.close()
        self._notifier.close()
        return super().destroy_node()


def _restore(evaluator: RuleEvaluator, path: Path) -> dict[str, int]:
    """Continue from a state file, if there is one; one that is damaged is ignored with a warning.

    Returns:
        The state of the deduplicator.
    """
    if path.is_file():
        try:
            saved = json.loads(path.read_text(encoding="utf-8"))
            evaluator.restore(saved)
            return {str(producer): int(number) for producer, number in saved.get("seen", {}).items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            log.warning("%s is ignored: it isn't the state of alarms (%s)", path, error)
    return {}

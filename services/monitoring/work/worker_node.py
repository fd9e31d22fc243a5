"""Node that queues the events of a topic for local worker processes, scaled on request of the autoscaler."""

from __future__ import annotations

import json
import shlex
import shutil
import time
from typing import Any

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.monitoring.events.bus import Bus
from scan2sim.services.monitoring.events.schema import QueueState, WorkersWanted
from scan2sim.services.monitoring.node.monitor import STRING, Monitor, ros
from scan2sim.services.monitoring.settings.bus import BusParams
from scan2sim.services.monitoring.settings.monitor import WorkParams
from scan2sim.services.monitoring.work.local_workers import LocalWorkers
from scan2sim.services.monitoring.work.queue import EventQueue
from scan2sim.services.transport import Arrival, QoS

EVENTS_QOS = QoS(depth=1000)


class WorkerNode(Monitor):
    """Treats the strings on a topic as events; publishes the state of its queue once per period.

    Attributes:
        queue: its event queue, named like the topic.
    """

    def __init__(self, params: WorkParams, node_name: str = "work") -> None:
        """Create the node and start the first worker.

        Raises:
            SettingError: there is no such worker program.
        """
        command = _command(params.command)
        super().__init__(node_name, **params.monitor_settings())
        self.queue = EventQueue(params.topic, params.queue_length, params.when_full)
        self._workers = LocalWorkers(self.queue, command, params.deadline)
        self._max_workers, self._with_text = params.max_workers, params.with_text
        self._sent: float | None = None
        self._bus = Bus(self, BusParams.of_node(params, params.events_topic))
        self.drops.append(self._bus.dropped)
        self._bus.events.on("workers", self._scale)
        self._bus.start()
        self.create_subscription(ros.message_type(STRING), params.topic, self._enqueue, EVENTS_QOS)
        self._reported = time.monotonic()
        self._workers.scale(1)
        self.create_timer(params.period, self._report_queue)

    def received(self, arrival: Arrival) -> None:
        """Store the source timestamp of the message that is passed to `_enqueue` next."""
        super().received(arrival)
        self._sent = arrival.sent / 1e9 if arrival.sent is not None else None

    def _enqueue(self, message: Any) -> None:
        sent = self._sent if self._sent is not None else time.time()
        event = {"sent": sent, "size": len(message.data)} | ({"text": message.data} if self._with_text else {})
        self.queue.put(json.dumps(event), sent)

    def _scale(self, wanted: WorkersWanted) -> None:
        if wanted.queue == self.queue.name:
            self._workers.scale(min(self._max_workers, wanted.workers))

    def _report_queue(self) -> None:
        now = time.monotonic()
        state: QueueState = self.queue.state(now - self._reported, self._workers.workers())
        self._reported = now
        self._bus.events.send("queue", state)

    def destroy_node(self) -> Any:
        """Stop the workers and destroy the node."""
        self._workers.close()
        self._bus.close()
        return super().destroy_node()


def _command(text: str) -> list[str]:
    """Program and arguments of a worker.

    Raises:
        SettingError: the quotes aren't closed, or there is no such program.
    """
    remedy = "Name a program by its path, or one that is on the PATH, with its arguments"
    try:
        command = shlex.split(text)
    except ValueError as error:
        raise SettingError("WORKER", f"{text!r:.80} can't be read ({error})", remedy) from None
    if not command or shutil.which(command[0]) is None:
        raise SettingError("WORKER", f"there is no program {text!r:.80}", remedy)
    return command

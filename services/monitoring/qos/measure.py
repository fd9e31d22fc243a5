"""Measure the event bus's quality of service: a publisher of events, a network and a subscriber (D3.2, table 3)."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

from scan2sim.pipeline.core.errors import StepError
from scan2sim.pipeline.core.step import Report
from scan2sim.services.monitoring.qos import peer
from scan2sim.services.monitoring.qos.peer import Received
from scan2sim.services.qos import deployment
from scan2sim.services.qos.environments import network
from scan2sim.services.qos.host_load import Machine, Usage, host_values, machine
from scan2sim.services.qos.measure import module_environment
from scan2sim.services.qos.requirements import Environment


@dataclass(frozen=True)
class Measurement:
    """Results of a measurement.

    Attributes:
        events: what the subscriber received.
        usage: resources used by the subscriber; machine: hardware it ran on.
        seconds: duration, until the last event was received.
        wire_bytes: bytes transferred over the network, both ways, with overhead; None: no network.
    """

    events: Received
    usage: Usage
    machine: Machine
    seconds: float
    wire_bytes: int | None

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Confidence bounds of metrics that are shares of the events."""
        return self.events.bounds()

    def values(self) -> dict[str, float | None]:
        """Values of the metrics of `requirements.Requirements`; None: not applicable."""
        events = self.events
        return {
            "response_time": None,
            "delay": events.delay,
            "jitter": events.jitter,
            "data_rate": events.bytes * 8e-6 / max(events.seconds, 1e-9),
            "bandwidth": None if self.wire_bytes is None else self.wire_bytes * 8e-6 / self.seconds,
            "loss_rate": 1 - events.received / events.sent,
            "error_rate": events.corrupted / max(1, events.received),
            **host_values(self.machine, self.usage),
        }


def measure(
    environment: Environment, network_file: Path | None, rate: float, size: int, seconds: float, report: Report
) -> Measurement:
    """Publish events over an environment's network.

    Args:
        environment: environment of the subscriber.
        network_file: replaces the environment's assumed network.
        rate: events per second.
        size: bytes of an event.
        seconds: duration of publishing.
        report: progress callback.

    Raises:
        UnavailableError: a network can't be created here (it requires root).
        StepError: publisher or subscriber failed.
    """
    import psutil

    command = (sys.executable, "-m", peer.__name__)
    link = network(environment, network_file)
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": module_environment()}
    with deployment.open_hosts(link) as hosts:
        subscriber = hosts.start_service(*command, "receive", **options)
        publisher = hosts.start_robot(*command, "publish", rate, size, seconds, **options)
        try:
            assert subscriber.stdout
            subscriber.stdout.readline()
            usage, before, began = Usage.start(psutil.Process(subscriber.pid)), hosts.wire_bytes(), time.monotonic()
            while subscriber.poll() is None and publisher.poll() is None:
                usage = usage.updated()
                report(min(1.0, (time.monotonic() - began) / seconds), f"events are published for {seconds:.0f} s")
                time.sleep(0.2)
            transferred, took = hosts.wire_bytes() - before, time.monotonic() - began
            line, errors = subscriber.communicate(timeout=peer.DISCOVERY_TIMEOUT_S + 2 * peer.SILENCE_S)
        finally:
            for process in (publisher, subscriber):
                process.kill()
                process.wait()
    if subscriber.returncode:
        raise StepError("the subscriber", f"failed ({errors.strip()[-300:]})", "Report it as a bug")
    events = Received(**json.loads(line))
    sent = max(events.sent, round(rate * seconds))  # the subscriber may have missed the last ones
    return Measurement(replace(events, sent=sent), usage, machine(), took, transferred if link else None)

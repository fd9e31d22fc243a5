"""Hosts of the robot and the service: both on this machine, or at the two ends of an emulated link."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from scan2sim.pipeline.core.errors import StepError
from scan2sim.services.qos import probe as probe_module
from scan2sim.services.qos.emulated_link import Link
from scan2sim.services.qos.environments import Network
from scan2sim.services.qos.probe import ProbeResult

PROBE_RATE, MAX_PROBE_RATE, PROBE_PORT = 200.0, 1000.0, 9100
"""Packets per second that probe the network, usually and at most, and the UDP port that receives them."""
PROBE_TIMEOUT_S = 60.0


class Hosts(Protocol):
    """Host of the robot and host of the service, and the network between them.

    Attributes:
        address: address of the service's host, as seen by the robot.
    """

    address: str

    def start_robot(self, *command: object, **options: Any) -> subprocess.Popen[Any]:
        """Start a program on the robot's host."""

    def start_service(self, *command: object, **options: Any) -> subprocess.Popen[Any]:
        """Start a program on the service's host."""

    def wire_bytes(self) -> int:
        """Bytes transferred so far, both ways."""

    def probe_result(self, probe: Any) -> ProbeResult | None:
        """Wait for a probe and return its result; None: no network."""

    def start_probe(self, seconds: float, rate: float = PROBE_RATE) -> Any:
        """Start probing the network for a number of seconds, with `rate` packets per second."""


class SameHost:
    """Robot and service on this machine, without a network."""

    address = "127.0.0.1"

    def start_robot(self, *command: object, **options: Any) -> subprocess.Popen[Any]:
        """See `Hosts`."""
        return subprocess.Popen([str(one) for one in command], **options)

    start_service = start_robot

    def wire_bytes(self) -> int:
        """Always 0."""
        return 0

    def start_probe(self, seconds: float, rate: float = PROBE_RATE) -> None:
        """No network, no probe."""

    def probe_result(self, probe: None) -> None:
        """No network, no result."""


class LinkedHosts:
    """Robot at the near end of an emulated link, service at its far end."""

    def __init__(self, link: Link) -> None:
        self._link, self.address = link, link.far.address

    def start_robot(self, *command: object, **options: Any) -> subprocess.Popen[Any]:
        """See `Hosts`."""
        return self._link.near.popen(*command, **options)

    def start_service(self, *command: object, **options: Any) -> subprocess.Popen[Any]:
        """See `Hosts`."""
        return self._link.far.popen(*command, **options)

    def wire_bytes(self) -> int:
        """See `Hosts`."""
        counts = self._link.near.counts()
        return counts.sent_bytes + counts.received_bytes

    def start_probe(self, seconds: float, rate: float = PROBE_RATE) -> subprocess.Popen[str]:
        """See `Hosts`."""
        command = (sys.executable, "-m", probe_module.__name__)
        receiver = self.start_service(*command, "receive", PROBE_PORT, stdout=subprocess.PIPE, text=True)
        assert receiver.stdout
        receiver.stdout.readline()
        self.start_robot(*command, "send", self.address, PROBE_PORT, rate, seconds)
        return receiver

    def probe_result(self, probe: subprocess.Popen[str]) -> ProbeResult:
        """See `Hosts`."""
        line, _ = probe.communicate(timeout=PROBE_TIMEOUT_S)
        if probe.returncode:
            raise StepError("the network probe", "no packets were received", "Use a link with less loss")
        return ProbeResult(**json.loads(line))


@contextmanager
def open_hosts(network: Network | None) -> Iterator[Hosts]:
    """Hosts at the ends of a network; None: both on this machine.

    Raises:
        UnavailableError: a network can't be created here (it requires root).
    """
    if network is None:
        yield SameHost()
        return
    with Link(network.there, network.back) as link:
        yield LinkedHosts(link)

"""Where a robot's and a service's programs run: both on this machine, or each at an end of a shaped link."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from scan2sim.pipeline.core.errors import StepError
from scan2sim.services.qos import probe
from scan2sim.services.qos.emulated_link import Link
from scan2sim.services.qos.environments import Network
from scan2sim.services.qos.probe import Seen

PROBES, PORT = 200.0, 9100
"""Packets a second that probe a network, and where they are received."""
REPORTS_WITHIN = 60.0


class Places(Protocol):
    """Two places, and what is between them.

    Attributes:
        address: of the service's place, as the robot sees it.
    """

    address: str

    def robot(self, *command: object, **named: Any) -> subprocess.Popen[Any]:
        """Start a program where the robot is."""

    def service(self, *command: object, **named: Any) -> subprocess.Popen[Any]:
        """Start a program where the service is."""

    def bytes(self) -> int:
        """That went through the network, both ways, so far."""

    def seen(self, probing: Any) -> Seen | None:
        """What probes that were begun have seen; None: there is no network."""

    def probe(self, seconds: float) -> Any:
        """Begin to probe the network, for so long."""


class Here:
    """Both on this machine: there is no network."""

    address = "127.0.0.1"

    def robot(self, *command: object, **named: Any) -> subprocess.Popen[Any]:
        """See `Places`."""
        return subprocess.Popen([str(one) for one in command], **named)

    service = robot

    def bytes(self) -> int:
        """None."""
        return 0

    def probe(self, seconds: float) -> None:
        """Nothing."""

    def seen(self, probing: None) -> None:
        """Nothing."""


class Apart:
    """At the ends of a link: the robot at the near one, the service at the far one."""

    def __init__(self, link: Link) -> None:
        self._link, self.address = link, link.far.address

    def robot(self, *command: object, **named: Any) -> subprocess.Popen[Any]:
        """See `Places`."""
        return self._link.near.popen(*command, **named)

    def service(self, *command: object, **named: Any) -> subprocess.Popen[Any]:
        """See `Places`."""
        return self._link.far.popen(*command, **named)

    def bytes(self) -> int:
        """See `Places`."""
        counts = self._link.near.counts()
        return counts.sent_bytes + counts.received_bytes

    def probe(self, seconds: float) -> subprocess.Popen[str]:
        """See `Places`."""
        command = (sys.executable, "-m", probe.__name__)
        receiver = self.service(*command, "receive", PORT, stdout=subprocess.PIPE, text=True)
        assert receiver.stdout
        receiver.stdout.readline()
        self.robot(*command, "send", self.address, PORT, PROBES, seconds)
        return receiver

    def seen(self, probing: subprocess.Popen[str]) -> Seen:
        """See `Places`."""
        line, _ = probing.communicate(timeout=REPORTS_WITHIN)
        if probing.returncode:
            raise StepError("the network's probe", "got no packets through", "Make the link less bad")
        return Seen(**json.loads(line))


@contextmanager
def between(network: Network | None) -> Iterator[Places]:
    """The places at the ends of a network; None: both are this machine.

    Raises:
        UnavailableError: no network can be made here (it takes root).
    """
    if network is None:
        yield Here()
        return
    with Link(network.there, network.back) as link:
        yield Apart(link)

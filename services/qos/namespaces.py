"""Machines made up of one: network namespaces, and what runs in them.

They are gone with the process that made them, however that ends: a shell waits for it, and clears up.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import UnavailableError

WHAT = "a shaped link"
CLEAR = """
read -r _
for name in "$2" "$3"; do
  while pids=$(ip netns pids "$name") && [ -n "$pids" ]; do kill -9 $pids; done
  ip netns delete "$name"
done 2>/dev/null
rm -rf "$1"
"""
"""A shell's script: ends what runs in two namespaces, and them, when there is input or no more of it."""
_numbers = itertools.count()


@dataclass(frozen=True)
class Counts:
    """Of an interface since it was made; bytes are those of Ethernet frames, without their checksums."""

    received_packets: int
    received_bytes: int
    sent_packets: int
    sent_bytes: int


class Namespace:
    """A namespace with an interface a wire, beside its loopback; wires count from 0."""

    def __init__(self, name: str, host: int) -> None:
        """`host`: the last number of its addresses."""
        self.name, self._host = name, host
        self._started: list[subprocess.Popen[Any]] = []
        ip("netns", "add", name)

    @property
    def address(self) -> str:
        """On the first wire (IPv4)."""
        return self.address_on(0)

    def address_on(self, wire: int) -> str:
        """On a wire: each is a network of 24 bits."""
        return f"10.0.{wire}.{self._host}"

    @staticmethod
    def interface(wire: int = 0) -> str:
        """Its name, on both sides."""
        return f"wire{wire}"

    def up(self, wire: int = 0) -> None:
        """Give an interface its address, once it is there."""
        ip("-n", self.name, "link", "set", "dev", "lo", "up")
        ip("-n", self.name, "address", "add", f"{self.address_on(wire)}/24", "dev", self.interface(wire))
        ip("-n", self.name, "link", "set", "dev", self.interface(wire), "up")

    def know(self, other: Namespace, wire: int = 0) -> None:
        """Never ask for another's hardware address: on a link that loses packets, that takes seconds."""
        address = json.loads(ip("-j", "-n", other.name, "link", "show", "dev", other.interface(wire)))[0]["address"]
        known = ["lladdr", address, "dev", self.interface(wire), "nud", "permanent"]
        ip("-n", self.name, "neighbour", "replace", other.address_on(wire), *known)

    def ready(self, wire: int = 0) -> bool:
        """Whether an interface is there."""
        done = self.run("ip", "link", "show", "dev", self.interface(wire), capture_output=True)
        return done.returncode == 0

    def inside(self, *command: object) -> list[str]:
        """A command that runs another in here."""
        return ["ip", "netns", "exec", self.name, *map(str, command)]

    def popen(self, *command: object, priority: int = 0, **named: Any) -> subprocess.Popen[Any]:
        """Start a program here, as `subprocess.Popen` does; it ends with the namespace.

        `priority`: from 1 to 99, it goes before what else wants a processor, where this process may say so (real-time
        scheduling, in turn); 0: it is as others.
        """
        started = subprocess.Popen(self.inside(*command), **named)
        self._started.append(started)
        if priority:
            with contextlib.suppress(PermissionError):
                os.sched_setscheduler(started.pid, os.SCHED_RR, os.sched_param(priority))
        return started

    def run(self, *command: object, **named: Any) -> subprocess.CompletedProcess[Any]:
        """Run a program here to its end, as `subprocess.run` does."""
        return subprocess.run(self.inside(*command), **named)

    def counts(self, wire: int = 0) -> Counts:
        """What went through an interface."""
        told = json.loads(ip("-j", "-s", "-n", self.name, "link", "show", "dev", self.interface(wire)))[0]["stats64"]
        return Counts(told["rx"]["packets"], told["rx"]["bytes"], told["tx"]["packets"], told["tx"]["bytes"])

    def reap(self) -> None:
        """Wait for what was started here, after it was ended."""
        for process in self._started:
            process.wait()


@contextlib.contextmanager
def pair() -> Iterator[tuple[Namespace, Namespace, Path]]:
    """Two namespaces, yet without their interfaces, and a folder for their programs.

    Raises:
        UnavailableError: this process may not make any.
    """
    if os.geteuid() != 0:
        raise UnavailableError(WHAT, "only root may make network namespaces", "Run it as root (sudo)")
    name = f"scan2sim-{os.getpid()}-{next(_numbers)}"
    folder = Path(tempfile.mkdtemp(prefix=f"{name}-"))
    sides = [f"{name}-near", f"{name}-far"]
    # a session of its own, so that what ends this process by its group leaves it
    clearing = subprocess.Popen(
        ["sh", "-c", CLEAR, "clear", str(folder), *sides], stdin=subprocess.PIPE, start_new_session=True
    )
    made: list[Namespace] = []
    try:
        for number, side in enumerate(sides, 1):
            made.append(Namespace(side, number))
        yield made[0], made[1], folder
    finally:
        clearing.communicate(b"\n")  # not only by closing: a child forked meanwhile would hold it open
        for one in made:
            one.reap()


def ip(*arguments: str) -> str:
    """What iproute2's `ip` prints.

    Raises:
        UnavailableError: it is missing, or refuses.
    """
    if shutil.which("ip") is None:
        raise UnavailableError(WHAT, "needs ip, not installed here", "apt-get install iproute2")
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True)
    if done.returncode:
        cause = f"ip {' '.join(arguments)} failed ({done.stderr.strip()})"
        raise UnavailableError(WHAT, cause, "In a container, allow it CAP_SYS_ADMIN and CAP_NET_ADMIN")
    return done.stdout

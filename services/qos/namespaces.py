"""Network namespaces that act as separate hosts, and the processes in them.

They are removed with the process that created them, even if it is killed: a shell waits for its end and cleans up.
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

FEATURE = "a shaped link"
CLEANUP_SCRIPT = """
read -r _
for name in "$2" "$3"; do
  while pids=$(ip netns pids "$name") && [ -n "$pids" ]; do kill -9 $pids; done
  ip netns delete "$name"
done 2>/dev/null
rm -rf "$1"
"""
"""Shell script: after input or its end, kills all processes in two namespaces and removes the namespaces."""
_numbers = itertools.count()


@dataclass(frozen=True)
class Counts:
    """Traffic of an interface since its creation; bytes of Ethernet frames without checksum."""

    received_packets: int
    received_bytes: int
    sent_packets: int
    sent_bytes: int


class Namespace:
    """A network namespace with a loopback interface and one interface per wire, numbered from 0."""

    def __init__(self, name: str, host: int) -> None:
        """Create the namespace; `host` is the last number of its IPv4 addresses."""
        self.name, self._host = name, host
        self._started: list[subprocess.Popen[Any]] = []
        ip("netns", "add", name)

    @property
    def address(self) -> str:
        """IPv4 address on the first wire."""
        return self.address_on(0)

    def address_on(self, wire: int) -> str:
        """IPv4 address on a wire; each wire is a /24 network."""
        return f"10.0.{wire}.{self._host}"

    @staticmethod
    def interface(wire: int = 0) -> str:
        """Name of a wire's interface, the same on both sides."""
        return f"wire{wire}"

    def bring_up(self, wire: int = 0) -> None:
        """Assign the address of an existing interface and enable it."""
        ip("-n", self.name, "link", "set", "dev", "lo", "up")
        ip("-n", self.name, "address", "add", f"{self.address_on(wire)}/24", "dev", self.interface(wire))
        ip("-n", self.name, "link", "set", "dev", self.interface(wire), "up")

    def add_static_neighbour(self, other: Namespace, wire: int = 0) -> None:
        """Add a static ARP entry: address resolution takes seconds on a link that loses packets."""
        address = json.loads(ip("-j", "-n", other.name, "link", "show", "dev", other.interface(wire)))[0]["address"]
        entry = ["lladdr", address, "dev", self.interface(wire), "nud", "permanent"]
        ip("-n", self.name, "neighbour", "replace", other.address_on(wire), *entry)

    def has_interface(self, wire: int = 0) -> bool:
        """Whether a wire's interface exists."""
        done = self.run("ip", "link", "show", "dev", self.interface(wire), capture_output=True)
        return done.returncode == 0

    def command_inside(self, *command: object) -> list[str]:
        """Command line that runs a command in the namespace."""
        return ["ip", "netns", "exec", self.name, *map(str, command)]

    def popen(self, *command: object, priority: int = 0, **options: Any) -> subprocess.Popen[Any]:
        """Start a program in the namespace, like `subprocess.Popen`; it is killed with the namespace.

        `priority`: real-time priority from 1 to 99 (round-robin scheduling), if permitted; 0: normal scheduling.
        """
        started = subprocess.Popen(self.command_inside(*command), **options)
        self._started.append(started)
        if priority:
            with contextlib.suppress(PermissionError):
                os.sched_setscheduler(started.pid, os.SCHED_RR, os.sched_param(priority))
        return started

    def run(self, *command: object, **options: Any) -> subprocess.CompletedProcess[Any]:
        """Run a program in the namespace, like `subprocess.run`."""
        return subprocess.run(self.command_inside(*command), **options)

    def counts(self, wire: int = 0) -> Counts:
        """Traffic of a wire's interface."""
        stats = json.loads(ip("-j", "-s", "-n", self.name, "link", "show", "dev", self.interface(wire)))[0]["stats64"]
        return Counts(stats["rx"]["packets"], stats["rx"]["bytes"], stats["tx"]["packets"], stats["tx"]["bytes"])

    def kill_started(self) -> None:
        """Kill the processes started here: one that hasn't entered the namespace yet isn't found there."""
        for process in self._started:
            process.kill()

    def wait_for_processes(self) -> None:
        """Wait until all processes started here have ended."""
        for process in self._started:
            process.wait()


@contextlib.contextmanager
def pair() -> Iterator[tuple[Namespace, Namespace, Path]]:
    """Create two namespaces, without interfaces yet, and a folder for their programs.

    Raises:
        UnavailableError: this process isn't permitted to create namespaces.
    """
    if os.geteuid() != 0:
        raise UnavailableError(FEATURE, "only root may create network namespaces", "Run it as root (sudo)")
    name = f"scan2sim-{os.getpid()}-{next(_numbers)}"
    folder = Path(tempfile.mkdtemp(prefix=f"{name}-"))
    sides = [f"{name}-near", f"{name}-far"]
    # a session of its own survives if the process group of this process is killed
    cleanup = subprocess.Popen(
        ["sh", "-c", CLEANUP_SCRIPT, "clear", str(folder), *sides], stdin=subprocess.PIPE, start_new_session=True
    )
    made: list[Namespace] = []
    try:
        for number, side in enumerate(sides, 1):
            made.append(Namespace(side, number))
        yield made[0], made[1], folder
    finally:
        for one in made:
            one.kill_started()
        cleanup.communicate(b"\n")  # closing alone isn't enough: a forked child may still hold the pipe
        for one in made:
            one.wait_for_processes()


def ip(*arguments: str) -> str:
    """Run iproute2's `ip` and return its output.

    Raises:
        UnavailableError: it is missing or fails.
    """
    if shutil.which("ip") is None:
        raise UnavailableError(FEATURE, "needs ip, which isn't installed", "apt-get install iproute2")
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True)
    if done.returncode:
        cause = f"ip {' '.join(arguments)} failed ({done.stderr.strip()})"
        raise UnavailableError(FEATURE, cause, "In a container, grant CAP_SYS_ADMIN and CAP_NET_ADMIN")
    return done.stdout

"""Ports and DDS domains for servers that tests start, unique among concurrent test runs on a machine.

Each is reserved by a lock on a file in the temporary folder, held until the process ends, and checked to be unused:
servers of a killed run may still be stopping.
"""

from __future__ import annotations

import fcntl
import os
import random
import socket
import tempfile
from collections.abc import Callable
from pathlib import Path

PORTS = range(20_000, 32_000)  # below the kernel's range of ephemeral ports
DDS_DOMAINS = range(1, 100)
_locks: list[int] = []


def free_port() -> int:
    """A TCP port on which nothing listens, reserved until this process ends."""
    return _reserved("port", PORTS, lambda port: _can_bind(port, socket.SOCK_STREAM))


def free_dds_domain() -> int:
    """A DDS domain without participants, reserved until this process ends."""
    return _reserved("domain", DDS_DOMAINS, lambda domain: _can_bind(7400 + 250 * domain, socket.SOCK_DGRAM))


def _reserved(kind: str, numbers: range, unused: Callable[[int], bool]) -> int:
    """Reserve a number that is unused and not locked by another process; random, so that runs rarely collide."""
    folder = Path(tempfile.gettempdir()) / f"scan2sim-tests-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    for number in random.sample(numbers, len(numbers)):
        lock = os.open(folder / f"{kind}-{number}", os.O_CREAT | os.O_RDWR)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            continue
        if unused(number):
            _locks.append(lock)
            return number
        os.close(lock)
    raise RuntimeError(f"no free {kind} in {numbers}")


def _can_bind(port: int, kind: socket.SocketKind) -> bool:
    with socket.socket(socket.AF_INET, kind) as probe:
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True

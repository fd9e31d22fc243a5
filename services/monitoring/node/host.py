"""What is to be known of the machine that a node runs on: its name, addresses and load (D3.2, section 3.1)."""

from __future__ import annotations

import socket
import time
from functools import cache
from typing import Any

import psutil

REFRESHED = 10.0
"""Seconds for which addresses and disks are taken as they were."""


@cache
def hostname() -> str:
    """This machine's name."""
    return socket.gethostname()


class Machine:
    """Reads the machine's load; what changes seldom is read seldom."""

    def __init__(self) -> None:
        self._read_at = -REFRESHED
        self._seldom: dict[str, Any] = {}
        psutil.cpu_percent()  # the first is of no period

    def read(self) -> dict[str, Any]:
        """By the names of D3.2's code snippet 4; percent of the processors since the last reading."""
        if time.monotonic() - self._read_at >= REFRESHED:
            self._read_at = time.monotonic()
            addresses = local_ips()
            self._seldom = {
                "local ip": addresses[0] if addresses else "",
                "local ips": addresses,
                "disk usage": list(psutil.disk_usage("/")),
            }
        return {
            "hostname": hostname(),
            **self._seldom,
            "cpu times": psutil.cpu_times()._asdict(),
            "cpu percent": psutil.cpu_percent(),
            "virtual memory": psutil.virtual_memory()._asdict(),
        }


def local_ips() -> list[str]:
    """Addresses of interfaces that are up, without loopback; IPv4 before IPv6."""
    up = {name for name, told in psutil.net_if_stats().items() if told.isup}
    found = [
        (address.family, address.address.partition("%")[0])
        for name, addresses in psutil.net_if_addrs().items()
        if name in up
        for address in addresses
        if address.family in (socket.AF_INET, socket.AF_INET6)
    ]
    return [address for _, address in sorted(found) if address not in ("127.0.0.1", "::1")]

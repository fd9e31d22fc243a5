"""Host metrics: name, addresses and load of the machine that a node runs on (D3.2, section 3.1)."""

from __future__ import annotations

import socket
import time
from functools import cache
from typing import Any

import psutil

REFRESH_INTERVAL_S = 10.0
"""How long addresses and disk usage are cached."""


@cache
def hostname() -> str:
    """This machine's name."""
    return socket.gethostname()


class HostMetrics:
    """Reads the machine's load; values that change rarely are cached for `REFRESH_INTERVAL_S`."""

    def __init__(self) -> None:
        self._refreshed_at = -REFRESH_INTERVAL_S
        self._cached: dict[str, Any] = {}
        psutil.cpu_percent()  # starts the first period of measurement

    def read(self) -> dict[str, Any]:
        """Metrics by the field names of D3.2's code snippet 4; CPU percent since the last call."""
        if time.monotonic() - self._refreshed_at >= REFRESH_INTERVAL_S:
            self._refreshed_at = time.monotonic()
            addresses = local_ips()
            self._cached = {
                "local ip": addresses[0] if addresses else "",
                "local ips": addresses,
                "disk usage": list(psutil.disk_usage("/")),
            }
        return {
            "hostname": hostname(),
            **self._cached,
            "cpu times": psutil.cpu_times()._asdict(),
            "cpu percent": psutil.cpu_percent(),
            "virtual memory": psutil.virtual_memory()._asdict(),
        }


def local_ips() -> list[str]:
    """Addresses of the network interfaces that are up, without loopback; IPv4 before IPv6."""
    up = {name for name, stats in psutil.net_if_stats().items() if stats.isup}
    found = [
        (address.family, address.address.partition("%")[0])
        for name, addresses in psutil.net_if_addrs().items()
        if name in up
        for address in addresses
        if address.family in (socket.AF_INET, socket.AF_INET6)
    ]
    return [address for _, address in sorted(found) if address not in ("127.0.0.1", "::1")]

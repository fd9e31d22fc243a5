"""Kernel packet counters (nftables), at the egress or ingress of a network namespace."""

from __future__ import annotations

import json
import subprocess
from typing import Any, Literal, NamedTuple

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.services.qos.links import programs
from scan2sim.services.qos.namespaces import FEATURE, Namespace

NFT_RULES = """
table inet counted {{
  chain {way} {{
    type filter hook {way} priority 0;
    {prefix}ifname "{interface}" udp length {min_bytes}-{max_bytes} counter
  }}
}}
"""


class PacketCount(NamedTuple):
    """Number of packets, and of bytes including IP headers."""

    packets: int
    bytes: int


class Counter:
    """Counts UDP packets in a range of lengths on a namespace's interface."""

    def __init__(self, side: Namespace, way: Literal["input", "output"], min_bytes: int, max_bytes: int) -> None:
        """Start counting.

        Args:
            side: namespace of the interface.
            way: direction; "output" counts packets before the link can drop them.
            min_bytes, max_bytes: lengths including the UDP header, inclusive.

        Raises:
            UnavailableError: nft is missing, or the kernel has no nftables.
        """
        if unavailable := programs(nft="nftables"):
            raise UnavailableError(FEATURE, *unavailable)
        self._side = side
        rules = NFT_RULES.format(
            way=way, prefix=way[0], interface=side.interface(), min_bytes=min_bytes, max_bytes=max_bytes
        )
        self._nft("-f", "-", rules=rules)

    def read(self) -> PacketCount:
        """Packets counted so far."""
        for one in json.loads(self._nft("-j", "list", "table", "inet", "counted"))["nftables"]:
            for expression in one.get("rule", {}).get("expr", ()):
                if "counter" in expression:
                    return PacketCount(expression["counter"]["packets"], expression["counter"]["bytes"])
        raise UnavailableError(FEATURE, "the kernel's counter is gone", "Don't change the nftables table `counted`")

    def _nft(self, *arguments: str, rules: str | None = None) -> Any:
        done: subprocess.CompletedProcess[str] = self._side.run(
            "nft", *arguments, input=rules, capture_output=True, text=True
        )
        if done.returncode:
            raise UnavailableError(FEATURE, f"nft failed ({done.stderr.strip()})", "modprobe nf_tables")
        return done.stdout

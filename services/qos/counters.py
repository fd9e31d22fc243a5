"""Packets as the kernel counts them (nftables), where they leave a namespace or where they come in."""

from __future__ import annotations

import json
import subprocess
from typing import Any, Literal, NamedTuple

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.services.qos.links import programs
from scan2sim.services.qos.namespaces import WHAT, Namespace

RULES = """
table inet counted {{
  chain {way} {{
    type filter hook {way} priority 0;
    {of}ifname "{interface}" udp length {least}-{most} counter
  }}
}}
"""


class Counted(NamedTuple):
    """Packets, and bytes with the headers of IP."""

    packets: int
    bytes: int


class Counter:
    """Counts UDP packets of some lengths on a namespace's interface."""

    def __init__(self, side: Namespace, way: Literal["input", "output"], least: int, most: int) -> None:
        """Count from now on.

        Args:
            side: where.
            way: those that come in, or that leave; what leaves is counted before a link can drop it.
            least, most: bytes with the header of UDP, both counted.

        Raises:
            UnavailableError: nft is missing, or the kernel has no nftables.
        """
        if lacking := programs(nft="nftables"):
            raise UnavailableError(WHAT, *lacking)
        self._side = side
        rules = RULES.format(way=way, of=way[0], interface=side.interface(), least=least, most=most)
        self._nft("-f", "-", rules=rules)

    def read(self) -> Counted:
        """What was counted so far."""
        for one in json.loads(self._nft("-j", "list", "table", "inet", "counted"))["nftables"]:
            for said in one.get("rule", {}).get("expr", ()):
                if "counter" in said:
                    return Counted(said["counter"]["packets"], said["counter"]["bytes"])
        raise UnavailableError(WHAT, "the kernel's counter is gone", "Leave the table `counted` to it")

    def _nft(self, *arguments: str, rules: str | None = None) -> Any:
        done: subprocess.CompletedProcess[str] = self._side.run(
            "nft", *arguments, input=rules, capture_output=True, text=True
        )
        if done.returncode:
            raise UnavailableError(WHAT, f"nft failed ({done.stderr.strip()})", "modprobe nf_tables")
        return done.stdout

"""A publisher and a monitor at the two ends of an emulated link, each in a network namespace of its own."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from scan2sim.services.qos.emulated_link import Link
from scan2sim.services.qos.namespaces import Namespace
from tests.conftest import ROOT
from tests.fakes.interpreters import PYTHONS
from tests.fakes.nodes import json_lines
from tests.waiting import until

MESSAGE_CHARS = 1000
"""Characters of a message, which fits into one packet."""
MESSAGE_BYTES = MESSAGE_CHARS + 9
"""Size of a serialized message: 4 bytes of encapsulation, 4 of length, the text and its terminator."""
PACKET_BYTES = (MESSAGE_CHARS, MESSAGE_CHARS + 400)
"""Minimum and maximum size of a packet with a message, including UDP and RTPS headers; other packets are smaller."""
CLOCK_OFFSET_S = {"cyclone": 0.5, "rclpy": 0.0}
"""Clock offset of the other machine; none for rclpy, which stamps messages in C++ code that can't be patched."""
TIMEOUT_S = 60.0
"""Seconds within which nodes must discover each other, write the records that are awaited, and end."""
QUIET_RECORDS = 2
"""Records without messages in a row after which the link has delivered everything."""


class MonitorLog:
    """Records of a monitor on the far side."""

    def __init__(self, log: Path, process: subprocess.Popen[Any]) -> None:
        self._log, self._process = log, process
        self.flows: list[dict[str, Any]] = []

    def read(self) -> None:
        """Read all flows written so far, with the `time` and `period` of their records."""
        records = json_lines(self._log)
        self.flows = [flow | {key: one[key] for key in ("time", "period")} for one in records for flow in one["flows"]]

    def wait_for_records(self, count: int) -> float:
        """Wait for further records with messages; returns the time of the last one."""
        self.read()
        known = len(self.flows)

        def further() -> list[float]:
            return [flow["time"] for flow in self.flows[known:] if flow["messages"]]

        self._wait(lambda: len(further()) >= count)
        return further()[count - 1]

    def wait_until_quiet(self) -> None:
        """Wait until no messages arrive any more."""
        self.read()
        known = len(self.flows)
        self._wait(
            lambda: (
                len(self.flows) >= known + QUIET_RECORDS
                and not any(flow["messages"] for flow in self.flows[-QUIET_RECORDS:])
            )
        )

    def wait_for(self, condition: Callable[[dict[str, Any]], Any]) -> None:
        """Wait until some flow meets a condition."""
        self._wait(lambda: any(map(condition, self.flows)))

    def _wait(self, condition: Callable[[], bool]) -> None:
        def is_met() -> bool:
            if self._process.poll() is not None:
                raise RuntimeError("the monitor has ended")
            self.read()
            return condition()

        until(is_met, TIMEOUT_S, what="records of the monitor", state=lambda: self.flows[-3:])


@contextmanager
def monitored(link: Link, transport: str, interval: float, machines: bool = False) -> Iterator[MonitorLog]:
    """A talker on the near side and a monitor on the far side; at the end, records cover everything that was sent."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "watch.log"
        monitor = _start(link.far, transport, "watch", path, *(("--machine", "far") if machines else ()))
        other = ("--machine", "near", "--ahead", CLOCK_OFFSET_S[transport]) if machines else ()
        options = ("--size", MESSAGE_CHARS, "--interval", interval)
        talker = _start(link.near, transport, "talk", Path(name) / "talk.log", *options, *other)
        log = MonitorLog(path, monitor)
        log.wait_for(lambda flow: flow["messages"])
        yield log
        talker.terminate()
        talker.wait(TIMEOUT_S)
        log.wait_until_quiet()
        monitor.terminate()
        monitor.wait(TIMEOUT_S)
        log.read()


def _start(side: Namespace, transport: str, *arguments: object) -> subprocess.Popen[Any]:
    variables = {"SCAN2SIM_TRANSPORT": transport, "PYTHONPATH": str(ROOT)}
    variables |= {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}  # both ends could use this machine's shared memory
    command = (PYTHONS[transport], "-m", "tests.fakes.link_node", *arguments)
    return side.popen(*command, env=os.environ | variables, cwd=ROOT)

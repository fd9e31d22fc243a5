"""What monitors tell, held against shaped links (part `link` of `bench.bus`): bandwidth, losses and latency.

A watched node talks in one network namespace, a monitor watches the topic in another, and the link between them
(`services.qos.emulated_link`) is as slow, late or lossy as is set. Wants root, nftables and what shapes links.

- bandwidth: more is published than the link lets through. The truth is the rate that is set, times the share of
  messages' own bytes in what came by the interface: the kernel counts both.
- losses: each message is a packet of its own. The truth is the packets that left by the one interface and didn't come
  by the other, as the kernel counts them.
- latency: the truth is the delay that is set. What nodes take by themselves is told on a link that does nothing, and
  taken away.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from bench.bus.overhead import ROS_PYTHON
from bench.paths import ROOT
from scan2sim.services.qos.counters import Counter
from scan2sim.services.qos.emulated_link import Link
from scan2sim.services.qos.link_profile import Shape
from scan2sim.services.qos.namespaces import Namespace

PYTHONS = {"cyclone": Path(sys.executable), "rclpy": ROS_PYTHON}
SIZE = 1000
"""Characters of a message, which makes one packet."""
CDR = SIZE + 9
"""Bytes of it: four of encapsulation, four of length, the text and what ends it."""
PACKET = (SIZE, SIZE + 400)
"""Bytes of a packet with a message, headers of UDP and RTPS included; no other packet is so long."""
RATES = (1e6, 2e6, 8e6)
"""Bits a second."""
FLOOD, FLOODED = 2.0, 10.0
"""How much more is published than the link's rate, and for how many seconds it is measured."""
LOSSES = ((Shape(loss=0.01), 100.0), (Shape(loss=0.05), 40.0), (Shape(loss=0.05, burst=5), 40.0))
"""And seconds of a thousand messages each."""
DELAYS = ((0.005, False), (0.02, False), (0.1, False), (0.02, True))
"""Seconds; and whether the ends take themselves for two machines."""
AHEAD = {"cyclone": 0.5, "rclpy": 0.0}
"""Seconds by which the other machine's clock is ahead; rclpy's messages are stamped below Python, where none can be."""
DELAYED = 15.0
"""Seconds that are measured."""
PRIORITY = 10
"""Of nodes: it is the link that is to be seen, not who else works here; the link's own is higher."""
JOINS = 60.0
"""Seconds within which nodes find each other."""


@dataclass(frozen=True)
class Row:
    """A setting, by the transport: what was set, what was to be found by it, what monitors told.

    Attributes:
        what: bandwidth, loss or latency.
        link: what the link did, in words.
        truth, told: bytes a second, shares or seconds.
    """

    what: str
    transport: str
    link: str
    truth: float
    told: float

    @property
    def error(self) -> float:
        """Share of the truth that it is off by."""
        return abs(self.told / self.truth - 1)

    def line(self) -> str:
        """As a line of a table."""
        truth, told = (f"{value:.6g}" for value in (self.truth, self.told))
        return f"{self.what:<10} {self.transport:<8} {self.link:<48} {truth:>10} {told:>10} {self.error:>8.2%}"


class Watch:
    """A monitor on the far side, and what it tells of the topic."""

    def __init__(self, log: Path, process: subprocess.Popen[Any]) -> None:
        self._log, self._process = log, process
        self.flows: list[dict[str, Any]] = []

    def read(self) -> None:
        """Take what it told so far: flows, with the `time` and `period` of their records."""
        lines = self._log.read_text(encoding="utf-8").splitlines(keepends=True) if self._log.exists() else []
        records = [json.loads(line) for line in lines if line.endswith("\n")]
        self.flows = [flow | {key: one[key] for key in ("time", "period")} for one in records for flow in one["flows"]]

    def until(self, told: Callable[[dict[str, Any]], Any]) -> None:
        """Wait until some record tells so."""
        end = time.monotonic() + JOINS
        while not any(map(told, self.flows)):
            if self._process.poll() is not None:
                raise RuntimeError("the node that watches has ended")
            if time.monotonic() > end:
                raise RuntimeError(f"nodes didn't find each other, or clocks, within {JOINS:g} s")
            time.sleep(0.1)
            self.read()


@contextmanager
def watched(link: Link, transport: str, interval: float, machines: bool = False) -> Iterator[Watch]:
    """A talker on the near side, watched from the far one; afterwards all was told of what was sent."""
    with tempfile.TemporaryDirectory() as name:
        log = Path(name) / "watch.log"
        listens = _started(link.far, transport, "watch", log, *(("--machine", "far") if machines else ()))
        other = ("--machine", "near", "--ahead", AHEAD[transport]) if machines else ()
        how = ("--size", SIZE, "--interval", interval)
        talks = _started(link.near, transport, "talk", Path(name) / "talk.log", *how, *other)
        watch = Watch(log, listens)
        watch.until(lambda flow: flow["messages"])
        yield watch
        for process, rest in ((talks, 1.5), (listens, 0.0)):
            process.terminate()
            process.wait(JOINS)
            time.sleep(rest)
        watch.read()


def _started(side: Namespace, transport: str, *arguments: object) -> subprocess.Popen[Any]:
    told = {"SCAN2SIM_TRANSPORT": transport, "PYTHONPATH": str(ROOT)}
    told |= {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}  # both ends have this machine's memory, and would share it
    command = (PYTHONS[transport], "-m", "bench.bus.link_node", *arguments)
    return side.popen(*command, priority=PRIORITY, env=os.environ | told, cwd=ROOT)


def bandwidth(transport: str, rate: float) -> Row:
    """More is published than a rate lets through."""
    with Link(Shape(rate=rate)) as link, watched(link, transport, CDR * 8 / (rate * FLOOD)) as watch:
        time.sleep(2.0)
        came = Counter(link.far, "input", *PACKET)
        before, began = link.far.counts().received_bytes, time.time()
        time.sleep(FLOODED)
        through, packets, ended = link.far.counts().received_bytes - before, came.read().packets, time.time()
    flows = [one for one in watch.flows if began + one["period"] <= one["time"] <= ended]
    told = sum(one["bandwidth"] * one["period"] for one in flows) / sum(one["period"] for one in flows)
    more = sum(one["published messages"] for one in flows) / sum(one["messages"] for one in flows)
    did = 8 * through / (ended - began) / 1e6
    done = f"{rate / 1e6:g} Mbit/s (did {did:.3f}), {more:.1f}x published"
    return Row("bandwidth", transport, done, rate / 8 * CDR * packets / through, told)


def loss(transport: str, shape: Shape, seconds: float) -> Row:
    """Each message is a packet; some are lost, once the nodes know each other: before, who watches expects none."""
    with Link(Shape()) as link:
        left, came = Counter(link.near, "output", *PACKET), Counter(link.far, "input", *PACKET)
        with watched(link, transport, 0.001) as watch:
            before = left.read().packets
            link.shape(shape)
            time.sleep(seconds)
        sent, lost = left.read().packets - before, left.read().packets - came.read().packets
    told = sum(one["lost messages"] for one in watch.flows)
    bursts = f", {shape.burst:g} in a row" if shape.burst > 1 else ""
    return Row("loss", transport, f"{shape.loss:.0%}{bursts}, of {sent} messages", lost / sent, told / sent)


def latencies(transport: str) -> Iterator[Row]:
    """Each delay; what nodes take by themselves is taken away."""
    own = latency(transport, Shape(), machines=False)
    for delay, machines in DELAYS:
        told = latency(transport, Shape(delay=delay), machines) - own
        clocks = f", two clocks {AHEAD[transport]:g} s apart" if machines else ""
        yield Row("latency", transport, f"{delay * 1e3:g} ms{clocks} (nodes: {own * 1e3:.2f} ms)", delay, told)


def latency(transport: str, shape: Shape, machines: bool) -> float:
    """Median of what records tell, once it is known how far the clocks are off, seconds."""
    with Link(shape) as link, watched(link, transport, 0.005, machines) as watch:
        watch.until(_clock_known)
        time.sleep(DELAYED)
    return median(one["latency (nanoseconds)"] for one in watch.flows if one["messages"] and _clock_known(one)) / 1e9


def _clock_known(flow: dict[str, Any]) -> bool:
    return flow["clock offset (nanoseconds)"] is not None


def link() -> dict[str, float]:
    """Worst errors of what monitors tell, by all transports that are here, as shares of the truth."""
    worst: dict[str, float] = {}
    for row in _rows():
        print(row.line(), flush=True)
        key = f"{row.what}_error"
        worst[key] = round(max(worst.get(key, 0.0), row.error), 4)
    return worst


def _rows() -> Iterator[Row]:
    for transport, python in PYTHONS.items():
        if not python.exists():
            print(f"{transport}: left out, there is no {python}")
            continue
        for rate in RATES:
            yield bandwidth(transport, rate)
        for shape, seconds in LOSSES:
            yield loss(transport, shape, seconds)
        yield from latencies(transport)


if __name__ == "__main__":
    print("RESULT " + json.dumps(link()))

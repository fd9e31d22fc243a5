"""Links shaped by the kernel: netem (tc-netem(8)) on the two ends of a virtual Ethernet.

It keeps times to the microsecond, and carries what the machine can. With jitter, packets may overtake each other.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.plugins import Lacking
from scan2sim.services.qos.link_profile import Shape
from scan2sim.services.qos.links import programs
from scan2sim.services.qos.namespaces import WHAT, Namespace, ip

RANK = 1
LARGEST = 1514
"""Bytes of an Ethernet frame, as the kernel counts it."""
MANY = 1_000_000
"""Packets that may be on their way where the rate isn't bound."""


def lacking() -> Lacking | None:
    """Programs, and the kernel's module: tried in a namespace that is gone with the trial."""
    absent = programs(tc="iproute2", unshare="util-linux")
    if absent:
        return absent
    tried = subprocess.run(
        ["unshare", "--net", "tc", "qdisc", "add", "dev", "lo", "root", "netem"], capture_output=True, text=True
    )
    if tried.returncode == 0:
        return None
    said = tried.stderr.strip().removeprefix("Error: ").rstrip(".")
    return Lacking(f"needs the kernel's netem ({said})", "modprobe sch_netem")


def connect(near: Namespace, far: Namespace, folder: Path, wire: int) -> Wire:
    """A pair of interfaces, one in each namespace."""
    name = near.interface(wire)
    ip("-n", near.name, "link", "add", "dev", name, "type", "veth", "peer", "name", name, "netns", far.name)
    return Wire(near, far, name)


class Wire:
    """Each direction is shaped where it leaves."""

    def __init__(self, near: Namespace, far: Namespace, interface: str) -> None:
        self._near, self._far, self._interface = near, far, interface

    def shape(self, there: Shape, back: Shape) -> None:
        """Replace both queueing disciplines; what they hold is dropped."""
        for side, shape in ((self._near, there), (self._far, back)):
            command = ("tc", "qdisc", "replace", "dev", self._interface, "root", "netem", *_settings(shape))
            done = side.run(*command, capture_output=True, text=True)
            if done.returncode:
                raise UnavailableError(WHAT, f"{' '.join(command)} failed ({done.stderr.strip()})", "Update iproute2")


def _settings(shape: Shape) -> list[str]:
    """Arguments of tc-netem(8); Gilbert's model as p and r of its `gemodel`."""
    told = ["limit", str(MANY if shape.backlog is None else max(1, shape.backlog // LARGEST))]
    if shape.delay or shape.jitter:
        told += ["delay", f"{shape.delay * 1e6:.0f}us", f"{shape.jitter * 1e6:.0f}us"]
    if shape.loss and shape.burst > 1:
        ends = 1 / shape.burst
        begins = shape.loss * ends / (1 - shape.loss)
        told += ["loss", "gemodel", f"{100 * begins:.6f}%", f"{100 * ends:.6f}%"]
    elif shape.loss:
        told += ["loss", "random", f"{100 * shape.loss:.6f}%"]
    return [*told, "rate", f"{shape.rate:.0f}bit"] if shape.rate else told

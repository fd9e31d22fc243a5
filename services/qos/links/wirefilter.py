"""Links shaped by wirefilter of Virtual Distributed Ethernet (vde2, Davoli 2005): a process, for kernels without netem.

It keeps times to some tenths of a millisecond, packets in order, and up to some 10 000 packets a second.
"""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.plugins import Lacking
from scan2sim.services.qos.link_profile import Shape
from scan2sim.services.qos.links import programs
from scan2sim.services.qos.namespaces import WHAT, Namespace

RANK = 2
PROMPT = b"VDEwf$ "
STARTS_WITHIN = 5.0
"""Seconds."""
PRIORITY = 20
"""A link keeps time, whatever else the processors have to do."""


def lacking() -> Lacking | None:
    """Programs, and the kernel's taps."""
    if not Path("/dev/net/tun").exists():
        return Lacking("needs /dev/net/tun, not there", "modprobe tun (in a container: --device /dev/net/tun)")
    return programs(vde_plug="vdeplug", wirefilter="vde-wirefilter")


def connect(near: Namespace, far: Namespace, folder: Path, wire: int) -> Wire:
    """A tap in each namespace, wirefilter between them."""
    managed, log = folder / f"wirefilter{wire}", folder / f"wirefilter{wire}.log"
    pipes = [os.pipe() for _ in range(4)]
    (to_near, from_near), (to_far, from_far) = pipes[:2], pipes[2:]
    ends = {"ALTERNATE_STDIN": from_far[0], "ALTERNATE_STDOUT": to_far[1]}
    with log.open("w") as said:
        for side, to, back in ((near, to_near, from_near), (far, to_far, from_far)):
            side.popen(
                "vde_plug", f"tap://{side.interface(wire)}", stdin=to[0], stdout=back[1], stderr=said, priority=PRIORITY
            )
        started = near.popen(
            *("wirefilter", "-M", managed),
            priority=PRIORITY,
            **{"stdin": from_near[0], "stdout": to_near[1], "stderr": said},
            pass_fds=ends.values(),
            env=os.environ | {name: str(end) for name, end in ends.items()},
        )
    for end in (end for pipe in pipes for end in pipe):
        os.close(end)
    limit = time.monotonic() + STARTS_WITHIN
    while not (managed.exists() and near.ready(wire) and far.ready(wire)):
        if started.poll() is not None or time.monotonic() > limit:
            cause = f"wirefilter and its taps didn't start ({log.read_text().strip()[:200]})"
            raise UnavailableError(WHAT, cause, "Look whether they start by hand (man wirefilter)")
        time.sleep(0.01)
    return Wire(managed)


class Wire:
    """Told what to do by its management socket."""

    def __init__(self, managed: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(STARTS_WITHIN)
        self._socket.connect(str(managed))
        self._answer()

    def shape(self, there: Shape, back: Shape) -> None:
        """One command a figure and direction."""
        for way, shape in (("LR", there), ("RL", back)):
            for name, value in _settings(shape).items():
                self._socket.sendall(f"{name} {way}{value}\n".encode())
                said = self._answer()
                if "1000 Success" not in said:
                    raise UnavailableError(WHAT, f"wirefilter refuses {name} {value}: {said}", "Report it")

    def _answer(self) -> str:
        said = b""
        while not said.endswith(PROMPT):
            read = self._socket.recv(4096)
            if not read:
                raise UnavailableError(WHAT, "wirefilter has ended", "Make the link anew")
            said += read
        return said.removesuffix(PROMPT).decode(errors="replace").strip()


def _settings(shape: Shape) -> dict[str, str]:
    """In milliseconds, percent, bytes a second and bytes."""
    return {
        "delay": f"{shape.delay * 1e3:g}+{shape.jitter * 1e3:g}U",
        "loss": f"{shape.loss * 100:g}",
        "lostburst": f"{shape.burst if shape.burst > 1 else 0:g}",
        "bandwidth": f"{(shape.rate or 0) / 8:.0f}",
        "chanbufsize": f"{shape.backlog or 0}",
    }

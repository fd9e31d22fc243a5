"""Links shaped by wirefilter of Virtual Distributed Ethernet (vde2, Davoli 2005), for kernels without netem.

A user-space process: delays are precise to some tenths of a millisecond, packets are never reordered, and throughput is
limited to some 10 000 packets per second.
"""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.plugins import Unavailable
from scan2sim.services.qos.link_profile import LinkProfile
from scan2sim.services.qos.links import programs
from scan2sim.services.qos.namespaces import FEATURE, Namespace

RANK = 2
PROMPT = b"VDEwf$ "
OFF = "0", "0+0U"
"""Values of settings that are switched off."""
START_TIMEOUT_S = 5.0
"""Seconds to wait for its start and for responses."""
REALTIME_PRIORITY = 20
"""Real-time priority, so that delays don't depend on other load."""


def unavailable() -> Unavailable | None:
    """Check for the programs and the kernel's TAP devices."""
    if not Path("/dev/net/tun").exists():
        return Unavailable(
            "needs /dev/net/tun, which doesn't exist", "modprobe tun (in a container: --device /dev/net/tun)"
        )
    return programs(vde_plug="vdeplug", wirefilter="vde-wirefilter")


def connect(near: Namespace, far: Namespace, folder: Path, wire: int) -> Wire:
    """Create a TAP device in each namespace and connect them with wirefilter."""
    management, log = folder / f"wirefilter{wire}", folder / f"wirefilter{wire}.log"
    pipes = [os.pipe() for _ in range(4)]
    (to_near, from_near), (to_far, from_far) = pipes[:2], pipes[2:]
    ends = {"ALTERNATE_STDIN": from_far[0], "ALTERNATE_STDOUT": to_far[1]}
    with log.open("w") as log_file:
        for side, to, back in ((near, to_near, from_near), (far, to_far, from_far)):
            side.popen(
                "vde_plug",
                f"tap://{side.interface(wire)}",
                stdin=to[0],
                stdout=back[1],
                stderr=log_file,
                priority=REALTIME_PRIORITY,
            )
        started = near.popen(
            *("wirefilter", "-M", management),
            priority=REALTIME_PRIORITY,
            **{"stdin": from_near[0], "stdout": to_near[1], "stderr": log_file},
            pass_fds=ends.values(),
            env=os.environ | {name: str(end) for name, end in ends.items()},
        )
    for end in (end for pipe in pipes for end in pipe):
        os.close(end)
    deadline = time.monotonic() + START_TIMEOUT_S
    while not (management.exists() and near.has_interface(wire) and far.has_interface(wire)):
        if started.poll() is not None or time.monotonic() > deadline:
            cause = f"wirefilter and its TAP devices didn't start ({log.read_text().strip()[:200]})"
            raise UnavailableError(FEATURE, cause, "Check whether they start in a shell (man wirefilter)")
        time.sleep(0.01)
    return Wire(management)


class Wire:
    """Link controlled by wirefilter's management socket."""

    def __init__(self, management: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(START_TIMEOUT_S)
        self._socket.connect(str(management))
        self._response()

    def shape(self, there: LinkProfile, back: LinkProfile) -> None:
        """Send one command per setting and direction; what is switched off comes last.

        While there is neither a delay nor a bandwidth, packets overtake those that wait.
        """
        for way, profile in (("LR", there), ("RL", back)):
            for name, value in sorted(_settings(profile).items(), key=lambda setting: setting[1] in OFF):
                self._socket.sendall(f"{name} {way}{value}\n".encode())
                response = self._response()
                if "1000 Success" not in response:
                    raise UnavailableError(
                        FEATURE, f"wirefilter rejects {name} {value}: {response}", "Report it as a bug"
                    )

    def _response(self) -> str:
        response = b""
        while not response.endswith(PROMPT):
            received = self._socket.recv(4096)
            if not received:
                raise UnavailableError(FEATURE, "wirefilter has ended", "Create the link again")
            response += received
        return response.removesuffix(PROMPT).decode(errors="replace").strip()


def _settings(profile: LinkProfile) -> dict[str, str]:
    """Settings of wirefilter in ms, percent, bytes per second and bytes."""
    return {
        "delay": f"{profile.delay * 1e3:g}+{profile.jitter * 1e3:g}U",
        "loss": f"{profile.loss * 100:g}",
        "lostburst": f"{profile.burst if profile.burst > 1 else 0:g}",
        "bandwidth": f"{(profile.rate or 0) / 8:.0f}",
        "chanbufsize": f"{profile.backlog or 0}",
    }

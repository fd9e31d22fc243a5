"""Links shaped by the kernel's netem (tc-netem(8)) at both ends of a virtual Ethernet pair.

Delays are precise to the microsecond. With jitter, packets may be reordered.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.plugins import Unavailable
from scan2sim.services.qos.link_profile import LinkProfile
from scan2sim.services.qos.links import programs
from scan2sim.services.qos.namespaces import FEATURE, Namespace, ip

RANK = 1
ETHERNET_FRAME_BYTES = 1514
"""Size of an Ethernet frame as counted by the kernel."""
UNLIMITED_PACKETS = 1_000_000
"""Queue limit without a rate."""


def unavailable() -> Unavailable | None:
    """Check for the programs and the kernel module, by using it in a temporary namespace."""
    missing = programs(tc="iproute2", unshare="util-linux")
    if missing:
        return missing
    tried = subprocess.run(
        ["unshare", "--net", "tc", "qdisc", "add", "dev", "lo", "root", "netem"], capture_output=True, text=True
    )
    if tried.returncode == 0:
        return None
    message = tried.stderr.strip().removeprefix("Error: ").rstrip(".")
    return Unavailable(f"needs the kernel's netem ({message})", "modprobe sch_netem")


def connect(near: Namespace, far: Namespace, folder: Path, wire: int) -> Wire:
    """Create a pair of interfaces, one in each namespace."""
    name = near.interface(wire)
    ip("-n", near.name, "link", "add", "dev", name, "type", "veth", "peer", "name", name, "netns", far.name)
    return Wire(near, far, name)


class Wire:
    """Link whose directions are shaped at their egress."""

    def __init__(self, near: Namespace, far: Namespace, interface: str) -> None:
        self._near, self._far, self._interface = near, far, interface

    def shape(self, there: LinkProfile, back: LinkProfile) -> None:
        """Replace both queueing disciplines; queued packets are dropped."""
        for side, profile in ((self._near, there), (self._far, back)):
            command = ("tc", "qdisc", "replace", "dev", self._interface, "root", "netem", *_settings(profile))
            done = side.run(*command, capture_output=True, text=True)
            if done.returncode:
                raise UnavailableError(
                    FEATURE, f"{' '.join(command)} failed ({done.stderr.strip()})", "Update iproute2"
                )


def _settings(profile: LinkProfile) -> list[str]:
    """Arguments of tc-netem(8); bursts use the Gilbert model, with p and r of netem's `gemodel`."""
    limit = UNLIMITED_PACKETS if profile.backlog is None else max(1, profile.backlog // ETHERNET_FRAME_BYTES)
    arguments = ["limit", str(limit)]
    if profile.delay or profile.jitter:
        arguments += ["delay", f"{profile.delay * 1e6:.0f}us", f"{profile.jitter * 1e6:.0f}us"]
    if profile.loss and profile.burst > 1:
        ends = 1 / profile.burst
        begins = profile.loss * ends / (1 - profile.loss)
        arguments += ["loss", "gemodel", f"{100 * begins:.6f}%", f"{100 * ends:.6f}%"]
    elif profile.loss:
        arguments += ["loss", "random", f"{100 * profile.loss:.6f}%"]
    return [*arguments, "rate", f"{profile.rate:.0f}bit"] if profile.rate else arguments

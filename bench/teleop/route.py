"""Scripted drive along a world's street: cross-track error of its path (part of `bench.teleop`).

`python -m bench.teleop.route WORLD PICTURE [--seconds 30]`, as root, also plots it. The driver steers by the vehicle's
delayed telemetry: without a network, over the mobile link, and over one with four times its delay.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.teleop.drives import MOBILE
from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.qos.link_profile import LinkProfile
from scan2sim.services.teleoperation.qos.measure import Measurement, percentile, render_test_images, scripted_pair
from scan2sim.services.teleoperation.qos.route import cross_track_error
from scan2sim.services.teleoperation.qos.scripted_drive import Setup

Report = Callable[[str], None]
NETWORKS: dict[str, LinkProfile | None] = {
    "no network": None,
    "mobile": MOBILE,
    "slow": MOBILE.model_copy(update={"delay": 4 * MOBILE.delay}),
}
MAX_COMMAND_AGE_MS = 600.0
"""Limit of the command age: over the slow network all commands are older than the default limit."""


def drives(world: Path, seconds: float) -> dict[str, Measurement]:
    """Repeated drives along the street, by network."""
    if not world.is_dir():
        raise InputError(world, "folder not found", "Build it with `make demo`, or choose another with --world")
    found = {}
    for name, profile in NETWORKS.items():
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-teleop-")))
            setup = replace(
                Setup("", ""), cameras=1, pictures=str(render_test_images(folder / "pictures")), world=str(world)
            )
            profiles = None if profile is None else (profile, profile)
            ends = stack.enter_context(scripted_pair(profiles, replace(setup, limit=MAX_COMMAND_AGE_MS), folder))
            ends.station.ask("join")
            ends.station.ask("drive")
            found[name] = ends.measured(seconds)
    return found


def route(world: Path, scale: float, report: Report) -> dict[str, Any]:
    """Cross-track error by network: mean and 95th percentile."""
    found = dict[str, list[float]]()
    for name, measured in drives(world, max(12.0, 25.0 * scale)).items():
        off = measured.cross_track_error
        found[name] = [round(sum(off) / len(off), 3), round(percentile(off, 95), 3)]
        report(
            f"route, {name}: {measured.vehicle['runs']} times along {_length(measured):.0f} m, cross-track error "
            f"{found[name][0]:.2f} m on average, p95 {found[name][1]:.2f}, max {max(off):.2f}; "
            f"faults {measured.vehicle['faults']}"
        )
    return {"off_way_m": found}


def _length(measured: Measurement) -> float:
    return float(np.linalg.norm(np.diff(np.array(measured.vehicle["way"]), axis=0), axis=1).sum())


def draw(found: dict[str, Measurement], picture: Path) -> None:
    """Plot the paths from above, and the cross-track error along them."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (above, off) = plt.subplots(2, 1, figsize=(9, 4.6), sharex=True, height_ratios=(2, 3))
    way = np.array(next(iter(found.values())).vehicle["way"])
    begin, end = way[0], way[-1]
    ahead = (end - begin) / np.linalg.norm(end - begin)
    turned = np.column_stack([ahead, [-ahead[1], ahead[0]]])  # the street from left to right
    above.plot(*((way - begin) @ turned).T, color="0.6", linewidth=6, label="intended", solid_capstyle="round")
    for (name, measured), colour in zip(found.items(), ("#2a6f97", "#e07a1f", "#b3261e"), strict=True):
        driven = np.array(measured.vehicle["driven"])
        positions = (driven[:, 1:] - begin) @ turned
        left = cross_track_error(way, measured.vehicle["driven"])
        for run in np.unique(driven[:, 0]):
            mine = driven[:, 0] == run
            label = name if run == driven[0, 0] else None
            above.plot(*positions[mine].T, color=colour, linewidth=1, label=label)
            off.plot(positions[mine, 0], left[mine], color=colour, linewidth=1)
    above.set_aspect("equal")
    above.set_ylabel("m across the street")
    above.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, fontsize=9, frameon=False)
    off.axhline(0.0, color="0.6", linewidth=1)
    off.set_ylabel("cross-track error, m (left)")
    off.set_xlabel("m along the street")
    for axes in (above, off):
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(picture, dpi=110)


def main() -> None:
    """Drive and plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("world", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--seconds", type=float, default=30.0, help="duration with each network")
    given = parser.parse_args()
    draw(drives(given.world, given.seconds), given.picture)


if __name__ == "__main__":
    main()

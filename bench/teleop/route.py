"""A drive along a world's street by script: its path against the intended one (part of `bench.teleop`).

`python -m bench.teleop.route WORLD PICTURE [--seconds 30]`, as root, draws it too. The driver steers by what the
vehicle tells, as late as that comes: over no network, the mobile link, and one that is four times as slow.
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
from scan2sim.services.qos.link_profile import Shape
from scan2sim.services.teleoperation.qos.measure import Measured, film, pair, percentile
from scan2sim.services.teleoperation.qos.scripted_drive import Setup
from scan2sim.services.teleoperation.sim.route import aside

Say = Callable[[str], None]
NETWORKS: dict[str, Shape | None] = {
    "no network": None,
    "mobile": MOBILE,
    "slow": MOBILE.model_copy(update={"delay": 4 * MOBILE.delay}),
}
LIMIT = 600.0
"""Milliseconds: over the slow network no command is younger than the limit that is usual."""


def drives(world: Path, seconds: float) -> dict[str, Measured]:
    """Along the street, again and again for so long, by network."""
    if not world.is_dir():
        raise InputError(world, "isn't there", "`make demo` makes one; or name another by --world")
    found = {}
    for name, shape in NETWORKS.items():
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-teleop-")))
            setup = replace(Setup("", ""), cameras=1, pictures=str(film(folder / "pictures")), world=str(world))
            shapes = None if shape is None else (shape, shape)
            ends = stack.enter_context(pair(shapes, replace(setup, limit=LIMIT), folder))
            ends.station.ask("join")
            ends.station.ask("drive")
            found[name] = ends.measured(seconds)
    return found


def route(world: Path, scale: float, say: Say) -> dict[str, Any]:
    """How far off the way the car was: on average, and of 95 %, by network."""
    found = dict[str, list[float]]()
    for name, measured in drives(world, max(12.0, 25.0 * scale)).items():
        off = measured.aside
        found[name] = [round(sum(off) / len(off), 3), round(percentile(off, 95), 3)]
        say(
            f"route, {name}: {measured.vehicle['runs']} times along {_length(measured):.0f} m, {found[name][0]:.2f} m "
            f"off the way on average, 95 % within {found[name][1]:.2f}, all within {max(off):.2f}; "
            f"faults {measured.vehicle['faults']}"
        )
    return {"off_way_m": found}


def _length(measured: Measured) -> float:
    return float(np.linalg.norm(np.diff(np.array(measured.vehicle["way"]), axis=0), axis=1).sum())


def draw(found: dict[str, Measured], picture: Path) -> None:
    """The ways from above, and how far off the car was along them."""
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
        places = (driven[:, 1:] - begin) @ turned
        left = aside(way, measured.vehicle["driven"])
        for run in np.unique(driven[:, 0]):
            mine = driven[:, 0] == run
            label = name if run == driven[0, 0] else None
            above.plot(*places[mine].T, color=colour, linewidth=1, label=label)
            off.plot(places[mine, 0], left[mine], color=colour, linewidth=1)
    above.set_aspect("equal")
    above.set_ylabel("m across the street")
    above.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, fontsize=9, frameon=False)
    off.axhline(0.0, color="0.6", linewidth=1)
    off.set_ylabel("m to the left of the way")
    off.set_xlabel("m along the street")
    for axes in (above, off):
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(picture, dpi=110)


def main() -> None:
    """Drive, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("world", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--seconds", type=float, default=30.0, help="by each network")
    given = parser.parse_args()
    draw(drives(given.world, given.seconds), given.picture)


if __name__ == "__main__":
    main()

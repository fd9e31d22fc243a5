"""The worlds that go through the gate, made where they aren't there yet: the demo tile, a real street, ten tiles."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bench.measure import measure
from bench.paths import ROOT
from bench.street.run import STREETS
from scan2sim.data_samples import make_tile
from scan2sim.data_samples.layout import Layout, lay_out
from scan2sim.data_samples.photos import Effects
from scan2sim.data_samples.street import generate
from scan2sim.pipeline.tiling.cut_corridor import CutParams, cut_survey

LENGTH, SEED = 100.0, 3
STREET = {"length": LENGTH, "points": 8e5, "photos": 40, "seed": SEED, "photo_width": 640}
CUT = {"length": 10.0, "buffer": 3.0, "reach": 20.0, "photo_reach": 8.0}
COARSE = ("voxel.size=0.15", "unwrap.texel=0.05", "visibility.pixels=200000", "pictures.width=320")
"""Settings of the ten tiles, so that they take a quarter of an hour and not three."""


@dataclass(frozen=True)
class Subject:
    """A world, and what it was made from.

    Attributes:
        name: of it.
        run: folder that `run` or `survey` was given as its output.
        tiles: folders of its tiles, by the names' order.
        street: the tile that it was generated as, with the truth of its photos, where there is one.
        layout: of the generated street, whose lines are known.
    """

    name: str
    run: Path
    tiles: tuple[Path, ...]
    street: Path | None = None
    layout: Layout | None = None


class Absent(Exception):
    """A world can't be made here; the text says why."""


def demo(folder: Path) -> Subject:
    """The committed tile."""
    tile = ROOT / "data_samples" / "tile"
    scan2sim("run", tile, "--out", folder / "run", "--hold-out", 8, "--set", "segment.overwrite=true")
    return Subject("demo", folder / "run", (tile,), layout=lay_out(make_tile.LENGTH, make_tile.SEED))


def raw0009(folder: Path) -> Subject:
    """25 frames of KITTI's raw drive 0009.

    Raises:
        Absent: they aren't there.
    """
    street, tile = STREETS["raw0009"], folder / "tile"
    if not street.data.is_dir():
        raise Absent(f"there is no {street.data}")
    if not (tile / "tile.toml").is_file():
        scan2sim("import", *street.importing, "--out", tile)
    scan2sim("run", tile, "--out", folder / "run", "--hold-out", 8)
    return Subject("raw0009", folder / "run", (tile,))


def survey(folder: Path) -> Subject:
    """Ten tiles of a synthetic street."""
    street, tiles = folder / "street", folder / "tiles"
    if not (street / "tile.toml").is_file():
        generate(street, **STREET, truth_density=20.0, photo_labels=True, effects=Effects(quality=90))  # type: ignore[arg-type]
    if not (tiles / "survey.toml").is_file():
        cut_survey(street, tiles, CutParams.model_validate(CUT))
    options = [part for value in COARSE for part in ("--set", value)]
    scan2sim("survey", tiles, "--out", folder / "run", "--jobs", 2, "--cores", 1, *options)
    parts = tuple(sorted(p.parent for p in tiles.glob("*/tile.toml")))
    return Subject("survey", folder / "run", parts, street, lay_out(LENGTH, SEED))


WORLDS: dict[str, Callable[[Path], Subject]] = {"demo": demo, "raw0009": raw0009, "survey": survey}


def scan2sim(*arguments: object) -> None:
    """Run the command; what is made already stays."""
    measured = measure([sys.executable, "-m", "scan2sim.flows.cli", *map(str, arguments)])
    if measured.status:
        sys.exit(f"scan2sim {arguments[0]} failed with exit status {measured.status}")

"""Worlds of the gate, built if missing: the demo tile, a real street, ten tiles, a robot's map of a building."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bench.maps.inputs import simulate
from bench.measure import measure
from bench.paths import ROOT
from bench.street.run import STREETS
from scan2sim.data_samples import make_tile
from scan2sim.data_samples.building import Style
from scan2sim.data_samples.layout import Layout, lay_out
from scan2sim.data_samples.photos import Effects
from scan2sim.data_samples.robot_map import Lidar, Mapping
from scan2sim.data_samples.street import generate
from scan2sim.flows.commands.robot_map import FOLDER
from scan2sim.pipeline.tiling.cut_corridor import CutParams, cut_survey

LENGTH, SEED = 100.0, 3
STREET = {"length": LENGTH, "points": 8e5, "photos": 40, "seed": SEED, "photo_width": 640}
CUT = {"length": 10.0, "buffer": 3.0, "max_distance": 20.0, "photo_distance": 8.0}
COARSE_SETTINGS = ("voxel.size=0.15", "unwrap.texel=0.05", "visibility.pixels=200000", "pictures.width=320")
"""Settings of the ten tiles, with which they take a quarter of an hour instead of three quarters."""


@dataclass(frozen=True)
class GateWorld:
    """A world and its source.

    Attributes:
        name: name of the world.
        run: output folder of `run` or `survey`.
        tiles: folders of its tiles, sorted by name.
        street: the generated tile with the truth of its photos, if it is synthetic.
        layout: layout of the generated street, whose geometry is known.
    """

    name: str
    run: Path
    tiles: tuple[Path, ...]
    street: Path | None = None
    layout: Layout | None = None


class WorldUnavailable(Exception):
    """The world can't be built here; the text says why."""


def demo(folder: Path) -> GateWorld:
    """The demo tile of this repository, with splats."""
    tile = ROOT / "data_samples" / "tile"
    settings = ("--set", "segment.overwrite=true", "--set", "splats.when=auto")
    scan2sim("run", tile, "--out", folder / "run", "--hold-out", 8, *settings)
    return GateWorld("demo", folder / "run", (tile,), layout=lay_out(make_tile.STREET_LENGTH_M, make_tile.SEED))


def raw0009(folder: Path) -> GateWorld:
    """25 frames of KITTI's raw drive 0009.

    Raises:
        WorldUnavailable: the data set is missing.
    """
    street, tile = STREETS["raw0009"], folder / "tile"
    if not street.data.is_dir():
        raise WorldUnavailable(f"{street.data} doesn't exist")
    if not (tile / "tile.toml").is_file():
        scan2sim("import", *street.importing, "--out", tile)
    scan2sim("run", tile, "--out", folder / "run", "--hold-out", 8)
    return GateWorld("raw0009", folder / "run", (tile,))


def survey(folder: Path) -> GateWorld:
    """Ten tiles of a synthetic street."""
    street, tiles = folder / "street", folder / "tiles"
    if not (street / "tile.toml").is_file():
        generate(street, **STREET, truth_density=20.0, photo_labels=True, effects=Effects(quality=90))  # type: ignore[arg-type]
    if not (tiles / "survey.toml").is_file():
        cut_survey(street, tiles, CutParams.model_validate(CUT))
    options = [part for value in COARSE_SETTINGS for part in ("--set", value)]
    scan2sim("survey", tiles, "--out", folder / "run", "--jobs", 2, "--cores", 1, *options)
    parts = tuple(sorted(p.parent for p in tiles.glob("*/tile.toml")))
    return GateWorld("survey", folder / "run", parts, street, lay_out(LENGTH, SEED))


def building(folder: Path) -> GateWorld:
    """A robot's map of a synthetic building."""
    made = simulate("building", Style(), Lidar(), Mapping(), folder, seed=SEED)
    scan2sim("run", made.path, "--out", folder / "run")
    return GateWorld("building", folder / "run", (folder / "run" / FOLDER / "tile",))


WORLDS: dict[str, Callable[[Path], GateWorld]] = {
    "demo": demo,
    "raw0009": raw0009,
    "survey": survey,
    "building": building,
}


def scan2sim(*arguments: object) -> None:
    """Run the command; finished tasks are not run again."""
    measured = measure([sys.executable, "-m", "scan2sim.flows.cli", *map(str, arguments)])
    if measured.status:
        sys.exit(f"scan2sim {arguments[0]} failed with exit status {measured.status}")

"""Which steps come before a survey's tiles, in order: what a vehicle brought home becomes a corridor, and that is cut.

A drive is told by a `drive.toml` (docs/scale.md shows one): a video for SLAM where GPS is poor, the scanner's sweeps,
which its path places, and how to cut; or, instead of sweeps, a corridor that is there already.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

from scan2sim.flows.pipelines import sweeps, video
from scan2sim.flows.pipelines.graph import Node, NodeId, Output
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.sweeps import Sweeps
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Params, Step
from scan2sim.pipeline.io import toml
from scan2sim.pipeline.io.tile import sources_of
from scan2sim.pipeline.steps.cut import CUT
from scan2sim.pipeline.tiling.cut_corridor import CutParams

STEPS: tuple[Step, ...] = (*sweeps.STEPS, CUT)


class Drive(Params):
    """All of `drive.toml`."""

    corridor: Path | None = None
    slam: video.Video | None = None
    sweeps: Sweeps | None = None
    tiles: CutParams = CutParams.model_validate({})

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read and check a `drive.toml`.

        Raises:
            InputError: naming the field.
        """
        absent = ("there is no drive here", "Name a drive.toml")
        drive = toml.read(path, cls, absent=absent, fields="docs/scale.md lists the fields")
        if (drive.corridor is None) == (drive.sweeps is None):
            raise InputError(path, "says neither or both of `corridor` and `[sweeps]`", "Give one: what is to be cut")
        return drive


def recipe(drive: Drive, here: Path) -> list[Node]:
    """The graph of a drive, each node after those that it reads; its files are relative to `here`.

    Raises:
        ScanError: a corridor, or a tile whose camera is asked for, can't be read.
    """
    nodes = [] if drive.slam is None else video.recipe(_at(drive.slam, here), Settings())
    corridor: dict[str, Any] = {}
    if drive.sweeps is not None:
        given = None if drive.sweeps.poses is None else here / drive.sweeps.poses
        nodes += sweeps.recipe(drive.sweeps, here, Output(NodeId("place"), "trajectory") if nodes else given)
        corridor["corridor"] = Output(NodeId("import_sweeps"), "corridor")
    elif drive.corridor is not None:
        place = here / drive.corridor
        tile = place / "tile.toml" if place.is_dir() else place
        corridor = {"corridor": tile} | {f"source.{i}": file for i, file in enumerate(sources_of(tile)[1:])}
    nodes.append(Node(CUT, drive.tiles, corridor))
    return nodes


def _at(given: video.Video, here: Path) -> video.Video:
    """The video with its files found from `here`."""
    files = {name: here / value for name, value in given if isinstance(value, Path)}
    return video.Video.model_validate(given.model_dump(exclude_unset=True) | files)

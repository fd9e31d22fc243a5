"""Which steps come before a survey's tiles, in order: what a vehicle brought home becomes a corridor, and that is cut.

A drive is told by a `drive.toml` (docs/scale.md shows one): a video for SLAM where GPS is poor, the scanner's sweeps,
which its path places, and how to cut; or, instead of sweeps, a corridor that is there already.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

from pydantic import Field

from scan2sim.flows.recipes import video
from scan2sim.flows.recipes.graph import Node, NodeId, Output
from scan2sim.flows.recipes.settings import Settings
from scan2sim.pipeline.corridor import CutParams
from scan2sim.pipeline.errors import InputError
from scan2sim.pipeline.io import toml
from scan2sim.pipeline.io.tile import sources_of
from scan2sim.pipeline.step import Params, Step
from scan2sim.pipeline.steps.cut import CUT
from scan2sim.pipeline.steps.import_sweeps import IMPORT_SWEEPS, SweepsParams

STEPS: tuple[Step, ...] = (IMPORT_SWEEPS, CUT)


class Sweeps(SweepsParams):
    """Sweeps and what is beside them: the options of `scan2sim import sweeps`, and `[sweeps]` of a `drive.toml`."""

    folder: Path = Field(description="Folder of sweeps in scanner axes: .bin, .pcd, .ply, .las, .laz.")
    poses: Path | None = Field(None, description="Trajectory, of `slam` for example: .csv, .tum, .kitti; z-up.")
    extrinsics: Path | None = Field(
        None, description="T_camera_scanner, 3 or 4 rows, or KITTI's calibration: poses are the camera's."
    )
    times: Path | None = Field(None, description="Of sweeps, seconds, one a line; default: names, or order.")
    photos: Path | None = Field(None, description="Folder of photos: they colour the points.")
    photo_times: Path | None = Field(None, description="Of photos, likewise.")
    mask: Path | None = Field(None, description="Of all photos: 0 where the car itself is seen.")

    @property
    def camera_file(self) -> Path | None:
        """Where the photos' camera is described, if `camera` is no model's name."""
        return Path(self.camera) if self.camera.endswith(".toml") or Path(self.camera).is_file() else None

    def inputs(self, here: Path) -> dict[str, Path]:
        """Of the import; files are relative to `here`."""
        beside = ("poses", "extrinsics", "times", "photos", "photo_times", "mask")
        files = {"sweeps": self.folder, "camera": self.camera_file} | {name: getattr(self, name) for name in beside}
        return {name: here / path for name, path in files.items() if path is not None}

    def params(self) -> SweepsParams:
        """Of the import: what isn't a file."""
        given = {name: getattr(self, name) for name in SweepsParams.model_fields}
        return SweepsParams(**given | ({"camera": "auto"} if self.camera_file else {}))


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
        if drive.sweeps and not (drive.sweeps.poses or drive.slam):
            raise InputError(path, "has sweeps, but nothing that places them", "Give sweeps.poses, or [slam]")
        return drive


def recipe(drive: Drive, here: Path) -> list[Node]:
    """The graph of a drive, each node after those that it reads; its files are relative to `here`.

    Raises:
        ScanError: a corridor, or a tile whose camera is asked for, can't be read.
    """
    nodes = [] if drive.slam is None else video.recipe(_at(drive.slam, here), Settings())
    corridor: dict[str, Any] = {}
    if drive.sweeps is not None:
        path = {"poses": Output(NodeId("place"), "trajectory")} if nodes else {}
        nodes.append(Node(IMPORT_SWEEPS, drive.sweeps.params(), {**drive.sweeps.inputs(here), **path}))
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

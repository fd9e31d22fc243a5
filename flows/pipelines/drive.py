"""Pipeline definition of a drive: the steps that make a survey of a vehicle's recordings, before its tiles are built.

A `drive.toml` (docs/surveys.md has an example) describes a drive: a video for SLAM if GPS is poor, the lidar sweeps
that are merged by the trajectory, and how to cut the corridor into tiles; or a ROS bag, a drive of a data set, or an
existing corridor, instead of sweeps.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

from scan2sim.flows.pipelines import bag, dataset, sweeps, video
from scan2sim.flows.pipelines.bag import BagSource
from scan2sim.flows.pipelines.graph import Output, Task, TaskId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.sweeps import Sweeps
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Params, Step
from scan2sim.pipeline.io import toml
from scan2sim.pipeline.io.tile import source_files
from scan2sim.pipeline.steps.cut import CUT
from scan2sim.pipeline.steps.read_bag import READ_BAG
from scan2sim.pipeline.tiling.cut_corridor import CutParams

STEPS: tuple[Step, ...] = (READ_BAG, *dataset.STEPS, *sweeps.STEPS, CUT)


class Drive(Params):
    """Content of a `drive.toml`.

    Attributes:
        corridor: path of an existing corridor, instead of `sweeps`.
        slam: video whose trajectory places the sweeps.
        sweeps: lidar sweeps to merge.
        bag, nuscenes, pandaset: ROS bag, or drive of a data set, to import instead of `sweeps`.
        tiles: how to cut the corridor.
    """

    corridor: Path | None = None
    slam: video.Video | None = None
    sweeps: Sweeps | None = None
    bag: BagSource | None = None
    nuscenes: dataset.NuScenes | None = None
    pandaset: dataset.PandaSet | None = None
    tiles: CutParams = CutParams.model_validate({})

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read and check a `drive.toml`.

        Raises:
            InputError: naming the field.
        """
        absent = ("file not found", "Name a drive.toml")
        drive = toml.read(path, cls, absent=absent, fields="docs/surveys.md lists the fields")
        sources = (drive.corridor, drive.sweeps, drive.bag, drive.nuscenes, drive.pandaset)
        with_poses = drive.bag or drive.nuscenes or drive.pandaset
        if sum(source is not None for source in sources) != 1 or (with_poses is not None and drive.slam is not None):
            raise InputError(
                path,
                "must have either `corridor` or `[sweeps]`, `[bag]`, `[nuscenes]` or `[pandaset]` ([slam] only with "
                "[sweeps])",
                "Give one of them: the source of the tiles",
            )
        return drive


def build_graph(drive: Drive, here: Path) -> list[Task]:
    """The task graph of a drive, each task after those that it reads; its paths are relative to `here`.

    Raises:
        ScanError: the corridor, or a tile whose camera is used, can't be read.
    """
    tasks = [] if drive.slam is None else video.build_graph(_at(drive.slam, here), Settings())
    corridor: dict[str, Any] = {}
    if drive.sweeps is not None:
        given = None if drive.sweeps.poses is None else here / drive.sweeps.poses
        tasks += sweeps.build_graph(
            drive.sweeps, here, Output(TaskId("georeference"), "trajectory") if tasks else given
        )
    elif drive.bag is not None:
        tasks += bag.build_graph(drive.bag, here)
    elif (source := drive.nuscenes or drive.pandaset) is not None:
        tasks += dataset.build_graph(source, here)
    if drive.corridor is None:
        corridor["corridor"] = Output(TaskId("import_sweeps"), "corridor")
    else:
        place = here / drive.corridor
        tile = place / "tile.toml" if place.is_dir() else place
        corridor = {"corridor": tile} | {f"source.{i}": file for i, file in enumerate(source_files(tile)[1:])}
    tasks.append(Task(CUT, drive.tiles, corridor))
    return tasks


def _at(given: video.Video, here: Path) -> video.Video:
    """The parameters with their paths resolved relative to `here`."""
    files: dict[str, Any] = {name: here / value for name, value in given if isinstance(value, Path)}
    if given.camera_file is not None:
        files["camera"] = str(here / given.camera_file)
    return video.Video.model_validate(given.model_dump(exclude_unset=True) | files)

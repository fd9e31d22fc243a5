"""Pipeline definition of a data set's drive (nuScenes, PandaSet): reading its files, and import of its sweeps."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from scan2sim.flows.pipelines import sweeps
from scan2sim.flows.pipelines.graph import Output, Task
from scan2sim.pipeline.core.step import Step
from scan2sim.pipeline.importers.datasets import nuscenes, pandaset
from scan2sim.pipeline.importers.datasets.nuscenes import NuScenesParams
from scan2sim.pipeline.importers.datasets.recording import DatasetParams, Recording
from scan2sim.pipeline.importers.sweeps import Box, PointSelection
from scan2sim.pipeline.steps.import_sweeps import SweepsParams
from scan2sim.pipeline.steps.read_dataset import READ_NUSCENES, READ_PANDASET
from scan2sim.slam.steps.strip_adjustment import PoseSourceParams

STEPS: tuple[Step, ...] = (READ_NUSCENES, READ_PANDASET)
"""Those before the steps of sweeps."""


class NuScenes(PoseSourceParams, PointSelection, NuScenesParams):
    """A scene of nuScenes: the options of `scan2sim import nuscenes`, and table `[nuscenes]` of a `drive.toml`."""

    folder: Path = Field(description="Folder with samples, sweeps and v1.0-mini (or v1.0-trainval, v1.0-test).")
    vehicle_box: Box | None = Field(
        nuscenes.VEHICLE_BOX,
        description="Box that contains the vehicle, in scanner axes: x y z of its low and its high corner, metres.",
    )


class PandaSet(PoseSourceParams, PointSelection, DatasetParams):
    """A sequence of PandaSet: the options of `scan2sim import pandaset`, and table `[pandaset]` of a `drive.toml`."""

    folder: Path = Field(description="Folder of a sequence, with lidar, camera and meta.")


def build_graph(source: NuScenes | PandaSet, here: Path) -> list[Task]:
    """The task graph that makes a corridor of a drive.

    Args:
        source: the drive; its folder is relative to `here`.

    Raises:
        ScanError: the tables can't be read, or have no such scene or camera.
    """
    folder, chosen = here / source.folder, {"camera": source.camera, "photo_interval": source.photo_interval}
    if isinstance(source, NuScenes):
        found = nuscenes.find_scene(folder, source.scene)
        params = NuScenesParams(scene=found.token, crs=found.crs(source.crs), **chosen)
        drive = nuscenes.read_scene(found, params)
        task = Task(READ_NUSCENES, params, {**found.files(), **_recorded(drive)})
    else:
        sequence, of_sequence = pandaset.find_sequence(folder), DatasetParams(crs=source.crs, **chosen)
        drive = pandaset.read_sequence(sequence, of_sequence)
        task = Task(READ_PANDASET, of_sequence, pandaset.input_files(sequence))
    placing = SweepsParams(
        **{name: getattr(source, name) for name in PointSelection.model_fields},
        crs=drive.frame.crs,
        scanner_poses=True,
    )
    files = {"sweeps": Output(task.id, "sweeps")}
    photos = {"photos": Output(task.id, "photos")} if drive.cameras else {}
    return [task, *sweeps.checked(files, photos, Output(task.id, "poses"), placing, source.pose_source)]


def _recorded(drive: Recording) -> dict[str, Path]:
    """Sweeps and photos of a drive, as inputs of a task."""
    files = [*drive.sweeps, *(one for part in drive.photos.values() for one in part)]
    return {f"file.{i}": path for i, (_, path) in enumerate(files)}

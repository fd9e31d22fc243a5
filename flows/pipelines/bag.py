"""Pipeline definition of a ROS bag: unpacking, lidar odometry if it has no poses, and import of its sweeps."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from scan2sim.flows.pipelines import sweeps
from scan2sim.flows.pipelines.graph import Output, Task
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.importers.bag.contents import inspected
from scan2sim.pipeline.importers.bag.plan import BagParams, Plan, plan_import, resolved
from scan2sim.pipeline.importers.bag.poses import crs_of
from scan2sim.pipeline.importers.bag.reader import opened
from scan2sim.pipeline.importers.sweeps import PhotoPlacementParams, SelectionParams
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.steps.import_sweeps import SweepsParams
from scan2sim.pipeline.steps.read_bag import READ_BAG, Planned, ReadBagParams
from scan2sim.slam.steps.strip_adjustment import PoseSourceParams


class BagSource(PoseSourceParams, PhotoPlacementParams, SelectionParams, BagParams):
    """A bag and related files: the options of `scan2sim import bag`, and table `[bag]` of a `drive.toml`."""

    file: Path = Field(description="ROS 2 bag (.mcap, .db3, or its folder) or ROS 1 bag (.bag).")
    lidar_odometry: bool = Field(False, description="Run lidar odometry also if the bag has poses, and fuse both.")
    deskew: Literal["auto", "none", "kitti", "times"] = Field(  # type: ignore[assignment]
        "auto",
        description="Motion compensation: none, kitti (rotating scanner), times (the points have times), or auto: "
        "times if the points have them, else none.",
    )
    intrinsics: Path | None = Field(
        None,
        description="File with the cameras instead of CameraInfo: TOML as in a tile, or the calibration of another "
        "program (docs/inputs.md).",
    )
    mask: Path | None = Field(
        None,
        description="Ego-vehicle mask: an image, 0 on the car; for several cameras a folder of them (front.png).",
    )
    urdf: Path | None = Field(
        None, description="URDF file of the robot: its fixed joints are added to the static transforms of the bag."
    )

    def selection(self, plan: Plan) -> SelectionParams:
        """Selection of points for a plan."""
        deskew = self.deskew if self.deskew != "auto" else "times" if plan.timed else "none"
        given = {name: getattr(self, name) for name in SelectionParams.model_fields}
        return SelectionParams(**given | {"deskew": deskew})


def build_graph(source: BagSource, here: Path) -> list[Task]:
    """The task graph that makes a corridor of a bag; its first seconds are read to decide about the source of poses.

    Args:
        source: the bag; its paths are relative to `here`.

    Raises:
        ScanError: the bag can't be read, or misses what the settings need.
    """
    path = here / source.file
    beside = {name: here / file for name in ("intrinsics", "urdf") if (file := getattr(source, name)) is not None}
    params = BagParams(**{name: getattr(source, name) for name in BagParams.model_fields})
    with opened(path) as bag:
        found = inspected(bag)
        plan = plan_import(found, params, beside.get("intrinsics"), beside.get("urdf"))
        utm = crs_of(found, plan)
    by_satellites = plan.poses.kind == "gnss"
    if by_satellites and source.crs not in (crs_io.LOCAL, utm):
        raise SettingError("--crs", f"the poses by {plan.poses.topic} are in {utm}", "Leave it out")
    crs = source.crs if source.crs != crs_io.LOCAL else utm or crs_io.LOCAL
    photos_as = {name: getattr(source, name) for name in PhotoPlacementParams.model_fields}
    placing = SweepsParams(**dict(source.selection(plan)) | photos_as | {"crs": crs, "scanner_poses": True})
    chosen = ReadBagParams(**dict(resolved(params, plan)), context=Planned(warnings=plan.warnings))
    tasks = [Task(READ_BAG, chosen, {"bag": path, **beside})]
    read = tasks[0].id
    files = {"sweeps": Output(read, "sweeps")}
    poses = None if plan.poses.kind == "sweeps" else Output(read, "poses")
    photos: dict[str, Path | Output] = {"photos": Output(read, "photos")} if plan.cameras else {}
    if source.mask is not None:
        if not photos:
            raise SettingError("--mask", f"no photos of {path} are imported", "Leave it out, or choose a --camera")
        photos["mask"] = here / source.mask
    if not (source.lidar_odometry or plan.gps or poses is None):
        return [*tasks, *sweeps.checked(files, photos, poses, placing, source.pose_source)]
    gps = Output(read, "gps") if plan.gps else None
    own = crs if by_satellites else source.crs  # that of the poses
    return [*tasks, *sweeps.matched(files, photos, poses, placing, gps=gps, crs=own)]

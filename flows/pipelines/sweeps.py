"""Pipeline definition of lidar sweeps: lidar odometry, fusion with GPS and poses, strip adjustment, and import."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from scan2sim.flows.pipelines.graph import Output, Task, TaskId, folder_inputs
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.parameters import Shift
from scan2sim.pipeline.core.step import Params, Step
from scan2sim.pipeline.io import camera_calibrations
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.steps.import_sweeps import IMPORT_SWEEPS, SweepsParams
from scan2sim.slam.steps.fuse import FUSE, FuseParams
from scan2sim.slam.steps.lidar import LIDAR, LidarParams
from scan2sim.slam.steps.strip_adjustment import STRIP_ADJUSTMENT, PoseSourceParams, StripAdjustmentParams
from scan2sim.slam.trajectory.strip_adjustment import PoseSource

STEPS: tuple[Step, ...] = (LIDAR, FUSE, STRIP_ADJUSTMENT, IMPORT_SWEEPS)


class Sweeps(PoseSourceParams, SweepsParams):
    """Sweeps and related files: the options of `scan2sim import sweeps`, and table `[sweeps]` of a `drive.toml`."""

    folder: Path = Field(description="Folder of sweeps in scanner coordinates: .bin, .pcd, .ply, .las or .laz files.")
    poses: Path | None = Field(
        None, description="Trajectory (.csv, .tum, .kitti; z up), such as one of `scan2sim slam`."
    )
    gps: Path | None = Field(
        None, description="GPS track, to fuse and to georeference: GPX, NMEA, CSV, or a GoPro video."
    )
    gps_offset: Shift = Field(0.0, description="Seconds to add to the times of the GPS track.")
    lidar_odometry: bool = Field(
        False,
        description="Run lidar odometry also if a trajectory is given, and fuse both; always without one.",
    )
    extrinsics: Path | None = Field(
        None,
        description="File of T_camera_scanner, if the poses are the camera's or there are photos: a matrix of 3 or 4 "
        "rows, KITTI's, or the calibration of another program (docs/inputs.md).",
    )
    times: Path | None = Field(
        None,
        description="Text file with the times of the sweeps: seconds, one per line; default: file names, or order.",
    )
    photos: Path | None = Field(None, description="Folder of photos, which colour the points and texture the world.")
    photo_times: Path | None = Field(
        None, description="Text file with the times of the photos: seconds, one per line; default: as for the sweeps."
    )
    mask: Path | None = Field(None, description="Ego-vehicle mask of all photos: an image, 0 on the car.")

    @property
    def camera_file(self) -> Path | None:
        """File of the photos' camera, if `camera` names a file and not a camera model."""
        return camera_calibrations.file_of(self.camera)

    def inputs(self, here: Path) -> dict[str, Path]:
        """Input files of the import; paths are relative to `here`."""
        beside = ("poses", "extrinsics", "times", "photos", "photo_times", "mask")
        files = {"sweeps": self.folder, "camera": self.camera_file} | {name: getattr(self, name) for name in beside}
        given = {name: here / path for name, path in files.items() if path is not None}
        if "photos" in given:
            given |= folder_inputs("photos", given["photos"])
        return given

    def params(self) -> SweepsParams:
        """Parameters of the import, without files."""
        given = {name: getattr(self, name) for name in SweepsParams.model_fields}
        return SweepsParams(**given | ({"camera": "auto"} if self.camera_file else {}))


def uses_only_poses(sweeps: Sweeps, poses: bool) -> bool:
    """Whether only a given trajectory places the sweeps; `poses`: whether there is one."""
    return poses and not sweeps.lidar_odometry and sweeps.gps is None


def path(sweeps: Sweeps, here: Path, poses: Path | Output | None) -> list[Task]:
    """The tasks that estimate the scanner's trajectory, or correct a given one; none if that is used as it is.

    Args:
        sweeps: sweeps and related files.
        here: folder that paths are relative to.
        poses: the given trajectory, or None.

    Raises:
        SettingError: `scanner_poses` without poses.
    """
    files: dict[str, Path | Output] = {"sweeps": here / sweeps.folder}
    if sweeps.times is not None:
        files["times"] = here / sweeps.times
    if uses_only_poses(sweeps, poses is not None):
        assert poses is not None
        if sweeps.pose_source == "given":
            return []
        beside = {} if sweeps.extrinsics is None else {"extrinsics": here / sweeps.extrinsics}
        own = {name: getattr(sweeps, name) for name in StripAdjustmentParams.model_fields}
        return [Task(STRIP_ADJUSTMENT, StripAdjustmentParams(**own), {**files, **beside, "poses": poses})]
    fused = dict(files)
    tasks = []
    if sweeps.lidar_odometry or poses is None:
        own = {name: getattr(sweeps, name) for name in LidarParams.model_fields}
        tasks.append(Task(LIDAR, LidarParams(**own), files))
        fused["matched"] = Output(TaskId("lidar"), "matched")
    if poses is not None:
        fused["poses"] = poses
        if sweeps.extrinsics is not None:
            fused["extrinsics"] = here / sweeps.extrinsics
    elif sweeps.scanner_poses:
        raise SettingError("--scanner-poses", "no trajectory is given", "Leave it out, or give a trajectory")
    if sweeps.gps is not None:
        fused["gps"] = here / sweeps.gps
    own = {name: getattr(sweeps, name) for name in FuseParams.model_fields}
    return [*tasks, Task(FUSE, FuseParams(**own), fused)]


def placed(sweeps: Sweeps, here: Path, poses: Path | Output | None) -> tuple[dict[str, Path | Output], SweepsParams]:
    """Inputs and parameters of the import; arguments as for `path`.

    Raises:
        ScanError: the GPS track can't be read.
    """
    files: dict[str, Path | Output] = {**sweeps.inputs(here)}
    if poses is not None:
        files["poses"] = poses
    if uses_only_poses(sweeps, poses is not None):
        if sweeps.pose_source == "given":
            return files, sweeps.params()
        adjusted = TaskId("strip_adjustment")
        files |= {"poses": Output(adjusted, "trajectory"), "trajectory_check": Output(adjusted, "check")}
        return files, sweeps.params().model_copy(update={"scanner_poses": True, "quaternions": "xyzw"})
    files["poses"] = Output(TaskId("fuse"), "trajectory")
    crs = sweeps.crs
    if crs == crs_io.LOCAL and sweeps.gps is not None:
        crs = gps_io.read(here / sweeps.gps).frame.crs
    changed: dict[str, Any] = {"scanner_poses": True, "time_offset": 0.0, "crs": crs, "quaternions": "xyzw"}
    return files, sweeps.params().model_copy(update=changed)


def build_graph(sweeps: Sweeps, here: Path, poses: Path | Output | None) -> list[Task]:
    """The task graph that makes a corridor of sweeps; arguments and errors as for `path`."""
    files, params = placed(sweeps, here, poses)
    return [*path(sweeps, here, poses), Task(IMPORT_SWEEPS, params, files)]


def checked(
    files: Mapping[str, Path | Output],
    photos: Mapping[str, Path | Output],
    poses: Path | Output,
    placing: SweepsParams,
    pose_source: PoseSource,
) -> list[Task]:
    """The tasks that check the scanner's poses, unless `pose_source` is "given", and import sweeps by them.

    Args:
        files: `sweeps`, and optionally their `times`.
        photos: `photos`, if there are any.
        poses: trajectory of the scanner.
        placing: settings of the import.
        pose_source: which poses are used.
    """
    if pose_source == "given":
        return [Task(IMPORT_SWEEPS, placing, {**files, **photos, "poses": poses})]
    own = StripAdjustmentParams(pose_source=pose_source, **_shared(StripAdjustmentParams, placing))
    check = Task(STRIP_ADJUSTMENT, own, {**files, "poses": poses})
    path, found = Output(check.id, "trajectory"), Output(check.id, "check")
    return [check, Task(IMPORT_SWEEPS, placing, {**files, **photos, "poses": path, "trajectory_check": found})]


def matched(
    files: Mapping[str, Path | Output],
    photos: Mapping[str, Path | Output],
    poses: Path | Output | None,
    placing: SweepsParams,
    *,
    gps: Path | Output | None = None,
    crs: str,
) -> list[Task]:
    """The tasks that run lidar odometry, fuse it with poses and a GPS track (None: without), and import sweeps by it.

    Args:
        files, photos, poses, placing: as for `checked`.
        gps: track of the receiver.
        crs: CRS of the poses.
    """
    lidar = Task(LIDAR, LidarParams(**_shared(LidarParams, placing)), files)
    given = {name: file for name, file in (("poses", poses), ("gps", gps)) if file is not None}
    own = FuseParams(**_shared(FuseParams, placing) | {"crs": crs})
    fuse = Task(FUSE, own, {**files, **given, "matched": Output(lidar.id, "matched")})
    path = Output(fuse.id, "trajectory")
    return [lidar, fuse, Task(IMPORT_SWEEPS, placing, {**files, **photos, "poses": path})]


def _shared(model: type[Params], placing: SweepsParams) -> dict[str, Any]:
    """Values of the fields that a step's parameters share with those of the import."""
    return {name: getattr(placing, name) for name in model.model_fields if name in SweepsParams.model_fields}

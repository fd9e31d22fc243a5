"""Which steps place a scanner's sweeps, in order: matched, fused with what else tells the path, and imported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field

from scan2sim.flows.pipelines.graph import Node, NodeId, Output
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.parameters import Shift
from scan2sim.pipeline.core.step import Step
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.steps.import_sweeps import IMPORT_SWEEPS, SweepsParams
from scan2sim.slam.steps.fuse import FUSE, FuseParams
from scan2sim.slam.steps.lidar import LIDAR, LidarParams

STEPS: tuple[Step, ...] = (LIDAR, FUSE, IMPORT_SWEEPS)


class Sweeps(SweepsParams):
    """Sweeps and what is beside them: the options of `scan2sim import sweeps`, and `[sweeps]` of a `drive.toml`."""

    folder: Path = Field(description="Folder of sweeps in scanner axes: .bin, .pcd, .ply, .las, .laz.")
    poses: Path | None = Field(None, description="Trajectory, of `slam` for example: .csv, .tum, .kitti; z-up.")
    gps: Path | None = Field(None, description="GPX, NMEA, CSV, or a GoPro video: fused with the rest, and places it.")
    gps_offset: Shift = Field(0.0, description="Seconds to add to GPS's times.")
    lidar: bool = Field(False, description="Match sweeps, too, where there is a trajectory (without, they always are).")
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


def alone(sweeps: Sweeps, poses: bool) -> bool:
    """Whether a trajectory alone places sweeps; `poses`: there is one."""
    return poses and not sweeps.lidar and sweeps.gps is None


def path(sweeps: Sweeps, here: Path, poses: Path | Output | None) -> list[Node]:
    """The graph of the scanner's path: none where a trajectory alone tells it.

    Args:
        here: what files are relative to.
        poses: the trajectory, or None.

    Raises:
        SettingError: `scanner_poses` without poses.
    """
    if alone(sweeps, poses is not None):
        return []
    files: dict[str, Path | Output] = {"sweeps": here / sweeps.folder}
    if sweeps.times is not None:
        files["times"] = here / sweeps.times
    told = dict(files)
    nodes = []
    if sweeps.lidar or poses is None:
        own = {name: getattr(sweeps, name) for name in LidarParams.model_fields}
        nodes.append(Node(LIDAR, LidarParams(**own), files))
        told["matched"] = Output(NodeId("lidar"), "matched")
    if poses is not None:
        told["poses"] = poses
        if sweeps.extrinsics is not None:
            told["extrinsics"] = here / sweeps.extrinsics
    elif sweeps.scanner_poses:
        raise SettingError("--scanner-poses", "there are no poses", "Leave it out, or give a trajectory")
    if sweeps.gps is not None:
        told["gps"] = here / sweeps.gps
    own = {name: getattr(sweeps, name) for name in FuseParams.model_fields}
    return [*nodes, Node(FUSE, FuseParams(**own), told)]


def placed(sweeps: Sweeps, here: Path, poses: Path | Output | None) -> tuple[dict[str, Path | Output], SweepsParams]:
    """What the import reads, and its parameters; arguments as of `path`.

    Raises:
        ScanError: GPS can't be read.
    """
    files: dict[str, Path | Output] = {**sweeps.inputs(here)}
    if poses is not None:
        files["poses"] = poses
    if alone(sweeps, poses is not None):
        return files, sweeps.params()
    files["poses"] = Output(NodeId("fuse"), "trajectory")
    crs = sweeps.crs
    if crs == crs_io.LOCAL and sweeps.gps is not None:
        crs = gps_io.read(here / sweeps.gps).frame.crs
    changed: dict[str, Any] = {"scanner_poses": True, "time_offset": 0.0, "crs": crs}
    return files, sweeps.params().model_copy(update=changed)


def recipe(sweeps: Sweeps, here: Path, poses: Path | Output | None) -> list[Node]:
    """The graph that makes a corridor of sweeps; arguments and errors as of `path`."""
    files, params = placed(sweeps, here, poses)
    return [*path(sweeps, here, poses), Node(IMPORT_SWEEPS, params, files)]

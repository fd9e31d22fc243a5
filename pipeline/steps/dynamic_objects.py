"""Dynamic object removal step: removes objects that moved during the scan, and returns of the ego vehicle."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.parameters import Coordinate
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, Bools, Frame, PointCloud, Trajectory
from scan2sim.pipeline.io.file_checks import link_or_copy
from scan2sim.pipeline.lidar.sweeps import SCAN_WINDOW_S, scanner_origins

MOVING_MAX_HEIGHT_M = 4.0
"""Height above the path beyond which nothing is moving: lorries are no higher above the ground."""
MIN_REVISITED_FRACTION = 0.1
"""Minimum fraction of points whose voxel was crossed by rays at `votes` moments; below, rays decide almost nothing."""
MOVING_FRACTION_WARNING = 0.2
"""Fraction of moving points above which the step warns."""
CAMERA_RADIUS_M = 1.0
"""Radius around every camera in which points are removed."""


class Cameras(Context):
    """Camera positions (x, y, z) in local metres."""

    positions: tuple[tuple[Coordinate, Coordinate, Coordinate], ...] = ()


class DynamicObjectsParams(Params):
    """Detection of moving objects by free space.

    Attributes:
        when: "auto": if the scanner's path and the points' times are known; "never".
        voxel: edge of the occupancy voxels in metres. A voxel is free only if all its neighbours are, so moving points
            within one voxel of a static surface are kept, and poses may be wrong by one voxel.
        max_range: maximum length of rays in metres; at 20 m, half a degree is one voxel.
        votes: number of moments (of 0.1 s; for a profile scanner, passes) at which rays must have crossed a voxel.
    """

    when: Literal["auto", "never"] = "auto"
    voxel: float = Field(0.2, ge=0.02, le=5)
    max_range: float = Field(20.0, ge=1, le=500)
    votes: int = Field(3, ge=1, le=1000)
    context: Cameras = Cameras()


def dynamic_objects(inputs: Inputs, params: DynamicObjectsParams, out: Path, report: Report) -> Done:
    """Split `cloud` into static and moving points by the free space along the rays from the scanner's `path`.

    Files: `cloud`, without moving points, returns of the ego vehicle, and points next to a camera; `moving`, the moving
    points with time, normals towards the scanner and the class "vehicle"; `dropped`, .npy (N,) uint8 per point of the
    input: 0 if kept, else the class "vehicle" (moving) or "low_noise"; empty if all points are kept.
    """
    from scan2sim.pipeline.dynamic_objects.ego_vehicle_mask import in_swept_volume, near_cameras, swept_volume

    if params.when == "never" or not (params.context.positions or "path" in inputs):
        why = "dynamic_objects.when=never" if params.when == "never" else "neither path nor cameras are known"
        return _untouched(inputs["cloud"], out, why)
    report(0.0, "reading")
    cloud = PointCloud.load(inputs["cloud"])
    path = Trajectory.load(inputs["path"]) if "path" in inputs else None
    seen_again = 0.0
    moved, origins, why = np.zeros(len(cloud), bool), np.zeros((0, 3)), "the scanner's path isn't known"
    volume = own = None
    if path is not None:
        report(0.1, "ego vehicle")
        origins, why = scanner_origins(cloud, path)
        if not why.startswith("the scanner is airborne"):
            volume = swept_volume(cloud.xyz, path)
            own = in_swept_volume(cloud.xyz, volume)
    if not why:
        report(0.2, "tracing rays")
        moved, seen_again = _moved(cloud, origins, path, params)
        why = "" if seen_again > MIN_REVISITED_FRACTION else "nearly all voxels were observed only once"
    near = near_cameras(
        cloud.xyz, np.array(params.context.positions, np.float64).reshape(-1, 3), CAMERA_RADIUS_M, volume
    )
    own = np.zeros(len(cloud), bool) if own is None else own & ~moved
    near &= ~moved & ~own
    moving_share = float(moved.mean())
    metrics: dict[str, object] = {
        "points": len(cloud),
        "moved": int(moved.sum()),
        "moving_share": round(moving_share, 5),
        "own_volume": int(own.sum()),
        "near_cameras": int(near.sum()),
        "revisited": round(seen_again, 3),
        "rays": why or "followed",
    }
    gone = moved | own | near
    if not gone.any():
        return _untouched(inputs["cloud"], out, why, metrics)
    report(0.9, "writing")
    cloud.take(~gone).save(out / "cloud.npz")
    dropped = np.where(moved, CODE["vehicle"], np.where(gone, CODE["low_noise"], 0)).astype(np.uint8)
    np.save(out / "dropped.npy", dropped)
    index = np.flatnonzero(moved)
    towards = origins[index] - cloud.xyz[index] if len(index) else np.zeros((0, 3))
    towards = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-6)
    part = cloud.take(index)
    PointCloud(
        part.frame, part.xyz, part.rgb, towards.astype(np.float32),
        np.full(len(part), CODE["vehicle"], np.uint8), part.time, part.intensity,
    ).save(out / "moving.npz")  # fmt: skip
    files = {name: out / f"{name}.npz" for name in ("cloud", "moving")} | {"dropped": out / "dropped.npy"}
    warnings = []
    if moving_share > MOVING_FRACTION_WARNING:
        warnings.append(
            f"{moving_share:.0%} of the points were removed as moving objects, because other rays passed through them: "
            "check that path and points share a clock, and that poses are accurate to a voxel. "
            "--set dynamic_objects.when=never keeps all points"
        )
    return Done(files, metrics, warnings)


def _untouched(cloud: Path, out: Path, why: str, metrics: dict[str, object] | None = None) -> Done:
    """Result without moving points: the input cloud, linked."""
    file, moving = out / "cloud.npz", out / "moving.npz"
    link_or_copy(cloud, file)
    none = np.zeros((0, 3), np.float32)
    PointCloud(Frame(), none, none.astype(np.uint8), none, np.zeros(0, np.uint8), np.zeros(0)).save(moving)
    np.save(out / "dropped.npy", np.zeros(0, np.uint8))
    return Done({"cloud": file, "moving": moving, "dropped": out / "dropped.npy"}, metrics or {"rays": why})


def _moved(
    cloud: PointCloud, origins: F64, path: Trajectory | None, params: DynamicObjectsParams
) -> tuple[Bools, float]:
    """(N,) bool, True for points that other rays passed through; and the fraction of points in revisited voxels."""
    from scan2sim.pipeline.dynamic_objects.free_space import in_free_space

    assert cloud.time is not None and path is not None
    order = np.argsort(cloud.time, kind="stable")
    time = cloud.time[order]
    free, seen_again = in_free_space(
        cloud.xyz[order],
        origins[order].astype(np.float32),
        np.floor((time - time[0]) / SCAN_WINDOW_S + 0.5).astype(np.int64),
        voxel=params.voxel,
        max_range=params.max_range,
        votes=params.votes,
        high=float(path.positions[:, 2].max()) + MOVING_MAX_HEIGHT_M,
    )
    out = np.empty(len(cloud), bool)
    out[order] = free
    return out, seen_again


DYNAMIC_OBJECTS = Step("dynamic_objects", 3, dynamic_objects, DynamicObjectsParams, memory=(0.5, 6))

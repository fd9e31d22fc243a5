"""Carve: what moved while it was scanned goes, and what lies where the recording vehicle or a camera has been."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.parameters import Coordinate
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, Bools, Frame, PointCloud, Trajectory
from scan2sim.pipeline.io.file_checks import pass_on

WINDOW = 0.1
"""Seconds: a turn of most spinning scanners."""
GAP = 1.0
"""Seconds between two places of the path (or three times what is usual) over which the scanner's place isn't known."""
ABOVE = 4.0
"""Metres above the path from which on nothing moves: lorries are no higher above the ground."""
AIRBORNE = 60.0
"""Metres of median range from which on a scanner flies: its rays pass no place from several sides."""
SEEN_AGAIN = 0.1
"""Share of points that were looked at `votes` times below which the step says that rays tell next to nothing."""
MANY = 0.2
"""Share of points that moved above which a run warns."""


class CarveParams(Params):
    """What is looked for.

    Attributes:
        when: "auto": where there are the scanner's path and points' times; "never".
        voxel: metres, of the cells that rays pass; a place is free only with all of its neighbours, so what moved stays
            within so much of what stands, and poses may be off by so much.
        reach: metres from the scanner up to which rays count: half a degree is a voxel at 20 m.
        votes: moments (of a tenth of a second) that must have seen through a place. Of a profile scanner, passes.
        camera: metres around every camera in which nothing stands; 0: that isn't looked at.
        cameras: (x, y, z) local metres; set by the recipe.
    """

    when: Literal["auto", "never"] = "auto"
    voxel: float = Field(0.2, ge=0.02, le=5)
    reach: float = Field(20.0, ge=1, le=500)
    votes: int = Field(3, ge=1, le=1000)
    camera: float = Field(1.0, ge=0, le=10)
    cameras: tuple[tuple[Coordinate, Coordinate, Coordinate], ...] = ()


def carve(inputs: Inputs, params: CarveParams, out: Path, report: Report) -> Done:
    """Part `cloud` into what stands and what moved, by the rays from `path`, the scanner's, where it is known.

    Files: `cloud`, without what moved, the recording vehicle's own returns and those within a camera's first metre;
    `moving`, what moved, with time, normals towards the scanner and the class "vehicle"; `dropped`, .npy (N,) uint8 by
    point of the cloud, 0 where it is kept, else "vehicle" (it moved) or "low_noise"; empty where all are.
    """
    from scan2sim.pipeline.dynamic_objects.ego_vehicle_mask import in_first_metre, in_swept, swept

    if params.when == "never" or not (params.cameras or "path" in inputs):
        why = "carve.when=never" if params.when == "never" else "neither path nor cameras are known"
        return _untouched(inputs["cloud"], out, why)
    report(0.0, "reading")
    cloud = PointCloud.load(inputs["cloud"])
    path = Trajectory.load(inputs["path"]) if "path" in inputs else None
    seen_again = 0.0
    moved, origins, why = np.zeros(len(cloud), bool), np.zeros((0, 3)), "the scanner's path isn't known"
    way = own = None
    if path is not None:
        report(0.1, "where the vehicle went")
        origins, why = _origins(cloud, path)
        if not why.startswith("the scanner flies"):
            way = swept(cloud.xyz, path)
            own = in_swept(cloud.xyz, way)
    if not why:
        report(0.2, "following rays")
        moved, seen_again = _moved(cloud, origins, path, params)
        why = "" if seen_again > SEEN_AGAIN else "nearly every place was seen once alone"
    near = in_first_metre(cloud.xyz, np.array(params.cameras, np.float64).reshape(-1, 3), params.camera, way)
    own = np.zeros(len(cloud), bool) if own is None else own & ~moved
    near &= ~moved & ~own
    moving_share = float(moved.mean())
    facts: dict[str, object] = {
        "points": len(cloud),
        "moved": int(moved.sum()),
        "moving_share": round(moving_share, 5),
        "own_volume": int(own.sum()),
        "first_metre": int(near.sum()),
        "looked_at_again": round(seen_again, 3),
        "rays": why or "followed",
    }
    gone = moved | own | near
    if not gone.any():
        return _untouched(inputs["cloud"], out, why, facts)
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
    if moving_share > MANY:
        warnings.append(
            f"{moving_share:.0%} of the points lie where other rays saw nothing, and are left out as moving: "
            "are path and points of the same time, and poses better than a voxel? --set carve.when=never keeps them"
        )
    return Done(files, facts, warnings)


def _untouched(cloud: Path, out: Path, why: str, facts: dict[str, object] | None = None) -> Done:
    """The cloud as it is, linked, and nothing that moved."""
    file, moving = out / "cloud.npz", out / "moving.npz"
    pass_on(cloud, file)
    none = np.zeros((0, 3), np.float32)
    PointCloud(Frame(), none, none.astype(np.uint8), none, np.zeros(0, np.uint8), np.zeros(0)).save(moving)
    np.save(out / "dropped.npy", np.zeros(0, np.uint8))
    return Done({"cloud": file, "moving": moving, "dropped": out / "dropped.npy"}, facts or {"rays": why})


def _origins(cloud: PointCloud, path: Trajectory) -> tuple[F64, str]:
    """(N, 3) where the scanner was at each point's time, NaN where that isn't known; and why it isn't at all, or ""."""
    if cloud.time is None:
        return np.zeros((0, 3)), "the points have no times"
    known = np.isfinite(path.times)
    times, positions = path.times[known], path.positions[known]
    if len(times) < 2:
        return np.zeros((0, 3)), "the path has no times"
    origins = np.stack([np.interp(cloud.time, times, positions[:, k]) for k in range(3)], axis=1)
    after = np.clip(np.searchsorted(times, cloud.time), 1, len(times) - 1)
    span = np.diff(times)
    usual = max(GAP, 3 * float(np.median(span)))
    lost = span[after - 1] > usual
    lost &= np.minimum(np.abs(cloud.time - times[after - 1]), np.abs(times[after] - cloud.time)) > WINDOW
    lost |= (cloud.time < times[0] - WINDOW) | (cloud.time > times[-1] + WINDOW)
    origins[lost] = np.nan
    if lost.all():
        return origins, "the path is of another time than the points"
    some = slice(None, None, max(1, len(cloud) // 100_000))
    ranges = np.linalg.norm(cloud.xyz[some] - origins[some], axis=1)
    if np.nanmedian(ranges) > AIRBORNE:
        return origins, f"the scanner flies: points are {np.nanmedian(ranges):.0f} m away"
    return origins, ""


def _moved(cloud: PointCloud, origins: F64, path: Trajectory | None, params: CarveParams) -> tuple[Bools, float]:
    """(N,) which points other rays passed through, and the share of those that rays can tell of."""
    from scan2sim.pipeline.dynamic_objects.free_space import in_free_space

    assert cloud.time is not None and path is not None
    order = np.argsort(cloud.time, kind="stable")
    time = cloud.time[order]
    free, seen_again = in_free_space(
        cloud.xyz[order],
        origins[order].astype(np.float32),
        np.floor((time - time[0]) / WINDOW + 0.5).astype(np.int64),
        voxel=params.voxel,
        reach=params.reach,
        votes=params.votes,
        high=float(path.positions[:, 2].max()) + ABOVE,
    )
    out = np.empty(len(cloud), bool)
    out[order] = free
    return out, seen_again


CARVE = Step("carve", 3, carve, CarveParams, memory=(0.5, 6))

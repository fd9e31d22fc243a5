"""Furniture detection step: signs, poles, lamps and trunks of a tile, before merging with its neighbours."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import F32, PointCloud, Trajectory

if TYPE_CHECKING:
    from scan2sim.pipeline.furniture.classify import Detection

GROUND_CELL_M = 0.5  # cell of the ground height raster
MIN_HEIGHT_M, MAX_HEIGHT_M = 0.2, 14.0  # height range above the ground of points used for detection
MAX_OUTSIDE_CELL_M = 0.5  # detections farther outside the tile's cell are left to the neighbour
KINDS = ("pole", "sign", "lamp", "trunk")


class DetectFurnitureParams(Params):
    """No settings: detections more than 0.5 m outside the tile's cell are discarded."""

    context: TileCell | None = None


def detect_furniture(inputs: Inputs, params: DetectFurnitureParams, out: Path, report: Report) -> Done:
    """Detect street furniture (pole-like objects and sign panels) in the classified `cloud`, using the scanner `path`.

    Without a path, nothing is detected.
    File: `detections`, JSON list of `Detection`s in world metres. Metrics: number of detections of each kind.
    """
    detections: list[Detection] = []
    if "path" in inputs:
        cloud = PointCloud.load(inputs["cloud"])
        report(0.3, "stems")
        detections = detect(cloud, Trajectory.load(inputs["path"]))
        origin = np.asarray(cloud.frame.origin, np.float64)
        detections = [detection.moved(origin) for detection in detections]
        if params.context and detections:
            outside = params.context.cell.outside(np.array([detection.foot[:2] for detection in detections]))
            detections = [
                detection for detection, far in zip(detections, outside, strict=True) if far <= MAX_OUTSIDE_CELL_M
            ]
    (out / "detections.json").write_text(
        json.dumps([detection.to_json() for detection in detections]), encoding="utf-8"
    )
    return Done(
        {"detections": out / "detections.json"}, {kind: sum(t.kind == kind for t in detections) for kind in KINDS}
    )


def detect(cloud: PointCloud, path: Trajectory) -> list[Detection]:
    """Detections in a cloud, local metres."""
    from scan2sim.pipeline.furniture.classify import detect_furniture, eligible
    from scan2sim.pipeline.furniture.poles import Columns

    ground, candidates = eligible(cloud)
    if not ground.any() or not len(candidates):
        return []
    height = heights(cloud.xyz[ground], cloud.xyz[candidates])
    within = (height > MIN_HEIGHT_M) & (height < MAX_HEIGHT_M)
    near_ground = cloud.take(candidates[within])
    return detect_furniture(near_ground, Columns(near_ground.xyz), height[within], path) if len(near_ground) else []


def heights(ground: F32, xyz: F32) -> F32:
    """Height (N,) in metres of points (N, 3) above the lowest nearby ground points (M, 3)."""
    from scipy import ndimage

    from scan2sim.pipeline.geometry.height_map import Raster

    raster = Raster.over(GROUND_CELL_M, [ground, xyz])
    low = -raster.highest(np.column_stack([ground[:, :2], -ground[:, 2]]).astype(np.float32))
    nearest = ndimage.distance_transform_edt(np.isnan(low), return_distances=False, return_indices=True)
    smooth = ndimage.median_filter(low[tuple(nearest)], 5)
    return (xyz[:, 2] - smooth[raster.at(xyz)]).astype(np.float32)


DETECT_FURNITURE = Step("detect_furniture", 3, detect_furniture, DetectFurnitureParams)

"""Floor: ground without holes for the map of a robot, scanned where possible, assumed elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE, GROUPS
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Mesh, PointCloud, Trajectory

MAX_ASSUMED_SHARE = 0.05
"""Share of assumed floor above which the step warns."""
OUTDOOR_GAP_FACTOR = 2.0
"""Outdoors, the rings of a lidar are farther apart, and vehicles cast longer shadows."""


class MapContext(Context):
    """The robot's map.

    Attributes:
        scene: indoor or outdoor.
        spacing: typical distance of neighbouring points, metres.
    """

    scene: Literal["indoor", "outdoor"] = "indoor"
    spacing: float = Field(0.05, gt=0)


class FloorParams(Params):
    """How far the floor of a robot's map extends, and how closely it follows the points.

    Attributes:
        gap: metres; gaps in the floor and between walls narrower than twice this are closed indoors; outdoors, twice as
            wide ones, and if the map has no ground at all, 20 m between walls.
        tolerance: metres; maximum vertical distance of the mesh from the denoised heights.
    """

    gap: float = Field(1.5, ge=0, le=20)
    tolerance: float = Field(0.02, ge=0.001, le=0.5)
    context: MapContext = MapContext()


def floor(inputs: Inputs, params: FloorParams, out: Path, report: Report) -> Done:
    """Make the floor of the clouds `terrain`, `building`, `vegetation` and `rest`; `path` (optional): of the sensor.

    Heights are those of `terrain`. Gaps, scan shadows, and everything enclosed by walls are filled. If the ground is
    missing (removed by a filter), the floor follows the feet of the walls, or the path at the sensor's height, which is
    estimated. Floors above each other become storeys.

    Files: `mesh`; `synthesized`, points of the assumed floor; `mask` (.npz): for each storey K `height_K` (metres, NaN
    without floor) and `assumed_K` (bool), (rows, columns), with `cell` (metres) and `low` (x, y of the first cell's
    corner, local metres).
    """
    from scan2sim.pipeline.terrain.floor_map import floor_map
    from scan2sim.pipeline.terrain.floor_mesh import triangulate

    clouds = {name: PointCloud.load(inputs[name]) for name in (*GROUPS, "rest") if name in inputs}
    terrain = clouds["terrain"]
    path = Trajectory.load(inputs["path"]).positions.astype(np.float32) if "path" in inputs else None
    others = np.concatenate([cloud.xyz for name, cloud in clouds.items() if name != "terrain"])
    context = params.context
    gap = params.gap * (OUTDOOR_GAP_FACTOR if context.scene == "outdoor" else 1.0)
    found = floor_map(
        terrain.xyz, others, spacing=context.spacing, gap=gap, level=context.scene == "indoor", path=path
    )  # fmt: skip
    raster = found.raster
    report(0.5, "triangles")
    meshes, points = [], []
    arrays: dict[str, Any] = {"cell": raster.cell, "low": np.array(raster.low) * raster.cell}
    for k, storey in enumerate(found.storeys):
        meshes.append(triangulate(raster, storey.height, params.tolerance, terrain.frame))
        assumed = storey.there & ~storey.scanned
        points.append(np.column_stack([raster.centres(assumed), storey.height[assumed]]))
        arrays |= {f"height_{k}": storey.height.astype(np.float32), f"assumed_{k}": assumed}
    mesh = _joined(meshes, terrain)
    mesh.save(out / "mesh.npz")
    xyz = np.concatenate([np.zeros((0, 3)), *points]).astype(np.float32)
    up = np.tile(np.array([[0, 0, 1]], np.float32), (len(xyz), 1))
    made = PointCloud(terrain.frame, xyz, _colours(terrain, len(xyz)), up, np.full(len(xyz), CODE["terrain"], np.uint8))
    made.save(out / "synthesized.npz")
    np.savez_compressed(out / "floor.npz", **arrays)
    share = found.assumed_share
    metrics = {
        "storeys": len(found.storeys),
        "area_m2": round(found.area, 1),
        "assumed_m2": round(share * found.area, 1),
        "assumed_share": round(share, 4),
        "ground_missing": found.filtered,
        "sensor_height_m": None if found.sensor_height is None else round(found.sensor_height, 3),
        "cell_m": raster.cell,
        "triangles": len(mesh),
    }
    files = {"mesh": out / "mesh.npz", "synthesized": out / "synthesized.npz", "mask": out / "floor.npz"}
    return Done(files, metrics, _warnings(metrics, path is not None))


def _warnings(metrics: dict[str, Any], has_path: bool) -> list[str]:
    """What was assumed."""
    share, area = metrics["assumed_share"], metrics["assumed_m2"]
    if not metrics["storeys"]:
        return ["no floor: the map has neither ground nor walls"]
    if metrics["ground_missing"]:
        height = metrics["sensor_height_m"]
        source = f"the sensor's path, {height:.2f} m above it" if height is not None else "the feet of the walls"
        hint = "" if has_path else "; --trajectory gives its height more exactly"
        return [f"the map has no ground: its floor ({area:,.0f} m2) is assumed from {source}{hint}"]
    if share > MAX_ASSUMED_SHARE:
        return [f"{share:.0%} of the floor ({area:,.0f} m2) was not scanned: its height is assumed"]
    return []


def _colours(terrain: PointCloud, count: int) -> Any:
    """Mean colour of the ground for assumed points (count, 3); None if the ground has no colours."""
    if terrain.rgb is None:
        return None
    mean = terrain.rgb.mean(axis=0) if len(terrain) else np.full(3, 128)
    return np.tile(np.rint(mean).astype(np.uint8), (count, 1))


def _joined(meshes: list[Mesh], terrain: PointCloud) -> Mesh:
    """The meshes of all storeys as one."""
    first = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    return Mesh(
        terrain.frame,
        np.concatenate([np.zeros((0, 3), np.float32), *(mesh.vertices for mesh in meshes)]),
        np.concatenate(
            [np.zeros((0, 3), np.int32), *(m.faces + np.int32(n) for m, n in zip(meshes, first, strict=False))]
        ).astype(np.int32),
    )


FLOOR = Step("floor", 5, floor, FloorParams, memory=(0.6, 30))

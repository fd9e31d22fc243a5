"""Free space step: removes surface that rays of the scanner pass through."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import Bools, Mesh, PointCloud, Trajectory
from scan2sim.pipeline.io.file_checks import link_or_copy

ROUNDS = 2
"""Rounds of ray casting: surface behind removed surface is reached in the next one."""
BORDER_MARGIN_M = 1.0
"""Distance from the border of a tile within which faces are kept, as the neighbour has other rays."""


PLAN_CELL_M = 0.3
"""Squares of the plan in which a lower face is searched."""
LAYER_M = 0.1
"""Height above the lowest face from which another one is a second layer."""


class FreeSpaceContext(Context):
    """The tile's cell, if it has neighbours."""

    cell: TileCell | None = None


class FreeSpaceParams(Params):
    """Which surface is in free space.

    Attributes:
        when: "auto": if points have times and the scanner's path is known; "never".
        min_hit_ratio: share of the rays reaching a place that must end there for its surface to be kept; foliage
            lets many rays through.
        keep_lowest: keep surface below which there is no other, so that the ground has no holes.
        context: the tile's cell.
    """

    when: Literal["auto", "never"] = "auto"
    min_hit_ratio: float = Field(0.5, ge=0, le=1)
    keep_lowest: bool = False
    context: FreeSpaceContext = FreeSpaceContext()


def free_space(inputs: Inputs, params: FreeSpaceParams, out: Path, report: Report) -> Done:
    """Remove the faces of `mesh` that rays from `path` to the points of `cloud`, of all classes, pass through.

    Metrics: `faces_in`, `faces`; `reason` why there are no rays, or "".
    """
    from scan2sim.pipeline.lidar.free_space import passed_faces
    from scan2sim.pipeline.lidar.sweeps import scanner_origins

    report(0.0, "reading")
    mesh, cloud = Mesh.load(inputs["mesh"]), PointCloud.load(inputs["cloud"])
    origins, reason = scanner_origins(cloud, Trajectory.load(inputs["path"]))
    if reason or not len(mesh):
        link_or_copy(inputs["mesh"], out / "mesh.npz")
        return Done({"mesh": out / "mesh.npz"}, {"faces_in": len(mesh), "faces": len(mesh), "reason": reason})
    known = np.isfinite(origins[:, 0])
    kept = mesh
    for i in range(ROUNDS):
        report(0.2 + 0.4 * i, "casting rays")
        free = passed_faces(kept, origins[known], cloud.xyz[known], params.min_hit_ratio)
        if params.context.cell is not None:
            world = kept.corners.mean(axis=1)[:, :2] + np.asarray(mesh.frame.origin)[:2]
            free &= params.context.cell.cell.outside(world) < -BORDER_MARGIN_M
        if params.keep_lowest:
            free &= _has_lower(kept)
        kept = kept.keep(~free)
    kept.save(out / "mesh.npz")
    metrics = {"faces_in": len(mesh), "faces": len(kept), "reason": ""}
    return Done({"mesh": out / "mesh.npz"}, metrics)


def _has_lower(mesh: Mesh) -> Bools:
    """(F,) bool, True for faces clearly above the lowest one in their square of the plan."""
    centroid = mesh.corners.mean(axis=1)
    square = np.floor(centroid[:, :2] / PLAN_CELL_M).astype(np.int64)
    square -= square.min(axis=0)
    _, of_face = np.unique(square @ [square[:, 1].max() + 1, 1], return_inverse=True)
    lowest = np.full(int(of_face.max()) + 1, np.inf)
    np.minimum.at(lowest, of_face, centroid[:, 2])
    return np.asarray(centroid[:, 2] > lowest[of_face] + LAYER_M)


FREE_SPACE = Step(
    "free_space",
    1,
    free_space,
    FreeSpaceParams,
    class_defaults={"terrain": {"keep_lowest": True}, "vegetation": {"min_hit_ratio": 0.4}},
    per_class=True,
    memory=(0.6, 40),
)

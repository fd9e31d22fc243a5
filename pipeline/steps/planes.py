"""Planes: a mesh laid onto the planes of its points, with straight edges where they meet and end."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Place, Voxel
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, Mesh, PointCloud
from scan2sim.pipeline.tiling.voronoi_cell import Cell

KEPT, FADED = 2.5, 5.0  # voxels from a border up to which Poisson's surface stays, and up to which it partly does


class PlanesParams(Params):
    """Whether buildings get straight edges.

    Limits follow from the voxels and from the noise that flat places of the cloud have.

    Attributes:
        when: "auto" where a scanner drove by (there is a path), "always", or "never".
        voxel: size that the cloud was thinned to; set by the recipe.
        seed: the tile's (x, y), world metres, where it meets others: at its borders the surface stays as it was, which
            is the same in both tiles; set by the recipe.
        neighbours: names of tiles whose cells touch to their seeds, world metres; set by the recipe.
    """

    when: Literal["auto", "always", "never"] = "auto"
    voxel: Voxel = 0.10
    seed: Place | None = None
    neighbours: dict[str, Place] = Field(default_factory=dict)


def planes(inputs: Inputs, params: PlanesParams, out: Path, report: Report) -> Done:
    """Find the planes of `cloud`, thinned of `points`, and lay `mesh` onto them.

    What was made up on planes (`made`, optional) is as good as scanned. Where two planes meet, the mesh folds there;
    where one ends before a parallel one (a window's reveal), it gets the face between them; where one ends and nothing
    is behind, none of `other.*` either, so does the mesh.
    """
    from scan2sim.pipeline.geometry import plane_boundaries, plane_snapping
    from scan2sim.pipeline.geometry.planes import Planes, detect

    mesh, cloud, voxel = Mesh.load(inputs["mesh"]), PointCloud.load(inputs["cloud"]), params.voxel
    assert cloud.normal is not None
    found, which, tolerance = detect(cloud.xyz, cloud.normal, voxel)
    facts: dict[str, Any] = {"faces_in": len(mesh), "planes": len(found)}
    if not len(found) or not len(mesh):
        mesh.save(out / "mesh.npz")
        return Done({"mesh": out / "mesh.npz"}, facts | {"faces": len(mesh), "on_planes": 0.0})
    report(0.2, "extents")
    points = PointCloud.load(inputs["points"]).xyz
    own = plane_boundaries.members(points, found, cloud.xyz, which, voxel, tolerance)
    if "made" in inputs:
        made = PointCloud.load(inputs["made"])
        assert made.normal is not None
        theirs = found.of(made.xyz, made.normal)
        points, own = np.concatenate([points, made.xyz]), np.concatenate([own, theirs])
        cloud, which = PointCloud.join([cloud, made]), np.concatenate([which, theirs])
    sides = plane_boundaries.sides(points, own, found, voxel)
    faces, between, of_face = plane_boundaries.steps(sides, found, cloud.xyz, which, voxel, tolerance)
    others = [PointCloud.load(path).xyz for name, path in inputs.items() if name.startswith("other.")]
    edges = plane_snapping.edges_of(mesh)
    border = mesh.vertices[plane_snapping.border_of(edges)]
    ends, of_side = plane_boundaries.free(
        sides, found, cloud.xyz, which, np.concatenate([np.zeros((0, 3), np.float32), *others]), border, voxel
    )
    report(0.5, "vertices")
    on = which >= 0
    near, beside = plane_snapping.plane_of(
        mesh,
        every := Planes.join([found, faces]),
        np.concatenate([cloud.xyz[on], between]).astype(np.float32),
        np.concatenate([which[on], of_face + len(found)]).astype(np.int32),
        voxel,
        tolerance,
    )
    laid = plane_boundaries.ended(mesh.vertices.astype(np.float64), near, every, sides, ends, of_side, cloud.xyz, voxel)
    report(0.7, "edges")
    beside |= laid != near
    share = inland(mesh, params)
    laid[share == 0] = -1
    every_end = Planes.join([every, sides.planes])
    sharp = plane_snapping.sharpen(mesh, edges, every_end, laid, beside, share, len(every), voxel, tolerance)
    sharp.mesh.save(out / "mesh.npz")
    facts |= {
        "faces": len(sharp.mesh),
        "on_planes": round(float((sharp.which >= 0).mean()), 3) if len(sharp.which) else 0.0,
        "steps": len(faces),
        "straight_ends_m": round(len(ends) * voxel, 1),
        "tolerance_m": round(tolerance, 4),
    }
    return Done({"mesh": out / "mesh.npz"}, facts)


def inland(mesh: Mesh, params: PlanesParams) -> F64:
    """(V,) by how much vertices may be moved: 0 beside a border with another tile, 1 away from it.

    Beyond a tile's buffer its planes' points are missing, so its planes aren't quite the neighbour's.
    """
    from scan2sim.pipeline.tiling.borders.grid import world

    share = np.ones(len(mesh.vertices))
    if params.seed is not None and params.neighbours:
        away = np.abs(Cell(params.seed, params.neighbours).outside(world(mesh)[:, :2])) / params.voxel
        share = np.clip((away - KEPT) / (FADED - KEPT), 0, 1)
    return share


PLANES = Step("planes", 3, planes, PlanesParams)

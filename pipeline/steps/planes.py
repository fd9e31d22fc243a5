"""Plane snapping (step `planes`): moves mesh vertices onto planes of the cloud, with straight edges and boundaries."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import ThinnedCloud
from scan2sim.pipeline.core.types import F64, Mesh, PointCloud

FIXED_VOXELS, BLENDED_VOXELS = 2.5, 5.0  # distance from a tile border up to which vertices are fixed, and blended


class PlanesParams(Params):
    """Whether buildings get straight edges.

    Thresholds follow from the voxel size and the noise of planar parts of the cloud.

    Attributes:
        when: "auto": if the tile has a scanner's path; "always"; "never".
        context: the cloud's voxel size and the tile's cell; vertices at borders stay, so that both tiles agree.
    """

    when: Literal["auto", "always", "never"] = "auto"
    context: ThinnedCloud = ThinnedCloud()


def planes(inputs: Inputs, params: PlanesParams, out: Path, report: Report) -> Done:
    """Detect planes in `cloud` (the thinned `points`) and snap `mesh` to them.

    Synthesized points on planes (`synthesized`, optional) are used like scanned ones. Where two planes intersect, the
    mesh gets a sharp edge; where one ends in front of a parallel one (a window reveal), the face between them; where
    one ends with no points behind it (nor in `other.*`), a straight boundary.
    """
    from scan2sim.pipeline.geometry import plane_boundaries, plane_snapping
    from scan2sim.pipeline.geometry.planes import Planes, detect

    mesh, cloud, voxel = Mesh.load(inputs["mesh"]), PointCloud.load(inputs["cloud"]), params.context.voxel
    assert cloud.normal is not None
    found, which, tolerance = detect(cloud.xyz, cloud.normal, voxel)
    metrics: dict[str, Any] = {"faces_in": len(mesh), "planes": len(found)}
    if not len(found) or not len(mesh):
        mesh.save(out / "mesh.npz")
        return Done({"mesh": out / "mesh.npz"}, metrics | {"faces": len(mesh), "on_planes": 0.0})
    report(0.2, "boundaries")
    points = PointCloud.load(inputs["points"]).xyz
    point_plane = plane_boundaries.assign_points(points, found, cloud.xyz, which, voxel, tolerance)
    if "synthesized" in inputs:
        made = PointCloud.load(inputs["synthesized"])
        assert made.normal is not None
        made_plane = found.nearest(made.xyz, made.normal)
        points, point_plane = np.concatenate([points, made.xyz]), np.concatenate([point_plane, made_plane])
        cloud, which = PointCloud.join([cloud, made]), np.concatenate([which, made_plane])
    sides = plane_boundaries.sides(points, point_plane, found, voxel)
    faces, between, of_face = plane_boundaries.step_faces(sides, found, cloud.xyz, which, voxel, tolerance)
    others = [PointCloud.load(path).xyz for name, path in inputs.items() if name.startswith("other.")]
    edges = plane_snapping.edges_of(mesh)
    border = mesh.vertices[plane_snapping.border_vertices(edges)]
    ends, of_side = plane_boundaries.open_boundaries(
        sides, found, cloud.xyz, which, np.concatenate([np.zeros((0, 3), np.float32), *others]), border, voxel
    )
    report(0.5, "vertices")
    on_plane = which >= 0
    near, near_edge = plane_snapping.assign_vertices(
        mesh,
        every := Planes.join([found, faces]),
        np.concatenate([cloud.xyz[on_plane], between]).astype(np.float32),
        np.concatenate([which[on_plane], of_face + len(found)]).astype(np.int32),
        voxel,
        tolerance,
    )
    vertex_plane = plane_boundaries.cut_at_boundaries(
        mesh.vertices.astype(np.float64), near, every, sides, ends, of_side, cloud.xyz, voxel
    )
    report(0.7, "edges")
    near_edge |= vertex_plane != near
    weight = snap_weights(mesh, params)
    vertex_plane[weight == 0] = -1
    every_end = Planes.join([every, sides.planes])
    snapped = plane_snapping.snap_to_planes(
        mesh, edges, every_end, vertex_plane, near_edge, weight, len(every), voxel, tolerance
    )
    snapped.mesh.save(out / "mesh.npz")
    metrics |= {
        "faces": len(snapped.mesh),
        "on_planes": round(float((snapped.which >= 0).mean()), 3) if len(snapped.which) else 0.0,
        "steps": len(faces),
        "straight_ends_m": round(len(ends) * voxel, 1),
        "tolerance_m": round(tolerance, 4),
    }
    return Done({"mesh": out / "mesh.npz"}, metrics)


def snap_weights(mesh: Mesh, params: PlanesParams) -> F64:
    """Blend weight (V,) of snapping: 0 beside a border with another tile, 1 away from it.

    Planes of two tiles differ slightly, because a tile has no points beyond its buffer.
    """
    from scan2sim.pipeline.geometry.coordinate_grid import world

    weight = np.ones(len(mesh.vertices))
    tile = params.context.cell
    if tile is not None and tile.neighbours:
        away = np.abs(tile.cell.outside(world(mesh)[:, :2])) / params.context.voxel
        weight = np.clip((away - FIXED_VOXELS) / (BLENDED_VOXELS - FIXED_VOXELS), 0, 1)
    return weight


PLANES = Step("planes", 4, planes, PlanesParams)

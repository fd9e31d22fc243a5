"""Reflectance: what a lidar's returns say about each surface, from the intensities of the points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.classes import SURFACES, name_of, surface_of
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, Mesh, PointCloud, Trajectory
from scan2sim.pipeline.geometry.voxel_grid import sample
from scan2sim.pipeline.io.worlds.textured_mesh import save_reflectance

POINT_SPACING_M = 0.1
"""Voxels from which one intensity is taken."""
DARKEST = 1 / 255
"""Reflectance of the darkest surface that gave returns: 0 is surface that gave none."""
NEAR_M = 0.5
"""Distance of the nearest point up to which the reflectance of a vertex counts as measured."""


def reflectance(inputs: Inputs, params: Params, out: Path, report: Report) -> Done:
    """Reflectance of the vertices of `textured.GROUP` from the intensities of the classified `cloud`.

    Intensities are corrected for range and angle of incidence if the `path` (optional) of the sensor is known. The
    folder `reflectance` contains a folder `GROUP` for each mesh (`textured_mesh.save_reflectance`); it is empty if the
    cloud has no intensities, or constant ones. Reflectance 0 marks surface that gave no return
    (`pipeline.lidar.no_return`); it needs `sweeps` and `moving` (optional) with rays without a return.

    Metrics: `source`: "corrected" for range and angle, "intensity" without a path, or "none" and the `reason`;
    `classes`, median by class; `measured`, share of the vertices with a point within 0.5 m: others have the
    reflectance of the nearest points; `no_return_m2`, by surface, area that gave no return, or `unmarked`, the reason
    why it isn't known.
    """
    from scan2sim.pipeline.lidar.intensity import MIN_POINTS, has_intensity
    from scan2sim.pipeline.lidar.no_return import gave_no_return
    from scan2sim.pipeline.lidar.reflectance import at_vertices
    from scan2sim.pipeline.lidar.reflectance import reflectance as of_points

    folder = out / "reflectance"
    folder.mkdir()
    cloud = PointCloud.load(inputs["cloud"])
    if cloud.intensity is None or not has_intensity(cloud):
        reason = "the cloud has no intensities" if cloud.intensity is None else "the intensities are constant"
        return Done({"reflectance": folder}, {"source": "none", "reason": reason})
    report(0.1, "correcting for range and angle")
    thin = sample(cloud, POINT_SPACING_M)
    value = of_points(thin, Trajectory.load(inputs["path"]) if "path" in inputs else None)
    thin, value = thin.take(np.isfinite(value)), value[np.isfinite(value)]
    if len(thin) < MIN_POINTS:
        return Done({"reflectance": folder}, {"source": "none", "reason": "most intensities are 0"})
    assert thin.classification is not None
    groups = [group for group in SURFACES if f"textured.{group}" in inputs]
    surface = surface_of(groups)[thin.classification]
    meshes = [Mesh.load(inputs[f"textured.{group}"] / "mesh.npz") for group in groups]
    report(0.4, "rays without a return")
    hits, held_out, unmarked = _unreturned(inputs, meshes)
    returns = np.concatenate([cloud.xyz, held_out])
    near, total = 0, 0
    no_return: dict[str, float] = {}
    for i, (group, mesh) in enumerate(zip(groups, meshes, strict=True)):
        report(0.5 + 0.5 * i / len(groups), group)
        own = surface == i
        if np.count_nonzero(own) < MIN_POINTS:
            own[:] = True
        found, distance = at_vertices(mesh.vertices, thin.xyz[own], value[own])
        marked = gave_no_return(mesh.vertices, returns, hits)
        no_return[group] = round(float(mesh.face_area @ marked[mesh.faces].mean(axis=1)), 2)
        (folder / group).mkdir()
        save_reflectance(folder / group, np.where(marked, 0, np.maximum(found, DARKEST)).astype(np.float32))
        near, total = near + int(np.count_nonzero(distance < NEAR_M)), total + len(mesh.vertices)
    codes = np.unique(thin.classification).tolist()
    metrics = {
        "source": "corrected" if "path" in inputs else "intensity",
        "classes": {name_of(one): round(float(np.median(value[thin.classification == one])), 3) for one in codes},
        "measured": round(near / max(total, 1), 4),
        **({"unmarked": unmarked} if unmarked else {"no_return_m2": no_return}),
    }
    return Done({"reflectance": folder}, metrics)


def _unreturned(inputs: Inputs, meshes: Sequence[Mesh]) -> tuple[F32, F32, str]:
    """Points (M, 3) where rays of the sweeps without a return meet the meshes, and the sweeps' returns (N, 3).

    Third the reason if such rays aren't known, or "".
    """
    from scan2sim.pipeline.lidar.casting import Scanner
    from scan2sim.pipeline.lidar.no_return import unreturned_hits
    from scan2sim.pipeline.lidar.sweeps import Sweeps, moving_returns
    from scan2sim.pipeline.lidar.unreturned import near_excluded, unreturned_rays

    none = np.zeros((0, 3), np.float32)
    if "sweeps" not in inputs:
        return none, none, "the path of the scanner isn't known"
    sweeps = Sweeps.load(inputs["sweeps"])
    if not len(sweeps):
        return none, none, "the cloud has no sweeps"
    rays, unknown = unreturned_rays(sweeps)
    if unknown:
        return none, none, unknown
    rays = rays.take(~near_excluded(rays, moving_returns(sweeps, PointCloud.load(inputs["moving"]))))
    return unreturned_hits(rays, Scanner.of(meshes)), sweeps.xyz, ""


REFLECTANCE = Step("reflectance", 2, reflectance, memory=(0.5, 6))

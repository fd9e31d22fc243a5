"""Visibility: a depth map for every photo, from the meshes and from points that no mesh represents."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Distance
from scan2sim.pipeline.core.parts import NO_PARTS, Parts, file_digest
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Mesh, PointCloud, View
from scan2sim.pipeline.io import views as views_io


class VisibilityParams(Params):
    """Resolution of the depth maps.

    Attributes:
        pixels: maximum number of pixels of a depth map.
        radius: radius in metres of the discs that represent points of the cloud.
        mesh_distance: points farther than this from every mesh (cars, people) occlude as discs, metres.
        slim_radius: radius in metres of the discs that represent points of posts, signs and trunks: a photo shows them
            this far beside their meshes, and they aren't to be seen on the walls behind; 0: off.
    """

    pixels: int = Field(2_000_000, ge=10_000, le=64_000_000)
    radius: float = Field(0.08, ge=0.001, le=10)
    mesh_distance: Distance = 0.2
    slim_radius: float = Field(0.05, ge=0, le=1)


def visibility(inputs: Inputs, params: VisibilityParams, out: Path, report: Report, parts: Parts = NO_PARTS) -> Done:
    """Render a depth map of the meshes `mesh.*`, the clouds `cloud.*` and the `moving` points for every view.

    Points of street `furniture` (optional) hide what is clearly behind them.

    Files: `depth/<view index>.npy`, (H, W) float32, metres along the pixel's ray.
    """
    from scan2sim.pipeline.camera import depth_map as kernel

    folder = out / "depth"
    folder.mkdir()
    views = views_io.load(inputs["views"])
    if not views:
        return Done({"depth": folder}, {"views": 0})
    meshes = [Mesh.load(path) for name, path in inputs.items() if name.startswith("mesh.")]
    cloud = PointCloud.join([PointCloud.load(path) for name, path in inputs.items() if name.startswith("cloud.")])
    moving = PointCloud.load(inputs["moving"]) if "moving" in inputs else None
    occluders = kernel.scene(meshes, cloud, radius=params.radius, mesh_distance=params.mesh_distance, moving=moving)
    if "furniture" in inputs and params.slim_radius:
        slim = PointCloud.load(inputs["furniture"]).xyz
        occluders = replace(occluders, slim=slim, slim_radius=params.slim_radius)
    hidden_by = [params.model_dump(mode="json"), {n: file_digest(p) for n, p in inputs.items() if n != "views"}]
    for i, view in enumerate(views):
        report(i / len(views), view.name)

        def render(file: Path = folder / f"{i}.npy", view: View = view) -> list[Path]:
            depth = kernel.depth_map(view.camera, view.T_world_cam, occluders, time=view.time, pixels=params.pixels)
            np.save(file, depth.range)
            return [file]

        parts.provide(folder, [*hidden_by, i, views_io.to_json(view, with_paths=False)], render)
    return Done(
        {"depth": folder}, {"views": len(views), "triangles": occluders.triangles, "discs": len(occluders.centres)}
    )


VISIBILITY = Step("visibility", 5, visibility, VisibilityParams, parts=True, memory=(0.7, 3))

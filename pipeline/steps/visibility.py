"""Visibility: a depth map for every photo, from the meshes and from what of the cloud they lack."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Reach
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Mesh, PointCloud
from scan2sim.pipeline.io import views as views_io


class VisibilityParams(Params):
    """How finely is looked.

    Attributes:
        pixels: depth maps are at most this large.
        radius: of the discs that the cloud's points are drawn as, metres.
        lacking: points further than this from every mesh hide by themselves (cars, people), metres.
    """

    pixels: int = Field(2_000_000, ge=10_000, le=64_000_000)
    radius: float = Field(0.08, ge=0.001, le=10)
    lacking: Reach = 0.2


def visibility(inputs: Inputs, params: VisibilityParams, out: Path, report: Report) -> Done:
    """Draw a depth map of the meshes `mesh.*`, the clouds `cloud.*` and what is `moving` for every view of `views`.

    The maps are `depth/<view index>.npy`: (H, W) float32, metres along the pixel's ray.
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
    hides = kernel.scene(meshes, cloud, radius=params.radius, lacking=params.lacking, moving=moving)
    for i, view in enumerate(views):
        report(i / len(views), view.name)
        depth = kernel.depth_map(view.camera, view.T_world_cam, hides, time=view.time, pixels=params.pixels)
        np.save(folder / f"{i}.npy", depth.range)
    return Done({"depth": folder}, {"views": len(views), "triangles": hides.triangles, "discs": len(hides.centres)})


VISIBILITY = Step("visibility", 4, visibility, VisibilityParams, memory=(0.7, 3))

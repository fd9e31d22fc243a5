"""Who sees what: range images of meshes and points, and the test of a point against them.

A range image holds, for every pixel of a scaled camera, the distance along the pixel's ray to
what it meets first, whatever the camera model. Meshes are met by ray casting (Embree); for discs every
pixel of their footprint asks exactly where its own ray meets the plane.

What hides: the meshes, and of the cloud only what the meshes lack (cars, people, what was trimmed away),
as discs along the points' normals. A point is visible if its range is no more than the range image's
plus a bias that grows with the slope at which the surface is seen.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.types import F32, F64, Camera, Mesh, PointCloud

BIAS = 0.04
"""Metres that a point may lie behind what the range image shows and still count as seen."""
PIXELS = 2_000_000
"""Range images are at most this large."""
ENLARGED = 2.0
"""They are at most this many times as wide as the photo: finer pixels leak less and hide less falsely."""


@dataclass(frozen=True)
class Scene:
    """What hides.

    Attributes:
        casting: Open3D's `RaycastingScene` of the meshes.
        triangles: number of them.
        centres, normals: (N, 3) of the discs; unit normals.
        radius: of the discs, metres.
    """

    casting: Any
    triangles: int
    centres: F32
    normals: F32
    radius: float


@dataclass(frozen=True)
class DepthMap:
    """What a view sees first.

    Attributes:
        camera: the view's, scaled.
        T_world_cam: (4, 4) camera to local coordinates.
        range: (H, W) float32 metres along each pixel's ray; inf where it meets nothing.
    """

    camera: Camera
    T_world_cam: F64
    range: F32


def scene(
    meshes: Iterable[Mesh], cloud: PointCloud | None = None, *, radius: float = 0.08, lacking: float = 0.2
) -> Scene:
    """What hides, from the meshes of all classes and the whole cloud.

    Args:
        meshes: all classes.
        cloud: with normals; None if only meshes hide.
        radius: of the discs, metres; about the cloud's voxel size.
        lacking: points nearer than this to a mesh (metres) are left to the mesh.
    """
    import open3d as o3d

    casting, triangles = o3d.t.geometry.RaycastingScene(), 0
    for mesh in meshes:
        if len(mesh):
            casting.add_triangles(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces, np.uint32))
            triangles += len(mesh)
    if cloud is None or not len(cloud) or cloud.normal is None:
        empty = np.zeros((0, 3), np.float32)
        return Scene(casting, triangles, empty, empty, radius)
    if triangles:
        cloud = cloud.take(casting.compute_distance(np.ascontiguousarray(cloud.xyz)).numpy() > lacking)
    assert cloud.normal is not None
    return Scene(casting, triangles, cloud.xyz, cloud.normal, radius)


def depth_map(camera: Camera, T_world_cam: F64, hides: Scene, *, pixels: int = PIXELS) -> DepthMap:
    """The range image of a view.

    Args:
        camera: of the view, at full size.
        T_world_cam: (4, 4) camera to local coordinates.
        hides: see `scene`.
        pixels: the camera is scaled to at most this many, and to at most `ENLARGED` times its width.
    """
    from pipeline import range_image
    from pipeline.cameras import MODEL_ID, parameters, pixel_rays

    camera = camera.scaled(min(ENLARGED, math.sqrt(pixels / (camera.width * camera.height))))
    model, p, rays = MODEL_ID[camera.model], parameters(camera), pixel_rays(camera)
    T_world_cam = np.asarray(T_world_cam, np.float64)
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    if hides.triangles:
        cast = np.empty((camera.height, camera.width, 6), np.float32)
        cast[..., :3], cast[..., 3:] = (
            T_world_cam[:3, 3],
            np.nan_to_num(rays) @ T_world_cam[:3, :3].T.astype(np.float32),
        )
        met = hides.casting.cast_rays(cast)["t_hit"].numpy()
        depth = np.where(np.isfinite(rays[..., 0]), met, np.inf).astype(np.float32)
    if len(hides.centres):
        T_cam_world: F64 = np.linalg.inv(T_world_cam).astype(np.float64)
        range_image.draw_discs(depth, rays, model, p, T_cam_world, hides.centres, hides.normals, hides.radius)
    return DepthMap(camera, T_world_cam, depth)


def load_depth_map(path: Path, camera: Camera, T_world_cam: F64) -> DepthMap:
    """The range image kept at `path` (.npy, (H, W) float32) of a view with that camera and pose."""
    depth = np.load(path)
    height, width = depth.shape
    sx, sy = width / camera.width, height / camera.height
    small = replace(
        camera, width=width, height=height, fx=camera.fx * sx, fy=camera.fy * sy,
        cx=(camera.cx + 0.5) * sx - 0.5, cy=(camera.cy + 0.5) * sy - 0.5,
    )  # fmt: skip
    return DepthMap(small, np.asarray(T_world_cam, np.float64), depth)


def visible(
    depth: DepthMap, points: npt.ArrayLike, normals: npt.ArrayLike | None = None, *, bias: float = BIAS
) -> npt.NDArray[np.bool_]:
    """(N,) which points the view sees: within the image, and not behind what its range image shows.

    Args:
        depth: of the view.
        points: (N, 3) local metres.
        normals: (N, 3) unit, of the surface at the points; either side; None: seen head-on.
        bias: metres allowed behind the range image, before the slope's share.
    """
    from pipeline import range_image
    from pipeline.cameras import MODEL_ID, parameters, pixel_angle

    points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
    facing = np.zeros((0, 3)) if normals is None else np.ascontiguousarray(normals, np.float64).reshape(-1, 3)
    return range_image.points_visible(
        depth.range,
        MODEL_ID[depth.camera.model],
        parameters(depth.camera),
        np.linalg.inv(depth.T_world_cam),
        points,
        facing,
        bias,
        pixel_angle(depth.camera),
    )

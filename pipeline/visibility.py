"""Who sees what: range images of meshes and points, and the test of a point against them.

A range image holds, for every pixel of a (scaled-down) camera, the distance along the pixel's ray to
what it meets first. Triangles and discs go through the same kernel: their footprint in the image is
found by projection, and every pixel in it asks exactly where its own ray meets the plane. So it holds
for every camera model, and equals ray casting at a fraction of its time.

What hides: the meshes, and of the cloud only what the meshes lack (cars, people, what was trimmed away),
as discs along the points' normals. A point is visible if its range is no more than the range image's
plus a bias that grows with the slope at which the surface is seen.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.types import F32, F64, Camera, Mesh, PointCloud

BIAS = 0.05
"""Metres that a point may lie behind what the range image shows and still count as seen."""
PIXELS = 1_000_000
"""Range images are at most this large."""


@dataclass(frozen=True)
class Scene:
    """What hides: triangles (F, 3, 3), and discs with centres (N, 3), unit normals (N, 3), one radius (m)."""

    triangles: F32
    centres: F32
    normals: F32
    radius: float


@dataclass(frozen=True)
class DepthMap:
    """What a view sees first.

    Attributes:
        camera: scaled down from the view's.
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
    parts = [mesh.corners for mesh in meshes if len(mesh)]
    triangles = np.concatenate(parts) if parts else np.zeros((0, 3, 3), np.float32)
    empty = np.zeros((0, 3), np.float32)
    if cloud is None or not len(cloud) or cloud.normal is None:
        return Scene(np.ascontiguousarray(triangles), empty, empty, radius)
    far = _farther_than(cloud.xyz, parts, lacking)
    return Scene(np.ascontiguousarray(triangles), cloud.xyz[far], cloud.normal[far], radius)


def _farther_than(points: F32, parts: Sequence[F32], distance: float) -> npt.NDArray[np.bool_]:
    """(N,) which points lie farther than `distance` from every triangle."""
    if not parts:
        return np.ones(len(points), bool)
    import open3d as o3d

    casting = o3d.t.geometry.RaycastingScene()
    for corners in parts:
        casting.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(corners.reshape(-1, 3))),
            o3d.core.Tensor(np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)),
        )
    return casting.compute_distance(o3d.core.Tensor(np.ascontiguousarray(points))).numpy() > distance


def depth_map(camera: Camera, T_world_cam: F64, hides: Scene, *, pixels: int = PIXELS) -> DepthMap:
    """The range image of a view.

    Args:
        camera: of the view, at full size.
        T_world_cam: (4, 4) camera to local coordinates.
        hides: see `scene`.
        pixels: the camera is scaled down to at most this many.
    """
    from pipeline.cameras import MODEL_ID, parameters, pixel_rays

    camera = camera.scaled(min(1.0, math.sqrt(pixels / (camera.width * camera.height))))
    model, p, rays = MODEL_ID[camera.model], parameters(camera), pixel_rays(camera)
    T_cam_world = np.linalg.inv(np.asarray(T_world_cam, np.float64))
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    from pipeline import range_image

    if len(hides.triangles):
        range_image.draw_triangles(depth, rays, model, p, T_cam_world, hides.triangles)
    if len(hides.centres):
        range_image.draw_discs(depth, rays, model, p, T_cam_world, hides.centres, hides.normals, hides.radius)
    return DepthMap(camera, np.asarray(T_world_cam, np.float64), depth)


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

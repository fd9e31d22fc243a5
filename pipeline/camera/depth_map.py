"""Who sees what: range images of meshes and points, and the test of a point against them.

A range image holds, for every pixel of a scaled camera, the distance along the pixel's ray to
its first hit, whatever the camera model. Meshes are hit by ray casting (Embree); for discs every
pixel of their footprint asks exactly where its own ray meets the plane.

What hides: the meshes where points bear them out (Poisson rounds off what is thin, and such a bulge hides nothing),
and of the cloud only what the meshes lack (cars, people, what was trimmed away), as discs along the points'
normals. What drove past while it was scanned left a trail of points, most of which `carve` has told apart: each hides
only from photos taken at about the time when it was scanned. A point is visible if its range is no more than the range
image's plus a bias that grows with the slope at which the surface is seen. Measured on a street whose truth is known
by `bench/visibility.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, F64, Bools, Camera, Mesh, PointCloud

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.projection import Ranges

BIAS = 0.04
"""Metres that a point may lie behind what the range image shows and still count as seen."""
PIXELS = 2_000_000
"""Range images are at most this large."""
ENLARGED = 2.0
"""They are at most this many times as wide as the photo: finer pixels leak less and hide less falsely."""
SUPPORT = 1.3
"""A mesh farther from every point than so many times the points' usual spacing hides nothing there."""
LOOSE = 2.5
"""Leaves stand off the mesh of their crown: their points are left to it even so many times farther away."""
MOVABLE = (CODE["vehicle"], CODE["person"])
FOLIAGE = (CODE["low_vegetation"], CODE["mid_vegetation"], CODE["high_vegetation"])
PASSING = 1.0
"""Seconds: a movable thing moves where the points around one of its points were all scanned within this time."""
AROUND = 1.0
"""Metres: the points that are around another."""
PASS = 5.0
"""Seconds between scans of the same place that are told apart as two passes of the scanner."""
PRESENT = (-0.1, 0.4)
"""Seconds after its scan within which a point of a moving thing hides: points tell when their place was first scanned,
and a car takes about so long to leave it."""
MOMENT = 0.1
"""The same, before and after, of points that `carve` found moving: the scanner's next turn has new ones."""
FASTEST = 20.0
"""Metres a second: points of moving things belong together less, the longer the time between them."""
CLOSING = 0.7
"""Discs of movable things reach so far of the way to the eighth neighbour: seen from one side, they are sparse."""
SPARSE = 3.0
"""Though to at most so many times the discs' radius."""


@dataclass(frozen=True)
class Scene:
    """What hides.

    Attributes:
        casting: Open3D's `RaycastingScene` of the meshes.
        triangles: number of them.
        centres, normals: (N, 3) of the discs; unit normals.
        radii: (N,) of the discs, metres.
        spans: (N, 2) of the discs, seconds from and to which they hide; NaN for those that hide at all times.
    """

    casting: Any
    triangles: int
    centres: F32
    normals: F32
    radii: F32
    spans: F64


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

    @property
    def ranges(self) -> Ranges:
        """As kernels take it."""
        from scan2sim.pipeline.camera.models import pixel_angle
        from scan2sim.pipeline.camera.projection import Ranges

        return Ranges(self.range, pixel_angle(self.camera))


def scene(
    meshes: Iterable[Mesh],
    cloud: PointCloud | None = None,
    *,
    radius: float = 0.08,
    lacking: float = 0.2,
    moving: PointCloud | None = None,
) -> Scene:
    """What hides, from the meshes of all classes and the whole cloud.

    Args:
        meshes: all classes.
        cloud: with normals; None if only meshes hide, all of them.
        radius: of the discs, metres; about the cloud's voxel size.
        lacking: points nearer than this to a mesh (metres) are left to the mesh.
        moving: what the step `carve` found moving, with normals and time.
    """
    import open3d as o3d

    whole = cloud is None or not len(cloud) or cloud.normal is None
    if cloud is not None and not whole:
        meshes = _borne_out(meshes, cloud)
    casting, triangles = o3d.t.geometry.RaycastingScene(), 0
    for mesh in meshes:
        if len(mesh):
            casting.add_triangles(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces, np.uint32))
            triangles += len(mesh)
    if cloud is None or whole:
        empty = np.zeros((0, 3), np.float32)
        still = Scene(casting, triangles, empty, empty, np.zeros(0, np.float32), np.zeros((0, 2)))
        return _with(still, moving, radius)
    if triangles:
        near = casting.compute_distance(np.ascontiguousarray(cloud.xyz)).numpy()
        cloud = cloud.take(near > np.where(_of_class(cloud, FOLIAGE), LOOSE * lacking, lacking))
    assert cloud.normal is not None
    spans = times_of_moving(cloud)[:, None] + PRESENT
    return _with(Scene(casting, triangles, cloud.xyz, cloud.normal, _radii(cloud, radius), spans), moving, radius)


def _with(still: Scene, moving: PointCloud | None, radius: float) -> Scene:
    """The scene with the points of what moved, each at its time."""
    from scipy.spatial import cKDTree

    if moving is None or not len(moving):
        return still
    assert moving.normal is not None and moving.time is not None
    since = FASTEST * (moving.time - moving.time.min())
    there = np.column_stack([moving.xyz, since])
    distance, _ = cKDTree(there).query(there, k=[min(9, len(there))], workers=-1)
    radii = np.clip(CLOSING * distance[:, 0], radius, SPARSE * radius).astype(np.float32)
    return replace(
        still,
        centres=np.concatenate([still.centres, moving.xyz]),
        normals=np.concatenate([still.normals, moving.normal]),
        radii=np.concatenate([still.radii, radii]),
        spans=np.concatenate([still.spans, moving.time[:, None] + (-MOMENT, MOMENT)]),
    )


def _of_class(cloud: PointCloud, codes: tuple[int, ...]) -> Bools:
    """(N,) which points are of these classes; none where the classes aren't known."""
    return np.zeros(len(cloud), bool) if cloud.classification is None else np.isin(cloud.classification, codes)


def _borne_out(meshes: Iterable[Mesh], cloud: PointCloud) -> list[Mesh]:
    """The faces whose corners all have a point near by; how near, the points' usual spacing says.

    Those with a class of their own are things' (`furniture`), fitted to points that are in no surface's cloud.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(cloud.xyz)
    some = cloud.xyz[:: max(1, len(cloud) // 20_000)]
    spacing, _ = tree.query(some, k=min(7, len(cloud)), workers=-1)
    reach = SUPPORT * float(np.median(np.atleast_2d(spacing)[:, 1:].mean(axis=1))) if len(cloud) > 1 else np.inf
    kept = []
    for mesh in meshes:
        distance, _ = tree.query(mesh.vertices, distance_upper_bound=reach, workers=-1)
        near = np.isfinite(distance)[mesh.faces].all(axis=1)
        kept.append(mesh.keep(near if mesh.classification is None else near | (mesh.classification > 0)))
    return kept


def _radii(cloud: PointCloud, radius: float) -> F32:
    """(N,) metres: `radius`, and of movable things so large that their discs close the surface between them."""
    from scipy.spatial import cKDTree

    radii = np.full(len(cloud), radius, np.float32)
    movable = np.flatnonzero(_of_class(cloud, MOVABLE))
    if len(movable):
        xyz = cloud.xyz[movable]
        distance, _ = cKDTree(xyz).query(xyz, k=[9], workers=-1)  # the first is the point itself
        radii[movable] = np.clip(CLOSING * distance[:, 0], radius, SPARSE * radius)
    return radii


def times_of_moving(cloud: PointCloud) -> F64:
    """(N,) seconds: when points of moving things were scanned; NaN for all that stands, or of which it isn't known.

    The scanner sees what stands for seconds while it drives by, and what drives past only for a moment at each place.
    """
    from scipy.spatial import cKDTree

    times = np.full(len(cloud), np.nan)
    movable = np.flatnonzero(_of_class(cloud, MOVABLE))
    if len(movable) == 0 or cloud.time is None:
        return times
    xyz, own = cloud.xyz[movable], cloud.time[movable]
    some = slice(None, None, 8)  # enough to tell, and so few that a fixed number of neighbours reaches far
    _, near = cKDTree(xyz[some]).query(xyz, k=32, distance_upper_bound=AROUND, workers=-1)
    around = np.append(own[some], np.nan)[near]
    around[~(np.abs(around - own[:, None]) < PASS)] = np.nan
    around[:, 0] = own
    moving = np.nanmax(around, axis=1) - np.nanmin(around, axis=1) < PASSING
    times[movable[moving]] = own[moving]
    return times


def depth_map(
    camera: Camera, T_world_cam: F64, hides: Scene, *, time: float | None = None, pixels: int = PIXELS
) -> DepthMap:
    """The range image of a view.

    Args:
        camera: of the view, at full size.
        T_world_cam: (4, 4) camera to local coordinates.
        hides: see `scene`.
        time: of the photo, seconds, for what moves; None: everything hides wherever it was scanned.
        pixels: the camera is scaled to at most this many, and to at most `ENLARGED` times its width.
    """
    from scan2sim.pipeline.camera import disc_splatting
    from scan2sim.pipeline.camera.models import pixel_rays, ray_origins
    from scan2sim.pipeline.camera.projection import eye

    camera = camera.scaled(min(ENLARGED, math.sqrt(pixels / (camera.width * camera.height))))
    rays = pixel_rays(camera)
    T_world_cam = np.asarray(T_world_cam, np.float64)
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    if hides.triangles:
        cast = np.empty((camera.height, camera.width, 6), np.float32)
        cast[..., :3], cast[..., 3:] = (
            T_world_cam[:3, 3],
            np.nan_to_num(rays) @ T_world_cam[:3, :3].T.astype(np.float32),
        )
        if camera.model == "orthographic":
            v, u = np.mgrid[: camera.height, : camera.width]
            begin = ray_origins(camera, np.column_stack([u.ravel(), v.ravel()])).reshape(*u.shape, 3)
            cast[..., :3] += begin @ T_world_cam[:3, :3].T
        hit = hides.casting.cast_rays(cast)["t_hit"].numpy()
        depth = np.where(np.isfinite(rays[..., 0]), hit, np.inf).astype(np.float32)
    there = np.ones(len(hides.centres), bool)
    if time is not None:
        there = np.isnan(hides.spans[:, 0]) | ((time > hides.spans[:, 0]) & (time < hides.spans[:, 1]))
    if there.any():
        centres, normals, radii = hides.centres[there], hides.normals[there], hides.radii[there]
        disc_splatting.draw_discs(depth, rays, eye(camera, T_world_cam), centres, normals, radii)
    return DepthMap(camera, T_world_cam, depth)


def load_depth_map(path: Path, camera: Camera, T_world_cam: F64) -> DepthMap:
    """The range image kept at `path` (.npy, (H, W) float32) of a view with that camera and pose."""
    depth = np.load(path)
    height, width = depth.shape
    return DepthMap(camera.resized(width, height), np.asarray(T_world_cam, np.float64), depth)


def visible(
    depth: DepthMap, points: npt.ArrayLike, normals: npt.ArrayLike | None = None, *, bias: float = BIAS
) -> Bools:
    """(N,) which points the view sees: within the image, and not behind what its range image shows.

    Args:
        depth: of the view.
        points: (N, 3) local metres.
        normals: (N, 3) unit, of the surface at the points; either side; None: seen head-on.
        bias: metres allowed behind the range image, before the slope's share.
    """
    from scan2sim.pipeline.camera.projection import eye, visible_places

    points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
    facing = np.zeros((0, 3)) if normals is None else np.ascontiguousarray(normals, np.float64).reshape(-1, 3)
    return visible_places(eye(depth.camera, depth.T_world_cam), depth.ranges, points, facing, bias)

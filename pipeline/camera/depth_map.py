"""Visibility by depth maps (range images): occluders, rendering of range images, visibility test of points.

A range image stores, for every pixel of a scaled camera, the distance along the pixel's ray to the first hit, for any
camera model. Meshes are rendered by ray casting (Embree), points as discs (splatting) with exact ray-plane
intersections per pixel.

Occluders are the mesh faces that are supported by points (a surface that Poisson inflates around thin structures has
no points and occludes nothing), and those points of the cloud that no mesh represents (cars, people, trimmed
surfaces), as discs with the points' normals. Objects that moved during the scan left trails of points, most of which
`dynamic_objects` has separated: such a point occludes only in photos taken at about the time when it was scanned.
Posts are modelled more accurately than photos are posed, so a photo shows them beside their meshes: their points hide
what is clearly behind them, too. A point is visible if its range is at most that of the range image plus a bias that
grows with the slope of the surface.
Evaluated against ground truth by `bench/visibility.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, F64, Bools, Camera, Mesh, PointCloud

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.projection import Ranges

RANGE_BIAS_M = 0.04
"""A point up to this far behind the range image still counts as visible."""
MAX_PIXELS = 2_000_000
"""Maximum number of pixels of a range image."""
MAX_UPSCALING = 2.0
"""Maximum width of a range image relative to the photo; smaller pixels reduce both leaking and false occlusion."""
RAY_CHUNK = 500_000
"""Number of rays cast at a time, to bound memory."""
SUPPORT_DISTANCE_SPACINGS = 1.3
"""Mesh vertices farther from all points than this many median point spacings are unsupported and don't occlude."""
FOLIAGE_DISTANCE_FACTOR = 2.5
"""Leaves scatter around the mesh of their crown: factor on the distance within which a mesh represents a point."""
MOVABLE = (CODE["vehicle"], CODE["person"])
FOLIAGE = (CODE["low_vegetation"], CODE["mid_vegetation"], CODE["high_vegetation"])
MOVING_MAX_SCAN_TIME_S = 1.0
"""A point of a movable class is moving if all points around it were scanned within this time."""
MOVING_NEIGHBOURHOOD_M = 1.0
"""Radius of the neighbourhood for `MOVING_MAX_SCAN_TIME_S`."""
SAME_PASS_MAX_S = 5.0
"""Points scanned further apart in time belong to different passes of the scanner."""
MOVING_OCCLUSION_S = (-0.1, 0.4)
"""Time window around its scan in which a point of a moving object occludes: a car leaves its own length in 0.4 s."""
REMOVED_OCCLUSION_S = 0.1
"""Half of that window for points that step `dynamic_objects` classified as moving: the next turn has new points."""
TIME_WEIGHT_M_PER_S = 20.0
"""Scale from time to distance in the neighbour search among moving points: only points of one moment are neighbours."""
DISC_RADIUS_FRACTION = 0.7
"""Disc radius of movable objects relative to the distance of the eighth neighbour; their points are sparse."""
MAX_DISC_SCALE = 3.0
"""Upper limit of that radius, relative to the radius of other discs."""
SLIM_MARGIN_M = 0.3
"""Slim objects hide what is at least this far behind their points: neither their own meshes nor the ground at
their foot."""


@dataclass(frozen=True)
class Scene:
    """Occluders: meshes and discs.

    Attributes:
        casting: Open3D `RaycastingScene` of the meshes.
        triangles: number of mesh triangles.
        centres, normals: (N, 3) centres and unit normals of the discs.
        radii: (N,) radii of the discs, metres.
        spans: (N, 2) time span in which each disc occludes, seconds; NaN: always.
        slim: (M, 3) points of slim objects.
        slim_radius: radius of their discs, metres.
    """

    casting: Any
    triangles: int
    centres: F32
    normals: F32
    radii: F32
    spans: F64
    slim: F32 = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    slim_radius: float = 0.0


@dataclass(frozen=True)
class DepthMap:
    """Range image of a posed camera.

    Attributes:
        camera: the view's camera, scaled.
        T_world_cam: (4, 4) camera to local coordinates.
        range: (H, W) float32 metres along each pixel's ray; inf where it meets nothing.
    """

    camera: Camera
    T_world_cam: F64
    range: F32

    @property
    def ranges(self) -> Ranges:
        """The range image in the form that kernels take."""
        from scan2sim.pipeline.camera.models import pixel_angle
        from scan2sim.pipeline.camera.projection import Ranges

        return Ranges(self.range, pixel_angle(self.camera))


def scene(
    meshes: Iterable[Mesh],
    cloud: PointCloud | None = None,
    *,
    radius: float = 0.08,
    mesh_distance: float = 0.2,
    moving: PointCloud | None = None,
) -> Scene:
    """Build the occluders from the meshes of all classes and the whole cloud.

    Args:
        meshes: meshes of all classes.
        cloud: cloud with normals; None: all faces of the meshes occlude, and nothing else.
        radius: radius of the discs in metres; about the cloud's voxel size.
        mesh_distance: points nearer than this to a mesh (metres) are represented by the mesh and get no disc.
        moving: points that the step `dynamic_objects` classified as moving, with normals and time.
    """
    import open3d as o3d

    meshes_only = cloud is None or not len(cloud) or cloud.normal is None
    if cloud is not None and not meshes_only:
        meshes = _supported_faces(meshes, cloud)
    casting, triangles = o3d.t.geometry.RaycastingScene(), 0
    for mesh in meshes:
        if len(mesh):
            casting.add_triangles(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces, np.uint32))
            triangles += len(mesh)
    if cloud is None or meshes_only:
        empty = np.zeros((0, 3), np.float32)
        static = Scene(casting, triangles, empty, empty, np.zeros(0, np.float32), np.zeros((0, 2)))
        return _with_moving(static, moving, radius)
    if triangles:
        distance = casting.compute_distance(np.ascontiguousarray(cloud.xyz)).numpy()
        cloud = cloud.take(
            distance > np.where(_of_class(cloud, FOLIAGE), FOLIAGE_DISTANCE_FACTOR * mesh_distance, mesh_distance)
        )
    assert cloud.normal is not None
    spans = times_of_moving(cloud)[:, None] + MOVING_OCCLUSION_S
    return _with_moving(
        Scene(casting, triangles, cloud.xyz, cloud.normal, _radii(cloud, radius), spans), moving, radius
    )


def _with_moving(static: Scene, moving: PointCloud | None, radius: float) -> Scene:
    """The scene with discs of moving points, each limited to the time of its scan."""
    from scipy.spatial import cKDTree

    if moving is None or not len(moving):
        return static
    assert moving.normal is not None and moving.time is not None
    scaled_time = TIME_WEIGHT_M_PER_S * (moving.time - moving.time.min())
    xyzt = np.column_stack([moving.xyz, scaled_time])
    distance, _ = cKDTree(xyzt).query(xyzt, k=[min(9, len(xyzt))], workers=-1)
    radii = np.clip(DISC_RADIUS_FRACTION * distance[:, 0], radius, MAX_DISC_SCALE * radius).astype(np.float32)
    return replace(
        static,
        centres=np.concatenate([static.centres, moving.xyz]),
        normals=np.concatenate([static.normals, moving.normal]),
        radii=np.concatenate([static.radii, radii]),
        spans=np.concatenate([static.spans, moving.time[:, None] + (-REMOVED_OCCLUSION_S, REMOVED_OCCLUSION_S)]),
    )


def _of_class(cloud: PointCloud, codes: tuple[int, ...]) -> Bools:
    """(N,) bool, True for points of these classes; all False if the cloud has no classes."""
    return np.zeros(len(cloud), bool) if cloud.classification is None else np.isin(cloud.classification, codes)


def _supported_faces(meshes: Iterable[Mesh], cloud: PointCloud) -> list[Mesh]:
    """Faces supported by points: all their corners are within a multiple of the median point spacing of a point.

    Faces with a class of their own (from `furniture`) are always kept: their points are not in this cloud.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(cloud.xyz)
    sample = cloud.xyz[:: max(1, len(cloud) // 20_000)]
    spacing, _ = tree.query(sample, k=min(7, len(cloud)), workers=-1)
    max_distance = (
        SUPPORT_DISTANCE_SPACINGS * float(np.median(np.atleast_2d(spacing)[:, 1:].mean(axis=1)))
        if len(cloud) > 1
        else np.inf
    )
    kept = []
    for mesh in meshes:
        distance, _ = tree.query(mesh.vertices, distance_upper_bound=max_distance, workers=-1)
        supported = np.isfinite(distance)[mesh.faces].all(axis=1)
        kept.append(mesh.keep(supported if mesh.classification is None else supported | (mesh.classification > 0)))
    return kept


def _radii(cloud: PointCloud, radius: float) -> F32:
    """(N,) disc radii in metres: `radius`; for movable objects, large enough that the discs overlap."""
    from scipy.spatial import cKDTree

    radii = np.full(len(cloud), radius, np.float32)
    movable = np.flatnonzero(_of_class(cloud, MOVABLE))
    if len(movable):
        xyz = cloud.xyz[movable]
        distance, _ = cKDTree(xyz).query(xyz, k=[9], workers=-1)  # the first neighbour is the point itself
        radii[movable] = np.clip(DISC_RADIUS_FRACTION * distance[:, 0], radius, MAX_DISC_SCALE * radius)
    return radii


def times_of_moving(cloud: PointCloud) -> F64:
    """Times (N,) in seconds at which points of moving objects were scanned; NaN for static or undecided points.

    A scanner that drives by sees a static object for seconds, and a moving object only briefly at each position.
    """
    from scipy.spatial import cKDTree

    times = np.full(len(cloud), np.nan)
    movable = np.flatnonzero(_of_class(cloud, MOVABLE))
    if len(movable) == 0 or cloud.time is None:
        return times
    xyz, own = cloud.xyz[movable], cloud.time[movable]
    every_8th = slice(None, None, 8)  # thinned, so that 32 neighbours cover the neighbourhood
    _, near = cKDTree(xyz[every_8th]).query(xyz, k=32, distance_upper_bound=MOVING_NEIGHBOURHOOD_M, workers=-1)
    neighbour_times = np.append(own[every_8th], np.nan)[near]
    neighbour_times[~(np.abs(neighbour_times - own[:, None]) < SAME_PASS_MAX_S)] = np.nan
    neighbour_times[:, 0] = own
    moving = np.nanmax(neighbour_times, axis=1) - np.nanmin(neighbour_times, axis=1) < MOVING_MAX_SCAN_TIME_S
    times[movable[moving]] = own[moving]
    return times


def depth_map(
    camera: Camera, T_world_cam: F64, occluders: Scene, *, time: float | None = None, pixels: int = MAX_PIXELS
) -> DepthMap:
    """Render the range image of a view.

    Args:
        camera: camera of the view, at full size.
        T_world_cam: (4, 4) camera to local coordinates.
        occluders: from `scene`.
        time: time of the photo in seconds, selects moving points; None: all moving points occlude.
        pixels: maximum number of pixels; the range image is also at most `MAX_UPSCALING` times as wide as the photo.
    """
    from scan2sim.pipeline.camera import disc_splatting
    from scan2sim.pipeline.camera.models import pixel_rays, ray_origins
    from scan2sim.pipeline.camera.projection import posed_camera

    camera = camera.scaled(min(MAX_UPSCALING, math.sqrt(pixels / (camera.width * camera.height))))
    rays = pixel_rays(camera)
    T_world_cam = np.asarray(T_world_cam, np.float64)
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    rows_at_once = max(1, RAY_CHUNK // camera.width)
    for first in range(0, camera.height, rows_at_once) if occluders.triangles else ():
        part = rays[first : first + rows_at_once]
        cast = np.empty((*part.shape[:2], 6), np.float32)
        cast[..., :3], cast[..., 3:] = (
            T_world_cam[:3, 3],
            np.nan_to_num(part) @ T_world_cam[:3, :3].T.astype(np.float32),
        )
        if camera.model == "orthographic":
            v, u = np.mgrid[first : first + len(part), : camera.width]
            begin = ray_origins(camera, np.column_stack([u.ravel(), v.ravel()])).reshape(*u.shape, 3)
            cast[..., :3] += begin @ T_world_cam[:3, :3].T
        hit = occluders.casting.cast_rays(cast)["t_hit"].numpy()
        depth[first : first + len(part)] = np.where(np.isfinite(part[..., 0]), hit, np.inf)
    active = np.ones(len(occluders.centres), bool)
    if time is not None:
        active = np.isnan(occluders.spans[:, 0]) | ((time > occluders.spans[:, 0]) & (time < occluders.spans[:, 1]))
    if active.any():
        centres, normals, radii = occluders.centres[active], occluders.normals[active], occluders.radii[active]
        disc_splatting.draw_discs(depth, rays, posed_camera(camera, T_world_cam), centres, normals, radii)
    if len(occluders.slim) and camera.model != "orthographic":
        facing = T_world_cam[:3, 3] - occluders.slim
        facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-6)
        silhouette, radii = np.full_like(depth, np.inf), np.full(len(facing), occluders.slim_radius, np.float32)
        posed = posed_camera(camera, T_world_cam)
        disc_splatting.draw_discs(silhouette, rays, posed, occluders.slim, facing.astype(np.float32), radii)
        hides = np.isfinite(depth) & (silhouette < depth - SLIM_MARGIN_M)
        depth[hides] = silhouette[hides]
    return DepthMap(camera, T_world_cam, depth)


def load_depth_map(path: Path, camera: Camera, T_world_cam: F64) -> DepthMap:
    """Load the range image of a view with that camera and pose from `path` (.npy, (H, W) float32)."""
    depth = np.load(path)
    height, width = depth.shape
    return DepthMap(camera.resized(width, height), np.asarray(T_world_cam, np.float64), depth)


def visible(
    depth: DepthMap, points: npt.ArrayLike, normals: npt.ArrayLike | None = None, *, bias: float = RANGE_BIAS_M
) -> Bools:
    """(N,) bool, True for points that the view sees: inside the image, and not behind its range image.

    Args:
        depth: range image of the view.
        points: (N, 3) local metres.
        normals: (N, 3) unit surface normals at the points, of either sign; None: assume frontal incidence.
        bias: tolerance behind the range image in metres, to which a term for the slope is added.
    """
    from scan2sim.pipeline.camera.projection import posed_camera, visible_points

    points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
    facing = np.zeros((0, 3)) if normals is None else np.ascontiguousarray(normals, np.float64).reshape(-1, 3)
    return visible_points(posed_camera(depth.camera, depth.T_world_cam), depth.ranges, points, facing, bias)

"""Range images compared with ray casting, and visibility of points on a synthetic street."""

from dataclasses import replace

import numba
import numpy as np
import open3d as o3d
import pytest

from scan2sim.pipeline.camera.depth_map import depth_map, scene, visible
from scan2sim.pipeline.camera.models import pixel_rays, project
from scan2sim.pipeline.core.types import F32, F64, U8, Camera, Frame, Mesh, PointCloud

CAMERAS = {
    "pinhole": Camera("pinhole", 320, 240, 200.0, 200.0, 159.5, 119.5),
    "opencv": Camera("opencv", 320, 240, 200.0, 200.0, 159.5, 119.5, (-0.2, 0.05, 0.001, 0.0)),
    "fisheye": Camera("fisheye", 320, 320, 100.0, 100.0, 159.5, 159.5, (0.02, 0.0, 0.0, 0.0)),
    "equirectangular": Camera("equirectangular", 400, 200),
}


def forward_pose(x: float = 0.0, y: float = 0.0, z: float = 2.0) -> F64:
    """A camera that looks along world x, upright."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[:3, 3] = x, y, z
    return pose


def grid(nx: int, ny: int, size: float, at: tuple[float, float, float]) -> Mesh:
    """A horizontal grid of nx x ny cells of `size` metres around `at`."""
    x, y = np.meshgrid(np.arange(nx + 1) * size, np.arange(ny + 1) * size, indexing="ij")
    vertices = np.column_stack([x.ravel() - nx * size / 2, y.ravel() - ny * size / 2, np.zeros(x.size)]) + at
    i, j = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    a = (i * (ny + 1) + j).ravel()
    faces = np.concatenate([np.column_stack([a, a + ny + 1, a + ny + 2]), np.column_stack([a, a + ny + 2, a + 1])])
    return Mesh(Frame(), vertices.astype(np.float32), faces.astype(np.int32))


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
    mesh = o3d.t.geometry.TriangleMesh.create_box(*(np.subtract(high, low)))
    vertices = mesh.vertex.positions.numpy() + np.asarray(low)
    return Mesh(Frame(), vertices.astype(np.float32), mesh.triangle.indices.numpy().astype(np.int32))


@pytest.fixture(scope="module")
def street() -> list[Mesh]:
    return [grid(60, 60, 1.0, (0, 0, 0)), box((8, -2, 0), (9, 2, 3)), box((-6, 3, 0), (-4, 5, 4))]


def cast(meshes: list[Mesh], camera: Camera, pose: F64) -> F32:
    casting = o3d.t.geometry.RaycastingScene()
    for mesh in meshes:
        casting.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    rays = pixel_rays(camera).reshape(-1, 3) @ pose[:3, :3].T.astype(np.float32)
    rays = np.concatenate([np.broadcast_to(pose[:3, 3].astype(np.float32), rays.shape), rays], axis=1)
    ranges = casting.cast_rays(o3d.core.Tensor(np.ascontiguousarray(rays)))["t_hit"].numpy()
    return ranges.reshape(camera.height, camera.width)


@pytest.mark.parametrize("name", CAMERAS)
def test_range_image_equals_ray_casting(street: list[Mesh], name: str) -> None:
    camera, pose = CAMERAS[name], forward_pose()
    depth = depth_map(camera, pose, scene(street))
    expected = cast(street, depth.camera, pose)
    with np.errstate(invalid="ignore"):
        same = (np.isinf(expected) & np.isinf(depth.range)) | (np.abs(depth.range - expected) < 1e-3 * expected)
    assert same.mean() > 0.999


def test_large_cameras_are_scaled_down(street: list[Mesh]) -> None:
    depth = depth_map(CAMERAS["pinhole"], forward_pose(), scene(street), pixels=20_000)
    assert depth.range.size <= 20_500
    assert depth.range.shape == (depth.camera.height, depth.camera.width)


@pytest.mark.parametrize("name", CAMERAS)
def test_visibility_errors_on_the_ground_are_small_at_grazing_angles(street: list[Mesh], name: str) -> None:
    camera, pose = CAMERAS[name], forward_pose()
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-25, 25, (40_000, 2)), np.zeros(40_000)])
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    uv, valid = project(camera, local)
    framed = valid & (uv > 0).all(axis=1) & (uv < [camera.width - 1, camera.height - 1]).all(axis=1)
    points = points[framed]
    casting = o3d.t.geometry.RaycastingScene()
    for mesh in street[1:]:
        casting.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    rays = np.concatenate([points + [0, 0, 1e-3], pose[:3, 3] - points], axis=1).astype(np.float32)
    truly = ~casting.test_occlusions(o3d.core.Tensor(rays), tfar=1.0).numpy()
    # visibility is undefined below the boxes
    seen = visible(depth_map(camera, pose, scene(street)), points, np.tile([0.0, 0, 1], (len(points), 1)))
    assert (~truly).sum() > 200
    assert seen[~truly].mean() < 0.06  # of a camera of 0.08 MP: a pixel of the boxes' border
    assert (~seen[truly]).mean() < 0.06


def side_of(x: float, y0: float, y1: float, z0: float, z1: float, step: float = 0.1) -> F32:
    """(N, 3) points every `step` metres on an upright rectangle across the view of `forward_pose`."""
    y, z = (part.ravel() for part in np.meshgrid(np.arange(y0, y1, step), np.arange(z0, z1, step)))
    return np.column_stack([np.full(y.size, x), y, z]).astype(np.float32)


def cloud_of(*parts: F32, classification: U8 | None = None, time: F64 | None = None) -> PointCloud:
    """Points with normals towards the camera."""
    xyz = np.concatenate(parts)
    return PointCloud(
        Frame(),
        xyz,
        normal=np.tile(np.array([-1, 0, 0], np.float32), (len(xyz), 1)),
        classification=classification,
        time=time,
    )


WALL = Mesh(
    Frame(),
    np.array([[8, -2, 0], [8, 2, 0], [8, 2, 3], [8, -2, 3]], np.float32),
    np.array([[0, 2, 1], [0, 3, 2]], np.int32),
)
ON_WALL = np.array([[8.0, 0.0, 1.5], [8.0, 1.9, 1.5]])
FACING = np.tile([-1.0, 0, 0], (2, 1))


def test_points_without_a_mesh_occlude() -> None:
    pose, camera = forward_pose(), CAMERAS["pinhole"]
    car = side_of(4.0, -1, 0.5, 0.5, 2.5)
    before_wall = side_of(7.95, -2, 2.05, 0, 3.05)  # covered by the mesh
    hides = scene([WALL], cloud_of(car, before_wall))
    assert len(hides.centres) == len(car)
    assert visible(depth_map(camera, pose, scene([WALL])), ON_WALL, FACING).tolist() == [True, True]
    assert visible(depth_map(camera, pose, hides), ON_WALL, FACING).tolist() == [False, True]
    assert visible(depth_map(camera, pose, hides), car, np.tile([-1.0, 0, 0], (len(car), 1))).all()


def test_points_of_a_post_occlude_surfaces_clearly_behind_them() -> None:
    pose, camera = forward_pose(), CAMERAS["pinhole"]
    post = side_of(5.0, -0.02, 0.03, 0.0, 4.0)
    corners = np.array([[5.1, 0.1, 0], [5.1, 0.2, 0], [5.1, 0.2, 4]], np.float32)
    own = Mesh(Frame(), corners, np.array([[0, 2, 1]], np.int32))
    hides = replace(scene([WALL, own]), slim=post, slim_radius=0.05)
    depth = depth_map(camera, pose, hides)
    assert visible(depth, ON_WALL, FACING).tolist() == [False, True]
    assert visible(depth, np.array([[5.1, 0.12, 0.5]]), FACING[:1]).all()  # mesh of the post, beside its points
    above = depth.range[: camera.height // 8]
    assert np.isinf(above).all()  # no surface behind the post: no range


def test_trail_of_a_passing_object_occludes_only_at_its_time() -> None:
    wall, trail = side_of(8.0, -2, 2.05, 0, 3.05), side_of(4.0, -1, 0.5, 0.5, 2.5)
    classification = np.repeat(np.array([6, 66], np.uint8), [len(wall), len(trail)])
    passed = np.concatenate([np.full(len(wall), 100.0), np.linspace(100.0, 100.2, len(trail))])
    stood = np.concatenate([np.full(len(wall), 100.0), np.linspace(100.0, 104.0, len(trail))])
    camera, pose = CAMERAS["pinhole"], forward_pose()

    def sees_wall(cloud: PointCloud, time: float | None) -> bool:
        depth = depth_map(camera, pose, scene([WALL], cloud), time=time)
        return bool(visible(depth, ON_WALL[:1], FACING[:1])[0])

    moving, parked = (cloud_of(wall, trail, classification=classification, time=t) for t in (passed, stood))
    assert not sees_wall(moving, 100.2)
    assert sees_wall(moving, 103.0)
    assert sees_wall(moving, 97.0)
    assert not sees_wall(moving, None)  # the photo's time is unknown: treated as occluded
    assert not sees_wall(parked, 110.0)


def test_removed_moving_points_occlude_only_at_their_time() -> None:
    wall, car = side_of(8.0, -2, 2.05, 0, 3.05), side_of(4.0, -1, 0.5, 0.5, 2.5)
    moving = cloud_of(car, time=np.full(len(car), 100.0))
    hides = scene([WALL], cloud_of(wall), moving=moving)

    def sees_wall(time: float | None) -> bool:
        depth = depth_map(CAMERAS["pinhole"], forward_pose(), hides, time=time)
        return bool(visible(depth, ON_WALL[:1], FACING[:1])[0])

    assert [sees_wall(time) for time in (99.8, 100.0, 100.2)] == [True, False, True]


def test_surface_without_supporting_points_does_not_occlude() -> None:
    wall, sign = side_of(8.0, -2, 2.05, 0, 3.05), side_of(4.0, -0.3, 0.35, 1.5, 2.1)
    flat = grid(20, 11, 0.1, (0, 1.8, 0))
    bulge = Mesh(Frame(), np.roll(flat.vertices, 1, axis=1) + np.array([4, 0, 0], np.float32), flat.faces)
    depth = depth_map(CAMERAS["pinhole"], forward_pose(), scene([WALL, bulge], cloud_of(wall, sign)))
    behind = np.array([[8.0, 0.0, 1.6], [8.0, 1.6, 1.6]])  # the sign, and its remaining points
    assert visible(depth, behind, FACING).tolist() == [False, True]


def test_furniture_occludes_without_points_in_surface_clouds() -> None:
    pole, ground = box((3, -0.2, 0), (3.1, 0.2, 4)), grid(40, 20, 0.5, (10, 0, 0))
    cloud = PointCloud(
        Frame(), ground.vertices, normal=np.tile(np.array([0, 0, 1], np.float32), (len(ground.vertices), 1))
    )
    behind = [[6.0, 0.0, 1.0]]
    for classification, hidden in ((0, False), (64, True)):
        mesh = replace(pole, classification=np.full(len(pole), classification, np.uint8))
        hides = scene([ground, mesh], cloud)
        depth = depth_map(CAMERAS["pinhole"], forward_pose(z=1.5), hides)
        assert visible(depth, behind).tolist() == [not hidden]


def test_points_outside_the_image_are_not_visible(street: list[Mesh]) -> None:
    depth = depth_map(CAMERAS["pinhole"], forward_pose(), scene(street))
    assert not visible(depth, [[-5.0, 0, 1], [5.0, 60, 1]]).any()


def test_depth_is_identical_with_any_number_of_threads(street: list[Mesh]) -> None:
    camera, pose = CAMERAS["equirectangular"], forward_pose()
    first = depth_map(camera, pose, scene(street)).range
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        np.testing.assert_array_equal(first, depth_map(camera, pose, scene(street)).range)
    finally:
        numba.set_num_threads(before)

"""Range images against ray casting, and who sees what on a made-up street."""

import numpy as np
import open3d as o3d
import pytest

from pipeline.cameras import pixel_rays, project
from pipeline.types import Camera, Frame, Mesh, PointCloud
from pipeline.visibility import depth_map, scene, visible

CAMERAS = {
    "pinhole": Camera("pinhole", 320, 240, 200.0, 200.0, 159.5, 119.5),
    "opencv": Camera("opencv", 320, 240, 200.0, 200.0, 159.5, 119.5, (-0.2, 0.05, 0.001, 0.0)),
    "fisheye": Camera("fisheye", 320, 320, 100.0, 100.0, 159.5, 159.5, (0.02, 0.0, 0.0, 0.0)),
    "equirectangular": Camera("equirectangular", 400, 200),
}


def forward_pose(x=0.0, y=0.0, z=2.0):
    """A camera that looks along world x, upright."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[:3, 3] = x, y, z
    return pose


def grid(nx, ny, size, at):
    """A horizontal grid of nx x ny cells of `size` metres around `at`."""
    x, y = np.meshgrid(np.arange(nx + 1) * size, np.arange(ny + 1) * size, indexing="ij")
    vertices = np.column_stack([x.ravel() - nx * size / 2, y.ravel() - ny * size / 2, np.zeros(x.size)]) + at
    i, j = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    a = (i * (ny + 1) + j).ravel()
    faces = np.concatenate([np.column_stack([a, a + ny + 1, a + ny + 2]), np.column_stack([a, a + ny + 2, a + 1])])
    return Mesh(Frame(), vertices.astype(np.float32), faces.astype(np.int32))


def box(low, high):
    mesh = o3d.t.geometry.TriangleMesh.create_box(*(np.subtract(high, low)))
    vertices = mesh.vertex.positions.numpy() + np.asarray(low)
    return Mesh(Frame(), vertices.astype(np.float32), mesh.triangle.indices.numpy().astype(np.int32))


@pytest.fixture(scope="module")
def street():
    return [grid(60, 60, 1.0, (0, 0, 0)), box((8, -2, 0), (9, 2, 3)), box((-6, 3, 0), (-4, 5, 4))]


def cast(meshes, camera, pose):
    casting = o3d.t.geometry.RaycastingScene()
    for mesh in meshes:
        casting.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    rays = pixel_rays(camera).reshape(-1, 3) @ pose[:3, :3].T.astype(np.float32)
    rays = np.concatenate([np.broadcast_to(pose[:3, 3].astype(np.float32), rays.shape), rays], axis=1)
    ranges = casting.cast_rays(o3d.core.Tensor(np.ascontiguousarray(rays)))["t_hit"].numpy()
    return ranges.reshape(camera.height, camera.width)


@pytest.mark.parametrize("name", CAMERAS)
def test_range_image_is_what_rays_meet(street, name):
    camera, pose = CAMERAS[name], forward_pose()
    depth = depth_map(camera, pose, scene(street))
    expected = cast(street, depth.camera, pose)
    with np.errstate(invalid="ignore"):
        same = (np.isinf(expected) & np.isinf(depth.range)) | (np.abs(depth.range - expected) < 1e-3 * expected)
    assert same.mean() > 0.999


def test_large_cameras_are_scaled_down(street):
    depth = depth_map(CAMERAS["pinhole"], forward_pose(), scene(street), pixels=20_000)
    assert depth.range.size <= 20_500
    assert depth.range.shape == (depth.camera.height, depth.camera.width)


@pytest.mark.parametrize("name", CAMERAS)
def test_leak_and_false_hiding_on_the_ground_are_small_at_grazing_angles(street, name):
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
    # inside the boxes' feet nothing is defined
    seen = visible(depth_map(camera, pose, scene(street)), points, np.tile([0.0, 0, 1], (len(points), 1)))
    assert (~truly).sum() > 200
    assert seen[~truly].mean() < 0.06  # of a camera of 0.08 MP: a pixel of the boxes' border
    assert (~seen[truly]).mean() < 0.06


def test_points_without_a_mesh_hide_what_is_behind_them(street):
    pose = forward_pose()
    y, z = (part.ravel() for part in np.meshgrid(np.arange(-1, 0.5, 0.1), np.arange(0.5, 2.5, 0.1)))
    car = np.column_stack([np.full(y.size, 4.0), y, z]).astype(np.float32)
    normal = np.tile(np.float32([-1, 0, 0]), (len(car), 1))
    ground = np.column_stack([y * 5 + 3, z, np.full(y.size, 0.05)]).astype(np.float32)  # the mesh has it already
    cloud = PointCloud(
        Frame(), np.concatenate([car, ground]), normal=np.concatenate([normal, np.tile([0, 0, 1], (len(ground), 1))])
    )
    hides = scene(street, cloud)
    assert len(hides.centres) == len(car)
    wall = np.array([[8.0, 0.0, 1.5], [8.0, 1.9, 1.5]])
    facing = np.array([[-1.0, 0, 0], [-1.0, 0, 0]])
    camera = CAMERAS["pinhole"]
    assert visible(depth_map(camera, pose, scene(street)), wall, facing).tolist() == [True, True]
    assert visible(depth_map(camera, pose, hides), wall, facing).tolist() == [False, True]
    assert visible(depth_map(camera, pose, hides), car, normal).all()


def test_what_is_out_of_the_image_is_not_seen(street):
    depth = depth_map(CAMERAS["pinhole"], forward_pose(), scene(street))
    assert not visible(depth, [[-5.0, 0, 1], [5.0, 60, 1]]).any()


def test_depth_is_the_same_whatever_the_number_of_threads(street):
    import numba

    camera, pose = CAMERAS["equirectangular"], forward_pose()
    first = depth_map(camera, pose, scene(street)).range
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        np.testing.assert_array_equal(first, depth_map(camera, pose, scene(street)).range)
    finally:
        numba.set_num_threads(before)

"""Camera models compared with OpenCV's, round trips, and the limits of their validity."""

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.camera.models import inside, pixel_rays, project, unproject
from scan2sim.pipeline.core.types import F64, Camera

K = (700.0, 690.0, 639.5, 359.5)
CAMERAS = {
    "pinhole": Camera("pinhole", 1280, 720, *K),
    "opencv4": Camera("opencv", 1280, 720, *K, (-0.25, 0.08, 0.001, -0.0005)),
    "opencv8": Camera("opencv", 1280, 720, *K, (0.3, -0.1, 0.001, -0.0005, 0.02, 0.6, -0.05, 0.01)),
    "fisheye": Camera("fisheye", 1280, 720, 400.0, 400.0, 639.5, 359.5, (0.05, -0.01, 0.002, -0.0003)),
    "equirectangular": Camera("equirectangular", 2048, 1024),
}


def matrix(camera: Camera) -> F64:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


@pytest.fixture
def points() -> F64:
    rng = np.random.default_rng(0)
    z = rng.uniform(1, 20, 500)
    return np.column_stack([rng.uniform(-0.9, 0.9, 500) * z, rng.uniform(-0.5, 0.5, 500) * z, z])


@pytest.mark.parametrize("name", ["pinhole", "opencv4", "opencv8"])
def test_projection_equals_opencv(name: str, points: F64) -> None:
    camera = CAMERAS[name]
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), matrix(camera), np.array(camera.distortion or np.zeros(4))
    )
    uv, valid = project(camera, points)
    assert valid.all()
    np.testing.assert_allclose(uv, expected[:, 0], atol=2e-3)


def test_fisheye_projection_equals_opencv(points: F64) -> None:
    camera = CAMERAS["fisheye"]
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix(camera), np.array(camera.distortion)
    )
    np.testing.assert_allclose(project(camera, points)[0], expected.reshape(-1, 2), atol=2e-3)


def test_equirectangular_centre_is_the_z_axis_and_its_right_the_x_axis() -> None:
    camera = CAMERAS["equirectangular"]
    uv, valid = project(camera, np.array([[0, 0, 5], [5, 0, 0], [0, 3, 0], [-1e-9, 0, -2]]))
    assert valid.all()
    np.testing.assert_allclose(uv[:2], [[1023.5, 511.5], [1535.5, 511.5]], atol=1e-3)
    assert uv[2, 1] == pytest.approx(1023.5)  # straight down
    assert uv[3, 0] == pytest.approx(-0.5)  # straight back


@pytest.mark.parametrize("name", CAMERAS)
def test_unproject_and_project_round_trip(name: str) -> None:
    camera = CAMERAS[name]
    rng = np.random.default_rng(1)
    uv = rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (2000, 2))
    rays = unproject(camera, uv)
    reached = np.isfinite(rays).all(axis=1)
    assert reached.mean() > 0.999
    np.testing.assert_allclose(np.linalg.norm(rays[reached], axis=1), 1, atol=1e-9)
    back, valid = project(camera, rays[reached] * 7.0)
    assert valid.all()
    np.testing.assert_allclose(back, uv[reached], atol=2e-3)


def test_points_beyond_the_field_of_view_do_not_fold_back_into_the_image() -> None:
    camera = Camera("opencv", 1280, 720, *K, (-0.25, 0.02, 0.0, 0.0))
    angles = np.radians(np.linspace(0, 89.9, 500))
    points = np.column_stack([np.sin(angles), np.zeros(500), np.cos(angles)])
    uv, valid = project(camera, points)
    assert valid[0] and not valid[-1]
    assert (np.diff(uv[valid, 0]) > 0).all()  # image radius increases with the angle
    naive, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix(camera), np.array(camera.distortion))
    folded = (np.diff(naive[:, 0, 0]) < 0).any()
    assert folded  # OpenCV's projection folds some points back into the image


def test_points_behind_are_invalid_except_for_wide_cameras() -> None:
    behind = [[0.5, 0.1, -1.0]]
    assert not project(CAMERAS["pinhole"], behind)[1][0]
    assert not project(CAMERAS["opencv4"], behind)[1][0]
    assert project(Camera("fisheye", 100, 100, 20, 20, 49.5, 49.5), behind)[1][0]
    assert project(CAMERAS["equirectangular"], behind)[1][0]


def test_pixel_rays_equal_unproject() -> None:
    camera = CAMERAS["fisheye"].scaled(0.1)
    rays = pixel_rays(camera)
    assert rays.shape == (camera.height, camera.width, 3)
    v, u = np.mgrid[: camera.height, : camera.width]
    expected = unproject(camera, np.column_stack([u.ravel(), v.ravel()]))
    np.testing.assert_allclose(rays.reshape(-1, 3), expected, atol=1e-6)
    assert inside(camera, np.array([[-0.4, 0], [-0.6, 0], [camera.width - 0.6, 0]])).tolist() == [True, False, True]

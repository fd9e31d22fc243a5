"""Cameras of CameraInfo."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.io.camera_info import InvalidCamera, camera_of


def info(model: str, D: list[float], **more: Any) -> Any:
    """A CameraInfo of ROS 2."""
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    P = [350.0, 0, 330, 0, 0, 350, 250, 0, 0, 0, 1, 0]
    body = {"d": D, "k": [400.0, 0, 320, 0, 410, 240, 0, 0, 1], "p": P, "distortion_model": model, "roi": roi}
    return SimpleNamespace(**({"width": 640, "height": 480, "binning_x": 0, "binning_y": 0} | body | more))


@pytest.mark.parametrize(
    ("model", "D"),
    [
        ("plumb_bob", [-0.2, 0.05, 1e-3, -2e-3, 0.01]),
        ("rational_polynomial", [0.3, -0.1, 1e-3, 2e-3, 0.01, 0.5, -0.05, 0.02]),
        ("equidistant", [0.02, -0.01, 3e-3, -1e-3]),
    ],
)
def test_distortion_models_project_like_opencv(model: str, D: list[float]) -> None:
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (50, 3))
    K = np.array([[400.0, 0, 320], [0, 410, 240], [0, 0, 1]])
    if model == "equidistant":
        expected = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, np.array(D))[0]
    else:
        expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(D))[0]
    uv, valid = project(camera_of(info(model, D), rectified=False), points)
    assert valid.all() and np.allclose(uv, expected.reshape(-1, 2), atol=1e-3)


def test_rectified_images_have_the_intrinsics_of_p() -> None:
    camera = camera_of(info("plumb_bob", [-0.2, 0.05, 0, 0, 0]), rectified=True)
    assert (camera.model, camera.fx, camera.cx, camera.distortion) == ("pinhole", 350, 330, ())
    plain = camera_of(info("plumb_bob", [0.0] * 5), rectified=False)
    assert (plain.model, plain.fx, plain.cy) == ("pinhole", 400, 240)


def test_intrinsics_follow_binning_and_region_of_interest() -> None:
    roi = SimpleNamespace(x_offset=100, y_offset=60, width=400, height=300)
    camera = camera_of(info("plumb_bob", [0.0] * 5, roi=roi, binning_x=2, binning_y=2), rectified=False)
    assert (camera.width, camera.height, camera.fx, camera.cx) == (200, 150, 200, (220 + 0.5) / 2 - 0.5)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (info("plumb_bob", [], k=[0.0] * 9, p=[0.0] * 12), "is not calibrated"),
        (info("thin_prism", [0.1]), "unknown distortion model 'thin_prism'"),
        (info("omni", [0.0] * 4), "has the model 'omni' .Mei.* no counterpart"),
        (info("plumb_bob", [0.1] * 12), "has 12 coefficients"),
    ],
)
def test_unusable_cameras_are_rejected(bad: Any, message: str) -> None:
    with pytest.raises(InvalidCamera, match=message):
        camera_of(bad, rectified=False)

"""Intrinsics by CameraInfo: used, passed on, and ignored with a reason where they can't be."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.camera.renderer import pinhole
from scan2sim.services.world_camera.intrinsics import Intrinsics
from tests.services.world_camera.messages import camera_info


def test_camera_info_gives_camera_and_frame_and_is_passed_on() -> None:
    known, info = Intrinsics(None), camera_info()
    assert known.camera is None and known.receive(info) is None
    camera: Any = known.camera
    assert (camera.model, camera.width, camera.height) == ("opencv", 64, 48)
    assert (camera.fx, camera.cy) == (50.0, 23.5) and camera.distortion[0] == -0.2
    assert known.frame == "front_optical_frame"
    assert known.fields["d"] is info.d and known.fields["k"] is info.k and known.fields["roi"] is info.roi


def test_rectified_images_have_the_projection_matrix() -> None:
    known = Intrinsics(None, rectified=True)
    assert known.receive(camera_info()) is None
    camera: Any = known.camera
    assert (camera.model, camera.fx, camera.cx, camera.distortion) == ("pinhole", 40.0, 30.5, ())


def test_field_of_view_gives_a_pinhole_camera_and_its_camera_info() -> None:
    known = Intrinsics(pinhole(640, 480, field=90))
    again = Intrinsics(None)
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    assert again.receive(camera_info(**known.fields, roi=roi)) is None
    assert again.camera == known.camera


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"d": np.ones(12)}, "12 coefficients"),
        ({"d": np.array([0.1, math.nan])}, "coefficients"),
        ({"d": np.array([1e300, 0.0, 0.0, 0.0])}, "distortion"),
        ({"distortion_model": "double_sphere"}, "'double_sphere' (the double sphere model)"),
        ({"k": np.zeros(9)}, "not calibrated"),
        ({"k": np.full(9, math.nan)}, "not calibrated"),
        ({"k": np.array([1e9, 0, 31.5, 0, 1e9, 23.5, 0, 0, 1]), "d": np.zeros(5)}, "focal lengths"),
        ({"k": np.array([50, 0, -1e6, 0, 50, 23.5, 0, 0, 1]), "d": np.zeros(5)}, "centre"),
        ({"width": 2**31, "height": 2**31}, "pixels"),
        ({"width": 0}, "not calibrated"),
        ({"binning_x": 1000}, "pixels"),
        ({"k": np.zeros(2)}, "malformed"),
    ],
)
def test_camera_info_that_cannot_be_used_is_ignored_with_a_reason(changed: dict[str, Any], reason: str) -> None:
    known = Intrinsics(None)
    problem = known.receive(camera_info(**changed))
    assert problem is not None and reason in problem and known.camera is None
    assert known.receive(camera_info()) is None
    before = known.camera, known.fields, known.frame
    assert known.receive(camera_info(**changed)) is not None
    assert (known.camera, known.fields, known.frame) == before, "the last valid one remains"

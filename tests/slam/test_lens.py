"""Lens estimation: wrong intrinsics are detected and estimated together, right ones and straight drives keep theirs."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.camera.lens import GIVEN_SIGMA, changed_lens, lens_difference
from scan2sim.slam.lens import contradicts, fit_lens, lens_warning
from tests.fakes.slam_drive import LENS, odometry_with_wrong_intrinsics
from tests.present import present


@pytest.mark.parametrize(
    ("off", "said"),
    [
        pytest.param((0, 0, 0, 0, 0), None, id="right"),
        pytest.param((-0.05, 0, 0, 0, 0), "a focal length of", id="short", marks=pytest.mark.slow),
        pytest.param((-0.7, 0, 0, 0, 0), "better than", id="half"),
        pytest.param((0, 0.1, 0, 0, 0), "a centre at", id="cropped", marks=pytest.mark.slow),
        pytest.param((0, 0, 0, 0.15, 0), "distortion k1", id="bent"),
    ],
)  # fmt: skip
def test_wrong_intrinsics_are_detected_in_a_turn(off: tuple[float, ...], said: str | None) -> None:
    given = changed_lens(LENS, np.array(off))
    text = lens_warning(given, fit_lens(given, odometry_with_wrong_intrinsics(given, seed=1).map.misfits))
    assert (text is None) == (said is None)
    assert said is None or said in present(text)


def test_focal_length_centre_and_distortion_are_refined_together() -> None:
    """As with a published calibration: each parameter is slightly wrong, k1 and k2 are missing."""
    off = np.array([0.008, -0.005, 0.004, -0.015, 0.006])
    given = camera = changed_lens(LENS, off)
    for _ in range(2):
        misfits = odometry_with_wrong_intrinsics(camera, seed=1).map.misfits
        found = present(fit_lens(camera, misfits, GIVEN_SIGMA, prior=given))
        assert contradicts(found) == (camera is given)
        camera = found.camera
    error = lens_difference(LENS, camera)
    assert np.all(np.abs(error) < 3 * found.sigma) and np.all(np.abs(error) < [0.002, 0.001, 0.001, 0.003, 0.002])


def test_a_straight_drive_keeps_its_lens() -> None:
    given = changed_lens(LENS, np.array([0.01, 0.01, 0, 0.01, 0]))
    misfits = odometry_with_wrong_intrinsics(given, seed=1, turn=0.0).map.misfits
    found = present(fit_lens(given, misfits, GIVEN_SIGMA))
    assert not contradicts(found)
    assert abs(found.camera.fx / given.fx - 1) < 0.002


def test_no_warning_about_intrinsics_without_a_turn() -> None:
    given = changed_lens(LENS, np.array([0.3, 0, 0, 0, 0]))
    misfits = odometry_with_wrong_intrinsics(given, seed=1, turn=0.0).map.misfits
    assert lens_warning(given, fit_lens(given, misfits, GIVEN_SIGMA)) is None

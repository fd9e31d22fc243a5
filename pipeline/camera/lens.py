"""Lens parameters of a camera: focal length, principal point and radial distortion, and their usual errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2sim.pipeline.core.types import F64, Camera

LENS_MODELS = ("pinhole", "opencv")
"""Camera models whose lens can be estimated."""
GIVEN_SIGMA = np.array([0.01, 0.01, 0.01, 0.03, 0.01])
"""Standard deviations of a given lens' errors: logarithm of the focal length, principal point x and y (in focal
lengths), k1, k2. Calibrations differ by about 1 % from what fits another drive of the same car, and rectified images
keep some distortion."""


def changed_lens(camera: Camera, by: F64) -> Camera:
    """Camera whose lens parameters, as in `GIVEN_SIGMA`, are changed by (5,)."""
    k1, k2, *others = camera.distortion or (0.0, 0.0)
    k1, k2 = k1 + float(by[3]), k2 + float(by[4])
    distorted = any((k1, k2, *others))
    return replace(
        camera, model="opencv" if distorted else "pinhole", fx=camera.fx * float(np.exp(by[0])),
        fy=camera.fy * float(np.exp(by[0])), cx=camera.cx + camera.fx * float(by[1]),
        cy=camera.cy + camera.fy * float(by[2]),
        distortion=(k1, k2, *others, *[0.0] * (2 - len(others))) if distorted else (),
    )  # fmt: skip


def lens_difference(camera: Camera, other: Camera) -> F64:
    """(5,) difference of lens parameters, as in `GIVEN_SIGMA`, from one camera to another."""
    distortions = [np.array((one.distortion or (0.0, 0.0))[:2]) for one in (camera, other)]
    centre = (other.cx - camera.cx) / camera.fx, (other.cy - camera.cy) / camera.fy
    return np.array([np.log(other.fx / camera.fx), *centre, *(distortions[1] - distortions[0])])

"""Lens estimation: whether given focal length, principal point and distortion fit the images, and which ones do.

In turns, a wrong lens contradicts itself: features that cross the image rotate by more, or less, than the intrinsics
predict. A window's graph is solved again with the lens as four additional parameters; their information is summed over
all windows. When driving straight ahead, a wrong lens can hardly be distinguished from Lucas-Kanade's small errors, so
only turning windows are used. Distortion and focal length are correlated, too: distortion is only estimated if it is
significant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from scan2sim.pipeline.camera.models import project_exactly, unproject
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.slam.factor_graph import Graph, errors
from scan2sim.slam.geometry import log_so3
from scan2sim.slam.solvers import lm

MODELS = ("pinhole", "opencv")
"""Camera models whose lens can be estimated."""
TURN_MIN = np.radians(20)
"""Least rotation between the first and the last camera of a window, radians."""
PRIOR_SIGMA = np.array([0.5, 0.3, 0.3, 0.3])
"""Standard deviations of the prior of the four lens parameters: logarithm of the focal length, principal point x and y
(in focal lengths), k1."""
CORRELATION_FACTOR = 25.0
"""Lucas-Kanade's errors are correlated between frames and points, which multiplies the standard deviations by this.
Determined on rendered turns with a known lens."""
SIGNIFICANT_CHANGE = np.array([0.02, 0.02, 0.02, 0.05])
"""Least difference of the parameters that is reported to the user."""
SIGNIFICANCE_SIGMAS = 3.0
"""Number of standard deviations from which a difference is significant."""
ROUNDS_MAX = 5
"""Greatest number of times a window is solved, each with the lens of the previous round."""
DIFFERENCE_STEP = 1e-5
"""Step of the central differences by the lens parameters."""


@dataclass(frozen=True)
class LensEstimate:
    """An estimated lens: `camera`, and `sigma` (4,), standard deviations of the parameters of `PRIOR_SIGMA`."""

    camera: Camera
    sigma: F64


def changed_lens(camera: Camera, by: F64) -> Camera:
    """Camera whose lens parameters, as in `PRIOR_SIGMA`, are changed by (4,)."""
    k1, *others = camera.distortion or (0.0,)
    k1 += float(by[3])
    distorted = k1 != 0 or any(others)
    return replace(
        camera, model="opencv" if distorted else "pinhole", fx=camera.fx * float(np.exp(by[0])),
        fy=camera.fy * float(np.exp(by[0])), cx=camera.cx + camera.fx * float(by[1]),
        cy=camera.cy + camera.fy * float(by[2]),
        distortion=(k1, *others, *[0.0] * (3 - len(others))) if distorted else (),
    )  # fmt: skip


def lens_difference(camera: Camera, other: Camera) -> F64:
    """(4,) difference of lens parameters, as in `PRIOR_SIGMA`, from one camera to another."""
    k1, other_k1 = ((one.distortion or (0.0,))[0] for one in (camera, other))
    centre = (other.cx - camera.cx) / camera.fx, (other.cy - camera.cy) / camera.fy
    return np.array([np.log(other.fx / camera.fx), *centre, other_k1 - k1])


def lens_information(camera: Camera, graph: Graph) -> F64 | None:
    """(4, 5) information of a graph on its camera's lens: matrix (4, 4) and vector (4,) of the normal equations.

    None if the camera turns too little, or pixels can't be unprojected.
    """
    first, last = graph.poses[0, :3, :3], graph.poses[-1, :3, :3]
    if camera.model not in MODELS or np.linalg.norm(log_so3(first.T @ last)) < TURN_MIN:
        return None
    uv, _ = project_exactly(camera, graph.bearing)
    change = np.zeros(4)
    sigma = PRIOR_SIGMA / CORRELATION_FACTOR
    graph = replace(graph, fixed=np.arange(len(graph.poses)) < 1, shared_sigma=sigma, distances=())
    for _ in range(ROUNDS_MAX):
        free = _with_free_lens(changed_lens(camera, change), graph, uv, change)
        if free is None:
            return None
        solved = lm.solve(free, iterations=15)
        change = change + solved.shared
        graph = replace(graph, poses=solved.poses, points=solved.points)
        if np.all(np.abs(solved.shared) < 0.05 * SIGNIFICANT_CHANGE):
            break
    free = _with_free_lens(changed_lens(camera, change), graph, uv, change)
    if free is None:
        return None
    noise = float(np.median(errors(free, free.poses, free.points))) / 1.18  # of two components each
    information = lm.information_of_shared(free) / (noise * CORRELATION_FACTOR) ** 2
    return np.concatenate([information, (information @ change)[:, None]], axis=1)


def _with_free_lens(camera: Camera, graph: Graph, uv: F64, change: F64) -> Graph | None:
    """Graph of the pixels (O, 2) with the lens parameters as shared parameters; None if pixels can't be unprojected.

    `change` (4,): lens difference of `camera` from the original camera, which is the mean of the prior.
    """
    bearing = unproject(camera, uv)
    derivative = np.stack(
        [
            (unproject(changed_lens(camera, h), uv) - unproject(changed_lens(camera, -h), uv)) / (2 * DIFFERENCE_STEP)
            for h in DIFFERENCE_STEP * np.eye(4)
        ],
        axis=1,
    )
    if not np.isfinite(derivative).all():
        return None
    # a change of a bearing is equivalent to a rotation of its camera
    jacobian = np.zeros((len(uv), 4, 6))
    turn = np.cross(bearing[:, None], derivative)
    jacobian[:, :, 3:] = np.einsum("oij,osj->osi", graph.poses[graph.camera_of, :3, :3], turn)
    return replace(graph, bearing=bearing, shared_jacobian=jacobian, shared=np.zeros(4), shared_prior=-change)


def fit_lens(camera: Camera, misfits: Sequence[F64]) -> LensEstimate | None:
    """Lens with the best fit to the information (4, 5) of all windows; None without any."""
    if not len(misfits):
        return None
    total = np.sum(misfits, axis=0)
    information, right = total[:, :4] + np.diag(PRIOR_SIGMA**-2.0), total[:, 4]
    covariance = np.linalg.inv(information)
    change, sigma = covariance @ right, np.sqrt(np.diag(covariance))
    if not camera.distortion and abs(change[3]) < max(SIGNIFICANCE_SIGMAS * sigma[3], SIGNIFICANT_CHANGE[3]):
        change[:3], change[3] = np.linalg.solve(information[:3, :3], right[:3]), 0.0
        sigma[:3], sigma[3] = np.sqrt(np.diag(np.linalg.inv(information[:3, :3]))), 0.0
    return LensEstimate(changed_lens(camera, change), sigma)


def lens_warning(camera: Camera, found: LensEstimate | None) -> str | None:
    """Warning that an estimated lens differs significantly from the camera's; None if it doesn't."""
    if found is None:
        return None
    threshold = np.maximum(SIGNIFICANT_CHANGE, SIGNIFICANCE_SIGMAS * found.sigma)
    wrong = np.abs(lens_difference(camera, found.camera)) > threshold
    if not wrong.any():
        return None
    now, sigma = found.camera, found.sigma
    fits = []
    if wrong[0] or wrong[3]:
        fits.append(f"a focal length of {now.fx:.0f} +- {sigma[0] * now.fx:.0f} pixels better than {camera.fx:.0f}")
    if wrong[1] or wrong[2]:
        fits.append(
            f"a centre at {now.cx:.0f}, {now.cy:.0f} (+- {sigma[1] * now.fx:.0f}, {sigma[2] * now.fx:.0f}) better than "
            f"{camera.cx:.0f}, {camera.cy:.0f}"
        )
    if wrong[3]:
        k1, better_k1 = ((one.distortion or (0.0,))[0] for one in (camera, now))
        fits.append(f"distortion k1 = {better_k1:.2f} +- {sigma[3]:.2f} better than {k1:.2f}")
    return (
        f"in turns, the images fit {', and '.join(fits)}: check --focal, --centre and --k1, and whether the images "
        "were cropped or scaled; --calibrate estimates them"
    )

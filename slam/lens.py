"""Lens estimation: whether given focal length, principal point and distortion fit the images, and which ones do.

In turns, a wrong lens contradicts itself: features that cross the image rotate by more, or less, than the intrinsics
predict. Windows of the map are bundle-adjusted again with the lens free: focal length, principal point and radial
distortion k1, k2 together, as they are correlated. Their information is summed over all windows, and combined with a
Gaussian prior of the given lens: parameters that the drive doesn't determine, all of them on a straight one, keep their
given value. Residuals are in pixels. Angles would bias the lens, as a longer focal length makes all of them smaller.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from scan2sim.pipeline.camera.lens import LENS_MODELS, changed_lens, lens_difference
from scan2sim.pipeline.camera.models import SERIAL_MAX, parameters, project_exactly
from scan2sim.pipeline.core.types import F64, I32, I64, Camera
from scan2sim.slam.factor_graph import Graph, Solution
from scan2sim.slam.solvers import lm

PARAMETERS = 5
"""Number of lens parameters: logarithm of the focal length, principal point x and y (in focal lengths), k1, k2."""
UNKNOWN_SIGMA = np.array([0.5, 0.3, 0.3, 0.3, 0.1])
"""Standard deviations of the prior of an unknown lens, in these parameters."""
CORRELATION_FACTOR = 10.0
"""Lucas-Kanade's errors are correlated between frames and points, which multiplies the standard deviations by this:
by the differences between two real drives of one car, and between the windows of each."""
CONTRADICTION_MIN = 20.5
"""Twice the logarithm of the likelihood ratio beyond which a drive contradicts its lens: 99.9 % of chi-square with five
degrees of freedom."""
SIGNIFICANCE_SIGMAS = 3.0
"""Number of standard deviations from which the difference of a parameter is reported."""
ITERATIONS_MAX = 12
BEHIND_PX = 1e3
"""Residual of a point behind the camera, pixels."""


@dataclass(frozen=True)
class LensEstimate:
    """An estimated lens.

    Attributes:
        camera: the camera.
        sigma: (5,) standard deviations of the parameters of `UNKNOWN_SIGMA`.
        contradiction: twice the logarithm of the ratio of the posterior densities of this lens and the windows'.
    """

    camera: Camera
    sigma: F64
    contradiction: float


def lens_information(camera: Camera, graph: Graph) -> F64 | None:
    """(5, 6) information of a graph on its camera's lens: matrix (5, 5) and vector (5,) of the normal equations.

    None if the camera's model isn't one of `LENS_MODELS`.
    """
    if camera.model not in LENS_MODELS:
        return None
    uv, _ = project_exactly(camera, graph.bearing)
    window = _Window(camera, replace(graph, fixed=np.arange(len(graph.poses)) < 1), uv)
    start = Solution(graph.poses, graph.points, np.zeros(PARAMETERS))
    solved = lm.minimize(start, window.graph.fixed, window.cost, window.normal, ITERATIONS_MAX)
    residual = window.residual(solved.poses, solved.points, solved.shared)
    noise = float(np.median(np.linalg.norm(residual, axis=1))) / 1.18  # of two components each
    normal = window.observations(solved.poses, solved.points, solved.shared)
    scale = window.sigma / max(noise, 1e-6) / CORRELATION_FACTOR
    information = lm.information_of_shared(normal, PARAMETERS) * scale**2
    return np.concatenate([information, (information @ solved.shared)[:, None]], axis=1)


class _Window:
    """Bundle adjustment of a window in pixels, its lens free: cost and normal equations for `lm.minimize`."""

    def __init__(self, camera: Camera, graph: Graph, uv: F64) -> None:
        """`graph`: its bearings aren't used; `uv` (O, 2): observed pixels."""
        self.camera, self.graph, self.uv = camera, graph, uv
        self.sigma = graph.sigma * camera.fx
        self._layout = lm.layout(graph.point_of, graph.camera_of, graph.fixed, len(graph.points), PARAMETERS)
        self._prior = (CORRELATION_FACTOR / UNKNOWN_SIGMA) ** 2

    def residual(self, poses: F64, points: F64, lens: F64) -> F64:
        """(O, 2) predicted minus observed pixels."""
        offset = points[self.graph.point_of] - poses[self.graph.camera_of, :3, 3]
        local = np.einsum("oji,oj->oi", poses[self.graph.camera_of, :3, :3], offset)
        camera, parts = changed_lens(self.camera, lens), range(0, len(local), SERIAL_MAX)
        projected = [project_exactly(camera, local[k : k + SERIAL_MAX]) for k in parts]  # on one thread
        uv, seen = (np.concatenate(one) for one in zip(*projected, strict=True))
        uv[~seen] = self.uv[~seen] + BEHIND_PX
        return uv - self.uv

    def cost(self, poses: F64, points: F64, lens: F64) -> float:
        """Cauchy cost of the residuals, and the prior of the lens."""
        squares = (self.residual(poses, points, lens) ** 2).sum(axis=1) / self.sigma**2
        return float(np.log1p(squares).sum() + (self._prior * lens**2).sum())

    def normal(self, poses: F64, points: F64, lens: F64) -> lm.Normal:
        """Normal equations of observations and prior."""
        normal = self.observations(poses, points, lens)
        last = np.arange(len(normal.g) - PARAMETERS, len(normal.g))
        normal.H[last, last] += self._prior
        normal.g[last] += self._prior * lens
        return normal

    def observations(self, poses: F64, points: F64, lens: F64) -> lm.Normal:
        """Normal equations of the observations alone."""
        camera = changed_lens(self.camera, lens)
        starts, columns, size = self._layout
        equations = _accumulate(
            parameters(camera), self.camera.fx, self.camera.fy, poses, points, self.uv, self.sigma, starts,
            self.graph.camera_of, columns, size,
        )  # fmt: skip
        return lm.Normal(*equations, starts, columns)


@njit(cache=True, nogil=True)
def _accumulate(
    camera: F64,
    fx: float,
    fy: float,
    poses: F64,
    points: F64,
    uv: F64,
    sigma: float,
    starts: I64,
    camera_of: I32,
    columns: I64,
    size: int,
) -> tuple[F64, F64, F64, F64, F64]:
    """H, g, V, gp, W of `lm.Normal`.

    Args:
        camera: (15,) parameters of `pipeline.camera.models.parameters`, OpenCV's distortion.
        fx, fy: focal lengths in which the principal point is measured, pixels.
        poses, points: (C, 4, 4), (P, 3).
        uv: (O, 2) observed pixels.
        sigma: their standard deviation, pixels.
        starts, camera_of, columns, size: layout of the equations, see `lm.layout`.
    """
    n, D = len(starts) - 1, 6 + PARAMETERS
    H, g, V, gp = np.zeros((size, size)), np.zeros(size), np.zeros((n, 3, 3)), np.zeros((n, 3))
    W, J, r, shared = np.zeros((len(uv), D, 3)), np.zeros((2, D)), np.empty(2), size - PARAMETERS
    k1, k2, p1, p2, k3, k4, k5, k6 = camera[4:12]
    for p in range(n):
        for o in range(starts[p], starts[p + 1]):
            T = poses[camera_of[o]]
            dx, dy, dz = points[p, 0] - T[0, 3], points[p, 1] - T[1, 3], points[p, 2] - T[2, 3]
            depth = T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz
            if depth <= 0:
                continue
            x = (T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz) / depth
            y = (T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz) / depth
            q = x * x + y * y
            if q >= camera[14] * camera[14]:
                continue
            above, below = 1 + q * (k1 + q * (k2 + q * k3)), 1 + q * (k4 + q * (k5 + q * k6))
            radial = above / below
            slope = (k1 + q * (2 * k2 + 3 * q * k3) - radial * (k4 + q * (2 * k5 + 3 * q * k6))) / below
            across = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
            for k in range(2):
                f, plain, centre = (camera[0], x, fx) if k == 0 else (camera[1], y, fy)
                if k == 0:
                    distorted = x * radial + 2 * p1 * x * y + p2 * (q + 2 * x * x)
                    bx, by = f * (radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x), f * across
                else:
                    distorted = y * radial + p1 * (q + 2 * y * y) + 2 * p2 * x * y
                    bx, by = f * across, f * (radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x)
                r[k] = f * distorted + camera[2 + k] - uv[o, k]
                bx, by, bz = bx / depth, by / depth, -(x * bx + y * by) / depth
                wx = T[0, 0] * bx + T[0, 1] * by + T[0, 2] * bz  # derivative by the point, world axes
                wy = T[1, 0] * bx + T[1, 1] * by + T[1, 2] * bz
                wz = T[2, 0] * bx + T[2, 1] * by + T[2, 2] * bz
                J[k, 0], J[k, 1], J[k, 2] = -wx, -wy, -wz
                J[k, 3], J[k, 4], J[k, 5] = wy * dz - wz * dy, wz * dx - wx * dz, wx * dy - wy * dx
                J[k, 6], J[k, 7 + k], J[k, 8 - k] = f * distorted, centre, 0.0
                J[k, 9], J[k, 10] = f * plain * q / below, f * plain * q * q / below
            w = 1 / (sigma * sigma + r[0] * r[0] + r[1] * r[1])
            for i in range(3):
                gp[p, i] -= w * (J[0, i] * r[0] + J[1, i] * r[1])
                for j in range(3):
                    V[p, i, j] += w * (J[0, i] * J[0, j] + J[1, i] * J[1, j])
            c = columns[o, 0]
            for i in range(0 if c >= 0 else 6, D):
                a, b = w * J[0, i], w * J[1, i]
                row = c + i if i < 6 else shared + i - 6
                g[row] += a * r[0] + b * r[1]
                for j in range(3):
                    W[o, i, j] = -(a * J[0, j] + b * J[1, j])
                if c >= 0:
                    own = H[row, c : c + 6]
                    for j in range(6):
                        own[j] += a * J[0, j] + b * J[1, j]
                lens = H[row, shared:]
                for j in range(PARAMETERS):
                    lens[j] += a * J[0, 6 + j] + b * J[1, 6 + j]
    return H, g, V, gp, W


def fit_lens(
    camera: Camera, misfits: Sequence[F64], sigma: F64 = UNKNOWN_SIGMA, prior: Camera | None = None
) -> LensEstimate | None:
    """Most probable lens by the information (5, 6) of all windows, and a Gaussian prior; None without any windows.

    Args:
        camera: camera of the windows.
        misfits: information of each window (`lens_information`).
        sigma: (5,) standard deviations of the prior.
        prior: mean of the prior; default: `camera`.
    """
    if not len(misfits):
        return None
    total = np.sum(misfits, axis=0)
    covariance = np.linalg.inv(total[:, :PARAMETERS] + np.diag(sigma**-2.0))
    gradient = total[:, PARAMETERS] - lens_difference(prior or camera, camera) / sigma**2
    change = covariance @ gradient
    return LensEstimate(changed_lens(camera, change), np.sqrt(np.diag(covariance)), float(change @ gradient))


def contradicts(found: LensEstimate | None) -> bool:
    """Whether a drive clearly contradicts the lens that an estimate started from."""
    return found is not None and found.contradiction > CONTRADICTION_MIN


def lens_changes(camera: Camera, found: LensEstimate) -> str:
    """The significant differences of an estimated lens from a camera's, for messages; empty if there are none."""
    wrong = np.abs(lens_difference(camera, found.camera)) > SIGNIFICANCE_SIGMAS * found.sigma
    now, sigma = found.camera, found.sigma
    fits = []
    if wrong[0]:
        fits.append(f"a focal length of {now.fx:.1f} +- {sigma[0] * now.fx:.1f} pixels better than {camera.fx:.1f}")
    if wrong[1] or wrong[2]:
        fits.append(
            f"a centre at {now.cx:.1f}, {now.cy:.1f} (+- {sigma[1] * now.fx:.1f}, {sigma[2] * now.fx:.1f}) better than "
            f"{camera.cx:.1f}, {camera.cy:.1f}"
        )
    for row, name in ((3, "k1"), (4, "k2")):
        if wrong[row]:
            given, better = ((one.distortion or (0.0, 0.0))[row - 3] for one in (camera, now))
            fits.append(f"distortion {name} = {better:.4f} +- {sigma[row]:.4f} better than {given:.4f}")
    return ", and ".join(fits)


def lens_warning(camera: Camera, found: LensEstimate | None) -> str | None:
    """Warning that a drive contradicts the camera's lens; None if it doesn't."""
    if found is None or not contradicts(found):
        return None
    return (
        f"in turns, the images fit {lens_changes(camera, found) or 'another lens'}: check --focal, --centre, --k1 and "
        "--k2, and whether the images were cropped or scaled; --calibrate estimates them"
    )

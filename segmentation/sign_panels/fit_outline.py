"""Fitting of sign panels to photos: position, heading, size and shape of outlines on which all photos agree.

Along a panel's outline the colours just inside and just outside differ in every photo, and the face of the panel looks
the same in all photos, whereas the background behind it moves from photo to photo. An objective function rates both;
it is maximised by differential evolution (Storn and Price 1997) and refined by the Nelder-Mead method.
Import late: it loads numba.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from scan2sim.pipeline.core.cores import available_cores
from scan2sim.pipeline.core.types import F32, F64, U8, View
from scan2sim.pipeline.furniture.sign_panels import ASPECT, OUTLINES, PANEL_SIZE_M, Shape, SignPanel, inside

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

MIN_PHOTOS, MAX_PHOTOS = 3, 6
"""Number of photos in which a panel is fitted: those with the best resolution."""
RESOLUTION_RATIO_MIN = 0.4
"""Smallest resolution (pixels per metre) of a photo relative to the best photo's."""
VIEW_ANGLE_MIN_COS = 0.5
"""Cosine of the largest angle between two photos' rays to a panel: beyond, one may see its back."""
CLOSE_UP_RADIUS_M = 1.6
"""Metres that a close-up extends to each side of its centre."""
VISIBLE_RADIUS_M = 0.6
"""Metres around the centre that a photo must show."""
MIN_RESOLUTION = 8
"""Pixels per metre below which a photo is not used."""
OUTLINE_SAMPLES = 48
"""Sample points along an outline."""
NOISE_LEVELS = 4.0
"""Standard deviation in grey levels by which photos of the same surface differ."""
MIN_EDGE_CONTRAST = 2 / 3
"""Contrast of the weakest quarter of an outline: across the edge, twice the disagreement of the photos and noise."""
MIN_FACE_AGREEMENT = 0.8
"""Share of the variance of a panel's face on which all photos agree."""
CANDIDATE_SHARE = 0.8
"""Share of both thresholds from which a panel is refined to its exact outline."""
CONTINUE_SHARE, CONTINUE_CHECK_GENERATION, MAX_GENERATIONS = 0.4, 25, 50
"""Share of both thresholds that a search must have reached at this generation to continue, and number of generations:
a search may converge late, but is close to the thresholds by then."""
REFINE_SHARE = 0.6
"""Share of both thresholds from which the result of a search is refined."""
HEADING_TOLERANCE = math.radians(60)
"""Largest error of a panel's initial heading."""
AREA_BONUS = 0.03
"""Bonus in the objective for twice the area: selects the outermost of several outlines of equal contrast."""
OUTER_SCALES, MAX_OUTER_OUTLINES = np.linspace(1.02, 1.4, 20), 3
"""Factors of an outline's size at which another outline is searched around it, and how many times."""
FINE_OFFSET_PX, HEADING_STARTS = 0.5, (-0.3, 0.0, 0.3)
"""Distance in pixels from the outline at which colours are compared for the exact outline, and starting values of the
heading's change in radians: small panels have about the same contrast at these headings."""
REFINE_MAX_SCALE, REFINE_MAX_SHIFT_M = 0.05, 0.1
"""Largest change of size (logarithm) and position in the refinement."""
ADJACENT_MAX_OFFSET_M, ADJACENT_MAX_OVERLAP_M, ADJACENT_MAX_GAP_M = 0.15, 0.03, 0.15
"""Largest sideways offset, overlap and gap between a panel and the next one on its pole."""
SIMILAR_AREA_RATIO = 0.8
"""Smallest area, relative to the largest detected outline, of an outline that may be selected instead of it."""


@dataclass(frozen=True)
class CloseUps:
    """Virtual pinhole views of several photos, centred on a point.

    Attributes:
        images: (J, S, S, 3) float32 pinhole images.
        project: (J, 3, 4) projection matrices from local metres to their pixels.
        focal: (J,) focal lengths in pixels.
        centre: (3,) point on which they are centred, local metres.
        towards: (3,) unit vector from there to the photos.
    """

    images: F32
    project: F64
    focal: F64
    centre: F64
    towards: F64

    def contrast(self, shape: Shape, panels: F64, offset: float = 1.0) -> F64:
        """(N, 3) mean contrast of outlines, contrast of their weakest quarter, and face agreement; each 0 to 1.

        Args:
            shape: shape of the outlines.
            panels: (N, 6) x, y, z (local metres), heading (radians), width, height.
            offset: distance in pixels from the outline, inside and outside, at which colours are compared.
        """
        return _contrast(
            self.images, self.project, self.focal, panels, *_samples(shape), OUTLINE_SAMPLES, offset, NOISE_LEVELS
        )

    def shows(self, panel: SignPanel, share: float = 1.0) -> bool:
        """Whether the photos show a panel: contrast and agreement reach a share of their thresholds."""
        _, weakest, agreement = self.contrast(panel.shape, _row(panel))[0]
        return bool(weakest >= share * MIN_EDGE_CONTRAST and agreement >= share * MIN_FACE_AGREEMENT)

    def objective(self, shape: Shape, panels: F64, offset: float = 1.0) -> F64:
        """(N,) objective to be maximised; arguments as of `contrast`."""
        mean, weakest, agreement = self.contrast(shape, panels, offset).T
        return np.asarray((mean + weakest) / 2 * agreement + AREA_BONUS * np.log2(panels[:, 4] * panels[:, 5]))


def close_ups(centre: F64, views: Sequence[View], photo: Callable[[int], U8 | None]) -> CloseUps | None:
    """Close-ups of a point (3,) from the photos with the best resolution; None if fewer than three show it.

    Args:
        centre: point in local metres.
        views: views that may be used.
        photo: function of the index of a view that returns its photo (H, W, 3), None if it can't be read.
    """
    resolution = np.array([_resolution(view, centre) for view in views])
    order = [int(i) for i in np.argsort(-resolution, kind="stable") if resolution[i] > MIN_RESOLUTION]
    if len(order) < MIN_PHOTOS:
        return None
    rays = np.array([views[i].centre - centre for i in order])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    selected = [
        i for i, ray in zip(order, rays, strict=True)
        if resolution[i] >= RESOLUTION_RATIO_MIN * resolution[order[0]] and ray @ rays[0] > VIEW_ANGLE_MIN_COS
    ][: MAX_PHOTOS]  # fmt: skip
    size = 2 * math.ceil(CLOSE_UP_RADIUS_M * resolution[order[0]]) + 1
    readable = [(rgb, views[i], resolution[i]) for i in selected if (rgb := photo(i)) is not None]
    if len(readable) < MIN_PHOTOS:
        return None
    rendered = [_close_up(rgb, view, centre, size, pixels_per_metre) for rgb, view, pixels_per_metre in readable]
    images, project, focal = (np.array(column) for column in zip(*rendered, strict=True))
    towards = rays[: len(selected)].mean(axis=0)
    return CloseUps(images, project, focal, centre, towards / np.linalg.norm(towards))


def _resolution(view: View, centre: F64) -> float:
    """Pixels per metre of a photo at a point (3,); 0 if it doesn't show `VISIBLE_RADIUS_M` around the point."""
    from scan2sim.pipeline.camera.models import inside as within
    from scan2sim.pipeline.camera.models import pixel_angle, project

    R = view.T_world_cam[:3, :3]
    local = (centre - view.centre) @ R
    distance = float(np.linalg.norm(local))
    corners = local + VISIBLE_RADIUS_M * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (0, 0, 0)])
    uv, valid = project(view.camera, corners)
    if distance < 2 * VISIBLE_RADIUS_M or not (valid & within(view.camera, uv)).all():
        return 0.0
    return 1 / (pixel_angle(view.camera) * distance)


def _close_up(rgb: U8, view: View, centre: F64, size: int, resolution: float) -> tuple[F32, F64, float]:
    """Pinhole image (size, size, 3) centred on a point, its projection matrix (3, 4), and its focal length."""
    import cv2

    from scan2sim.pipeline.camera.models import project

    ray = centre - view.centre
    distance = float(np.linalg.norm(ray))
    forward = ray / distance
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])  # world to the close-up
    focal, middle = resolution * distance, (size - 1) / 2
    row, column = np.mgrid[:size, :size]
    rays = np.stack([(column - middle) / focal, (row - middle) / focal, np.ones((size, size))], axis=-1)
    uv, valid = project(view.camera, rays.reshape(-1, 3) @ R @ view.T_world_cam[:3, :3])
    uv = np.where(valid[:, None], uv, -1e4).reshape(size, size, 2).astype(np.float32)
    image = cv2.remap(rgb, uv[..., 0], uv[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    K = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
    return np.asarray(image, np.float32), K @ np.column_stack([R, -R @ view.centre]), focal


def fit_panel(photos: CloseUps, radius: float, normal: F64 | None = None) -> SignPanel | None:
    """The panel within `radius` metres of the close-ups' centre; None if there is none.

    Args:
        photos: close-ups of the expected position.
        radius: search radius in metres.
        normal: (3,) approximate normal of the panel; None: towards the photos.
    """
    facing = photos.towards if normal is None else normal
    heading = math.atan2(facing[1], facing[0])
    low = [*(photos.centre - radius), heading - HEADING_TOLERANCE]
    high = [*(photos.centre + radius), heading + HEADING_TOLERANCE]
    return _best_of_all_shapes(photos, lambda shape, p: p, low, high, HEADING_STARTS)


def fit_adjacent_panel(photos: CloseUps, panel: SignPanel, up: int) -> SignPanel | None:
    """The next panel above (`up` 1) or below (-1) a panel, in the same plane; None if there is none."""

    def at(shape: Shape, p: F64) -> F64:
        across, gap, width, height = p.T
        rise = up * (panel.height / 2 + gap + height / 2)
        centre = panel.centre + across[:, None] * panel.across + rise[:, None] * (0, 0, 1)
        return np.column_stack([centre, np.full(len(p), _row(panel)[0, 3]), width, height])

    low, high = [-ADJACENT_MAX_OFFSET_M, -ADJACENT_MAX_OVERLAP_M], [ADJACENT_MAX_OFFSET_M, ADJACENT_MAX_GAP_M]
    return _best_of_all_shapes(photos, at, low, high, (0.0,))


def _best_of_all_shapes(
    photos: CloseUps,
    at: Callable[[Shape, F64], F64],
    low: Sequence[float],
    high: Sequence[float],
    heading_starts: Sequence[float],
) -> SignPanel | None:
    """The panel with the best objective among the largest of all shapes; None if no shape is shown.

    Args:
        photos: close-ups of the expected position.
        at: function that maps a shape and parameters (N, K + 2), width and height last, to panels (N, 6) as of
            `CloseUps.contrast`.
        low, high: (K,) bounds of the other parameters.
        heading_starts: starting values for the change of the heading in radians.
    """
    with ThreadPoolExecutor(available_cores()) as pool:
        best = list(pool.map(lambda shape: _best_of_shape(photos, shape, at, low, high), OUTLINES))
    candidates = [panel for panel in best if panel is not None and photos.shows(panel, CANDIDATE_SHARE)]
    found = [_outermost(photos, panel, heading_starts) for panel in candidates]
    shown = [panel for panel in found if photos.shows(panel)]
    if not shown:
        return None
    largest = max(panel.area for panel in shown)
    return max(
        (panel for panel in shown if panel.area > SIMILAR_AREA_RATIO * largest),
        key=lambda panel: float(photos.objective(panel.shape, _row(panel))[0]),
    )


def _best_of_shape(
    photos: CloseUps, shape: Shape, at: Callable[[Shape, F64], F64], low: Sequence[float], high: Sequence[float]
) -> SignPanel | None:
    """The panel of a shape with the best objective within bounds; None if it is far below the thresholds."""
    from scipy.optimize import differential_evolution, minimize

    sides = 2 if shape == "rectangle" else 1
    low, high = [*low, *[PANEL_SIZE_M[0]] * sides], [*high, *[PANEL_SIZE_M[1]] * sides]

    def panels(p: F64) -> F64:
        height = p[:, -1:] if sides == 2 else p[:, -1:] * ASPECT.get(shape, 1.0)
        return at(shape, np.column_stack([p[:, : len(low) - sides], p[:, -sides], height]))

    def cost(p: F64) -> F64:
        return -photos.objective(shape, panels(p.T))

    def cost_of_one(p: F64) -> float:
        return float(cost(p[:, None])[0])

    def stop_early(intermediate_result: OptimizeResult) -> bool:
        best = _panel(shape, panels(intermediate_result.x[None])[0])
        is_late = intermediate_result.nit >= CONTINUE_CHECK_GENERATION
        return bool(is_late and not photos.shows(best, CONTINUE_SHARE))

    bounds = list(zip(low, high, strict=True))
    found = differential_evolution(
        cost, bounds, popsize=16, maxiter=MAX_GENERATIONS, tol=1e-2, rng=0, polish=False, updating="deferred",
        vectorized=True, callback=stop_early,
    )  # fmt: skip
    if not photos.shows(_panel(shape, panels(found.x[None])[0]), REFINE_SHARE):
        return None
    refined = minimize(
        cost_of_one, found.x, method="Nelder-Mead", bounds=bounds,
        options={"maxiter": 300, "xatol": 1e-3, "fatol": 1e-5},
    )  # fmt: skip
    return _panel(shape, panels(refined.x[None])[0])


def _outermost(photos: CloseUps, panel: SignPanel, heading_starts: Sequence[float]) -> SignPanel:
    """A refined panel, or the largest shown outline around it; `heading_starts` as in `_refined`."""
    panel = _refined(photos, panel, heading_starts)
    for _ in range(MAX_OUTER_OUTLINES):
        scaled = [replace(panel, width=k * panel.width, height=k * panel.height) for k in (0.99, *OUTER_SCALES)]
        objective = photos.objective(panel.shape, np.concatenate([_row(p) for p in scaled]))
        peaks = [k for k in range(1, len(scaled) - 1) if objective[k] > max(objective[k - 1], objective[k + 1])]
        larger = (_refined(photos, scaled[k], heading_starts) for k in reversed(peaks))
        found = next((other for other in larger if photos.shows(other)), None)
        if found is None:
            break
        panel = found
    return panel


def _refined(photos: CloseUps, panel: SignPanel, heading_starts: Sequence[float]) -> SignPanel:
    """A panel refined to the best nearby position and size, and heading unless all `heading_starts` are 0."""
    from scipy.optimize import minimize

    row, free = _row(panel)[0], float(any(heading_starts))
    axes = np.stack([panel.across, np.array([0.0, 0.0, 1.0]), free * panel.normal])

    def at(p: F64) -> F64:
        wider, higher = np.exp([p[4], p[5] if panel.shape == "rectangle" else p[4]])
        return np.array([*(row[:3] + p[:3] @ axes), row[3] + free * p[3], row[4] * wider, row[5] * higher])

    def cost(p: F64) -> float:
        is_near = np.abs(p[4:]).max() < REFINE_MAX_SCALE and np.abs(p[:3]).max() < REFINE_MAX_SHIFT_M
        return -float(photos.objective(panel.shape, at(p)[None], FINE_OFFSET_PX)[0]) if is_near else 1e9

    steps = np.concatenate([np.zeros((1, 6)), np.diag([0.02, 0.02, 0.03, 0.1, 0.03, 0.03])])
    starts = [steps + (0, 0, 0, turn, 0, 0) for turn in heading_starts]
    found = [minimize(cost, s[0], method="Nelder-Mead", options={"initial_simplex": s, "maxiter": 400}) for s in starts]
    return _panel(panel.shape, at(min(found, key=lambda result: float(result.fun)).x))


def _panel(shape: Shape, row: F64) -> SignPanel:
    """The panel of a row (6,) of `CloseUps.contrast`'s panels."""
    x, y, z, heading, width, height = row.tolist()
    return SignPanel(np.array([x, y, z]), np.array([math.cos(heading), math.sin(heading), 0.0]), shape, width, height)


def _row(panel: SignPanel) -> F64:
    """(1, 6) row of a panel for `CloseUps.contrast`."""
    heading = math.atan2(panel.normal[1], panel.normal[0])
    return np.array([[*panel.centre, heading, panel.width, panel.height]], np.float64)


@cache
def _samples(shape: Shape) -> tuple[F64, F64]:
    """Samples (S, 2) of an outline of half-size 1, and directions (S, 2) in which they are offset.

    The samples are points along the outline with inward directions, the same points with outward directions, and
    points over the face without a direction.
    """
    corners = OUTLINES[shape]
    edge = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(edge, axis=1)
    first = np.concatenate([[0], np.cumsum(length)])
    t = (np.arange(OUTLINE_SAMPLES) + 0.5) / OUTLINE_SAMPLES * first[-1]
    k = np.searchsorted(first, t, side="right") - 1
    rim, out = corners[k] + ((t - first[k]) / length[k])[:, None] * edge[k], np.column_stack([edge[k, 1], -edge[k, 0]])
    grid = np.stack(np.meshgrid(*(np.linspace(-0.9, 0.9, 11),) * 2), axis=-1).reshape(-1, 2)
    face = grid[inside(grid, corners, -0.08)]
    return np.concatenate([rim, rim, face]), np.concatenate([-out, out, np.zeros_like(face)])


@njit(cache=True, nogil=True)
def _contrast(
    images: F32, project: F64, focal: F64, panels: F64, flat: F64, out: F64, rim: int, offset: float, noise: float
) -> F64:
    """Kernel of `CloseUps.contrast`; `flat` and `out` from `_samples`."""
    rated = np.zeros((len(panels), 3))
    seen, mean, edge = np.empty((len(images), len(flat), 3)), np.empty((len(flat), 3)), np.empty(rim)
    for n in range(len(panels)):
        if _sample_photos(images, project, focal, panels, n, flat, out, rim, offset, seen):
            rated[n, 0], rated[n, 1], rated[n, 2] = _rate(seen, mean, edge, noise)
    return rated


@njit(cache=True, nogil=True)
def _sample_photos(
    images: F32,
    project: F64,
    focal: F64,
    panels: F64,
    n: int,
    flat: F64,
    out: F64,
    rim: int,
    offset: float,
    seen: F64,
) -> bool:
    """Sample all images at the `_samples` of panel n into `seen` (J, S, 3), those of the outline `offset` pixels off.

    Returns False if an image doesn't contain all samples.
    """
    height, width = images.shape[1:3]
    x, y, z, wide, tall = panels[n, 0], panels[n, 1], panels[n, 2], panels[n, 4], panels[n, 5]
    right, ahead = -math.sin(panels[n, 3]), math.cos(panels[n, 3])
    for j in range(len(images)):
        # not by `pipeline.camera.projection`: points of a plane are linear in a and b, which saves most of the products
        # the point a across and b up from the centre is at pixel (u + a ua + b ub, v + ...) / (w + ...)
        u = project[j, 0, 0] * x + project[j, 0, 1] * y + project[j, 0, 2] * z + project[j, 0, 3]
        v = project[j, 1, 0] * x + project[j, 1, 1] * y + project[j, 1, 2] * z + project[j, 1, 3]
        w = project[j, 2, 0] * x + project[j, 2, 1] * y + project[j, 2, 2] * z + project[j, 2, 3]
        ua, ub = project[j, 0, 0] * right + project[j, 0, 1] * ahead, project[j, 0, 2]
        va, vb = project[j, 1, 0] * right + project[j, 1, 1] * ahead, project[j, 1, 2]
        wa, wb = project[j, 2, 0] * right + project[j, 2, 1] * ahead, project[j, 2, 2]
        step = offset * w / focal[j]
        for i in range(len(flat)):
            a, b = flat[i, 0] * wide / 2, flat[i, 1] * tall / 2
            if i < 2 * rim:
                p, q = out[i, 0] / wide, out[i, 1] / tall
                scale = step / math.sqrt(p * p + q * q)
                a, b = a + scale * p, b + scale * q
            depth = w + a * wa + b * wb
            if depth < 0.3:
                return False
            column, row = (u + a * ua + b * ub) / depth, (v + a * va + b * vb) / depth
            if not (column >= 0 and row >= 0 and column < width - 1 and row < height - 1):
                return False
            # not by `pipeline.camera.image_sampling`, which handles image borders and is 15 % slower
            c, r = int(column), int(row)
            s, t = column - c, row - r
            for k in range(3):
                upper = images[j, r, c, k] * (1 - s) + images[j, r, c + 1, k] * s
                lower = images[j, r + 1, c, k] * (1 - s) + images[j, r + 1, c + 1, k] * s
                seen[j, i, k] = upper * (1 - t) + lower * t
    return True


@njit(cache=True, nogil=True)
def _rate(seen: F64, mean: F64, edge: F64, noise: float) -> tuple[float, float, float]:
    """Row of `CloseUps.contrast` from colours (J, S, 3) at `_samples`: inside the outline, outside, and on the face.

    `mean` (S, 3) and `edge` (rim,) are work arrays.
    """
    count, sample_count, _ = seen.shape
    rim = len(edge)
    within, disagreement = 0.0, 0.0
    for k in range(3):
        face_mean = 0.0
        for i in range(sample_count):
            total = 0.0
            for j in range(count):
                total += seen[j, i, k]
            mean[i, k] = total / count
            if i >= 2 * rim:
                face_mean += mean[i, k] / (sample_count - 2 * rim)
        for i in range(2 * rim, sample_count):
            within += (mean[i, k] - face_mean) ** 2 + noise**2
            for j in range(count):
                disagreement += (seen[j, i, k] - mean[i, k]) ** 2 / count
    for i in range(rim):
        contrast, spread = 0.0, 0.0
        for j in range(count):
            across, own = 0.0, 0.0
            for k in range(3):
                across += (seen[j, i, k] - seen[j, rim + i, k]) ** 2
                own += (seen[j, i, k] - mean[i, k]) ** 2
            contrast += math.sqrt(across) / count
            spread += own / count
        edge[i] = contrast / (contrast + math.sqrt(spread) + 3 * noise)
    edge.sort()
    return edge.mean(), edge[: rim // 4].mean(), within / (within + disagreement)

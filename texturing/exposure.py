"""Exposure step: photometric calibration of all photos of a tile (exposure, white balance, vignetting), solved jointly.

Surface points are sampled in every photo that sees them. Encoded sRGB values follow a power law, in which a change of
exposure or white balance is a factor, so the logarithm of a sample is a sum: gain of the photo (per channel) +
vignetting of the camera (a polynomial of the distance to the image centre) + colour of the point. Solved by robust
least squares (Huber, iteratively reweighted) with the point colours eliminated (Schur complement), and with a prior
towards no change, or towards the exposures of an earlier tile, so that neighbouring tiles agree.

The prior weighs a share (`own_exposure`) of the photo's observations: photos that see the same surfaces agree, but over
a long stretch the world follows the camera's automatic exposure, so that neither sun nor shade clips. What is still
too bright is compressed by a tone curve (`exposure_model.compressed`), whose white point follows from the largest gain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Distance, ExposureStops, FileName
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, I64, U8, View
from scan2sim.pipeline.io import views as views_io

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.depth_map import DepthMap
    from scan2sim.texturing.photo_cache import Exposures


class ExposureParams(Params):
    """Settings of the exposure calibration.

    Attributes:
        solve: estimate exposures; False leaves all photos unchanged.
        vignetting: also estimate each camera's darkening towards the corners.
        prior: `exposure.json` of an earlier tile; photos and cameras that occur in it keep its values.
        samples: surface points sampled per photo.
        max_distance: metres from the camera beyond which a photo is not sampled.
        own_exposure: weight of a photo's own exposure relative to its agreement with other photos. Near 0, all photos
            of a tile are brought to one exposure; higher, the world's brightness follows the camera's automatic
            exposure along the path, which keeps highlights.
        tint: expected difference between a channel's gain and the other channels' in stops (EV).
    """

    solve: bool = True
    vignetting: bool = True
    prior: FileName = ""
    samples: int = Field(1500, ge=50, le=100_000)
    max_distance: Distance = 100.0
    own_exposure: float = Field(0.02, ge=0, le=10)
    tint: ExposureStops = 0.15


SAMPLING_PIXELS_MAX = 400_000
"""Points are sampled from depth maps of at most this many pixels."""
HUBER_RESIDUAL = 0.06
"""Residual (logarithm of encoded values) beyond which an observation is down-weighted (Huber)."""
PRIOR_TOLERANCE_EV = 0.05
"""Stops by which a photo may depart from the exposure that an earlier tile estimated for it (standard deviation)."""
MAX_GAIN_EV = 3.0
"""Stops by which a photo's exposure may change (standard deviation), for photos with few observations."""
IRLS_ITERATIONS = 8
VIGNETTING_RESIDUAL_RATIO_MAX = 0.8
"""Vignetting is kept if it reduces the median residual below this share of the residual without it."""
MIN_COS = 0.15
VISIBILITY_BIAS_M = 0.04


def exposure(inputs: Inputs, params: ExposureParams, out: Path, report: Report) -> Done:
    """Estimate the exposures of all photos that are not held out.

    Inputs: `views`, `depth` (folder of depth maps), `prior` (exposures of an earlier tile, optional).
    File: `exposures`, JSON of `texturing.photo_cache.Exposures`.
    """
    from scan2sim.texturing.photo_cache import Exposures, camera_of

    views = views_io.load(inputs["views"])
    held = views_io.load_held_out(inputs["views"])
    prior = Exposures.load(inputs["prior"]) if "prior" in inputs else Exposures()
    metrics: dict[str, object] = {"photos": 0}
    solved = prior
    if params.solve and sum(view.camera.model != "orthographic" for view in views) > 1:
        # orthophotos were already colour balanced when they were mosaicked
        used = [i for i, view in enumerate(views) if not held[i] and view.camera.model != "orthographic"]
        seen = observe(views, used, lambda i: inputs["depth"] / f"{i}.npy", params, report)
        solved, spread = solve(seen, views, params, prior)
        gain = solved.gain
        stops = np.log2([sum(gain[views[i].name]) / 3 for i in used if views[i].name in gain] or [1.0])
        metrics = {
            "photos": len(gain),
            "observations": len(seen.value),
            "largest_change_ev": round(float(np.abs(stops).max()), 3),
            "disagreement_before": round(spread[0], 4),
            "disagreement_after": round(spread[1], 4),
            "vignetting": {name: list(v) for name, v in solved.vignetting.items()},
            "white_level": round(solved.white, 1),
            "cameras": len({camera_of(v) for v in views}),
        }
    solved.save(out / "exposures.json")
    return Done({"exposures": out / "exposures.json"}, metrics)


@dataclass(frozen=True)
class Observations:
    """Samples of surface points that several photos see.

    Attributes:
        photo, point: (N,) indices of the photo and of the surface point.
        value: (N, 3) logarithms of the encoded values.
        q: (N,) normalised squared distance from the image centre, see `Exposures`.
    """

    photo: I64
    point: I64
    value: F64
    q: F64


def observe(
    views: Sequence[View],
    used: Sequence[int],
    depth_file: Callable[[int], Path],
    params: ExposureParams,
    report: Report,
) -> Observations:
    """Sample random surface points of every photo in all photos that see them; photos are read one at a time."""
    from scan2sim.pipeline.camera.depth_map import load_depth_map
    from scan2sim.texturing.photo_cache import PhotoCache
    from scan2sim.texturing.photo_prediction import surface

    rng = np.random.default_rng(0)
    points, normals = [], []
    for i in used:
        view = views[i]
        depth = load_depth_map(depth_file(i), view.camera, view.T_world_cam)
        coarse = surface(depth.camera.scaled(min(1.0, (SAMPLING_PIXELS_MAX / depth.range.size) ** 0.5)), depth)
        p, n = coarse.sample(params.samples, params.max_distance, rng)
        points.append(p)
        normals.append(n)
    point, normal = np.concatenate(points), np.concatenate(normals)
    photos = PhotoCache(views)
    rows = []
    for done, i in enumerate(used):
        report(done / len(used), views[i].name)
        photo = photos.get(i)
        if photo is None:
            continue
        depth = load_depth_map(depth_file(i), views[i].camera, views[i].T_world_cam)
        rows.append((i, *_observe(photo.low, photo.mask, views[i], depth, point, normal, params.max_distance)))
    if not rows:
        return Observations(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
    index = np.concatenate([np.full(len(r[1]), r[0]) for r in rows])
    at, value, q = (np.concatenate([r[k] for r in rows]) for k in (1, 2, 3))
    several = np.bincount(at, minlength=len(point))[at] > 1
    return Observations(index[several], at[several], value[several], q[several])


def _observe(
    low: U8,
    mask: U8,
    view: View,
    depth: DepthMap,
    point: F64,
    normal: F64,
    max_distance: float,
) -> tuple[I64, F64, F64]:
    """Indices (N,) of the points (P, 3) that a photo sees well, their log values (N, 3), and q (N,)."""
    import cv2

    from scan2sim.pipeline.camera.depth_map import DepthMap as Map
    from scan2sim.pipeline.camera.depth_map import visible
    from scan2sim.pipeline.camera.projection import pixels
    from scan2sim.texturing.photo_cache import GREY_LEVEL_MAX, GREY_LEVEL_MIN, SRGB_OFFSET

    camera = view.camera
    to = view.centre - point
    distance = np.linalg.norm(to, axis=1)
    cos = np.einsum("ij,ij->i", to, normal) / np.maximum(distance, 1e-9)
    at = np.flatnonzero((distance < max_distance) & (cos > MIN_COS))
    uv, inside = pixels(camera, view.T_world_cam, point[at])
    at, uv = at[inside], uv[inside]
    # no samples beside depth edges: the low frequencies mix both surfaces there
    kernel = 2 * round(camera.width / low.shape[1] * depth.camera.width / camera.width) + 1
    near = Map(depth.camera, depth.T_world_cam, np.asarray(cv2.erode(depth.range, np.ones((kernel, kernel)))))
    good = visible(near, point[at], normal[at], bias=0.3 + VISIBILITY_BIAS_M)
    at, uv = at[good], uv[good]
    x = np.clip((uv[:, 0] + 0.5) * low.shape[1] / camera.width - 0.5, 0, low.shape[1] - 1).astype(np.float32)
    y = np.clip((uv[:, 1] + 0.5) * low.shape[0] / camera.height - 0.5, 0, low.shape[0] - 1).astype(np.float32)
    rgb = np.zeros((len(at), 3))
    # cv2.remap rounds to whole grey levels; the fractions of `pipeline.camera.image_sampling` would change the
    # exposures and take four times as long
    for first in range(0, len(at), 30_000):  # cv2.remap takes at most 32767 rows
        part = slice(first, first + 30_000)
        rgb[part] = cv2.remap(low, x[part, None], y[part, None], cv2.INTER_LINEAR)[:, 0]
    usable = ((rgb > GREY_LEVEL_MIN) & (rgb < GREY_LEVEL_MAX)).all(axis=1)
    if mask.size:
        usable &= mask[np.clip(np.round(uv[:, 1]).astype(int), 0, camera.height - 1),
                       np.clip(np.round(uv[:, 0]).astype(int), 0, camera.width - 1)] > 0  # fmt: skip
    cx, cy = (camera.width - 1) / 2, (camera.height - 1) / 2
    q = ((uv[:, 0] - cx) ** 2 + (uv[:, 1] - cy) ** 2) / (cx * cx + cy * cy)
    return at[usable], np.log(rgb[usable] + SRGB_OFFSET), q[usable].astype(np.float64)


def solve(
    seen: Observations, views: Sequence[View], params: ExposureParams, prior: Exposures
) -> tuple[Exposures, tuple[float, float]]:
    """Exposures, and the median absolute residual before and after (logarithms of encoded values).

    Vignetting is kept only where it explains much. Distant surfaces appear in the image centre and look brighter
    against the sun, which resembles weak vignetting.
    """
    from scan2sim.texturing.photo_cache import camera_of

    if len(seen.photo) == 0:
        return prior, (0.0, 0.0)
    plain, spread = _least_squares(seen, views, [], params, prior)
    lenses = sorted({camera_of(views[i]) for i in np.unique(seen.photo) if views[i].camera.model != "equirectangular"})
    if not (params.vignetting and lenses):
        return plain, spread
    vignetted, less = _least_squares(seen, views, lenses, params, prior)
    return (vignetted, less) if less[1] < VIGNETTING_RESIDUAL_RATIO_MAX * spread[1] else (plain, spread)


def _least_squares(
    seen: Observations, views: Sequence[View], lenses: Sequence[str], params: ExposureParams, prior: Exposures
) -> tuple[Exposures, tuple[float, float]]:
    """Estimate the gains, and the vignetting of the cameras named `lenses`."""
    import scipy.sparse as sp

    from scan2sim.texturing.photo_cache import SRGB_GAMMA, Exposures, camera_of

    photos = np.unique(seen.photo)
    n, m, points = len(photos), len(lenses), len(np.unique(seen.point))
    own = np.searchsorted(photos, seen.photo)
    index = {name: k for k, name in enumerate(lenses)}
    lens = np.array([index.get(camera_of(views[i]), -1) for i in photos])[own]
    _, point = np.unique(seen.point, return_inverse=True)
    count = len(own)
    # unknowns: three gains per photo, then a and b per camera; one row per observation and channel
    has = np.flatnonzero(lens >= 0)
    rows, columns, values = [], [], []
    for channel in range(3):
        rows += [channel * count + np.arange(count), channel * count + has, channel * count + has]
        columns += [channel * n + own, 3 * n + lens[has], 3 * n + m + lens[has]]
        values += [np.ones(count), seen.q[has], seen.q[has] ** 2]
    at = (np.concatenate(rows), np.concatenate(columns))
    A = sp.csr_array((np.concatenate(values), at), (3 * count, 3 * n + 2 * m))
    owner = np.concatenate([channel * points + point for channel in range(3)])
    P = sp.csr_array((np.ones(3 * count), (np.arange(3 * count), owner)), (3 * count, 3 * points))
    y = -seen.value.T.ravel()  # gain minus the point's colour equals minus the observed value
    centre, precision = _prior(views, photos, np.bincount(own), lenses, prior, params)
    w = np.ones(3 * count)
    x, residual = centre, y
    for _ in range(IRLS_ITERATIONS):  # point colours eliminated by the Schur complement, outliers down-weighted
        WA = A.multiply(w[:, None]).tocsr()
        total = np.maximum(P.T @ w, 1e-12)
        cross = (P.T @ WA).tocsr()
        scaled = cross.multiply(1 / total[:, None]).tocsr()
        normal = (A.T @ WA - cross.T @ scaled).toarray() + precision
        x = np.linalg.solve(normal, WA.T @ y - scaled.T @ (P.T @ (w * y)) + precision @ centre)
        residual = A @ x - y
        residual -= P @ ((P.T @ (w * residual)) / total)
        w = np.minimum(1.0, HUBER_RESIDUAL / np.maximum(np.abs(residual), 1e-9))
    before = y - P @ ((P.T @ y) / (P.T @ np.ones(3 * count)))
    gain, vignetting = dict(prior.gain), dict(prior.vignetting)
    for k, i in enumerate(photos):
        r, g, b = (float(np.exp(SRGB_GAMMA * x[c * n + k])) for c in range(3))
        gain[views[i].name] = (r, g, b)
    for k, name in enumerate(lenses):
        vignetting[name] = (float(SRGB_GAMMA * x[3 * n + k]), float(SRGB_GAMMA * x[3 * n + m + k]))
    return Exposures(gain, vignetting), (float(np.median(np.abs(before))), float(np.median(np.abs(residual))))


def _prior(
    views: Sequence[View],
    photos: I64,
    observations: I64,
    lenses: Sequence[str],
    prior: Exposures,
    params: ExposureParams,
) -> tuple[F64, F64]:
    """Mean (U,) and precision (U, U) of the unknowns' prior, in units of one observation's precision.

    `observations` (n,): number of observations of each of the `photos` (n,).
    """
    from scan2sim.texturing.photo_cache import SRGB_GAMMA

    stop = np.log(2) / SRGB_GAMMA  # one stop, as logarithm of encoded values
    n, m = len(photos), len(lenses)
    centre, weight = np.zeros(3 * n + 2 * m), np.zeros((3 * n + 2 * m, 3 * n + 2 * m))
    noise = HUBER_RESIDUAL**2
    for k, i in enumerate(photos):
        at = [k, n + k, 2 * n + k]
        known: Mapping[str, tuple[float, float, float]] = prior.gain
        if views[i].name in known:
            centre[at] = np.log(known[views[i].name]) / SRGB_GAMMA
            # the earlier tile observed the photo about as often as this one does
            weight[at, at] += noise / (PRIOR_TOLERANCE_EV * stop) ** 2 * 1e3
            continue
        # mean gain (r + g + b) / 3 by its share of three channels' observations; differences of channels within `tint`
        mean = 3 * params.own_exposure * observations[k] + noise / (MAX_GAIN_EV * stop) ** 2
        weight[np.ix_(at, at)] += mean / 9
        difference = np.eye(3) - 1 / 3
        weight[np.ix_(at, at)] += noise / (params.tint * stop) ** 2 * difference
    for k, name in enumerate(lenses):
        for power, at_ in enumerate((3 * n + k, 3 * n + m + k)):
            centre[at_] = prior.vignetting.get(name, (0.0, 0.0))[power] / SRGB_GAMMA
            weight[at_, at_] += noise / (0.3 * stop) ** 2 * 50
    return centre, weight


EXPOSURE = Step("exposure", 2, exposure, ExposureParams)

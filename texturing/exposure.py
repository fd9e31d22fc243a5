"""Exposure: what makes all photos of a tile alike, solved jointly.

Places on the surface are sampled in every photo that sees them. In the encoded values' power law a change of
exposure or white balance is a factor, so its logarithm is a sum: photo's gain (per channel) + camera's vignetting
(a polynomial of the distance to the middle) + the place's own colour. Least squares over all of them, made robust
by reweighting (Huber), with the places eliminated, and a prior towards no change, or towards what an earlier tile
found, so that neighbouring tiles agree.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import FileName, Reach, Stops
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, I64, U8, View
from scan2sim.pipeline.io import views as views_io

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.depth_map import DepthMap
    from scan2sim.texturing.photo_cache import Exposures


class ExposureParams(Params):
    """How photos are made alike.

    Attributes:
        solve: False leaves all photos as they are.
        vignetting: solve a camera's darkening towards the corners, too.
        prior: an earlier tile's `exposure.json`, whose photos and cameras keep what it found for them.
        samples: places sampled for each photo.
        max_distance: metres beyond which a photo is not sampled.
        spread: stops (EV) by which exposures are expected to differ: the prior's standard deviation.
        tint: stops by which a channel's gain is expected to differ from the others'.
    """

    solve: bool = True
    vignetting: bool = True
    prior: FileName = ""
    samples: int = Field(1500, ge=50, le=100_000)
    max_distance: Reach = 100.0
    spread: Stops = 1.0
    tint: Stops = 0.15


PIXELS = 400_000
"""Places are drawn from depth maps of this size at most."""
OUTLIER = 0.06
"""Residual, of the encoded values' logarithm, beyond which an observation's say falls (Huber)."""
DARK, BRIGHT = 12, 243
"""Grey levels outside of which an observation says nothing."""
KNOWN = 0.05
"""Stops by which a photo may depart from what an earlier tile found for it."""
ROUNDS = 8
WORTH = 0.8
"""Vignetting is kept if it makes photos disagree less than this share of before."""
MIN_COS = 0.15
BIAS = 0.04


def exposure(inputs: Inputs, params: ExposureParams, out: Path, report: Report) -> Done:
    """Solve the exposures of all photos that are not held out.

    Inputs: `views`, `depth` (folder of depth maps), `prior` (an earlier tile's exposures) or none.
    File: `exposures`, JSON of `texturing.photo_cache.Exposures`.
    """
    from scan2sim.texturing.photo_cache import Exposures, camera_of

    views = views_io.load(inputs["views"])
    held = views_io.load_held_out(inputs["views"])
    prior = Exposures.load(inputs["prior"]) if "prior" in inputs else Exposures()
    facts: dict[str, object] = {"photos": 0}
    solved = prior
    if params.solve and sum(view.camera.model != "orthographic" for view in views) > 1:
        # an orthophoto's colours were balanced when it was put together
        used = [i for i, view in enumerate(views) if not held[i] and view.camera.model != "orthographic"]
        seen = observe(views, used, lambda i: inputs["depth"] / f"{i}.npy", params, report)
        solved, spread = solve(seen, views, params, prior)
        gain = solved.gain
        stops = np.log2([sum(gain[views[i].name]) / 3 for i in used if views[i].name in gain] or [1.0])
        facts = {
            "photos": len(gain),
            "observations": len(seen.value),
            "largest_change_ev": round(float(np.abs(stops).max()), 3),
            "disagreement_before": round(spread[0], 4),
            "disagreement_after": round(spread[1], 4),
            "vignetting": {name: list(v) for name, v in solved.vignetting.items()},
            "cameras": len({camera_of(v) for v in views}),
        }
    solved.save(out / "exposures.json")
    return Done({"exposures": out / "exposures.json"}, facts)


@dataclass(frozen=True)
class Observed:
    """Places seen in several photos: index of photo (N,), of place (N,), log values (N, 3), q (N,) of `Exposures`."""

    photo: I64
    place: I64
    value: F64
    q: F64


def observe(
    views: Sequence[View],
    used: Sequence[int],
    depth_file: Callable[[int], Path],
    params: ExposureParams,
    report: Report,
) -> Observed:
    """Sample random places of every photo in all photos that see them; read photo by photo."""
    from scan2sim.pipeline.camera.depth_map import load_depth_map
    from scan2sim.texturing.photo_cache import Photos
    from scan2sim.texturing.photo_prediction import surface

    rng = np.random.default_rng(0)
    points, normals = [], []
    for i in used:
        view = views[i]
        depth = load_depth_map(depth_file(i), view.camera, view.T_world_cam)
        coarse = surface(depth.camera.scaled(min(1.0, (PIXELS / depth.range.size) ** 0.5)), depth)
        p, n = coarse.some(params.samples, params.max_distance, rng)
        points.append(p)
        normals.append(n)
    place, normal = np.concatenate(points), np.concatenate(normals)
    photos = Photos(views)
    rows = []
    for done, i in enumerate(used):
        report(done / len(used), views[i].name)
        photo = photos.get(i)
        if photo is None:
            continue
        depth = load_depth_map(depth_file(i), views[i].camera, views[i].T_world_cam)
        rows.append((i, *_observe(photo.low, photo.mask, views[i], depth, place, normal, params.max_distance)))
    if not rows:
        return Observed(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
    index = np.concatenate([np.full(len(r[1]), r[0]) for r in rows])
    at, value, q = (np.concatenate([r[k] for r in rows]) for k in (1, 2, 3))
    several = np.bincount(at, minlength=len(place))[at] > 1
    return Observed(index[several], at[several], value[several], q[several])


def _observe(
    low: U8,
    mask: U8,
    view: View,
    depth: DepthMap,
    place: F64,
    normal: F64,
    max_distance: float,
) -> tuple[I64, F64, F64]:
    """Indices of the places (P, 3) that a photo sees well, their log values (N, 3), and q (N,)."""
    import cv2

    from scan2sim.pipeline.camera.depth_map import DepthMap as Map
    from scan2sim.pipeline.camera.depth_map import visible
    from scan2sim.pipeline.camera.projection import pixels
    from scan2sim.texturing.photo_cache import OFFSET

    camera = view.camera
    to = view.centre - place
    distance = np.linalg.norm(to, axis=1)
    cos = np.einsum("ij,ij->i", to, normal) / np.maximum(distance, 1e-9)
    at = np.flatnonzero((distance < max_distance) & (cos > MIN_COS))
    uv, shown = pixels(camera, view.T_world_cam, place[at])
    at, uv = at[shown], uv[shown]
    # beside something nearer the low frequencies mix both: not asked there
    reach = 2 * round(camera.width / low.shape[1] * depth.camera.width / camera.width) + 1
    near = Map(depth.camera, depth.T_world_cam, np.asarray(cv2.erode(depth.range, np.ones((reach, reach)))))
    good = visible(near, place[at], normal[at], bias=0.3 + BIAS)
    at, uv = at[good], uv[good]
    x = np.clip((uv[:, 0] + 0.5) * low.shape[1] / camera.width - 0.5, 0, low.shape[1] - 1).astype(np.float32)
    y = np.clip((uv[:, 1] + 0.5) * low.shape[0] / camera.height - 0.5, 0, low.shape[0] - 1).astype(np.float32)
    rgb = np.zeros((len(at), 3))
    # whole levels, by cv2.remap: `pipeline.camera.image_sampling`'s fractions would bring other exposures, at four
    # times the time
    for first in range(0, len(at), 30_000):  # it knows no more rows than 32767
        part = slice(first, first + 30_000)
        rgb[part] = cv2.remap(low, x[part, None], y[part, None], cv2.INTER_LINEAR)[:, 0]
    usable = ((rgb > DARK) & (rgb < BRIGHT)).all(axis=1)
    if mask.size:
        usable &= mask[np.clip(np.round(uv[:, 1]).astype(int), 0, camera.height - 1),
                       np.clip(np.round(uv[:, 0]).astype(int), 0, camera.width - 1)] > 0  # fmt: skip
    cx, cy = (camera.width - 1) / 2, (camera.height - 1) / 2
    q = ((uv[:, 0] - cx) ** 2 + (uv[:, 1] - cy) ** 2) / (cx * cx + cy * cy)
    return at[usable], np.log(rgb[usable] + OFFSET), q[usable].astype(np.float64)


def solve(
    seen: Observed, views: Sequence[View], params: ExposureParams, prior: Exposures
) -> tuple[Exposures, tuple[float, float]]:
    """The exposures, and how far places' values are apart before and after (median, logarithms of encoded values).

    A camera's vignetting is kept only where it explains much: surfaces that look brighter against the sun, which
    are in a photo's middle when far away, look like a little of it.
    """
    from scan2sim.texturing.photo_cache import camera_of

    if len(seen.photo) == 0:
        return prior, (0.0, 0.0)
    plain, spread = _least_squares(seen, views, [], params, prior)
    lenses = sorted({camera_of(views[i]) for i in np.unique(seen.photo) if views[i].camera.model != "equirectangular"})
    if not (params.vignetting and lenses):
        return plain, spread
    falling, less = _least_squares(seen, views, lenses, params, prior)
    return (falling, less) if less[1] < WORTH * spread[1] else (plain, spread)


def _least_squares(
    seen: Observed, views: Sequence[View], lenses: Sequence[str], params: ExposureParams, prior: Exposures
) -> tuple[Exposures, tuple[float, float]]:
    """Solve gains, and the vignetting of the cameras named `lenses`."""
    import scipy.sparse as sp

    from scan2sim.texturing.photo_cache import GAMMA, Exposures, camera_of

    photos = np.unique(seen.photo)
    n, m, places = len(photos), len(lenses), len(np.unique(seen.place))
    own = np.searchsorted(photos, seen.photo)
    index = {name: k for k, name in enumerate(lenses)}
    lens = np.array([index.get(camera_of(views[i]), -1) for i in photos])[own]
    _, place = np.unique(seen.place, return_inverse=True)
    count = len(own)
    # unknowns: three gains a photo, then a and b a camera; a row an observation and channel
    has = np.flatnonzero(lens >= 0)
    rows, columns, values = [], [], []
    for channel in range(3):
        rows += [channel * count + np.arange(count), channel * count + has, channel * count + has]
        columns += [channel * n + own, 3 * n + lens[has], 3 * n + m + lens[has]]
        values += [np.ones(count), seen.q[has], seen.q[has] ** 2]
    at = (np.concatenate(rows), np.concatenate(columns))
    A = sp.csr_array((np.concatenate(values), at), (3 * count, 3 * n + 2 * m))
    owner = np.concatenate([channel * places + place for channel in range(3)])
    P = sp.csr_array((np.ones(3 * count), (np.arange(3 * count), owner)), (3 * count, 3 * places))
    y = -seen.value.T.ravel()  # gain less the place's colour is the value's negative
    centre, precision = _prior(views, photos, lenses, prior, params)
    w = np.ones(3 * count)
    x, residual = centre, y
    for _ in range(ROUNDS):  # places eliminated by the Schur complement, outliers weighed down
        WA = A.multiply(w[:, None]).tocsr()
        total = np.maximum(P.T @ w, 1e-12)
        cross = (P.T @ WA).tocsr()
        scaled = cross.multiply(1 / total[:, None]).tocsr()
        normal = (A.T @ WA - cross.T @ scaled).toarray() + precision
        x = np.linalg.solve(normal, WA.T @ y - scaled.T @ (P.T @ (w * y)) + precision @ centre)
        residual = A @ x - y
        residual -= P @ ((P.T @ (w * residual)) / total)
        w = np.minimum(1.0, OUTLIER / np.maximum(np.abs(residual), 1e-9))
    before = y - P @ ((P.T @ y) / (P.T @ np.ones(3 * count)))
    gain, falling = dict(prior.gain), dict(prior.vignetting)
    for k, i in enumerate(photos):
        r, g, b = (float(np.exp(GAMMA * x[c * n + k])) for c in range(3))
        gain[views[i].name] = (r, g, b)
    for k, name in enumerate(lenses):
        falling[name] = (float(GAMMA * x[3 * n + k]), float(GAMMA * x[3 * n + m + k]))
    return Exposures(gain, falling), (float(np.median(np.abs(before))), float(np.median(np.abs(residual))))


def _prior(
    views: Sequence[View],
    photos: I64,
    lenses: Sequence[str],
    prior: Exposures,
    params: ExposureParams,
) -> tuple[F64, F64]:
    """Centre (U,) and precision (U, U) of the unknowns, in units of an observation's own precision."""
    from scan2sim.texturing.photo_cache import GAMMA

    stop = np.log(2) / GAMMA  # a stop, in logarithms of encoded values
    n, m = len(photos), len(lenses)
    centre, weight = np.zeros(3 * n + 2 * m), np.zeros((3 * n + 2 * m, 3 * n + 2 * m))
    noise = OUTLIER**2
    for k, i in enumerate(photos):
        at = [k, n + k, 2 * n + k]
        known: Mapping[str, tuple[float, float, float]] = prior.gain
        if views[i].name in known:
            centre[at] = np.log(known[views[i].name]) / GAMMA
            weight[at, at] += noise / (KNOWN * stop) ** 2 * 1e3  # an earlier tile saw it as often as this one does
            continue
        # overall: (r + g + b) / 3 within `spread`; differences between channels within `tint`
        weight[np.ix_(at, at)] += noise / (params.spread * stop) ** 2 / 9
        difference = np.eye(3) - 1 / 3
        weight[np.ix_(at, at)] += noise / (params.tint * stop) ** 2 * difference
    for k, name in enumerate(lenses):
        for power, at_ in enumerate((3 * n + k, 3 * n + m + k)):
            centre[at_] = prior.vignetting.get(name, (0.0, 0.0))[power] / GAMMA
            weight[at_, at_] += noise / (0.3 * stop) ** 2 * 50
    return centre, weight


EXPOSURE = Step("exposure", 1, exposure, ExposureParams)

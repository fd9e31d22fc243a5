"""Photo consistency step (`photo_consistency`): compares each photo with its neighbours and masks what is inconsistent.

Every photo is predicted from its neighbours (`texturing.photo_prediction`). Regions where at least two other photos
agree and this one differs are ghosts (a moving car, a person, its shadow, a reflection) and are masked, as is sky that
shows where a surface should be (`texturing.sky`). A photo that is shifted against its prediction has a wrong pose; one
that is less sharp is blurred. Both are reported, and the photo is excluded beyond a limit.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import PHOTO_CLASSES
from scan2sim.pipeline.core.parameters import Cosine, Depth, Distance
from scan2sim.pipeline.core.parts import NO_PARTS, Parts, file_digest
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, U8, Bools, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.depth_map import DepthMap
    from scan2sim.texturing.photo_cache import Exposures, PhotoCache
    from scan2sim.texturing.photo_prediction import Prediction

DEPTH_MAPS_CACHED = 16
"""Depth maps kept in memory."""
COMPARED_PIXELS_MAX = 250_000
"""Photos are compared at this size at most; "compared pixels" below are pixels at this size."""
SAMPLES_PER_PHOTO = 300
"""Surface points per photo by which its neighbours are chosen."""
WARP_MAX_PX, WARP_SMOOTHING_PX, WARP_GRADIENT = 5.0, 5.0, 8.0
"""Compared pixels: longest displacement that is used, and sigma of the smoothing; image gradient at which the warp is
halved."""
GHOST_SEED_LEVELS, GHOST_GROWN_LEVELS = 26.0, 12.0
"""Difference in grey levels that seeds a ghost, and down to which the ghost grows (hysteresis thresholds)."""
GHOST_EDGE_SLACK_PX = 2
"""Compared pixels by which edges may be displaced and still agree."""
GHOST_MIN_PIXELS = 60
"""Compared pixels of the smallest ghost."""
GHOST_SHARE_MAX = 0.25
"""Share of a photo beyond which differences are not ghosts: the photo as a whole is displaced."""
SIGN_EDGE_PX = 6
"""Compared pixels around what is classified as a traffic sign that are no ghosts, either: its rim, and cells of the
network's output."""
OVEREXPOSED_LEVEL = 250
"""Grey level from which a pixel counts as overexposed."""
OVEREXPOSED_SHARE_MAX = 0.6
"""Share of overexposed pixels beyond which a photo is excluded."""
SHARPNESS_RATIO_MIN = 0.6
"""Sharpness relative to the median of the same camera's photos below which a photo counts as blurred."""
SHARPNESS_PHOTOS_MIN = 3
"""Photos of a camera needed to know its median sharpness."""
SKY_OUTLINE_TOLERANCE_M = 0.5
"""Error of a surface's outline in metres: five voxels of the default size, as for foliage."""


class PhotoConsistencyParams(Params):
    """Settings of the photo consistency check.

    Attributes:
        ghosts: mask regions of a photo that differ from what the other photos agree on.
        sky: mask sky that shows beside the outlines of surfaces, and pixels that mix with it.
        align: warp photos locally, by a few pixels, onto what the other photos show.
        neighbours: number of photos that each photo is compared with.
        max_shift: pixels (of a photo scaled to 0.25 MP) by which a photo may be shifted against the others; photos
            with a larger shift are excluded; 0: no limit.
        max_distance, min_cos, bias: as in the step `view_selection`.
    """

    ghosts: bool = True
    sky: bool = True
    align: bool = True
    neighbours: int = Field(8, ge=2, le=16)
    max_shift: float = Field(3.0, ge=0, le=100)
    max_distance: Distance = 100.0
    min_cos: Cosine = 0.02
    bias: Depth = 0.04


def photo_consistency(
    inputs: Inputs, params: PhotoConsistencyParams, out: Path, report: Report, parts: Parts = NO_PARTS
) -> Done:
    """Compare every photo that is not held out with its neighbours.

    Inputs: `views`, `depth` (folder of depth maps), `exposures`; `labels`, classes of the photos (optional): what is
    classified as a traffic sign is no ghost.
    Folder: `photo_consistency`, with `photo_consistency.json` (one row per view), `mask_<i>.png` for photos with
    masked pixels (own mask, ghosts, sky), and `warp_<i>.npy` for photos that are warped.
    """
    from scan2sim.pipeline.camera.depth_map import load_depth_map
    from scan2sim.texturing.photo_cache import Exposures, PhotoCache, camera_of

    folder = out / "photo_consistency"
    folder.mkdir()
    views = views_io.load(inputs["views"])
    held = views_io.load_held_out(inputs["views"])
    # an orthophoto is a mosaic of many photos: it shows no moving objects, and its georeference is taken as given
    used = [i for i, view in enumerate(views) if not held[i] and view.camera.model != "orthographic"]
    exposures, photos = Exposures.load(inputs["exposures"]), PhotoCache(views)

    @lru_cache(maxsize=DEPTH_MAPS_CACHED)
    def depth(i: int) -> DepthMap:
        return load_depth_map(inputs["depth"] / f"{i}.npy", views[i].camera, views[i].T_world_cam)

    rows: list[dict[str, Any]] = [
        {"name": view.name, "camera": camera_of(view), "usable": not out_, "sharpness_factor": 1.0}
        for view, out_ in zip(views, held, strict=True)
    ]
    nearest = neighbours(views, used, depth, params)

    def row_of(i: int) -> tuple[dict[str, Any], list[Path]]:
        """A photo's columns, and the files about it."""
        photo, files = photos.get(i), []
        if photo is None:
            return {"usable": False, "reason": photos.skipped[i]}, []
        compared = compare(i, nearest[i], views, depth, photos, exposures, params)
        row, own = compared.figures, photo.mask
        if params.sky:
            own, row["sky_share"] = without_sky(views[i], photo.levels[0], own, depth(i))
        ghosts = compared.ghosts if params.ghosts else None
        if ghosts is not None and "labels" in inputs:
            ghosts = ghosts & ~sign_pixels(inputs["labels"] / f"{i}.npy", ghosts.shape)
        mask = combined(ghosts, own)
        if mask is not None:
            files.append(folder / f"mask_{i}.png")
            image.write(files[-1], mask)
        if params.align and compared.warp is not None:
            files.append(folder / f"warp_{i}.npy")
            np.save(files[-1], compared.warp)
        return row, files

    @cache
    def made_from(i: int) -> list[Any]:
        files = [path for path in (views[i].photo, views[i].mask, inputs["depth"] / f"{i}.npy") if path]
        about = [views_io.to_json(views[i]), exposures.of(views[i]).tolist()]
        return [i, *about, *map(file_digest, files)]

    for done, i in enumerate(used):
        report(done / len(used), views[i].name)
        column = folder / f"row_{i}.json"

        def compute(i: int = i, column: Path = column) -> list[Path]:
            row, files = row_of(i)
            column.write_text(json.dumps(row), encoding="utf-8")
            return [column, *files]

        labels = file_digest(inputs["labels"] / f"{i}.npy") if "labels" in inputs else ""
        others = [made_from(j) for j in (i, *nearest[i])]
        parts.provide(folder, [params.model_dump(mode="json"), labels, others], compute)
        rows[i] |= json.loads(column.read_text(encoding="utf-8"))
        column.unlink()
    _exclude_and_downweight(rows, params)
    (folder / "photo_consistency.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
    return Done(
        {"photo_consistency": folder}, _metrics(rows, used), [str(row["reason"]) for row in rows if "reason" in row]
    )


def neighbours(
    views: Sequence[View], used: Sequence[int], depth: Callable[[int], DepthMap], params: PhotoConsistencyParams
) -> dict[int, list[int]]:
    """For each view the neighbours that see most of its surface at a similar resolution, best first."""
    from scan2sim.pipeline.camera.depth_map import visible
    from scan2sim.pipeline.camera.models import pixel_angle
    from scan2sim.texturing.photo_prediction import surface

    rng = np.random.default_rng(0)
    points, normals, owners = [], [], []
    for i in used:
        camera = views[i].camera
        small = surface(camera.scaled(min(1.0, (60_000 / (camera.width * camera.height)) ** 0.5)), depth(i))
        p, n = small.sample(SAMPLES_PER_PHOTO, params.max_distance, rng)
        points.append(p)
        normals.append(n)
        owners.append(np.full(len(p), i))
    if not points:
        return {}
    xyz, normal, owner = np.concatenate(points), np.concatenate(normals), np.concatenate(owners)
    resolution = np.zeros((len(views), len(xyz)), np.float32)  # pixels per metre on the surface, 0 where not seen
    for j in used:
        to = views[j].centre - xyz
        distance = np.linalg.norm(to, axis=1)
        cos = np.einsum("ij,ij->i", to, normal) / np.maximum(distance, 1e-9)
        close = np.flatnonzero((distance < params.max_distance) & (cos > params.min_cos))
        seen = close[visible(depth(j), xyz[close], normal[close], bias=params.bias)]
        resolution[j, seen] = 1 / (pixel_angle(views[j].camera) * distance[seen])
    out = {}
    for i in used:
        own = owner == i
        share = np.minimum(1.0, resolution[:, own] / np.maximum(resolution[i, own], 1e-9)).sum(axis=1)
        share[i] = 0
        best = np.argsort(-share, kind="stable")[: params.neighbours]
        out[i] = [int(j) for j in best if share[j] > 0]
    return out


@dataclass(frozen=True)
class Comparison:
    """A photo compared with its prediction.

    Attributes:
        figures: columns of `photo_consistency.json`.
        ghosts: (h, w) where the photo shows a ghost; None: unknown.
        warp: displacement field of `warp_of`; None: unknown.
    """

    figures: dict[str, Any]
    ghosts: Bools | None = None
    warp: F32 | None = None


def compare(
    i: int,
    others: Sequence[int],
    views: Sequence[View],
    depth: Callable[[int], DepthMap],
    photos: PhotoCache,
    exposures: Exposures,
    params: PhotoConsistencyParams,
) -> Comparison:
    """Predict photo `i` from the photos `others`, and compare it with the prediction."""
    import cv2

    from scan2sim.texturing.photo_prediction import Predictor, corrected_photo, surface

    photo = photos.get(i)
    assert photo is not None
    camera = views[i].camera
    small = camera.scaled(min(1.0, (COMPARED_PIXELS_MAX / (camera.width * camera.height)) ** 0.5))
    visible_surface = surface(small, depth(i))
    predictor = Predictor(
        visible_surface, len(others), max_distance=params.max_distance, min_cos=params.min_cos, bias=params.bias
    )
    own = np.asarray(cv2.resize(photo.levels[0], (small.width, small.height), interpolation=cv2.INTER_AREA))
    for j in others:
        other = photos.get(j)
        if other is not None:
            predictor.add(other, views[j].camera, views[j].T_world_cam, depth(j), exposures.of(views[j]))
    has_surface = np.isfinite(visible_surface.points[..., 0])
    overexposed = float(np.all(own[has_surface] >= OVEREXPOSED_LEVEL, axis=1).mean()) if has_surface.any() else 0.0
    figures: dict[str, Any] = {"overexposed": round(overexposed, 3)}
    predicted = predictor.result()
    reliable = predicted.support >= 2
    if reliable.sum() < 2000:
        return Comparison(figures)
    mine = np.clip(corrected_photo(own, small, exposures.of(views[i])), 0, 255).astype(np.float32)
    ghosts = ghost_mask(mine, predicted, own >= OVEREXPOSED_LEVEL)
    figures["ghost_share"] = round(float(ghosts.mean()), 4)
    is_displaced = ghosts[reliable].mean() > GHOST_SHARE_MAX
    compared = reliable if is_displaced else reliable & ~ghosts
    displacement, warp = _shift(mine, predicted, compared, camera.width / small.width)
    return Comparison(figures | displacement, ghosts, warp)


def _shift(mine: F32, predicted: Prediction, compared: Bools, scale: float) -> tuple[dict[str, float], F32 | None]:
    """Displacement of a photo against its prediction by optical flow: figures (pixels of the photo), and its warp."""
    import cv2

    grey = cv2.cvtColor(mine, cv2.COLOR_RGB2GRAY)
    other = np.where(compared, cv2.cvtColor(predicted.rgb, cv2.COLOR_RGB2GRAY), grey)
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(
        np.clip(other, 0, 255).astype(np.uint8), np.clip(grey, 0, 255).astype(np.uint8), None
    )
    inner = cv2.erode(compared.astype(np.uint8), np.ones((7, 7))) > 0
    gradient = np.hypot(cv2.Sobel(other, cv2.CV_32F, 1, 0), cv2.Sobel(other, cv2.CV_32F, 0, 1))
    at = inner & (gradient > 40)  # flow is reliable only where the image has structure
    if at.sum() < 500:
        return {}, None
    dx, dy = np.median(flow[at], axis=0)
    mine_fine = np.abs(cv2.Laplacian(grey, cv2.CV_32F))[inner].mean()
    other_fine = np.abs(cv2.Laplacian(other.astype(np.float32), cv2.CV_32F))[inner].mean()
    figures = {
        "shift_px": round(float(np.hypot(dx, dy) * scale), 2),
        "shift_compared_px": round(float(np.hypot(dx, dy)), 2),
        "spread_px": round(float(np.median(np.hypot(*(flow[at] - (dx, dy)).T)) * scale), 2),
        "sharpness": round(float(mine_fine / max(float(other_fine), 1e-6)), 3),
    }
    return figures, warp_of(flow, np.where(inner, gradient, 0).astype(np.float32), scale)


def warp_of(flow: F32, gradient: F32, scale: float) -> F32:
    """Smoothed displacement field (h / 4, w / 4, 2), in pixels of the photo, that aligns a photo with its prediction.

    Args:
        flow: (h, w, 2) optical flow from the prediction to the photo, compared pixels.
        gradient: (h, w) image gradient, the weight of the flow; 0 where the flow is unknown.
        scale: pixels of the photo per compared pixel.
    """
    import cv2

    length = np.linalg.norm(flow, axis=2)
    weight = np.where(length < WARP_MAX_PX, np.minimum(gradient, 200), 0).astype(np.float32)
    total = cv2.GaussianBlur(weight, (0, 0), WARP_SMOOTHING_PX)
    weighted = cv2.GaussianBlur(flow * weight[..., None], (0, 0), WARP_SMOOTHING_PX)
    smooth = weighted / (total + WARP_GRADIENT)[..., None]
    size = (max(1, flow.shape[1] // 4), max(1, flow.shape[0] // 4))
    return np.asarray(cv2.resize(smooth, size, interpolation=cv2.INTER_AREA) * scale, np.float32)


def ghost_mask(mine: F32, predicted: Prediction, overexposed: Bools) -> Bools:
    """(h, w) ghosts: where a photo differs from what the other photos agree on.

    Args:
        mine: the photo (h, w, 3), exposure corrected.
        predicted: its prediction from the other photos.
        overexposed: (h, w, 3) where the photo is overexposed: the true value may be brighter, so a brighter
            prediction is no difference.
    """
    import cv2

    reliable = predicted.support >= 2
    theirs = np.where(reliable[..., None], predicted.rgb, mine)
    a, b = cv2.blur(mine, (3, 3)), cv2.blur(theirs, (3, 3))
    kernel = np.ones((2 * GHOST_EDGE_SLACK_PX + 1, 2 * GHOST_EDGE_SLACK_PX + 1))
    darker = np.where(overexposed, 0, cv2.erode(b, kernel) - a)
    channels = cv2.split(np.maximum(a - cv2.dilate(b, kernel), darker))
    difference = cv2.max(cv2.max(channels[0], channels[1]), channels[2])
    difference[~reliable] = 0
    seeds = cv2.morphologyEx((difference > GHOST_SEED_LEVELS).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3)))
    candidates = (difference > GHOST_GROWN_LEVELS).astype(np.uint8) | seeds
    grown = cv2.morphologyEx(candidates, cv2.MORPH_CLOSE, np.ones((7, 7)))
    n, component, stats, _ = cv2.connectedComponentsWithStats(grown, connectivity=8)
    is_seeded = np.bincount(component[seeds > 0], minlength=n) * 4 > GHOST_MIN_PIXELS
    ghost = (is_seeded & (stats[:, cv2.CC_STAT_AREA] > GHOST_MIN_PIXELS))[component] & (grown > 0)
    return np.asarray(cv2.dilate(ghost.astype(np.uint8), np.ones((7, 7)))) > 0


def sign_pixels(labels: Path, shape: tuple[int, ...]) -> Bools:
    """(h, w) what a photo's classes say is a traffic sign, with its edge; none if the photo wasn't classified.

    Signs don't move. They are small, flat and of strong colours: a photo from nearby, which shows a sign best, differs
    from those from afar by more than a tolerance for outlines.
    """
    import cv2

    if not labels.is_file():
        return np.zeros(shape, bool)
    sign = np.load(labels).argmax(axis=2) == PHOTO_CLASSES.index("road_sign")
    large = cv2.resize(sign.astype(np.uint8), (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.dilate(large, np.ones((2 * SIGN_EDGE_PX + 1, 2 * SIGN_EDGE_PX + 1)))) > 0


def without_sky(view: View, rgb: U8, mask: U8, depth: DepthMap) -> tuple[U8, float]:
    """A photo's mask with sky set to 0 as well ((0, 0): no mask), and the share of sky in the photo."""
    from scan2sim.pipeline.camera.models import pixel_angle, pixel_rays
    from scan2sim.texturing.sky import sky

    up = np.nan_to_num(pixel_rays(view.camera.scaled(1 / 8))) @ view.T_world_cam[2, :3].astype(np.float32)
    found = sky(rgb, depth.range, up, pixel_angle(view.camera), SKY_OUTLINE_TOLERANCE_M)
    if found is None:
        return mask, 0.0
    allowed = np.where(found, 0, 255).astype(np.uint8)
    return (np.minimum(allowed, mask) if mask.size else allowed), round(float(found.mean()), 5)


def combined(ghosts: Bools | None, mask: U8) -> U8 | None:
    """The photo's own mask combined with its ghosts, 0 where it must not be used; None if nothing is masked."""
    import cv2

    if ghosts is None or not ghosts.any():
        return np.where(mask > 0, 255, 0).astype(np.uint8) if mask.size else None
    allowed: U8 = np.where(ghosts, 0, 255).astype(np.uint8)
    if mask.size:
        size = (mask.shape[1], mask.shape[0])
        large = np.asarray(cv2.resize(allowed, size, interpolation=cv2.INTER_NEAREST), np.uint8)
        return np.where(mask > 0, large, 0).astype(np.uint8)
    return allowed


def _exclude_and_downweight(rows: list[dict[str, Any]], params: PhotoConsistencyParams) -> None:
    """Exclude overexposed and shifted photos, and set the weight of blurred ones, by their figures; in place."""
    for row in rows:
        if not row["usable"]:
            continue
        same_camera = [
            other["sharpness"] for other in rows if other["camera"] == row["camera"] and "sharpness" in other
        ]
        usual = float(np.median(same_camera)) if len(same_camera) >= SHARPNESS_PHOTOS_MIN else 1e-6
        relative = row.get("sharpness", usual) / usual
        row["sharpness_factor"] = 1.0 if relative > SHARPNESS_RATIO_MIN else round(max(0.02, relative**2), 3)
        if row.get("overexposed", 0.0) > OVEREXPOSED_SHARE_MAX:
            row |= {
                "usable": False,
                "reason": f"{row['name']}: excluded, {row['overexposed']:.0%} of it is overexposed",
            }
        elif params.max_shift and row.get("shift_compared_px", 0.0) > params.max_shift:
            row |= {
                "usable": False,
                "reason": f"{row['name']}: excluded, it is shifted by {row['shift_px']:.1f} pixels against the other "
                "photos: check its pose (`photo_consistency.max_shift` is the limit)",
            }
        elif row["sharpness_factor"] < 1:
            row["reason"] = (
                f"{row['name']}: blurred, {relative:.0%} as sharp as the camera's other photos; down-weighted for "
                "detail"
            )


def _metrics(rows: Sequence[dict[str, Any]], used: Sequence[int]) -> dict[str, Any]:
    ghosts = [rows[i]["ghost_share"] for i in used if "ghost_share" in rows[i]]
    shifts = {rows[i]["name"]: rows[i]["shift_px"] for i in used if "shift_px" in rows[i]}
    return {
        "photos": len(used),
        "left_out": [rows[i]["name"] for i in used if not rows[i]["usable"]],
        "ghost_share": round(sum(ghosts) / len(ghosts), 4) if ghosts else 0.0,
        "sky_share": round(sum(row.get("sky_share", 0.0) for row in rows) / max(1, len(used)), 5),
        "shift_px": shifts,
        "largest_shift_px": max(shifts.values(), default=0.0),
    }


PHOTO_CONSISTENCY = Step("photo_consistency", 5, photo_consistency, PhotoConsistencyParams, parts=True)

"""Agreement: where photos disagree with the rest, and which of them do so as a whole.

Every photo is predicted from those around it (`texturing.photo_prediction`). What at least two others agree on and it
doesn't is a ghost (a moving car, a person, its shadow, a reflection) and masked, as is sky where a surface should show
(`texturing.sky`). A photo that is shifted against its prediction has a pose that is off; one less sharp is blurred:
told in the report, and left out beyond a limit.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.parameters import Cosine, Depth, Reach
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, U8, Bools, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.depth_map import DepthMap
    from scan2sim.texturing.photo_cache import Exposures, Photos
    from scan2sim.texturing.photo_prediction import Prediction

KEPT = 16
"""Depth maps kept in memory."""
PIXELS = 250_000
"""Photos are compared at this size at most."""
SAMPLES = 300
MAX_WARP, SMOOTH, FAINT = 5.0, 5.0, 8.0
"""Pixels of the compared size: displacements believed, and smoothed over; and slope that says too little."""
SEED, GROWN = 26.0, 12.0
"""Grey levels of disagreement that a ghost starts from, and down to which it spreads."""
SLACK = 2
"""Pixels (of the compared size) by which edges may be displaced and still agree."""
SPECK = 60
"""Pixels of the smallest ghost."""
HAUNTED = 0.25
"""Share of a photo beyond which what disagrees is no ghost: the photo as a whole is displaced."""
WHITE = 250
"""Grey level from which a pixel counts as overexposed."""
SHARP = 0.6
"""Sharpness against that of the same camera's photos below which one counts as blurred."""
FEW = 3
"""Photos of a camera from which its usual sharpness is known."""
LOOSE = 0.5
"""Metres by which a surface's outline may be off: five voxels of the mission's, as leaves are."""
BURNT = 0.6
"""Share of overexposed pixels beyond which a photo is left out."""


class AgreementParams(Params):
    """How disagreement is dealt with.

    Attributes:
        ghosts: mask what the others agree on and a photo doesn't.
        sky: mask sky that shows beside outlines, and what mixes with it.
        align: shift parts of photos by pixels so that they meet what the others show there.
        neighbours: photos that each is compared with.
        max_shift: pixels (of a photo scaled to 0.45 MP) by which a photo may be shifted against the others;
            beyond it, it is left out; 0: never.
        max_distance, min_cos, bias: as in `choose`.
    """

    ghosts: bool = True
    sky: bool = True
    align: bool = True
    neighbours: int = Field(8, ge=2, le=16)
    max_shift: float = Field(3.0, ge=0, le=100)
    max_distance: Reach = 100.0
    min_cos: Cosine = 0.02
    bias: Depth = 0.04


@dataclass(frozen=True)
class Agreement:
    """What `agreement` found, by index of view.

    Attributes:
        folder: with `agreement.json` and the masks.
        usable: whether the photo is to be used for texture.
        sharp: factor on its quality, 1 unless it is blurred.
    """

    folder: Path
    usable: tuple[bool, ...]
    sharp: tuple[float, ...]

    @classmethod
    def load(cls, folder: Path) -> Agreement:
        """Read the folder that the step wrote."""
        path = folder / "agreement.json"
        try:
            rows = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, json.JSONDecodeError) as error:
            raise InputError(path, f"can't be read ({error})", "Run again with `--from agreement`") from None
        return cls(folder, tuple(row["usable"] for row in rows), tuple(row["sharpness_factor"] for row in rows))

    def sharpness(self, i: int) -> float:
        """Factor on the quality of view `i`."""
        return self.sharp[i]

    def mask(self, i: int, view: View) -> U8:
        """(h, w) uint8, 0 where photo `i` must not be used: its own mask, ghosts and sky; (0, 0) for nowhere."""
        path = self.folder / f"mask_{i}.png"
        return image.read_levels(path) if path.is_file() else np.zeros((0, 0), np.uint8)

    def warp(self, i: int) -> F32:
        """(h, w, 2) float32 pixels to be added to where photo `i` is looked up; (0, 0, 2) for none."""
        path = self.folder / f"warp_{i}.npy"
        return np.load(path) if path.is_file() else np.zeros((0, 0, 2), np.float32)


def agreement(inputs: Inputs, params: AgreementParams, out: Path, report: Report) -> Done:
    """Compare every photo that is not held out with the others.

    Inputs: `views`, `depth` (folder of depth maps), `exposures`.
    Folder: `agreement`, with `agreement.json` (a row a view), and `mask_<i>.png` where a photo has some, ghosts or sky.
    """
    from scan2sim.pipeline.camera.depth_map import load_depth_map
    from scan2sim.texturing.photo_cache import Exposures, Photos, camera_of

    folder = out / "agreement"
    folder.mkdir()
    views = views_io.load(inputs["views"])
    held = views_io.load_held_out(inputs["views"])
    # an orthophoto is put together of many photos: nothing moves in it, and it fits by its georeference or not at all
    used = [i for i, view in enumerate(views) if not held[i] and view.camera.model != "orthographic"]
    exposures, photos = Exposures.load(inputs["exposures"]), Photos(views)

    @lru_cache(maxsize=KEPT)
    def depth(i: int) -> DepthMap:
        return load_depth_map(inputs["depth"] / f"{i}.npy", views[i].camera, views[i].T_world_cam)

    rows: list[dict[str, Any]] = [
        {"name": view.name, "camera": camera_of(view), "usable": not out_, "sharpness_factor": 1.0}
        for view, out_ in zip(views, held, strict=True)
    ]
    nearest = neighbours(views, used, depth, params)
    for done, i in enumerate(used):
        report(done / len(used), views[i].name)
        photo = photos.get(i)
        if photo is None:
            rows[i] |= {"usable": False, "reason": photos.skipped[i]}
            continue
        compared = compare(i, nearest[i], views, depth, photos, exposures, params)
        rows[i] |= compared.figures
        own = photo.mask
        if params.sky:
            own, rows[i]["sky_share"] = without_sky(views[i], photo.levels[0], own, depth(i))
        mask = combined(compared.ghosts if params.ghosts else None, own)
        if mask is not None:
            image.write(folder / f"mask_{i}.png", mask)
        if params.align and compared.warp is not None:
            np.save(folder / f"warp_{i}.npy", compared.warp)
    _judge(rows, params)
    (folder / "agreement.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
    return Done({"agreement": folder}, _facts(rows, used), [str(row["reason"]) for row in rows if "reason" in row])


def neighbours(
    views: Sequence[View], used: Sequence[int], depth: Callable[[int], DepthMap], params: AgreementParams
) -> dict[int, list[int]]:
    """The views that see most of what each one sees, at no much lower resolution."""
    from scan2sim.pipeline.camera.depth_map import visible
    from scan2sim.pipeline.camera.models import pixel_angle
    from scan2sim.texturing.photo_prediction import surface

    rng = np.random.default_rng(0)
    place, normal, owner = [], [], []
    for i in used:
        camera = views[i].camera
        small = surface(camera.scaled(min(1.0, (60_000 / (camera.width * camera.height)) ** 0.5)), depth(i))
        p, n = small.some(SAMPLES, params.max_distance, rng)
        place.append(p)
        normal.append(n)
        owner.append(np.full(len(p), i))
    if not place:
        return {}
    xyz, facing, whose = np.concatenate(place), np.concatenate(normal), np.concatenate(owner)
    sharp = np.zeros((len(views), len(xyz)), np.float32)  # pixels a radian over distance, where seen
    for j in used:
        to = views[j].centre - xyz
        distance = np.linalg.norm(to, axis=1)
        cos = np.einsum("ij,ij->i", to, facing) / np.maximum(distance, 1e-9)
        close = np.flatnonzero((distance < params.max_distance) & (cos > params.min_cos))
        seen = close[visible(depth(j), xyz[close], facing[close], bias=params.bias)]
        sharp[j, seen] = 1 / (pixel_angle(views[j].camera) * distance[seen])
    out = {}
    for i in used:
        own = whose == i
        share = np.minimum(1.0, sharp[:, own] / np.maximum(sharp[i, own], 1e-9)).sum(axis=1)
        share[i] = 0
        best = np.argsort(-share, kind="stable")[: params.neighbours]
        out[i] = [int(j) for j in best if share[j] > 0]
    return out


@dataclass(frozen=True)
class Compared:
    """A photo beside its prediction: figures, where it shows a ghost (h, w), its warp (`warp_of`); None: unknown."""

    figures: dict[str, Any]
    ghosts: Bools | None = None
    warp: F32 | None = None


def compare(
    i: int,
    others: Sequence[int],
    views: Sequence[View],
    depth: Callable[[int], DepthMap],
    photos: Photos,
    exposures: Exposures,
    params: AgreementParams,
) -> Compared:
    """Predict photo `i` from `others`, and tell how it differs."""
    import cv2

    from scan2sim.texturing.photo_prediction import Predictor, corrected_photo, surface

    photo = photos.get(i)
    assert photo is not None
    camera = views[i].camera
    small = camera.scaled(min(1.0, (PIXELS / (camera.width * camera.height)) ** 0.5))
    shows = surface(small, depth(i))
    predictor = Predictor(
        shows, len(others), max_distance=params.max_distance, min_cos=params.min_cos, bias=params.bias
    )
    own = np.asarray(cv2.resize(photo.levels[0], (small.width, small.height), interpolation=cv2.INTER_AREA))
    for j in others:
        other = photos.get(j)
        if other is not None:
            predictor.add(other, views[j].camera, views[j].T_world_cam, depth(j), exposures.of(views[j]))
    there = np.isfinite(shows.points[..., 0])
    burnt = float(np.all(own[there] >= WHITE, axis=1).mean()) if there.any() else 0.0
    figures: dict[str, Any] = {"overexposed": round(burnt, 3)}
    predicted = predictor.result()
    sure = predicted.support >= 2
    if sure.sum() < 2000:
        return Compared(figures)
    mine = np.clip(corrected_photo(own, small, exposures.of(views[i])), 0, 255).astype(np.float32)
    ghosts = ghost_mask(mine, predicted, own >= WHITE)
    figures["ghost_share"] = round(float(ghosts.mean()), 4)
    displaced = ghosts[sure].mean() > HAUNTED
    displacement, warp = _shift(mine, predicted, sure if displaced else sure & ~ghosts, camera.width / small.width)
    return Compared(figures | displacement, ghosts, warp)


def _shift(mine: F32, predicted: Prediction, sure: Bools, scale: float) -> tuple[dict[str, float], F32 | None]:
    """How a photo is displaced against its prediction by optical flow: figures (pixels of the photo), and its warp."""
    import cv2

    grey = cv2.cvtColor(mine, cv2.COLOR_RGB2GRAY)
    other = np.where(sure, cv2.cvtColor(predicted.rgb, cv2.COLOR_RGB2GRAY), grey)
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(
        np.clip(other, 0, 255).astype(np.uint8), np.clip(grey, 0, 255).astype(np.uint8), None
    )
    inner = cv2.erode(sure.astype(np.uint8), np.ones((7, 7))) > 0
    slope = np.hypot(cv2.Sobel(other, cv2.CV_32F, 1, 0), cv2.Sobel(other, cv2.CV_32F, 0, 1))
    at = inner & (slope > 40)  # flow means something where there is something to see
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
    return figures, warp_of(flow, np.where(inner, slope, 0).astype(np.float32), scale)


def warp_of(flow: F32, slope: F32, scale: float) -> F32:
    """Where a photo shows what should be at a pixel, smoothed: (h / 4, w / 4, 2) pixels of the photo to be added.

    Args:
        flow: (h, w, 2) from the prediction to the photo, pixels of the compared size.
        slope: (h, w) how much there is to see; 0 where nothing is known.
        scale: pixels of the photo per pixel of the compared size.
    """
    import cv2

    length = np.linalg.norm(flow, axis=2)
    weight = np.where(length < MAX_WARP, np.minimum(slope, 200), 0).astype(np.float32)
    total = cv2.GaussianBlur(weight, (0, 0), SMOOTH)
    smooth = cv2.GaussianBlur(flow * weight[..., None], (0, 0), SMOOTH) / (total + FAINT)[..., None]
    size = (max(1, flow.shape[1] // 4), max(1, flow.shape[0] // 4))
    return np.asarray(cv2.resize(smooth, size, interpolation=cv2.INTER_AREA) * scale, np.float32)


def ghost_mask(mine: F32, predicted: Prediction, white: Bools) -> Bools:
    """Where a photo shows what the others agree is not there: (h, w).

    Args:
        mine: the photo (h, w, 3), exposure corrected.
        predicted: what the others show.
        white: (h, w, 3) where it is overexposed: as bright as it shows, or brighter.
    """
    import cv2

    sure = predicted.support >= 2
    theirs = np.where(sure[..., None], predicted.rgb, mine)
    a, b = cv2.blur(mine, (3, 3)), cv2.blur(theirs, (3, 3))
    kernel = np.ones((2 * SLACK + 1, 2 * SLACK + 1))
    darker = np.where(white, 0, cv2.erode(b, kernel) - a)
    channels = cv2.split(np.maximum(a - cv2.dilate(b, kernel), darker))
    apart = cv2.max(cv2.max(channels[0], channels[1]), channels[2])
    apart[~sure] = 0
    seeds = cv2.morphologyEx((apart > SEED).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3)))
    grown = cv2.morphologyEx((apart > GROWN).astype(np.uint8) | seeds, cv2.MORPH_CLOSE, np.ones((7, 7)))
    n, component, stats, _ = cv2.connectedComponentsWithStats(grown, connectivity=8)
    seeded = np.bincount(component[seeds > 0], minlength=n) * 4 > SPECK
    ghost = (seeded & (stats[:, cv2.CC_STAT_AREA] > SPECK))[component] & (grown > 0)
    return np.asarray(cv2.dilate(ghost.astype(np.uint8), np.ones((7, 7)))) > 0


def without_sky(view: View, rgb: U8, mask: U8, depth: DepthMap) -> tuple[U8, float]:
    """A photo's mask, (0, 0) for none, 0 also where it shows sky, and how large a share that is."""
    from scan2sim.pipeline.camera.models import pixel_angle, pixel_rays
    from scan2sim.texturing.sky import sky

    up = np.nan_to_num(pixel_rays(view.camera.scaled(1 / 8))) @ view.T_world_cam[2, :3].astype(np.float32)
    found = sky(rgb, depth.range, up, pixel_angle(view.camera), LOOSE)
    if found is None:
        return mask, 0.0
    allowed = np.where(found, 0, 255).astype(np.uint8)
    return (np.minimum(allowed, mask) if mask.size else allowed), round(float(found.mean()), 5)


def combined(ghosts: Bools | None, mask: U8) -> U8 | None:
    """The photo's own mask and its ghosts as one, 0 where it must not be used; None where that is nowhere."""
    import cv2

    if ghosts is None or not ghosts.any():
        return np.where(mask > 0, 255, 0).astype(np.uint8) if mask.size else None
    allowed: U8 = np.where(ghosts, 0, 255).astype(np.uint8)
    if mask.size:
        size = (mask.shape[1], mask.shape[0])
        large = np.asarray(cv2.resize(allowed, size, interpolation=cv2.INTER_NEAREST), np.uint8)
        return np.where(mask > 0, large, 0).astype(np.uint8)
    return allowed


def _judge(rows: list[dict[str, Any]], params: AgreementParams) -> None:
    """Decide from the figures which photos are left out, and how much blurred ones count."""
    for row in rows:
        if not row["usable"]:
            continue
        alike = [other["sharpness"] for other in rows if other["camera"] == row["camera"] and "sharpness" in other]
        usual = float(np.median(alike)) if len(alike) >= FEW else 1e-6
        relative = row.get("sharpness", usual) / usual
        row["sharpness_factor"] = 1.0 if relative > SHARP else round(max(0.02, relative**2), 3)
        if row.get("overexposed", 0.0) > BURNT:
            row |= {
                "usable": False,
                "reason": f"{row['name']}: left out, {row['overexposed']:.0%} of it is overexposed",
            }
        elif params.max_shift and row.get("shift_compared_px", 0.0) > params.max_shift:
            row |= {
                "usable": False,
                "reason": f"{row['name']}: left out, it is shifted by {row['shift_px']:.1f} pixels against the other "
                "photos: check its pose (`agreement.max_shift` is the limit)",
            }
        elif row["sharpness_factor"] < 1:
            row["reason"] = f"{row['name']}: blurred, {relative:.0%} as sharp as the others; used for little detail"


def _facts(rows: Sequence[dict[str, Any]], used: Sequence[int]) -> dict[str, Any]:
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


AGREEMENT = Step("agreement", 3, agreement, AgreementParams)

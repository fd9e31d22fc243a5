"""Whether followed things move: corners in them, followed by optical flow, against those of the background.

Corners (Shi and Tomasi, 1994) are followed from image to image (Lucas and Kanade; pyramidal: Bouguet, 2000). A thing's
step is what its corners do beyond what the background's do, so that a mast in the wind makes nothing move; steps are
summed over a second, in which shaking comes back to where it was and driving doesn't.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from scan2sim.pipeline.types import F32, F64, U8, Bools

WIDTH = 640
"""Pixels of the images that corners are followed in; larger ones are made smaller."""
WINDOW = 1.0
"""Seconds over which it is decided."""
SOONEST = 0.25
"""Seconds of a thing's steps before anything is said of it."""
STILL = 3.0
"""Pixels of such an image by which a standing thing's corners may drift in a second."""
LEAST = 1.0
"""Pixels that a thing must have gone, however short its history is."""
CORNERS, BACKGROUND = 60, 200
"""Corners of a thing, and of the background, at most; there are new ones once half of them are lost."""
FEWEST, FEWEST_BACKGROUND = 4, 8
"""Corners that say anything together."""
BACK = 0.5
"""Pixels that a corner may be off when it is followed there and back."""
REACH = (21, 21)
"""Pixels around a corner that are compared."""
QUALITY, APART = 0.01, 5.0
"""Of corners: least strength as a share of the strongest, and pixels between two."""

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Motion:
    """Of a thing over the last second.

    Attributes:
        moving: whether it moves; None: it isn't known yet.
        speed: pixels of the image a second; None likewise.
    """

    moving: bool | None = None
    speed: float | None = None


@dataclass
class _Thing:
    """Its corners (N, 2), and its steps: (seconds, seconds since the one before, pixels across, down, outwards)."""

    corners: F32 = field(default_factory=lambda: np.empty((0, 2), np.float32))
    steps: deque[tuple[float, float, F64]] = field(default_factory=deque)
    seen: float = 0.0


class Flow:
    """Optical flow of one source's images; their camera stands."""

    def __init__(self) -> None:
        self._last: U8 | None = None
        self._time = 0.0
        self._things: dict[int, _Thing] = {}
        self._background = np.empty((0, 2), np.float32)

    def update(self, image: U8, seconds: float, boxes: Mapping[int, Box]) -> dict[int, Motion]:
        """How things move, by their track.

        Args:
            image: (H, W, 3) RGB.
            seconds: when it was taken; after a gap of over a second, or a change of size, all begins anew.
            boxes: tracks of the things in it, and where they are: left, top, right, bottom, pixels.
        """
        grey, scale = _grey(image)
        if self._last is not None and self._last.shape == grey.shape and 0 < seconds - self._time < WINDOW:
            self._step(self._last, grey, seconds)
        else:
            self._things, self._background = {}, np.empty((0, 2), np.float32)
        self._last, self._time = grey, seconds
        self._renew(grey, seconds, {track: np.array(box) * scale for track, box in boxes.items()})
        return {track: self._motion(self._things[track], scale) for track in boxes}

    def _step(self, last: U8, grey: U8, seconds: float) -> None:
        """Follow all corners, and note how things went against the background."""
        kept = {track: thing for track, thing in self._things.items() if seconds - thing.seen < WINDOW}
        corners = [self._background, *(thing.corners for thing in kept.values())]
        ends = np.cumsum([len(one) for one in corners])[:-1]
        now, found = _followed(last, grey, np.concatenate(corners))
        parts = zip(corners, np.split(now, ends), np.split(found, ends), strict=True)
        before, after, good = next(parts)
        shake = _similarity(before[good], after[good])
        self._background = after[good]
        for thing, (before, after, good) in zip(kept.values(), parts, strict=True):
            thing.corners = after[good]
            if good.sum() >= FEWEST:
                went = _went(before[good] @ shake[:, :2].T + shake[:, 2], after[good])
                thing.steps.append((seconds, seconds - self._time, went))
            while thing.steps and seconds - thing.steps[0][0] > WINDOW:
                thing.steps.popleft()
        self._things = kept

    def _renew(self, grey: U8, seconds: float, boxes: Mapping[int, F64]) -> None:
        """Keep corners that are in their thing's box and in no nearer one's; find others for those that are lost."""
        height, width = grey.shape
        free = np.full(grey.shape, 255, np.uint8)
        for track, box in sorted(boxes.items(), key=lambda one: -one[1][3]):  # the nearest, lowest in the image, first
            thing = self._things.setdefault(track, _Thing())
            thing.seen = seconds
            left, top, right, bottom = np.clip(box.round().astype(int), 0, (width, height, width, height))
            own = np.zeros_like(free)
            own[top:bottom, left:right] = free[top:bottom, left:right]
            thing.corners = _corners(grey, own, thing.corners, CORNERS)
            free[top:bottom, left:right] = 0
        self._background = _corners(grey, free, self._background, BACKGROUND)

    @staticmethod
    def _motion(thing: _Thing, scale: float) -> Motion:
        duration = sum(took for _, took, _ in thing.steps)
        if duration < SOONEST:
            return Motion()
        way = float(np.linalg.norm(np.sum([went for _, _, went in thing.steps], axis=0)))
        return Motion(moving=way > max(LEAST, STILL * duration), speed=round(way / duration / scale, 2))


def _grey(image: U8) -> tuple[U8, float]:
    """(h, w) grey of an image, not wider than `WIDTH`, and its pixels by the image's."""
    import cv2

    scale = min(1.0, WIDTH / image.shape[1])
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if scale < 1:
        grey = cv2.resize(grey, (WIDTH, max(1, round(image.shape[0] * scale))), interpolation=cv2.INTER_AREA)
    return np.asarray(grey, np.uint8), scale


def _followed(last: U8, grey: U8, corners: F32) -> tuple[F32, Bools]:
    """Where corners (N, 2) are in the next image, and whether that is sure: followed back, they are where they were."""
    import cv2

    if not len(corners):
        return corners, np.zeros(0, bool)
    now, found, _ = cv2.calcOpticalFlowPyrLK(last, grey, corners, None, winSize=REACH)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(grey, last, now, None, winSize=REACH)
    sure = (found[:, 0] > 0) & (returned[:, 0] > 0) & (np.linalg.norm(back - corners, axis=1) < BACK)
    return np.asarray(now, np.float32), np.asarray(sure, bool)


def _similarity(before: F32, after: F32) -> F64:
    """(2, 3) how the background went: turned, shifted and enlarged; nowhere, where too little of it is seen."""
    import cv2

    if len(before) >= FEWEST_BACKGROUND:
        found, _ = cv2.estimateAffinePartial2D(before, after, ransacReprojThreshold=1.0)
        if found is not None:
            return np.asarray(found, np.float64)
    return np.eye(2, 3)


def _went(expected: F64, after: F32) -> F64:
    """(3,) pixels that most of a thing's corners went beyond what was expected: across, down, and outwards.

    What drives towards the camera goes outwards alone.
    """
    beyond = after - expected
    middle = np.median(beyond, axis=0)
    spokes = expected - np.median(expected, axis=0)
    lengths = np.linalg.norm(spokes, axis=1)
    outwards = ((beyond - middle) * spokes).sum(axis=1) / np.maximum(lengths, 1e-6)
    return np.array([*middle, np.median(outwards)])


def _corners(grey: U8, where: U8, known: F32, most: int) -> F32:
    """(N, 2) corners in the part of an image where a mask isn't 0: known ones, and others if there are too few."""
    import cv2

    at = known.round().astype(int)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < where.shape[1]) & (at[:, 1] < where.shape[0])
    kept = known[inside]
    kept = kept[where[at[inside, 1], at[inside, 0]] > 0]
    if len(kept) > most // 2:
        return kept
    found = cv2.goodFeaturesToTrack(grey, most - len(kept), QUALITY, APART, mask=where)
    return kept if found is None else np.concatenate([kept, found.reshape(-1, 2)])

"""Whether followed things move: corners in them, followed by optical flow, against those of the background.

Corners (Shi and Tomasi, 1994) are followed from image to image (Lucas and Kanade; pyramidal: Bouguet, 2000). A corner's
step is what it does beyond what the background does, so that a mast in the wind makes nothing move; steps are summed
over a second, in which shaking comes back to where it was and driving doesn't. A thing moves if enough of its corners
do: others in its box, at its rim mostly, may be of what lies behind it. One that stands may drift about as far as the
background's do. A thing that wasn't detected for a moment is where its corners went.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, U8, Bools
from scan2sim.services.toolboxes.results import Detection

WIDTH = 640
"""Pixels of the images that corners are followed in; larger ones are made smaller."""
WINDOW = 1.0
"""Seconds over which it is decided."""
SOONEST = 0.25
"""Seconds that a corner was followed for before it counts."""
STILL = (0.8, 3.0)
"""Pixels of such an image by which a standing corner may drift in a second, whatever the background's do."""
CALM = (75.0, 1.25)
"""A percentile of the background's drifts, and by how much more a standing corner may drift."""
LEAST = 0.7
"""Share of that drift that a corner must have gone, however short its history is."""
ENOUGH = ((0.5, 1.0), (0.3, 2.0))
"""A thing moves if such a share of its corners drifts so many times as far as standing ones may."""
CORNERS, BACKGROUND = 80, 200
"""Corners of a thing, and of the background, about: they are as far apart as that."""
NEAREST = 2.0
"""Pixels between two corners, at least."""
FEWEST, FEWEST_BACKGROUND = 4, 8
"""Corners that say anything together."""
DRIFT = 5.0
"""Pixels a second that the middle of a standing thing's boxes may go, where it has too few corners."""
PART = 0.8
"""Share of a box that lies in another thing's, from which it may be a part of it."""
RIM = 0.9
"""By what share a corner at a box's rim counts less than one in its middle."""
SURE = 2.0
"""Standard errors of that speed that it exceeds if the thing moves."""
BACK = 0.5
"""Pixels that a corner may be off when it is followed there and back."""
REACH = (15, 15)
"""Pixels around a corner that are compared."""
EDGE = max(REACH) // 2
"""Pixels around a nearer thing in which it would draw corners along."""
QUALITY = 0.02
"""Of corners: least strength as a share of the strongest."""


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
class _Corners:
    """Corners that are followed, and their steps: (N, 2) pixels, (N, T, 2) pixels, (T,) seconds that each step took.

    Steps before a corner was found are NaN. Of their thing: `box`, where it is (pixels followed), `score` and `seen`,
    how sure and when it was last detected, and `path`, (seconds, pixels across and down) of its detected boxes' middles
    over the last second.
    """

    at: F32 = field(default_factory=lambda: np.empty((0, 2), np.float32))
    steps: F32 = field(default_factory=lambda: np.empty((0, 0, 2), np.float32))
    took: F64 = field(default_factory=lambda: np.empty(0))
    box: F64 = field(default_factory=lambda: np.zeros(4))
    score: float = 0.0
    seen: float = 0.0
    path: deque[tuple[float, float, float]] = field(default_factory=deque)

    def keep(self, which: Bools) -> None:
        """Forget others."""
        self.at, self.steps = self.at[which], self.steps[which]

    def step(self, at: F32, beyond: F32, seconds: float) -> None:
        """All go to where they are now, and their thing with them; what is older than the window is forgotten."""
        if len(at):
            self.box = self.box + np.tile(np.median(at - self.at, axis=0), 2)
        self.at = at
        self.steps = np.concatenate([self.steps, beyond[:, None]], axis=1)
        self.took = np.append(self.took, seconds)
        recent = np.cumsum(self.took[::-1])[::-1] <= WINDOW + seconds / 2
        self.steps, self.took = self.steps[:, recent], self.took[recent]

    def place(self, seconds: float, box: F64, score: float) -> None:
        """Their thing was detected in a box."""
        self.box, self.score, self.seen = box, score, seconds
        self.path.append((seconds, (box[0] + box[2]) / 2, (box[1] + box[3]) / 2))
        while seconds - self.path[0][0] > WINDOW:
            self.path.popleft()

    def add(self, found: F32) -> None:
        """Follow others, too."""
        never = np.full((len(found), len(self.took), 2), np.nan, np.float32)
        self.at, self.steps = np.concatenate([self.at, found]), np.concatenate([self.steps, never])

    def ways(self) -> tuple[F64, F64]:
        """(K,) pixels that corners went beyond the background, and seconds that it took, of those that count."""
        durations = self._durations()
        counts = durations >= SOONEST
        return np.linalg.norm(np.nansum(self.steps[counts], axis=1), axis=1), durations[counts]

    def _durations(self) -> F64:
        """(N,) seconds for which corners were followed."""
        known = np.isfinite(self.steps[..., 0])
        return np.asarray(known @ self.took if len(self.took) else np.zeros(len(self.at)))

    def _weights(self) -> F64:
        """(K,) share that each corner that counts has in what is said of the thing.

        What passes by has its corners in the box for a moment, and what lies behind has them at its rim.
        """
        durations = self._durations()
        counts = durations >= SOONEST
        half = np.maximum((self.box[2:] - self.box[:2]) / 2, 1.0)
        off = np.abs((self.at[counts] - (self.box[:2] + self.box[2:]) / 2) / half).max(axis=1).clip(0, 1)
        weights = durations[counts] * (1 - RIM * off)
        return np.asarray(weights / weights.sum())

    def motion(self, scale: float, still: float) -> Motion:
        """Of their thing.

        Args:
            scale: pixels followed by pixels of the image.
            still: pixels followed by which a standing corner may drift in a second.
        """
        ways, durations = self.ways()
        if len(ways) < FEWEST:
            return self._drift(scale)
        speeds, drifts = ways / durations, ways / (still * np.maximum(LEAST, durations))
        weights = self._weights()
        moving = any(weights[drifts > times].sum() >= share for share, times in ENOUGH)
        moves = drifts > 1
        return Motion(moving, round(float(np.median(speeds[moves] if moving else speeds)) / scale, 2))

    def _drift(self, scale: float) -> Motion:
        """By the boxes alone: a line through their middles."""
        seconds, *middle = np.array(self.path).T
        if seconds[-1] - seconds[0] < SOONEST or len(seconds) < FEWEST:
            return Motion()
        fits = [np.polyfit(seconds - seconds[0], one, 1, full=True)[:2] for one in middle]
        speed = float(np.linalg.norm([line[0] for line, _ in fits]))
        spread = sum(left.sum() for _, left in fits) / (len(seconds) - 2)  # of the middles about the lines, squared
        unsure = math.sqrt(spread / (len(seconds) * seconds.var()))
        return Motion(speed > max(DRIFT, SURE * unsure), round(speed / scale, 2))


class Flow:
    """Optical flow of one source's images; their camera stands."""

    def __init__(self, kept: float = WINDOW) -> None:
        """Begin.

        Args:
            kept: seconds for which a thing that isn't detected is followed by its corners alone.
        """
        self._kept = kept
        self._last: U8 | None = None
        self._time, self._scale = 0.0, 1.0
        self._things: dict[int, _Corners] = {}
        self._background = _Corners()

    def update(self, image: U8, seconds: float, found: Mapping[int, Detection]) -> dict[int, Motion]:
        """How things move, by their track: those that were found, and those that are followed without (`box`).

        Args:
            image: (H, W, 3) RGB.
            seconds: when it was taken; after a gap of over a second, or a change of size, all begins anew.
            found: what was detected in it, by its track.
        """
        grey, scale = _grey(image)
        self._scale = scale
        if self._last is not None and self._last.shape == grey.shape and 0 < seconds - self._time < WINDOW:
            self._step(self._last, grey, seconds)
        else:
            self._things, self._background = {}, _Corners()
        self._last, self._time = grey, seconds
        there = self._renew(grey, seconds, found)
        still = self._still()
        return {track: self._things[track].motion(scale, still) for track in there}

    def box(self, track: int) -> tuple[float, float, float, float]:
        """Where a thing is, as its corners went: left, top, right, bottom, pixels."""
        left, top, right, bottom = (self._things[track].box / self._scale).tolist()
        return left, top, right, bottom

    def _still(self) -> float:
        """Pixels followed by which a standing corner may drift in a second."""
        ways, durations = self._background.ways()
        percentile, more = CALM
        drift = more * float(np.percentile(ways / durations, percentile)) if len(ways) >= FEWEST_BACKGROUND else 0.0
        return float(np.clip(drift, *STILL))

    def _step(self, last: U8, grey: U8, seconds: float) -> None:
        """Follow all corners, and note how they went against the background."""
        groups = [self._background, *self._things.values()]
        now, sure = _followed(last, grey, np.concatenate([one.at for one in groups]))
        ends = np.cumsum([len(one.at) for one in groups])[:-1]
        shake = np.eye(2, 3)
        for i, (one, after, good) in enumerate(zip(groups, np.split(now, ends), np.split(sure, ends), strict=True)):
            one.keep(good)
            if i == 0:
                shake = _similarity(one.at, after[good])
            expected = one.at @ shake[:, :2].T + shake[:, 2]
            one.step(after[good], np.asarray(after[good] - expected, np.float32), seconds - self._time)

    def _renew(self, grey: U8, seconds: float, found: Mapping[int, Detection]) -> Iterable[int]:
        """Keep corners that are in their thing's box and in no nearer one's; find others where there are none.

        Nearer: lower in the image. What is less sure, or lies all within a thing, may be a part of it, taken for
        something else: its corners are the thing's, too.

        Returns:
            Tracks of the things that are there.
        """
        for track, one in found.items():
            self._things.setdefault(track, _Corners()).place(seconds, np.array(one.box) * self._scale, one.score)
        self._things = {
            track: one for track, one in self._things.items() if track in found or seconds - one.seen < self._kept
        }
        there = {track: one for track, one in self._things.items() if track in found or len(one.at) >= FEWEST}
        things = list(there.values())
        for track, own in there.items():
            before = [
                other.box
                for other in things
                if other.box[3] > own.box[3] and other.score >= own.score and _within(other.box, own.box) < PART
            ]
            _find(grey, _free(grey.shape, before), _place(own.box, grey.shape), own, CORNERS if track in found else 0)
        _find(grey, _free(grey.shape, [one.box for one in things]), np.s_[:, :], self._background, BACKGROUND)
        return there


def _place(box: F64, shape: tuple[int, ...], around: int = 0) -> tuple[slice, slice]:
    """Rows and columns of a box, and of some pixels around it."""
    left, top, right, bottom = box.round().astype(int) + (-around, -around, around, around)
    return np.s_[max(0, top) : max(0, min(bottom, shape[0])), max(0, left) : max(0, min(right, shape[1]))]


def _free(shape: tuple[int, ...], boxes: Sequence[F64]) -> U8:
    """(H, W) 255 where none of the boxes is, nor near one, else 0."""
    free = np.full(shape, 255, np.uint8)
    for box in boxes:
        free[_place(box, shape, EDGE)] = 0
    return free


def _within(box: F64, other: F64) -> float:
    """Share of a box that lies in another one."""
    sides = np.minimum(box[2:], other[2:]) - np.maximum(box[:2], other[:2])
    return float(np.prod(np.maximum(sides, 0)) / max(np.prod(box[2:] - box[:2]), 1e-9))


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


def _find(grey: U8, free: U8, place: tuple[slice, slice], corners: _Corners, most: int) -> None:
    """Drop corners out of a place of an image, or where it isn't free (0), and find others, `most` with these."""
    import cv2

    top, left = place[0].start or 0, place[1].start or 0
    mask = free[place].copy()
    if not mask.size:
        corners.keep(np.zeros(len(corners.at), bool))
        return
    at = corners.at.round().astype(int) - (left, top)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < mask.shape[1]) & (at[:, 1] < mask.shape[0])
    inside[inside] = mask[at[inside, 1], at[inside, 0]] > 0
    corners.keep(inside)
    if not most:
        return
    apart = max(NEAREST, math.sqrt(mask.size / most))
    for x, y in at[inside]:
        cv2.circle(mask, (int(x), int(y)), math.ceil(apart), 0, cv2.FILLED)
    found = cv2.goodFeaturesToTrack(grey[place], most, QUALITY, apart, mask=mask)
    if found is not None:
        corners.add(np.asarray(found.reshape(-1, 2) + (left, top), np.float32))

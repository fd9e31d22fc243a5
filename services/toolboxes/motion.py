"""Motion detection of tracked objects: sparse optical flow of corners in an object, relative to the background.

Corners (Shi and Tomasi, 1994) are tracked from image to image (Lucas and Kanade; pyramidal: Bouguet, 2000). A corner's
step is its motion relative to the background's, so that camera shake moves nothing; steps are summed over a second, in
which shaking cancels out and driving doesn't. An object moves if enough of its corners do: some corners in its box,
mostly at the border, may belong to what is behind it. Corners of a stationary object may drift about as far as those of
the background. An object that isn't detected for a moment follows its corners.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, U8, Bools
from scan2sim.services.toolboxes.results import Detection


@dataclass(frozen=True)
class MotionConstants:
    """Constants of the motion detection; pixels are those of the downscaled image."""

    image_width_px: int = 640  # larger images are downscaled to this width
    window_s: float = 1.0  # time over which steps are summed
    min_track_s: float = 0.25  # track length from which a corner counts
    still_drift_px_s: tuple[float, float] = (0.8, 3.0)  # bounds of the drift tolerated for stationary corners
    background_percentile: float = 75.0  # percentile of the background's drift ...
    background_factor: float = 1.25  # ... that, times this factor, is tolerated for stationary corners
    min_drift_s: float = 0.7  # shorter tracks need the same distance as one of this length
    moving_shares: tuple[tuple[float, float], ...] = ((0.5, 1.0), (0.3, 2.0))  # (share of corners, times the tolerance)
    object_corners: int = 80  # corners per object, approximately
    background_corners: int = 200  # corners of the background, approximately
    min_corner_distance_px: float = 2.0
    min_object_corners: int = 4  # fewer corners aren't evaluated
    min_background_corners: int = 8
    box_drift_px_s: float = 5.0  # drift tolerated for the boxes of a stationary object, if it has too few corners
    contained_share: float = 0.8  # a box of which this share lies within another may be a part of that object
    border_penalty: float = 0.9  # weight that a corner at the box's border loses relative to one in the centre
    speed_sigmas: float = 2.0  # standard errors that a speed from boxes must exceed
    max_return_error_px: float = 0.5  # forward-backward check of the optical flow
    flow_window_px: tuple[int, int] = (15, 15)
    corner_quality: float = 0.02  # minimum corner strength relative to the strongest

    @property
    def occlusion_margin_px(self) -> int:
        """Margin around a nearer object in which the flow window would include its pixels."""
        return max(self.flow_window_px) // 2


MOTION = MotionConstants()


@dataclass(frozen=True)
class Motion:
    """Motion of an object over the last second.

    Attributes:
        moving: whether it moves; None: not known yet.
        speed: pixels of the original image per second; None likewise.
    """

    moving: bool | None = None
    speed: float | None = None


@dataclass
class _CornerTracks:
    """Tracked corners of an object or of the background.

    Attributes:
        at: (N, 2) current positions, pixels.
        steps: (N, T, 2) steps relative to the background, pixels; NaN before a corner was found.
        durations: (T,) seconds that each step took.
        box: (4,) current box of the object: left, top, right, bottom.
        score: score of its last detection.
        seen: time of its last detection, seconds.
        path: (seconds, x, y) of the centres of its detected boxes over the window.
    """

    at: F32 = field(default_factory=lambda: np.empty((0, 2), np.float32))
    steps: F32 = field(default_factory=lambda: np.empty((0, 0, 2), np.float32))
    durations: F64 = field(default_factory=lambda: np.empty(0))
    box: F64 = field(default_factory=lambda: np.zeros(4))
    score: float = 0.0
    seen: float = 0.0
    path: deque[tuple[float, float, float]] = field(default_factory=deque)

    def keep(self, mask: Bools) -> None:
        """Keep only the corners of a mask (N,)."""
        self.at, self.steps = self.at[mask], self.steps[mask]

    def step(self, at: F32, relative: F32, seconds: float) -> None:
        """Move all corners, and the box by their median; drop steps older than the window.

        Args:
            at: (N, 2) new positions.
            relative: (N, 2) steps relative to the background.
            seconds: duration of the step.
        """
        if len(at):
            self.box = self.box + np.tile(np.median(at - self.at, axis=0), 2)
        self.at = at
        self.steps = np.concatenate([self.steps, relative[:, None]], axis=1)
        self.durations = np.append(self.durations, seconds)
        recent = np.cumsum(self.durations[::-1])[::-1] <= MOTION.window_s + seconds / 2
        self.steps, self.durations = self.steps[:, recent], self.durations[recent]

    def set_detection(self, seconds: float, box: F64, score: float) -> None:
        """Set the box to that of a new detection."""
        self.box, self.score, self.seen = box, score, seconds
        self.path.append((seconds, (box[0] + box[2]) / 2, (box[1] + box[3]) / 2))
        while seconds - self.path[0][0] > MOTION.window_s:
            self.path.popleft()

    def add(self, found: F32) -> None:
        """Add new corners (K, 2)."""
        unknown = np.full((len(found), len(self.durations), 2), np.nan, np.float32)
        self.at, self.steps = np.concatenate([self.at, found]), np.concatenate([self.steps, unknown])

    def displacements(self) -> tuple[F64, F64]:
        """(K,) displacement relative to the background in pixels and (K,) its duration, for corners that count."""
        track_s = self._track_durations()
        counts = track_s >= MOTION.min_track_s
        return np.linalg.norm(np.nansum(self.steps[counts], axis=1), axis=1), track_s[counts]

    def _track_durations(self) -> F64:
        """(N,) seconds for which each corner was tracked."""
        known = np.isfinite(self.steps[..., 0])
        return np.asarray(known @ self.durations if len(self.durations) else np.zeros(len(self.at)))

    def _weights(self) -> F64:
        """(K,) weights of the corners that count, with sum 1.

        Corners of a passing object are in the box for a short time only, and those of the background are at its border.
        """
        track_s = self._track_durations()
        counts = track_s >= MOTION.min_track_s
        half = np.maximum((self.box[2:] - self.box[:2]) / 2, 1.0)
        offset = np.abs((self.at[counts] - (self.box[:2] + self.box[2:]) / 2) / half).max(axis=1).clip(0, 1)
        weights = track_s[counts] * (1 - MOTION.border_penalty * offset)
        return np.asarray(weights / weights.sum())

    def motion(self, scale: float, still_drift: float) -> Motion:
        """Motion of the object.

        Args:
            scale: scale of the downscaled image relative to the original.
            still_drift: tolerated drift of stationary corners, pixels per second.
        """
        distances, track_s = self.displacements()
        if len(distances) < MOTION.min_object_corners:
            return self._motion_of_boxes(scale)
        speeds, drifts = distances / track_s, distances / (still_drift * np.maximum(MOTION.min_drift_s, track_s))
        weights = self._weights()
        moving = any(weights[drifts > times].sum() >= share for share, times in MOTION.moving_shares)
        moves = drifts > 1
        return Motion(moving, round(float(np.median(speeds[moves] if moving else speeds)) / scale, 2))

    def _motion_of_boxes(self, scale: float) -> Motion:
        """Motion from the boxes alone: linear regression of their centres."""
        seconds, *centre = np.array(self.path).T
        if seconds[-1] - seconds[0] < MOTION.min_track_s or len(seconds) < MOTION.min_object_corners:
            return Motion()
        fits = [np.polyfit(seconds - seconds[0], one, 1, full=True)[:2] for one in centre]
        speed = float(np.linalg.norm([line[0] for line, _ in fits]))
        variance = sum(residual.sum() for _, residual in fits) / (len(seconds) - 2)  # of the centres about the lines
        standard_error = math.sqrt(variance / (len(seconds) * seconds.var()))
        return Motion(speed > max(MOTION.box_drift_px_s, MOTION.speed_sigmas * standard_error), round(speed / scale, 2))


class MotionDetector:
    """Motion of the objects of one source with a stationary camera."""

    def __init__(self, lost_s: float = MOTION.window_s) -> None:
        """Start without any images.

        Args:
            lost_s: seconds for which an object that isn't detected is tracked by its corners alone.
        """
        self._lost_s = lost_s
        self._last: U8 | None = None
        self._time, self._scale = 0.0, 1.0
        self._objects: dict[int, _CornerTracks] = {}
        self._background = _CornerTracks()

    def update(self, image: U8, seconds: float, found: Mapping[int, Detection]) -> dict[int, Motion]:
        """Motion of the objects by track: of the detected ones and of those tracked by their corners (see `box`).

        Args:
            image: (H, W, 3) RGB.
            seconds: its time; after a gap of more than a second or a change of size, the state is reset.
            found: detections in it by track.
        """
        grey, scale = _downscaled_grey(image)
        self._scale = scale
        if self._last is not None and self._last.shape == grey.shape and 0 < seconds - self._time < MOTION.window_s:
            self._step(self._last, grey, seconds)
        else:
            self._objects, self._background = {}, _CornerTracks()
        self._last, self._time = grey, seconds
        visible = self._update_corners(grey, seconds, found)
        still_drift = self._still_drift()
        return {track: self._objects[track].motion(scale, still_drift) for track in visible}

    def box(self, track: int) -> tuple[float, float, float, float]:
        """Current box of an object according to its corners: left, top, right, bottom, pixels of the original image."""
        left, top, right, bottom = (self._objects[track].box / self._scale).tolist()
        return left, top, right, bottom

    def _still_drift(self) -> float:
        """Tolerated drift of stationary corners, pixels per second."""
        distances, track_s = self._background.displacements()
        drift = 0.0
        if len(distances) >= MOTION.min_background_corners:
            percentile = float(np.percentile(distances / track_s, MOTION.background_percentile))
            drift = MOTION.background_factor * percentile
        return float(np.clip(drift, *MOTION.still_drift_px_s))

    def _step(self, last: U8, grey: U8, seconds: float) -> None:
        """Track all corners into the next image and store their steps relative to the background."""
        groups = [self._background, *self._objects.values()]
        now, valid = _track(last, grey, np.concatenate([one.at for one in groups]))
        ends = np.cumsum([len(one.at) for one in groups])[:-1]
        shake = np.eye(2, 3)
        for i, (one, after, good) in enumerate(zip(groups, np.split(now, ends), np.split(valid, ends), strict=True)):
            one.keep(good)
            if i == 0:
                shake = _similarity(one.at, after[good])
            expected = one.at @ shake[:, :2].T + shake[:, 2]
            one.step(after[good], np.asarray(after[good] - expected, np.float32), seconds - self._time)

    def _update_corners(self, grey: U8, seconds: float, found: Mapping[int, Detection]) -> Iterable[int]:
        """Keep corners that are in their object's box and not in a nearer one; detect new ones where they are missing.

        Nearer means lower in the image. A box with a lower score, or one that lies within the object, may be a part of
        it with another label: its corners belong to the object, too.

        Returns:
            Tracks of the visible objects.
        """
        for track, one in found.items():
            box = np.array(one.box) * self._scale
            self._objects.setdefault(track, _CornerTracks()).set_detection(seconds, box, one.score)
        self._objects = {
            track: one for track, one in self._objects.items() if track in found or seconds - one.seen < self._lost_s
        }
        visible = {
            track: one
            for track, one in self._objects.items()
            if track in found or len(one.at) >= MOTION.min_object_corners
        }
        objects = list(visible.values())
        for track, own in visible.items():
            nearer = [
                other.box
                for other in objects
                if other.box[3] > own.box[3]
                and other.score >= own.score
                and _contained_share(other.box, own.box) < MOTION.contained_share
            ]
            count = MOTION.object_corners if track in found else 0
            _renew_corners(grey, _free_mask(grey.shape, nearer), _box_slices(own.box, grey.shape), own, count)
        free = _free_mask(grey.shape, [one.box for one in objects])
        _renew_corners(grey, free, np.s_[:, :], self._background, MOTION.background_corners)
        return visible


def _box_slices(box: F64, shape: tuple[int, ...], margin: int = 0) -> tuple[slice, slice]:
    """Slices of the rows and columns of a box, enlarged by a margin in pixels."""
    left, top, right, bottom = box.round().astype(int) + (-margin, -margin, margin, margin)
    return np.s_[max(0, top) : max(0, min(bottom, shape[0])), max(0, left) : max(0, min(right, shape[1]))]


def _free_mask(shape: tuple[int, ...], boxes: Sequence[F64]) -> U8:
    """(H, W) mask: 0 in and near the boxes, else 255."""
    free = np.full(shape, 255, np.uint8)
    for box in boxes:
        free[_box_slices(box, shape, MOTION.occlusion_margin_px)] = 0
    return free


def _contained_share(box: F64, other: F64) -> float:
    """Share of a box's area that lies in another box."""
    sides = np.minimum(box[2:], other[2:]) - np.maximum(box[:2], other[:2])
    return float(np.prod(np.maximum(sides, 0)) / max(np.prod(box[2:] - box[:2]), 1e-9))


def _downscaled_grey(image: U8) -> tuple[U8, float]:
    """(h, w) grey image, at most `MOTION.image_width_px` wide, and its scale relative to the original."""
    import cv2

    width = MOTION.image_width_px
    scale = min(1.0, width / image.shape[1])
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if scale < 1:
        grey = cv2.resize(grey, (width, max(1, round(image.shape[0] * scale))), interpolation=cv2.INTER_AREA)
    return np.asarray(grey, np.uint8), scale


def _track(last: U8, grey: U8, corners: F32) -> tuple[F32, Bools]:
    """Positions (N, 2) of corners in the next image, and (N,) whether they pass the forward-backward check."""
    import cv2

    if not len(corners):
        return corners, np.zeros(0, bool)
    window = MOTION.flow_window_px
    now, found, _ = cv2.calcOpticalFlowPyrLK(last, grey, corners, None, winSize=window)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(grey, last, now, None, winSize=window)
    close = np.linalg.norm(back - corners, axis=1) < MOTION.max_return_error_px
    valid = (found[:, 0] > 0) & (returned[:, 0] > 0) & close
    return np.asarray(now, np.float32), np.asarray(valid, bool)


def _similarity(before: F32, after: F32) -> F64:
    """(2, 3) similarity transform of the background between two images; identity if too few corners are known."""
    import cv2

    if len(before) >= MOTION.min_background_corners:
        found, _ = cv2.estimateAffinePartial2D(before, after, ransacReprojThreshold=1.0)
        if found is not None:
            return np.asarray(found, np.float64)
    return np.eye(2, 3)


def _renew_corners(grey: U8, free: U8, region: tuple[slice, slice], corners: _CornerTracks, count: int) -> None:
    """Drop corners outside a region of the image or where the mask `free` is 0; detect new ones up to `count`."""
    import cv2

    top, left = region[0].start or 0, region[1].start or 0
    mask = free[region].copy()
    if not mask.size:
        corners.keep(np.zeros(len(corners.at), bool))
        return
    at = corners.at.round().astype(int) - (left, top)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < mask.shape[1]) & (at[:, 1] < mask.shape[0])
    inside[inside] = mask[at[inside, 1], at[inside, 0]] > 0
    corners.keep(inside)
    if not count:
        return
    spacing = max(MOTION.min_corner_distance_px, math.sqrt(mask.size / count))
    for x, y in at[inside]:
        cv2.circle(mask, (int(x), int(y)), math.ceil(spacing), 0, cv2.FILLED)
    found = cv2.goodFeaturesToTrack(grey[region], count, MOTION.corner_quality, spacing, mask=mask)
    if found is not None:
        corners.add(np.asarray(found.reshape(-1, 2) + (left, top), np.float32))

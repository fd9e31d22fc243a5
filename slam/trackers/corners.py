"""Corner tracker: pyramidal Lucas-Kanade optical flow from frame to frame, in the virtual views of the sphere.

Needs no weights. Corners are tracked forward and backward; one that doesn't return to its start is lost. Images are
first brought to the same exposure, and the remaining difference is removed with the local mean (`exposure.py`). The
tracked position is aligned with the corner's first template (`patch_alignment.py`); if it doesn't match, the corner is
lost, too.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64, U8
from scan2sim.slam.optical_flow import exposure
from scan2sim.slam.optical_flow.patch_alignment import Patches
from scan2sim.slam.trackers import Tracks
from scan2sim.slam.virtual_cameras import VirtualViews

COARSE_WINDOW_PX, FINE_WINDOW_PX = 17, 9
"""Sides of the Lucas-Kanade windows. The large one survives large displacements; the small one is more accurate, as
less of it moves differently from its centre."""
PYRAMID_LEVELS = 4
FORWARD_BACKWARD_MAX_PX = 0.5
"""Greatest distance from its start of a corner tracked forward and backward."""
SPACING_PX = 12
"""Least distance between corners."""
EIGENVALUE_MIN = 3e-4
"""Least eigenvalue of a corner's gradient matrix, for grey values in 0 to 1."""
CELLS_ACROSS = 24
"""Number of grid cells per full width; corners are distributed evenly over the cells."""


def load(
    views: VirtualViews, mask: U8 | None, count: int, features: None = None, matcher: None = None
) -> CornerTracker:
    """See `slam.trackers.named`; features and matcher aren't used."""
    return CornerTracker(views, mask, count)


class CornerTracker:
    """See `slam.trackers.Tracker`."""

    STATE: tuple[str, ...] = ("tracks", "images", "_next_id", "_patches")

    def __init__(self, views: VirtualViews, mask: U8 | None, count: int) -> None:
        """`mask` (H, W): 0 where the car itself is visible; `count`: number of corners to track."""
        self.views, self.count = views, count
        self.tracks = Tracks()
        self._masks = None if mask is None else views.images(np.where(mask > 0, np.uint8(255), np.uint8(0)))
        self.images: list[U8] = []
        self._next_id = 0
        self._patches = Patches()

    def track(self, grey: U8, expected: F64 | None = None) -> float:
        """Track all features into the next frame; returns the share that was tracked.

        Args:
            grey: (H, W) next frame.
            expected: (N, 3) predicted bearings of the tracks.
        """
        images = self.views.images(grey)
        before, tracks = self.images, self.tracks
        self.images = images
        if not before or not len(tracks):
            return 0.0
        expected = tracks.bearing if expected is None else expected
        bearing = np.full_like(tracks.bearing, np.nan)
        view_of = self.views.view_of(tracks.bearing)
        for view in range(self.views.count):
            rows = np.flatnonzero(view_of == view)
            if len(rows):
                bearing[rows] = self._optical_flow(
                    view, before[view], images[view], tracks.bearing[rows], expected[rows]
                )
        bearing = self._aligned_with_templates(tracks.ids, bearing)
        found = np.isfinite(bearing[:, 0])
        self.tracks = Tracks(tracks.ids[found], bearing[found])
        return float(found.mean())

    def _optical_flow(self, view: int, old: U8, new: U8, bearing: F64, expected: F64) -> F64:
        """(N, 3) bearings in image `new` of features at bearings (N, 3) in image `old`; NaN: lost."""
        start, guess = self.views.pixels(view, bearing), self.views.pixels(view, expected)
        height, width = new.shape
        if view == 0 and not self.views.single:  # predict across the seam if that is shorter
            turn = float(self.views.camera.width)
            guess[:, 0] = start[:, 0] + (guess[:, 0] - start[:, 0] + turn / 2) % turn - turn / 2
        outside = ~(np.isfinite(guess).all(axis=1) & (guess >= 0).all(axis=1) & (guess < (width, height)).all(axis=1))
        guess[outside] = start[outside]
        equalized = exposure.estimate(old, new, start, guess).equalize(old, new)
        end, ok, _ = flow(*equalized, start, guess.copy(), COARSE_WINDOW_PX, PYRAMID_LEVELS)
        old, new = exposure.estimate(old, new, start, np.where(ok > 0, end, np.nan)).equalize(old, new)
        old, new = exposure.subtract_local_mean(old), exposure.subtract_local_mean(new)
        end, ok2, _ = flow(old, new, start, end, FINE_WINDOW_PX, 1)
        back, ok3, _ = flow(new, old, end, start.copy(), FINE_WINDOW_PX, 1)
        good = ((ok > 0) & (ok2 > 0) & (ok3 > 0)).ravel()
        good &= np.linalg.norm(back - start, axis=1) < FORWARD_BACKWARD_MAX_PX
        edge = COARSE_WINDOW_PX / 2
        good &= (end > edge).all(axis=1) & (end < (width - 1 - edge, height - 1 - edge)).all(axis=1)
        if self._masks is not None:
            pixel = end[good].astype(int)
            good[good] = self._masks[view][pixel[:, 1], pixel[:, 0]] > 0
        out = np.full((len(bearing), 3), np.nan)
        out[good] = self.views.bearings(view, end[good])
        return out

    def _aligned_with_templates(self, ids: I64, bearing: F64) -> F64:
        """(N, 3) tracked bearings refined by their templates; NaN where a feature is lost or doesn't match."""
        found = np.isfinite(bearing[:, 0])
        self._patches.keep(ids[found])
        out = np.full_like(bearing, np.nan)
        view_of = np.full(len(ids), -1)
        rows, known = self._patches.find(ids)
        view_of[known] = self._patches.view[rows[known]]
        for view, image in enumerate(self.images):
            here = np.flatnonzero(view_of == view)
            if len(here):
                uv = self.views.pixels(view, bearing[here])
                out[here] = self.views.bearings(view, self._patches.align(ids[here], view, image, uv))
        found = np.isfinite(out[:, 0])
        new_view_of = np.full(len(ids), -1)
        new_view_of[found] = self.views.view_of(out[found])
        for view, image in enumerate(self.images):
            entered = (new_view_of == view) & (view_of != view)
            if entered.any():
                self._patches.capture(ids[entered], view, image, self.views.pixels(view, out[entered]))
        return out

    def drop(self, ids: I64) -> None:
        """Stop tracking these ids."""
        self.tracks = self.tracks.keep(~np.isin(self.tracks.ids, ids))

    def refill(self) -> int:
        """Detect new corners where there are few tracks; returns how many were added."""
        candidates = [self._detect_corners(view) for view in range(self.views.count)]
        bearing = np.concatenate([b for b, _ in candidates])
        strength = np.concatenate([s for _, s in candidates])
        if not len(bearing):
            return 0
        cell = self.views.cell(bearing, CELLS_ACROSS)
        taken = np.bincount(self.views.cell(self.tracks.bearing, CELLS_ACROSS), minlength=cell.max() + 1)
        cells = len(np.union1d(np.unique(cell), np.flatnonzero(taken)))
        order = np.lexsort((-strength, cell))
        first = np.searchsorted(cell[order], cell[order])
        rank = np.arange(len(order)) - first + taken[cell[order]]
        per_cell = self.count / max(cells, 1)
        missing = self.count - len(self.tracks)
        chosen = order[np.argsort(rank, kind="stable")]
        ranks = np.sort(rank, kind="stable")
        chosen = chosen[ranks < 3 * per_cell][: max(missing, 0)]
        ids = self._next_id + np.arange(len(chosen))
        self._next_id += len(chosen)
        self.tracks = Tracks(
            np.concatenate([self.tracks.ids, ids]), np.concatenate([self.tracks.bearing, bearing[chosen]])
        )
        view_of = self.views.view_of(bearing[chosen])
        for view, image in enumerate(self.images):
            here = view_of == view
            if here.any():
                self._patches.capture(ids[here], view, image, self.views.pixels(view, bearing[chosen[here]]))
        return len(chosen)

    def _detect_corners(self, view: int) -> tuple[F64, F32]:
        """(N, 3) bearings of corners away from all tracks, and (N,) their strength."""
        import cv2

        image = self.images[view]
        mask = np.full(image.shape, 255, np.uint8) if self._masks is None else self._masks[view].copy()
        height, width = image.shape
        edge = COARSE_WINDOW_PX // 2 + 1
        mask[:edge], mask[-edge:], mask[:, :edge], mask[:, -edge:] = 0, 0, 0, 0
        for x, y in self.views.pixels(view, self.tracks.bearing):
            if 0 <= x < width and 0 <= y < height:
                cv2.circle(mask, (int(x), int(y)), SPACING_PX, 0, -1)
        found = cv2.goodFeaturesToTrack(image, 3 * self.count, 0.002, SPACING_PX, mask=mask, blockSize=5)
        if found is None:
            return np.zeros((0, 3)), np.zeros(0, np.float32)
        uv: F32 = np.asarray(found, np.float32).reshape(-1, 2)
        strength = np.linspace(1, 0, len(uv), dtype=np.float32)  # OpenCV returns the strongest first
        bearing = self.views.bearings(view, uv)
        ok = np.isfinite(bearing[:, 0])
        ok[ok] = self.views.view_of(bearing[ok]) == view
        return bearing[ok], strength[ok]


def flow(old: U8, new: U8, start: F32, guess: F32, window: int, levels: int) -> Any:
    """Lucas-Kanade: (N, 2) pixels in `new` of features at `start` in `old`, (N, 1) status, (N, 1) error."""
    import cv2

    return cv2.calcOpticalFlowPyrLK(
        old, new, start, guess, winSize=(window, window), maxLevel=levels, minEigThreshold=EIGENVALUE_MIN,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip

"""Corners, followed from frame to frame by pyramidal Lucas-Kanade, each in its facet of the sphere.

Needs no weights. A corner is followed there and back; one that doesn't return to where it was is lost. Pictures are
brought to one exposure before, and what is left of its change is taken out (`exposure.py`). What is found is laid onto
what the corner looked like at first (`patch_alignment.py`): a corner that looks otherwise is lost, too.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I64, U8
from scan2sim.slam.odometry import exposure
from scan2sim.slam.odometry.patch_alignment import Patches
from scan2sim.slam.odometry.virtual_cameras import Facets
from scan2sim.slam.trackers import Tracks

WINDOW, FINE = 17, 9
"""Pixels, of Lucas-Kanade's square: a large one finds a corner again, a small one says where it is: the larger
a square, the more of it moves otherwise than its centre."""
LEVELS = 4
RETURN = 0.5
"""Pixels within which a corner followed there and back must return."""
SPACING = 12
"""Pixels between corners."""
QUALITY = 3e-4
"""Smallest eigenvalue of a corner, of grey values in 0 to 1."""
ACROSS = 24
"""Cells a full width, between which corners are shared out evenly."""


def load(facets: Facets, mask: U8 | None, count: int, features: None = None, matcher: None = None) -> CornerTracker:
    """See `slam.trackers.named`; it needs no features."""
    return CornerTracker(facets, mask, count)


class CornerTracker:
    """See `slam.trackers.Tracker`."""

    STATE: tuple[str, ...] = ("tracks", "pictures", "_next", "_patches")

    def __init__(self, facets: Facets, mask: U8 | None, count: int) -> None:
        """`mask` (H, W): 0 where the car itself is; `count`: corners to keep alive."""
        self.facets, self.count = facets, count
        self.tracks = Tracks()
        self._masks = None if mask is None else facets.pictures(np.where(mask > 0, np.uint8(255), np.uint8(0)))
        self.pictures: list[U8] = []
        self._next = 0
        self._patches = Patches()

    def track(self, grey: U8, expected: F64 | None = None) -> float:
        """Follow all tracks into the next frame; returns the share that could be followed.

        Args:
            grey: (H, W).
            expected: (N, 3) bearings where they are probably seen now.
        """
        pictures = self.facets.pictures(grey)
        before, tracks = self.pictures, self.tracks
        self.pictures = pictures
        if not before or not len(tracks):
            return 0.0
        expected = tracks.bearing if expected is None else expected
        bearing = np.full_like(tracks.bearing, np.nan)
        facet_of = self.facets.place(tracks.bearing)
        for facet in range(self.facets.count):
            rows = np.flatnonzero(facet_of == facet)
            if len(rows):
                bearing[rows] = self._follow(
                    facet, before[facet], pictures[facet], tracks.bearing[rows], expected[rows]
                )
        bearing = self._laid(tracks.ids, bearing)
        found = np.isfinite(bearing[:, 0])
        self.tracks = Tracks(tracks.ids[found], bearing[found])
        return float(found.mean())

    def _follow(self, facet: int, old: U8, new: U8, bearing: F64, expected: F64) -> F64:
        start, guess = self.facets.pixels(facet, bearing), self.facets.pixels(facet, expected)
        height, width = new.shape
        if facet == 0 and not self.facets.whole:  # the shorter way round
            turn = float(self.facets.camera.width)
            guess[:, 0] = start[:, 0] + (guess[:, 0] - start[:, 0] + turn / 2) % turn - turn / 2
        away = ~(np.isfinite(guess).all(axis=1) & (guess >= 0).all(axis=1) & (guess < (width, height)).all(axis=1))
        guess[away] = start[away]
        alike = exposure.between(old, new, start, guess).alike(old, new)
        there, ok, _ = flow(*alike, start, guess.copy(), WINDOW, LEVELS)
        old, new = exposure.between(old, new, start, np.where(ok > 0, there, np.nan)).alike(old, new)
        old, new = exposure.level(old), exposure.level(new)
        there, ok2, _ = flow(old, new, start, there, FINE, 1)
        back, ok3, _ = flow(new, old, there, start.copy(), FINE, 1)
        good = ((ok > 0) & (ok2 > 0) & (ok3 > 0)).ravel() & (np.linalg.norm(back - start, axis=1) < RETURN)
        edge = WINDOW / 2
        good &= (there > edge).all(axis=1) & (there < (width - 1 - edge, height - 1 - edge)).all(axis=1)
        if self._masks is not None:
            at = there[good].astype(int)
            good[good] = self._masks[facet][at[:, 1], at[:, 0]] > 0
        out = np.full((len(bearing), 3), np.nan)
        out[good] = self.facets.bearings(facet, there[good])
        return out

    def _laid(self, ids: I64, bearing: F64) -> F64:
        """Bearings (N, 3) of features that have been followed to such, where they look as at first; NaN: they don't."""
        found = np.isfinite(bearing[:, 0])
        self._patches.keep(ids[found])
        out = np.full_like(bearing, np.nan)
        facet_of = np.full(len(ids), -1)
        rows, known = self._patches.find(ids)
        facet_of[known] = self._patches.facet[rows[known]]
        for facet, picture in enumerate(self.pictures):
            mine = np.flatnonzero(facet_of == facet)
            if len(mine):
                uv = self.facets.pixels(facet, bearing[mine])
                out[mine] = self.facets.bearings(facet, self._patches.lay(ids[mine], facet, picture, uv))
        found = np.isfinite(out[:, 0])
        goes_on = np.full(len(ids), -1)
        goes_on[found] = self.facets.place(out[found])
        for facet, picture in enumerate(self.pictures):
            come = (goes_on == facet) & (facet_of != facet)
            if come.any():
                self._patches.take(ids[come], facet, picture, self.facets.pixels(facet, out[come]))
        return out

    def drop(self, ids: I64) -> None:
        """Don't follow these any more."""
        self.tracks = self.tracks.keep(~np.isin(self.tracks.ids, ids))

    def refill(self) -> int:
        """Find corners where few are followed; how many."""
        fresh = [self._corners(facet) for facet in range(self.facets.count)]
        bearing = np.concatenate([b for b, _ in fresh])
        strength = np.concatenate([s for _, s in fresh])
        if not len(bearing):
            return 0
        cell = self.facets.cell(bearing, ACROSS)
        taken = np.bincount(self.facets.cell(self.tracks.bearing, ACROSS), minlength=cell.max() + 1)
        cells = len(np.union1d(np.unique(cell), np.flatnonzero(taken)))
        order = np.lexsort((-strength, cell))
        first = np.searchsorted(cell[order], cell[order])
        rank = np.arange(len(order)) - first + taken[cell[order]]
        share = self.count / max(cells, 1)
        room = self.count - len(self.tracks)
        chosen = order[np.argsort(rank, kind="stable")]
        ranks = np.sort(rank, kind="stable")
        chosen = chosen[ranks < 3 * share][: max(room, 0)]
        ids = self._next + np.arange(len(chosen))
        self._next += len(chosen)
        self.tracks = Tracks(
            np.concatenate([self.tracks.ids, ids]), np.concatenate([self.tracks.bearing, bearing[chosen]])
        )
        facet_of = self.facets.place(bearing[chosen])
        for facet, picture in enumerate(self.pictures):
            mine = facet_of == facet
            if mine.any():
                self._patches.take(ids[mine], facet, picture, self.facets.pixels(facet, bearing[chosen[mine]]))
        return len(chosen)

    def _corners(self, facet: int) -> tuple[F64, F32]:
        """(N, 3) bearings of corners away from all tracks, and how pronounced they are."""
        import cv2

        picture = self.pictures[facet]
        mask = np.full(picture.shape, 255, np.uint8) if self._masks is None else self._masks[facet].copy()
        height, width = picture.shape
        edge = WINDOW // 2 + 1
        mask[:edge], mask[-edge:], mask[:, :edge], mask[:, -edge:] = 0, 0, 0, 0
        for x, y in self.facets.pixels(facet, self.tracks.bearing):
            if 0 <= x < width and 0 <= y < height:
                cv2.circle(mask, (int(x), int(y)), SPACING, 0, -1)
        found = cv2.goodFeaturesToTrack(picture, 3 * self.count, 0.002, SPACING, mask=mask, blockSize=5)
        if found is None:
            return np.zeros((0, 3)), np.zeros(0, np.float32)
        uv: F32 = np.asarray(found, np.float32).reshape(-1, 2)
        strength = np.linspace(1, 0, len(uv), dtype=np.float32)  # they come strongest first
        bearing = self.facets.bearings(facet, uv)
        ok = np.isfinite(bearing[:, 0])
        ok[ok] = self.facets.place(bearing[ok]) == facet
        return bearing[ok], strength[ok]


def flow(old: U8, new: U8, start: F32, guess: F32, window: int, levels: int) -> Any:
    """Places in `new` of what is at `start` in `old`, whether found, and how well."""
    import cv2

    return cv2.calcOpticalFlowPyrLK(
        old, new, start, guess, winSize=(window, window), maxLevel=levels, minEigThreshold=QUALITY,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip

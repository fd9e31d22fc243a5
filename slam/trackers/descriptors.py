"""Descriptors: features found in every frame, matched with the last frame's, their identities handed on (D3.2, 4.1).

Only neighbouring frames are matched. A match says where Lucas-Kanade, with a small window, is to look for what the
track has been so far: places are as accurate as those of `slam.trackers.corners`, but a leap that it couldn't follow
is made. Facets overlap: a feature that moves from one into another is matched in the first and goes on in the second.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F32, F64, I64, U8, Bools
from scan2sim.slam.features import Features, Found
from scan2sim.slam.matchers import Matcher, check
from scan2sim.slam.odometry import exposure
from scan2sim.slam.odometry.virtual_cameras import Facets
from scan2sim.slam.trackers import Tracker, Tracks
from scan2sim.slam.trackers.corners import FINE, RETURN, SPACING, WINDOW, CornerTracker, flow

STRAY = 4.0
"""Pixels between where a feature was matched and where Lucas-Kanade finds it."""
SAME = 2.0
"""Pixels within which a feature that two facets show is the same."""
AWAY = np.radians(15)
"""A match farther from where it was expected, and than most are, is wrong."""


@dataclass
class SeenInFacet:
    """Features of a facet, those beyond its border included, and ids (N,) of the tracks that they are; -1: of none."""

    found: Found
    ids: I64

    def add(self, uv: F32, descriptors: npt.NDArray[Any], ids: I64) -> None:
        """Features (M, 2) that weren't found here."""
        f = self.found
        scores = np.full(len(ids), f.scores.min(initial=1.0), np.float32)
        self.found = Found(
            np.vstack([f.uv, uv]), np.vstack([f.descriptors, descriptors]), np.concatenate([f.scores, scores])
        )
        self.ids = np.concatenate([self.ids, ids])


def load(facets: Facets, mask: U8 | None, count: int, features: Features | None, matcher: Matcher | None) -> Tracker:
    """See `slam.trackers.named`.

    Raises:
        SettingError: features or matcher are missing, or not made for each other.
    """
    if features is None or matcher is None:
        raise SettingError("track.features", "descriptors need features and a matcher", "Name both")
    return DescriptorTracker(facets, mask, count, features, matcher)


class DescriptorTracker(CornerTracker):
    """See `slam.trackers.Tracker`; what isn't matched is followed as corners are."""

    STATE = (*CornerTracker.STATE, "_seen")

    def __init__(
        self,
        facets: Facets,
        mask: U8 | None,
        count: int,
        features: Features,
        matcher: Matcher,
        *,
        bridge: bool = True,
    ) -> None:
        """Begin.

        Args:
            facets: of the frames.
            mask: (H, W), 0 where the car itself is.
            count: features to keep alive.
            features: backend that finds them.
            matcher: backend that matches them.
            bridge: a track that isn't found again, or not matched, is followed as corners are. Without, tracks are
                short: of ORB's corners, a third survives a frame.

        Raises:
            SettingError: the matcher wasn't made for these features.
        """
        super().__init__(facets, mask, count)
        check(features, matcher)
        self.features, self.matcher, self.bridge = features, matcher, bridge
        self._seen: list[SeenInFacet] = []

    def track(self, grey: U8, expected: F64 | None = None) -> float:
        """See `CornerTracker.track`."""
        old, before, tracks = self.pictures, self._seen, self.tracks
        self.pictures = self.facets.pictures(grey)
        self._seen = [self._detect(facet) for facet in range(self.facets.count)]
        if not old or not len(tracks):
            return 0.0
        expected = tracks.bearing if expected is None else expected
        bearing = np.full_like(tracks.bearing, np.nan)
        known: dict[int, npt.NDArray[Any]] = {}  # rows of tracks to their descriptors
        row_of = {int(track): row for row, track in enumerate(tracks.ids)}
        for facet, was in enumerate(before):
            at = np.array([row_of.get(int(track), -1) for track in was.ids], np.int64)
            alive = np.flatnonzero(at >= 0)
            known |= zip(at[alive].tolist(), was.found.descriptors[alive], strict=True)
            pairs = self._match(facet, was.found)
            pairs = pairs[at[pairs[:, 0]] >= 0]
            rows, features = at[pairs[:, 0]], pairs[:, 1]
            good = self._likely(self.facets.bearings(facet, self._seen[facet].found.uv[features]), expected[rows])
            rows, features = rows[good], features[good]
            there, good = self._refined(facet, old[facet], tracks.bearing[rows], features)
            rows, features = rows[good], features[good]
            bearing[rows] = self.facets.bearings(facet, there[good])
            self._seen[facet].ids[features] = tracks.ids[rows]
            known |= zip(rows.tolist(), self._seen[facet].found.descriptors[features], strict=True)
        if self.bridge:
            lost = np.isnan(bearing[:, 0])
            facet_of = self.facets.place(tracks.bearing)
            for facet in range(self.facets.count):
                rows = np.flatnonzero(lost & (facet_of == facet))
                if len(rows):
                    bearing[rows] = self._follow(
                        facet, old[facet], self.pictures[facet], tracks.bearing[rows], expected[rows]
                    )
        bearing = self._laid(tracks.ids, bearing)
        found = np.flatnonzero(np.isfinite(bearing[:, 0]))
        self.tracks = Tracks(tracks.ids[found], bearing[found])
        self._settle([known[row] for row in found.tolist()])
        return len(found) / len(tracks)

    def refill(self) -> int:
        """See `CornerTracker.refill`."""
        from scipy.spatial import cKDTree

        for seen in self._seen:
            seen.ids[~np.isin(seen.ids, self.tracks.ids)] = -1
        first, count = self._next, super().refill()
        fresh = self.tracks.ids >= first
        facet_of = self.facets.place(self.tracks.bearing)
        for facet, seen in enumerate(self._seen):
            rows = np.flatnonzero(fresh & (facet_of == facet))
            if len(rows):
                bearing = self.facets.bearings(facet, seen.found.uv)
                free = np.flatnonzero((seen.ids < 0) & np.isfinite(bearing[:, 0]))
                _, which = cKDTree(bearing[free]).query(self.tracks.bearing[rows])
                seen.ids[free[which]] = self.tracks.ids[rows]
        return count

    def _detect(self, facet: int) -> SeenInFacet:
        found = self.features.detect(self.pictures[facet], None if self._masks is None else self._masks[facet])
        return SeenInFacet(found, np.full(len(found.uv), -1, np.int64))

    def _match(self, facet: int, was: Found) -> I64:
        height, width = self.pictures[facet].shape
        size = width, height
        return self.matcher.match(was, self._seen[facet].found, (size, size))

    def _likely(self, bearing: F64, expected: F64) -> Bools:
        """(N,) matches that are near where they were expected, or at least not much farther than others."""
        if not len(bearing):
            return np.zeros(0, bool)
        away = np.arccos(np.clip(np.einsum("ij,ij->i", bearing, expected), -1, 1))
        return np.isfinite(away) & (away < max(AWAY, 3 * float(np.nanmedian(away))))

    def _refined(self, facet: int, old: U8, bearing: F64, features: I64) -> tuple[F32, Bools]:
        """Places (N, 2) near matched features of what `old` showed at bearings (N, 3), and whether they are sure."""
        new, guess = self.pictures[facet], np.ascontiguousarray(self._seen[facet].found.uv[features])
        start = self.facets.pixels(facet, bearing)
        good = np.asarray(np.isfinite(start).all(axis=1))
        if not good.any():
            return guess, good
        start[~good] = 0
        old, new = exposure.between(old, new, start, guess).alike(old, new)
        there, ok, _ = flow(old, new, start, guess.copy(), FINE, 1)
        back, ok2, _ = flow(new, old, there, start.copy(), FINE, 1)
        good &= ((ok > 0) & (ok2 > 0)).ravel() & (np.linalg.norm(back - start, axis=1) < RETURN)
        good &= np.linalg.norm(there - guess, axis=1) < STRAY
        edge = WINDOW / 2
        height, width = new.shape
        good &= (there > edge).all(axis=1) & (there < (width - 1 - edge, height - 1 - edge)).all(axis=1)
        if self._masks is not None:
            at = there[good].astype(int)
            good[good] = self._masks[facet][at[:, 1], at[:, 0]] > 0
        return there, good

    def _settle(self, descriptors: list[npt.NDArray[Any]]) -> None:
        """Every track is a feature of the facet where it goes on: the one it was matched with, or one that is there.

        Where there is none, the track's last descriptor is taken on.
        """
        from scipy.spatial import cKDTree

        goes_on = self.facets.place(self.tracks.bearing)
        for facet, seen in enumerate(self._seen):
            rows = np.flatnonzero(goes_on == facet)
            seen.ids[~np.isin(seen.ids, self.tracks.ids[rows])] = -1  # gone to other facets
            rows = rows[~np.isin(self.tracks.ids[rows], seen.ids)]
            free = np.flatnonzero(seen.ids < 0)
            if not len(rows):
                continue
            uv = self.facets.pixels(facet, self.tracks.bearing[rows])
            near = np.full(len(rows), -1)
            if len(free):
                away, which = cKDTree(seen.found.uv[free]).query(uv)
                near[away < SAME] = free[which[away < SAME]]
            _, first = np.unique(near, return_index=True)
            taken = np.zeros(len(rows), bool)
            taken[first] = near[first] >= 0
            seen.ids[near[taken]] = self.tracks.ids[rows[taken]]
            if not taken.all():
                rest = rows[~taken]
                seen.add(uv[~taken], np.stack([descriptors[row] for row in rest]), self.tracks.ids[rest])

    def _corners(self, facet: int) -> tuple[F64, F32]:
        """See `CornerTracker._corners`: features instead, the strongest of those that are near each other."""
        from scipy.spatial import cKDTree

        seen = self._seen[facet]
        bearing = self.facets.bearings(facet, seen.found.uv)
        height, width = self.pictures[facet].shape
        edge = WINDOW / 2 + 1
        good = (seen.ids < 0) & np.isfinite(bearing[:, 0])
        good &= ((seen.found.uv > edge) & (seen.found.uv < (width - 1 - edge, height - 1 - edge))).all(axis=1)
        good[good] = self.facets.place(bearing[good]) == facet
        spacing = SPACING * self.facets.pixel
        if good.any() and len(self.tracks):
            good[good] = cKDTree(self.tracks.bearing).query(bearing[good])[0] > spacing
        bearing = bearing[good]
        order = np.argsort(-seen.found.scores[good], kind="stable")
        bearing = bearing[order]
        if len(bearing) > 1:
            near = cKDTree(bearing).query_pairs(spacing / 2, output_type="ndarray")
            bearing = np.delete(bearing, near.max(axis=1), axis=0)
        return bearing, np.linspace(1, 0, len(bearing), dtype=np.float32)

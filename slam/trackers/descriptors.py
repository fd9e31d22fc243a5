"""Descriptor tracker: detects features in every frame and matches them with those of the last frame (D3.2, 4.1).

Only consecutive frames are matched. A match initializes Lucas-Kanade with a small window: positions are as accurate as
those of `slam.trackers.corners`, but displacements too large for optical flow are tracked, too. Virtual views overlap:
a feature that moves from one view into another is matched in the first and continues in the second.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F32, F64, I64, U8, Bools
from scan2sim.slam.features import Features, FeatureSet
from scan2sim.slam.matchers import Matcher, check
from scan2sim.slam.optical_flow import exposure
from scan2sim.slam.trackers import Tracker, Tracks
from scan2sim.slam.trackers.corners import (
    COARSE_WINDOW_PX,
    FINE_WINDOW_PX,
    FORWARD_BACKWARD_MAX_PX,
    SPACING_PX,
    CornerTracker,
    flow,
)
from scan2sim.slam.virtual_cameras import VirtualViews

REFINEMENT_MAX_PX = 4.0
"""Greatest distance between a matched feature and its refinement by Lucas-Kanade."""
SAME_FEATURE_PX = 2.0
"""Distance within which features of two overlapping views are the same."""
PREDICTION_ERROR_MAX = np.radians(15)
"""Matches farther from their predicted bearing than this, and than three times the median, are rejected, radians."""


@dataclass
class ViewFeatures:
    """Features of a virtual view, including its overlap, and ids (N,) of their tracks; -1: none."""

    found: FeatureSet
    ids: I64

    def add(self, uv: F32, descriptors: npt.NDArray[Any], ids: I64) -> None:
        """Add tracks at pixels (M, 2) that weren't detected in this view, with the least score."""
        f = self.found
        scores = np.full(len(ids), f.scores.min(initial=1.0), np.float32)
        self.found = FeatureSet(
            np.vstack([f.uv, uv]), np.vstack([f.descriptors, descriptors]), np.concatenate([f.scores, scores])
        )
        self.ids = np.concatenate([self.ids, ids])


def load(
    views: VirtualViews, mask: U8 | None, count: int, features: Features | None, matcher: Matcher | None
) -> Tracker:
    """See `slam.trackers.named`.

    Raises:
        SettingError: features or matcher are missing, or don't fit each other.
    """
    if features is None or matcher is None:
        raise SettingError("track.features", "the descriptor tracker needs features and a matcher", "Set both")
    return DescriptorTracker(views, mask, count, features, matcher)


class DescriptorTracker(CornerTracker):
    """See `slam.trackers.Tracker`; unmatched tracks are tracked by optical flow as in `CornerTracker`."""

    STATE = (*CornerTracker.STATE, "_features")

    def __init__(
        self,
        views: VirtualViews,
        mask: U8 | None,
        count: int,
        features: Features,
        matcher: Matcher,
        *,
        flow_unmatched: bool = True,
    ) -> None:
        """Tracker before its first frame.

        Args:
            views: virtual views of the frames.
            mask: (H, W) ego-vehicle mask, 0 where the car itself is visible.
            count: number of features to track.
            features: detector backend.
            matcher: matcher backend.
            flow_unmatched: track features that weren't detected again, or not matched, by optical flow. Without it,
                tracks are short: only a third of ORB's corners survives a frame.

        Raises:
            SettingError: the matcher doesn't fit these features.
        """
        super().__init__(views, mask, count)
        check(features, matcher)
        self.features, self.matcher, self.flow_unmatched = features, matcher, flow_unmatched
        self._features: list[ViewFeatures] = []

    def track(self, grey: U8, expected: F64 | None = None) -> float:
        """See `CornerTracker.track`."""
        old, before, tracks = self.images, self._features, self.tracks
        self.images = self.views.images(grey)
        self._features = [self._detect(view) for view in range(self.views.count)]
        if not old or not len(tracks):
            return 0.0
        expected = tracks.bearing if expected is None else expected
        bearing = np.full_like(tracks.bearing, np.nan)
        descriptors: dict[int, npt.NDArray[Any]] = {}  # by row of the track
        row_of = {int(track): row for row, track in enumerate(tracks.ids)}
        for view, last in enumerate(before):
            track_row = np.array([row_of.get(int(track), -1) for track in last.ids], np.int64)
            alive = np.flatnonzero(track_row >= 0)
            descriptors |= zip(track_row[alive].tolist(), last.found.descriptors[alive], strict=True)
            pairs = self._match(view, last.found)
            pairs = pairs[track_row[pairs[:, 0]] >= 0]
            rows, features = track_row[pairs[:, 0]], pairs[:, 1]
            good = self._near_prediction(
                self.views.bearings(view, self._features[view].found.uv[features]), expected[rows]
            )
            rows, features = rows[good], features[good]
            refined, good = self._refined(view, old[view], tracks.bearing[rows], features)
            rows, features = rows[good], features[good]
            bearing[rows] = self.views.bearings(view, refined[good])
            self._features[view].ids[features] = tracks.ids[rows]
            descriptors |= zip(rows.tolist(), self._features[view].found.descriptors[features], strict=True)
        if self.flow_unmatched:
            unmatched = np.isnan(bearing[:, 0])
            view_of = self.views.view_of(tracks.bearing)
            for view in range(self.views.count):
                rows = np.flatnonzero(unmatched & (view_of == view))
                if len(rows):
                    bearing[rows] = self._optical_flow(
                        view, old[view], self.images[view], tracks.bearing[rows], expected[rows]
                    )
        bearing = self._aligned_with_templates(tracks.ids, bearing)
        found = np.flatnonzero(np.isfinite(bearing[:, 0]))
        self.tracks = Tracks(tracks.ids[found], bearing[found])
        self._assign_to_views([descriptors[row] for row in found.tolist()])
        return len(found) / len(tracks)

    def refill(self) -> int:
        """See `CornerTracker.refill`."""
        from scipy.spatial import cKDTree

        for seen in self._features:
            seen.ids[~np.isin(seen.ids, self.tracks.ids)] = -1
        first, count = self._next_id, super().refill()
        new = self.tracks.ids >= first
        view_of = self.views.view_of(self.tracks.bearing)
        for view, seen in enumerate(self._features):
            rows = np.flatnonzero(new & (view_of == view))
            if len(rows):
                bearing = self.views.bearings(view, seen.found.uv)
                free = np.flatnonzero((seen.ids < 0) & np.isfinite(bearing[:, 0]))
                _, which = cKDTree(bearing[free]).query(self.tracks.bearing[rows])
                seen.ids[free[which]] = self.tracks.ids[rows]
        return count

    def _detect(self, view: int) -> ViewFeatures:
        found = self.features.detect(self.images[view], None if self._masks is None else self._masks[view])
        return ViewFeatures(found, np.full(len(found.uv), -1, np.int64))

    def _match(self, view: int, last: FeatureSet) -> I64:
        height, width = self.images[view].shape
        size = width, height
        return self.matcher.match(last, self._features[view].found, (size, size))

    def _near_prediction(self, bearing: F64, expected: F64) -> Bools:
        """(N,) whether matches are near their predicted bearing, or not much farther from it than the median."""
        if not len(bearing):
            return np.zeros(0, bool)
        error = np.arccos(np.clip(np.einsum("ij,ij->i", bearing, expected), -1, 1))
        return np.isfinite(error) & (error < max(PREDICTION_ERROR_MAX, 3 * float(np.nanmedian(error))))

    def _refined(self, view: int, old: U8, bearing: F64, features: I64) -> tuple[F32, Bools]:
        """Pixels (N, 2) of matched features, refined by Lucas-Kanade from image `old`, and whether that succeeded.

        Args:
            view: index of the virtual view.
            old: its previous image.
            bearing: (N, 3) bearings of the features in `old`.
            features: (N,) rows of the matched features in the current image.
        """
        new, guess = self.images[view], np.ascontiguousarray(self._features[view].found.uv[features])
        start = self.views.pixels(view, bearing)
        good = np.asarray(np.isfinite(start).all(axis=1))
        if not good.any():
            return guess, good
        start[~good] = 0
        old, new = exposure.estimate(old, new, start, guess).equalize(old, new)
        end, ok, _ = flow(old, new, start, guess.copy(), FINE_WINDOW_PX, 1)
        back, ok2, _ = flow(new, old, end, start.copy(), FINE_WINDOW_PX, 1)
        good &= ((ok > 0) & (ok2 > 0)).ravel() & (np.linalg.norm(back - start, axis=1) < FORWARD_BACKWARD_MAX_PX)
        good &= np.linalg.norm(end - guess, axis=1) < REFINEMENT_MAX_PX
        edge = COARSE_WINDOW_PX / 2
        height, width = new.shape
        good &= (end > edge).all(axis=1) & (end < (width - 1 - edge, height - 1 - edge)).all(axis=1)
        if self._masks is not None:
            pixel = end[good].astype(int)
            good[good] = self._masks[view][pixel[:, 1], pixel[:, 0]] > 0
        return end, good

    def _assign_to_views(self, descriptors: list[npt.NDArray[Any]]) -> None:
        """Assign every track to a feature of the view in which it continues: its match, or the nearest free feature.

        If there is none, a feature with the track's last descriptor is added.
        """
        from scipy.spatial import cKDTree

        view_of = self.views.view_of(self.tracks.bearing)
        for view, seen in enumerate(self._features):
            rows = np.flatnonzero(view_of == view)
            seen.ids[~np.isin(seen.ids, self.tracks.ids[rows])] = -1  # they continue in other views
            rows = rows[~np.isin(self.tracks.ids[rows], seen.ids)]
            free = np.flatnonzero(seen.ids < 0)
            if not len(rows):
                continue
            uv = self.views.pixels(view, self.tracks.bearing[rows])
            nearest = np.full(len(rows), -1)
            if len(free):
                distance, which = cKDTree(seen.found.uv[free]).query(uv)
                nearest[distance < SAME_FEATURE_PX] = free[which[distance < SAME_FEATURE_PX]]
            _, first = np.unique(nearest, return_index=True)
            assigned = np.zeros(len(rows), bool)
            assigned[first] = nearest[first] >= 0
            seen.ids[nearest[assigned]] = self.tracks.ids[rows[assigned]]
            if not assigned.all():
                rest = rows[~assigned]
                seen.add(uv[~assigned], np.stack([descriptors[row] for row in rest]), self.tracks.ids[rest])

    def _detect_corners(self, view: int) -> tuple[F64, F32]:
        """See `CornerTracker._detect_corners`: the view's detected features, thinned to the strongest nearby."""
        from scipy.spatial import cKDTree

        seen = self._features[view]
        bearing = self.views.bearings(view, seen.found.uv)
        height, width = self.images[view].shape
        edge = COARSE_WINDOW_PX / 2 + 1
        good = (seen.ids < 0) & np.isfinite(bearing[:, 0])
        good &= ((seen.found.uv > edge) & (seen.found.uv < (width - 1 - edge, height - 1 - edge))).all(axis=1)
        good[good] = self.views.view_of(bearing[good]) == view
        spacing = SPACING_PX * self.views.pixel
        if good.any() and len(self.tracks):
            good[good] = cKDTree(self.tracks.bearing).query(bearing[good])[0] > spacing
        bearing = bearing[good]
        order = np.argsort(-seen.found.scores[good], kind="stable")
        bearing = bearing[order]
        if len(bearing) > 1:
            near = cKDTree(bearing).query_pairs(spacing / 2, output_type="ndarray")
            bearing = np.delete(bearing, near.max(axis=1), axis=0)
        return bearing, np.linspace(1, 0, len(bearing), dtype=np.float32)

"""Detections of a source's images joined to tracks: ByteTrack (Zhang et al., 2022), as the library `trackers` has it.

Tracks begin with detections that are sure, and go on with fainter ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from scan2sim.pipeline.core import optional_deps
from scan2sim.services.toolboxes.results import Detection

NEEDS = ("trackers", "supervision")
PROVEN = 2
"""Images in a row that a thing must be detected in before it has a track."""
OVERLAP = 0.2
"""Intersection over union with where a thing was expected, from which a detection is of that thing."""
REFERENCE_RATE = 30.0
"""Images a second at which the library's lost tracks are counted by images, whatever the source's rate."""


class Tracker:
    """Follows things through the images of one source."""

    def __init__(self, sure: float, lost: float, rate: float) -> None:
        """Begin.

        Args:
            sure: score from which a detection begins a track; fainter ones go on with one.
            lost: seconds for which a track is kept that isn't detected.
            rate: images a second, about.
        """
        optional_deps.need("following things", *NEEDS)
        from trackers import ByteTrackTracker

        self._tracker: Any = ByteTrackTracker(
            lost_track_buffer=max(1, math.ceil(lost * rate)),
            frame_rate=REFERENCE_RATE,
            minimum_consecutive_frames=PROVEN,
            minimum_iou_threshold=OVERLAP,
            track_activation_threshold=sure,
            high_conf_det_threshold=sure,
        )
        self._numbers: dict[int, int] = {}

    def update(self, detections: Sequence[Detection]) -> list[int | None]:
        """The track's number of each detection of the next image; None: it has none yet."""
        import supervision

        found = self._tracker.update(
            supervision.Detections(
                xyxy=np.array([one.box for one in detections], np.float64).reshape(-1, 4),
                confidence=np.array([one.score for one in detections], np.float64),
                class_id=np.arange(len(detections)),  # the library drops nothing, but says no order
            )
        )
        ids: list[int | None] = [None] * len(detections)
        for place, track in zip(found.class_id, found.tracker_id, strict=True):
            if track >= 0:
                # the library counts through all sources' tracks
                ids[int(place)] = self._numbers.setdefault(int(track), len(self._numbers) + 1)
        return ids

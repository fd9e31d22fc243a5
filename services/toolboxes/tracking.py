"""Multi-object tracking of a source's detections: ByteTrack (Zhang et al., 2022) of the library `trackers`.

Tracks start with detections of high score and continue with detections of lower score.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from scan2sim.pipeline.core import optional_deps
from scan2sim.services.toolboxes.results import Detection

NEEDS = ("trackers", "supervision")
MIN_CONSECUTIVE_IMAGES = 2
"""Consecutive images in which an object must be detected before it gets a track."""
MIN_IOU = 0.2
"""Minimum intersection over union of a detection with the predicted box of a track."""
REFERENCE_RATE_HZ = 30.0
"""Frame rate at which the library's lost-track buffer is counted in images, whatever the source's rate."""


class Tracker:
    """Tracks the objects of one source."""

    def __init__(self, activation_score: float, lost_s: float, rate: float) -> None:
        """Create an empty tracker.

        Args:
            activation_score: minimum score to start a track; detections with lower scores only continue tracks.
            lost_s: seconds for which a track without detections is kept.
            rate: approximate frame rate of the source in Hz.
        """
        optional_deps.require("tracking objects", *NEEDS)
        from trackers import ByteTrackTracker

        self._tracker: Any = ByteTrackTracker(
            lost_track_buffer=max(1, math.ceil(lost_s * rate)),
            frame_rate=REFERENCE_RATE_HZ,
            minimum_consecutive_frames=MIN_CONSECUTIVE_IMAGES,
            minimum_iou_threshold=MIN_IOU,
            track_activation_threshold=activation_score,
            high_conf_det_threshold=activation_score,
        )
        self._numbers: dict[int, int] = {}

    def update(self, detections: Sequence[Detection]) -> list[int | None]:
        """Track number of each detection in the next image; None: no track yet."""
        import supervision

        found = self._tracker.update(
            supervision.Detections(
                xyxy=np.array([one.box for one in detections], np.float64).reshape(-1, 4),
                confidence=np.array([one.score for one in detections], np.float64),
                class_id=np.arange(len(detections)),  # index: the library doesn't preserve the order
            )
        )
        ids: list[int | None] = [None] * len(detections)
        for index, track in zip(found.class_id, found.tracker_id, strict=True):
            if track >= 0:
                # the library numbers the tracks of all sources together
                ids[int(index)] = self._numbers.setdefault(int(track), len(self._numbers) + 1)
        return ids

"""Detection of moving objects (D3.2, section 5.2): detector, multi-object tracker, and sparse optical flow.

Detections of low score continue tracks that started with a high score; an object that the detector misses is tracked by
the optical flow of its corners.

The camera must be stationary: the motion of a moving camera can't be separated from that of the objects. A vehicle's
camera is switched to standby and back through the HTTP API.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes import drawing, tracking
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.iou import iou_matrix
from scan2sim.services.toolboxes.motion import MotionDetector
from scan2sim.services.toolboxes.results import Body, Detection, Moving
from scan2sim.services.toolboxes.settings import Batch, Deadline, Waiting
from scan2sim.services.toolboxes.tasks import Model, PostProcessor, detect
from scan2sim.services.toolboxes.tracking import Tracker

NEEDS = (*detect.NEEDS, *tracking.NEEDS)
DUPLICATE_IOU = 0.5
"""Two detections with a larger intersection over union are the same object, whatever their classes."""
TAKEN_OVER_IOU = 0.3
"""A missed object with a larger intersection over union with a detected one has been taken over by its track."""


class Params(detect.Params):
    """Settings of the motion detection."""

    batch: Batch = 4
    waiting: Waiting = 8
    deadline: Deadline = 5.0
    threshold: Annotated[float, Field(ge=0.01, le=1, description="Minimum score of a track's first detection.")] = 0.25
    rate: Annotated[float, Field(ge=0.1, le=1000, description="Approximate frame rate of a source in Hz.")] = 25.0
    faint: Annotated[
        float,
        Field(ge=0.01, le=1, description="Minimum score of a detection that continues a track; below --threshold."),
    ] = 0.1
    lost: Annotated[float, Field(ge=0, le=60, description="Seconds for which a track without detections is kept.")] = (
        1.0
    )


def check(params: Params) -> None:
    """See `tasks.Toolbox`."""
    detect.check(params)


def load(params: Params) -> Model:
    """Load the detector with the lower of the two score thresholds (`tasks.Toolbox`)."""
    return detect.load(params.model_copy(update={"threshold": min(params.faint, params.threshold)}))


def post_processor(params: Params) -> PostProcessor | None:
    """Tracker and motion detector of one source."""
    return _MovementTracker(params)


def draw(image: U8, body: Body) -> U8:
    """Draw the boxes of the objects and whether they move."""
    return drawing.detections(image, body.detections or ())


def _without_duplicates(detections: Sequence[Detection]) -> list[Detection]:
    """Class-agnostic non-maximum suppression; detections by descending score."""
    kept: list[Detection] = []
    for one in sorted(detections, key=lambda one: -one.score):
        if not (iou_matrix([one.box], [other.box for other in kept]) > DUPLICATE_IOU).any():
            kept.append(one)
    return kept


class _MovementTracker:
    """Tracks the objects of one source and detects whether they move."""

    def __init__(self, params: Params) -> None:
        self._threshold = params.threshold
        self._tracker = Tracker(params.threshold, params.lost, params.rate)
        self._motion_detector = MotionDetector(params.lost)
        self._known: dict[int, Detection] = {}

    def __call__(self, frame: Frame, image: U8, body: Body) -> Body:
        """Objects with a track: those detected in this image, and those missed but detected recently."""
        found = _without_duplicates(body.detections or ())
        tracks = self._tracker.update(found)
        seconds = frame.received if frame.stamp is None else frame.stamp / 1e9
        tracked = {track: one for track, one in zip(tracks, found, strict=True) if track is not None}
        motions = self._motion_detector.update(image, seconds, tracked)
        self._known = {track: one for track, one in (self._known | tracked).items() if track in motions}
        missed = {track: self._missed(track, image) for track in motions if track not in tracked}
        boxes = [one.box for one in tracked.values()]
        tracked |= {
            track: one for track, one in missed.items() if not (iou_matrix([one.box], boxes) > TAKEN_OVER_IOU).any()
        }
        return Body(
            threshold=self._threshold,
            detections=tuple(
                Moving(
                    **one.model_dump(),
                    track=track,
                    moving=motions[track].moving,
                    speed=motions[track].speed,
                    detected=track not in missed,
                )
                for track, one in tracked.items()
            ),
        )

    def _missed(self, track: int, image: U8) -> Detection:
        """An object that the detector missed, with the box given by its tracked corners."""
        height, width = image.shape[:2]
        left, top, right, bottom = self._motion_detector.box(track)
        box = (max(left, 0.0), max(top, 0.0), min(right, float(width)), min(bottom, float(height)))
        return self._known[track].model_copy(update={"box": tuple(round(side, 1) for side in box)})

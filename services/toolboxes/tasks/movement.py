"""Detection of things that move (D3.2, section 5.2): a detector, a tracker, and optical flow of corners.

The detector's faint detections go on with what was found for sure, and what it misses is where its corners went.

The camera must stand while it looks: of one that drives, nobody can say whether it or the thing moves. It is stopped
(standby) and started again by the interface that serves it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes import drawing, tracking
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.iou import overlaps
from scan2sim.services.toolboxes.motion import Flow
from scan2sim.services.toolboxes.results import Body, Detection, Moving
from scan2sim.services.toolboxes.settings import Batch, Deadline, Waiting
from scan2sim.services.toolboxes.tasks import Follow, Model, detect
from scan2sim.services.toolboxes.tracking import Tracker

NEEDS = (*detect.NEEDS, *tracking.NEEDS)
TWICE = 0.5
"""Intersection over union from which two detections are of one thing, of whatever class."""
SAME = 0.3
"""Intersection over union with a detection from which a thing that was missed is another track's now."""


class Params(detect.Params):
    """Of detection with movement."""

    batch: Batch = 4
    waiting: Waiting = 8
    deadline: Deadline = 5.0
    rate: Annotated[float, Field(ge=0.1, le=1000, description="Images a second of a source, about.")] = 25.0
    faint: Annotated[
        float, Field(ge=0.01, le=1, description="Score from which a detection continues a track, below --threshold.")
    ] = 0.1
    lost: Annotated[
        float, Field(ge=0, le=60, description="Seconds for which a thing that isn't detected keeps its track.")
    ] = 1.0


def check(params: Params) -> None:
    """See `boxes.Toolbox`."""
    detect.check(params)


def load(params: Params) -> Model:
    """The model (`boxes.Toolbox`): the detector's, with faint detections."""
    return detect.load(params.model_copy(update={"threshold": min(params.faint, params.threshold)}))


def follow(params: Params) -> Follow | None:
    """A tracker and optical flow for each source."""
    return _Follower(params)


def draw(image: U8, body: Body) -> U8:
    """With the things' boxes, and whether they move."""
    return drawing.detections(image, body.detections or ())


def _apart(things: Sequence[Detection]) -> list[Detection]:
    """Of those whose boxes are nearly the same, whatever they are called, the surest one; the surest first."""
    kept: list[Detection] = []
    for one in sorted(things, key=lambda one: -one.score):
        if not (overlaps([one.box], [other.box for other in kept]) > TWICE).any():
            kept.append(one)
    return kept


class _Follower:
    """Tracks one source's things, and says whether they move."""

    def __init__(self, params: Params) -> None:
        self._tracker, self._flow = Tracker(params.threshold, params.lost, params.rate), Flow(params.lost)
        self._known: dict[int, Detection] = {}

    def __call__(self, frame: Frame, image: U8, body: Body) -> Body:
        """Things that have a track, with it: those detected here, and those that were a moment ago."""
        found = _apart(body.detections or ())
        tracks = self._tracker.update(found)
        seconds = frame.received if frame.stamp is None else frame.stamp / 1e9
        followed = {track: one for track, one in zip(tracks, found, strict=True) if track is not None}
        motions = self._flow.update(image, seconds, followed)
        self._known = {track: one for track, one in (self._known | followed).items() if track in motions}
        missed = {track: self._missed(track, image) for track in motions if track not in followed}
        here = [one.box for one in followed.values()]
        followed |= {track: one for track, one in missed.items() if not (overlaps([one.box], here) > SAME).any()}
        return Body(
            detections=tuple(
                Moving(
                    **one.model_dump(),
                    track=track,
                    moving=motions[track].moving,
                    speed=motions[track].speed,
                    detected=track not in missed,
                )
                for track, one in followed.items()
            )
        )

    def _missed(self, track: int, image: U8) -> Detection:
        """A thing that the detector missed, where its corners went."""
        height, width = image.shape[:2]
        left, top, right, bottom = self._flow.box(track)
        box = (max(left, 0.0), max(top, 0.0), min(right, float(width)), min(bottom, float(height)))
        return self._known[track].model_copy(update={"box": tuple(round(side, 1) for side in box)})

"""The lane that an actor drives in, and the room that it has there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.roads.lanes import sections
from scan2sim.pipeline.roads.model import Road, surface
from scan2sim.pipeline.tracking.tracks import Track

MIN_ALIGNMENT = 0.9
"""Cosine of the angle between an actor and its lane."""


@dataclass(frozen=True)
class LaneRoom:
    """Where an actor is on a road.

    Attributes:
        road: the road.
        s, t: (T,) chainages and offsets of its poses, metres.
        left, right: metres by which it can move sideways everywhere without leaving its lane; negative if it is
            outside it somewhere.
    """

    road: Road
    s: F64
    t: F64
    left: float
    right: float


def lane_room(roads: Sequence[Road], track: Track) -> LaneRoom | None:
    """The room of a vehicle in the lane that it drives in from its first to its last pose; None: it isn't in one."""
    for road in roads:
        s, t = road.line.locate(track.poses[:, :2])
        if s.min() < 0 or s.max() > road.line.length:
            continue
        if (np.abs(np.cos(road.line.headings(s) - track.poses[:, 3])) < MIN_ALIGNMENT).any():
            continue
        left, right = np.full(len(s), np.nan), np.full(len(s), np.nan)
        for section in sections(road):
            here = (s >= section.first) & (s <= section.last)
            borders = np.array([border.offset.at(s[here]) for border in section.borders]).reshape(-1, here.sum())
            for upper, lower in pairwise(borders):
                inside = (t[here] <= upper) & (t[here] >= lower)
                at = np.flatnonzero(here)[inside]
                left[at], right[at] = upper[inside] - t[at], t[at] - lower[inside]
        if np.isfinite(left).all():
            half = track.size[1] / 2
            return LaneRoom(road, s, t, float(left.min()) - half, float(right.min()) - half)
    return None


def shifted(room: LaneRoom, track: Track, sideways: float) -> F64:
    """Poses (T, 4) of a track moved to the left of the road by `sideways` metres, on the road's surface."""
    return _on_road(room, track, room.t + sideways)


def mirrored(room: LaneRoom, track: Track) -> F64:
    """Poses (T, 4) of a track on the other side of the road's reference line, driving the other way."""
    poses = _on_road(room, track, -room.t)
    poses[:, 3] += np.pi
    return poses[::-1].copy()


def _on_road(room: LaneRoom, track: Track, t: F64) -> F64:
    """Poses at other offsets; the distance from the road's surface is kept."""
    poses = track.poses.copy()
    change = surface(room.road, room.s, t) - surface(room.road, room.s, room.t)
    poses[:, :3] += change
    return poses

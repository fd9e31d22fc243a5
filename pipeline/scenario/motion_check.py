"""What a real road user can't do: overlap another, leave the ground, or jump."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.scenario.scenario import Actor, Scenario
from scan2sim.pipeline.tracking.overlaps import depth as rectangle_overlap
from scan2sim.pipeline.tracking.tracks import footprint

PERIOD_S = 0.1
"""Interval at which overlaps are looked for."""
MAX_HEIGHT_M = 0.1
"""Largest distance of a box's bottom from the ground."""
MAX_JUMP_M = 0.3
"""Largest deviation of a pose from where the two before it lead at constant velocity, if poses are frequent."""
MAX_ACCELERATION_MPS2 = 10.0
"""Where poses are rare, this acceleration may explain a larger deviation."""
Ground = Callable[[F64], F64]
"""Heights (N,) of the ground at places (N, 3), both in world metres; NaN where there is none."""


@dataclass(frozen=True)
class ImpossibleMotion:
    """What an actor, or two of them, can't do.

    Attributes:
        kind: what.
        actors: names.
        time: when it happens first, seconds of the scenario.
        amount: depth of the overlap, distance from the ground, or deviation; metres.
    """

    kind: Literal["overlap", "off the ground", "jump"]
    actors: tuple[str, ...]
    time: float
    amount: float

    def __str__(self) -> str:
        """One line for people."""
        return f"{' and '.join(self.actors)}: {self.kind} by {self.amount:.2f} m at {self.time:.1f} s"


def impossible_motions(scenario: Scenario, ground: Ground | None = None) -> list[ImpossibleMotion]:
    """All impossible motions of a scenario, at most one of each kind per actor or pair.

    Args:
        scenario: its actors, the ego included.
        ground: the world's ground; None: heights aren't checked.
    """
    everyone = scenario.everyone
    found = [one for i, actor in enumerate(everyone) for one in overlaps_with(actor, everyone[:i])]
    for actor in scenario.everyone:
        jumps = _jumps(actor)
        if len(jumps) and jumps.max() > MAX_JUMP_M:
            worst = int(jumps.argmax())
            found.append(ImpossibleMotion("jump", (actor.name,), float(actor.track.times[worst + 2]), jumps[worst]))
        if ground is not None:
            height = np.abs(actor.track.poses[:, 2] - ground(actor.track.poses[:, :3]))
            if np.nanmax(height, initial=0.0) > MAX_HEIGHT_M:
                worst = int(np.nanargmax(height))
                found.append(
                    ImpossibleMotion("off the ground", (actor.name,), float(actor.track.times[worst]), height[worst])
                )
    return found


def overlaps_with(actor: Actor, others: Sequence[Actor]) -> list[ImpossibleMotion]:
    """Overlaps of an actor's box with those of others, in plan and in height; only pairs of which one moves."""
    found = []
    for other in others:
        passing = [one for one in (actor, other) if not one.stays] or [actor]
        if not (actor.track.moving or other.track.moving):
            continue
        begin, end = max(one.begin for one in passing), min(one.end for one in passing)
        times = np.arange(begin, end + PERIOD_S, PERIOD_S).clip(max=end) if begin <= end else np.empty(0)
        depth = _overlap_depth(actor, other, times)
        if depth.max(initial=0.0) > 0:
            first = float(times[np.flatnonzero(depth > 0)[0]])
            found.append(ImpossibleMotion("overlap", (other.name, actor.name), first, float(depth.max())))
    return found


def _overlap_depth(first: Actor, second: Actor, times: F64) -> F64:
    """Depth (T,) in metres by which two boxes overlap; at most 0 where they don't."""
    a, b = first.track.at(times), second.track.at(times)
    depth = np.full(len(times), -np.inf)
    reach = np.hypot(*first.track.size[:2]) / 2 + np.hypot(*second.track.size[:2]) / 2
    above = a[:, 2] - b[:, 2]
    near = np.abs(b[:, :2] - a[:, :2]).max(axis=1) < reach
    near &= (-first.track.size[2] < above) & (above < second.track.size[2])
    for i in np.flatnonzero(near):
        depth[i] = rectangle_overlap(footprint(first.track.size, a[i]), footprint(second.track.size, b[i]))
    return depth


def _jumps(actor: Actor) -> F64:
    """Deviation (T - 2,) in metres of each pose from where the two before it lead, less what acceleration explains."""
    times, places = actor.track.times, actor.track.poses[:, :3]
    if len(times) < 3:
        return np.empty(0)
    steps = np.diff(times)
    velocity = np.diff(places, axis=0) / steps[:, None]
    deviation = np.linalg.norm(places[2:] - places[1:-1] - velocity[:-1] * steps[1:, None], axis=1)
    explained = MAX_ACCELERATION_MPS2 * steps[1:] * (steps[1:] + steps[:-1]) / 2
    return np.where(deviation > np.maximum(explained, MAX_JUMP_M), deviation, 0.0)

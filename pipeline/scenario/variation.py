"""Variations of a scenario as a test suite: actors moved in their lanes, mirrored, re-timed, added, removed; by seed.

A variation is accepted if nobody overlaps anybody else, the ego included, and whoever drove in a lane still does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from scan2sim.pipeline.roads.model import Road
from scan2sim.pipeline.scenario.lanes import lane_room, mirrored, shifted
from scan2sim.pipeline.scenario.motion_check import overlaps_with
from scan2sim.pipeline.scenario.scenario import Actor, Scenario
from scan2sim.pipeline.tracking.tracks import Track

MAX_SHIFT_M = 0.5
"""Largest change of the position in the lane."""
SPEED_FACTORS = (0.75, 1.25)
MAX_DELAY_S = 3.0
MAX_ATTEMPTS = 50
"""Attempts to change an actor until no one overlaps another; then it stays as it is."""
VEHICLES = ("car", "van", "truck", "bus", "motorcycle")
PAINTS = ((226, 226, 222), (30, 32, 36), (124, 128, 134), (150, 28, 30), (28, 58, 120), (60, 92, 66))
"""Colours of added vehicles."""


@dataclass(frozen=True)
class Variation:
    """A varied scenario.

    Attributes:
        scenario: the result.
        changes: what was changed, in words, by actor.
    """

    scenario: Scenario
    changes: dict[str, str]


def vary(scenario: Scenario, roads: Sequence[Road], seed: int, number: int) -> Variation:
    """Variation `number` of a scenario.

    Args:
        scenario: as recorded; the ego stays as it is.
        roads: of the world, world metres; without any, actors are only re-timed, added and removed.
        seed: of the whole suite.
        number: of the variation in it; the same seed and number give the same variation.
    """
    rng = np.random.default_rng((seed, number))
    fixed = [actor for actor in scenario.everyone if actor is scenario.ego or not actor.track.moving]
    kept: list[Actor] = []
    changes: dict[str, str] = {}
    for actor in scenario.moving:
        change = ("as recorded", "shift", "retime", "mirror", "remove")[rng.integers(5)]
        if change == "remove":
            changes[actor.name] = "removed"
            continue
        for _ in range(MAX_ATTEMPTS):
            track, words = _changed(actor.track, change, roads, rng)
            candidate = Actor(actor.name, track)
            if not overlaps_with(candidate, (*fixed, *kept)):
                break
        else:
            candidate, words = actor, "as recorded"
            if overlaps_with(actor, (*fixed, *kept)):
                changes[actor.name] = "removed"
                continue
        kept.append(candidate)
        changes[actor.name] = words
    for _ in range(int(rng.integers(0, 3))):
        if added := _added(scenario, (*fixed, *kept), rng, len(kept)):
            kept.append(added[0])
            changes[added[0].name] = added[1]
    still = [actor for actor in scenario.actors if not actor.track.moving]
    name = f"{scenario.name}_{number:03d}"
    return Variation(replace(scenario, name=name, actors=(*kept, *still)), changes)


def _changed(track: Track, change: str, roads: Sequence[Road], rng: np.random.Generator) -> tuple[Track, str]:
    room = lane_room(roads, track) if change in ("shift", "mirror") else None
    if change == "retime":
        factor, delay = float(rng.uniform(*SPEED_FACTORS)), float(rng.uniform(0, MAX_DELAY_S))
        return _retimed(track, factor, delay), f"{factor:.2f} times as fast, {delay:.1f} s later"
    if change == "shift" and room and room.left + room.right > 0:
        low, high = max(-MAX_SHIFT_M, -room.right), min(MAX_SHIFT_M, room.left)
        if low < high:
            sideways = float(rng.uniform(low, high))
            return replace(
                track, poses=shifted(room, track, sideways)
            ), f"{abs(sideways):.2f} m to the {'left' if sideways > 0 else 'right'} in its lane"
    if change == "mirror" and room:
        times = track.times[0] + (track.times[-1] - track.times[::-1])
        turned = replace(track, times=times, poses=mirrored(room, track), sigma=track.sigma[::-1].copy())
        still_there = lane_room([room.road], turned)
        if still_there and min(still_there.left, still_there.right) >= min(0.0, room.left, room.right):
            delay = float(rng.uniform(0, MAX_DELAY_S))
            return _retimed(turned, 1.0, delay), f"the other way, in the opposite lane, {delay:.1f} s later"
    return track, "as recorded"


def _retimed(track: Track, factor: float, delay: float) -> Track:
    return replace(track, times=track.times[0] + delay + (track.times - track.times[0]) / factor)


def _added(
    scenario: Scenario, others: tuple[Actor, ...], rng: np.random.Generator, count: int
) -> tuple[Actor, str] | None:
    """Another vehicle on the way of a recorded one, the ego's included, later than that one."""
    ways = [actor for actor in scenario.everyone if actor.track.moving and actor.track.category in (*VEHICLES, "ego")]
    if not ways:
        return None
    for _ in range(MAX_ATTEMPTS):
        way = ways[rng.integers(len(ways))]
        delay = float(rng.uniform(0.0, scenario.duration))
        factor = float(rng.uniform(*SPEED_FACTORS))
        track = _retimed(way.track, factor, delay)
        category = "car" if way.track.category == "ego" else way.track.category
        paint = PAINTS[rng.integers(len(PAINTS))]
        number = max(actor.track.id for actor in scenario.everyone) + 1 + count
        actor = Actor(f"added_{number}", replace(track, id=number, category=category, colour=paint))
        if not overlaps_with(actor, others):
            return actor, f"added on the way of {way.name}, {delay:.1f} s later, {factor:.2f} times as fast"
    return None

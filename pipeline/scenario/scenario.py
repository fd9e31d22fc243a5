"""A scenario: actors that move through a world, on one clock that starts with the recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from scan2sim.pipeline.tracking.tracks import Track

EGO = "ego"
"""Category and name of the recording vehicle."""


@dataclass(frozen=True)
class Actor:
    """A road user of a scenario.

    Attributes:
        name: unique in the scenario.
        track: its box and poses; world metres, seconds since the scenario's start. One pose: it is parked.
    """

    name: str
    track: Track

    @property
    def begin(self) -> float:
        """When it appears, seconds."""
        return float(self.track.times[0])

    @property
    def end(self) -> float:
        """When it disappears, seconds; equal to `begin` for a parked vehicle."""
        return float(self.track.times[-1])

    @property
    def stays(self) -> bool:
        """Whether it is there all the time: it is parked, or it is the ego, which waits at both ends of its way."""
        return not self.track.moving or self.track.category == EGO


@dataclass(frozen=True)
class Scenario:
    """Actors in a world.

    Attributes:
        name: used as file name.
        actors: other road users, by name.
        ego: the recording vehicle, or None.
        start: the clock of the recording at the scenario's start, seconds.
    """

    name: str
    actors: tuple[Actor, ...]
    ego: Actor | None
    start: float = 0.0

    @property
    def everyone(self) -> tuple[Actor, ...]:
        """The ego first, if there is one, then the others."""
        return self.actors if self.ego is None else (self.ego, *self.actors)

    @property
    def moving(self) -> tuple[Actor, ...]:
        """The others that move."""
        return tuple(actor for actor in self.actors if actor.track.moving)

    @property
    def duration(self) -> float:
        """Seconds until the last one that moves has arrived."""
        return max((actor.end for actor in self.everyone if actor.track.moving), default=0.0)


def from_tracks(name: str, tracks: Sequence[Track], offset: Sequence[float] = (0.0, 0.0, 0.0)) -> Scenario:
    """A scenario of recorded tracks.

    Args:
        name: of the scenario.
        tracks: in a tile's local metres, on the recording's clock.
        offset: (3,) metres from the world's origin to the tile's.
    """
    moving = [track for track in tracks if track.moving]
    start = min((float(track.times[0]) for track in moving), default=0.0)
    egos = [Actor(EGO, _placed(track, offset, start)) for track in tracks if track.category == EGO]
    others = [
        Actor(f"{track.category}_{track.id}", _placed(track, offset, start))
        for track in sorted(tracks, key=lambda track: track.id) if track.category != EGO
    ]  # fmt: skip
    return Scenario(name, tuple(others), egos[0] if egos else None, start)


def _placed(track: Track, offset: Sequence[float], start: float) -> Track:
    times = track.times - start if track.moving else np.zeros(1)
    poses = track.poses if track.moving else track.poses[:1]
    sigma = track.sigma if track.moving else track.sigma[:1]
    return replace(track, times=times, poses=poses + np.array([*offset, 0.0]), sigma=sigma)

"""The recorded road users of a scene as a scenario, joined across tile borders."""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import numpy as np

from scan2sim.pipeline.io.worlds.scene import TRACKS_FILE, Scene
from scan2sim.pipeline.scenario.motion_check import overlaps_with
from scan2sim.pipeline.scenario.scenario import EGO, Actor, Scenario, from_tracks
from scan2sim.pipeline.tracking.tracks import Track, read_tracks

MAX_APART_M = 1.0
"""Median distance, in plan, of two tiles' tracks at their common times up to which they are of one road user."""
VEHICLES = ("car", "van", "truck", "bus")
"""Categories that two tiles may give to one vehicle."""


def scenario_of(scene: Scene) -> Scenario:
    """Road users of all tiles in world metres; empty without tracks.

    Raises:
        InputError: a tile's tracks can't be read.
    """
    tracks: list[Track] = []
    egos: list[Track] = []
    numbers = count()
    for tile in scene.tiles:
        path = tile.folder / TRACKS_FILE
        own: list[Track] = []
        for track in read_tracks(path) if path.is_file() else ():
            placed = replace(track, poses=track.poses + np.array([*tile.offset, 0.0]))
            if track.category == EGO:
                egos.append(placed)
            else:
                own.append(placed if len(scene.tiles) == 1 else replace(placed, id=next(numbers)))
        tracks = _continued(tracks, own)
    scenario = from_tracks(scene.name, [*tracks, *_joined(egos)])
    return scenario if len(scene.tiles) == 1 else replace(scenario, actors=_once(scenario.actors))


def _continued(tracks: list[Track], own: list[Track]) -> list[Track]:
    """Tracks of tiles so far, and those of another tile: what both saw moving becomes one track."""
    tracks = list(tracks)
    for track in own:
        apart = [_apart(before, track) for before in tracks]
        nearest = int(np.argmin(apart)) if apart else -1
        if apart and apart[nearest] < MAX_APART_M:
            tracks[nearest] = _handed_over(tracks[nearest], track)
        else:
            tracks.append(track)
    return tracks


def _apart(first: Track, second: Track) -> float:
    """Median distance of two tracks at their common times, metres; inf if they can't be of one moving road user."""
    same = first.category == second.category or {first.category, second.category} <= {*VEHICLES}
    begin, end = max(first.times[0], second.times[0]), min(first.times[-1], second.times[-1])
    if not (same and first.moving and second.moving and begin <= end):
        return float("inf")
    times = np.concatenate([first.times, second.times])
    times = np.unique([begin, end, *times[(begin <= times) & (times <= end)]])
    return float(np.median(np.linalg.norm(first.at(times)[:, :2] - second.at(times)[:, :2], axis=1)))


def _handed_over(first: Track, second: Track) -> Track:
    """One track of two that saw the same: the earlier one passes into the later one while both saw it.

    If one of them saw it all the time, it is that one.
    """
    earlier, later = sorted((first, second), key=lambda track: (track.times[0], -track.times[-1]))
    colour = first.colour if first.colour is not None else second.colour
    if later.times[-1] <= earlier.times[-1]:
        return replace(earlier, id=first.id, colour=colour)
    begin, end = later.times[0], earlier.times[-1]
    times = np.unique(np.concatenate([earlier.times, later.times]))
    share = np.clip((times - begin) / max(end - begin, 1e-9), 0, 1)[:, None]
    before, after = earlier.at(times), later.at(times)
    poses = before + share * (after - before)
    turn = (after[:, 3] - before[:, 3] + np.pi) % (2 * np.pi) - np.pi  # the short way
    poses[:, 3] = np.unwrap(before[:, 3] + share[:, 0] * turn)
    sigma = [
        np.stack([np.interp(times, one.times, column) for column in one.sigma.T], axis=1) for one in (earlier, later)
    ]
    longest = max(first, second, key=lambda track: len(track.times))
    return replace(
        longest, id=first.id, times=times, poses=poses, sigma=sigma[0] + share * (sigma[1] - sigma[0]), colour=colour,
    )  # fmt: skip


def _joined(parts: list[Track]) -> list[Track]:
    """One track of the recording vehicle from those of tiles."""
    if len(parts) < 2:
        return parts
    times = np.concatenate([part.times for part in parts])
    _, order = np.unique(times, return_index=True)  # sorted, each time once
    poses, sigma = (np.concatenate([getattr(part, name) for part in parts])[order] for name in ("poses", "sigma"))
    return [replace(parts[0], times=times[order], poses=poses, sigma=sigma, moving=any(part.moving for part in parts))]


def _once(actors: tuple[Actor, ...]) -> tuple[Actor, ...]:
    """Actors without those of which another tile shows a longer part at the same place and time."""
    kept: list[Actor] = []
    for actor in sorted(actors, key=lambda actor: -len(actor.track.times)):
        if not overlaps_with(actor, kept):
            kept.append(actor)
    return tuple(actor for actor in actors if actor in kept)

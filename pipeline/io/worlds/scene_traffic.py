"""The recorded road users of a scene as a scenario, joined across tile borders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2sim.pipeline.io.worlds.scene import TRACKS_FILE, Scene
from scan2sim.pipeline.scenario.motion_check import overlaps_with
from scan2sim.pipeline.scenario.scenario import EGO, Actor, Scenario, from_tracks
from scan2sim.pipeline.tracking.tracks import Track, read_tracks


def scenario_of(scene: Scene) -> Scenario:
    """Road users of all tiles in world metres; empty without tracks.

    Raises:
        InputError: a tile's tracks can't be read.
    """
    tracks: list[Track] = []
    egos: list[Track] = []
    for tile in scene.tiles:
        path = tile.folder / TRACKS_FILE
        for track in read_tracks(path) if path.is_file() else ():
            placed = replace(track, poses=track.poses + np.array([*tile.offset, 0.0]))
            if track.category == EGO:
                egos.append(placed)
            else:
                tracks.append(placed if len(scene.tiles) == 1 else replace(placed, id=len(tracks)))
    scenario = from_tracks(scene.name, [*tracks, *_joined(egos)])
    return scenario if len(scene.tiles) == 1 else replace(scenario, actors=_once(scenario.actors))


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

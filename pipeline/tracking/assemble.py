"""Tracks of a tile, from its classified cloud, its moving points, and its detected instances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.classes import CODE, group_of
from scan2sim.pipeline.core.types import F64, I64, U8, Bools, PointCloud, Trajectory
from scan2sim.pipeline.lidar.sweeps import sweep_numbers
from scan2sim.pipeline.tracking import overlaps, parked
from scan2sim.pipeline.tracking.extents import axes
from scan2sim.pipeline.tracking.follow import Followed, Returns, follow, height_above
from scan2sim.pipeline.tracking.sizes import TYPICAL
from scan2sim.pipeline.tracking.tracks import Track, footprint

GROUND_CELL_M = 0.5
"""Cells of the ground, one height each: wheels stand on it."""
LEVELLED_M, UNEVEN_M = 2.0, 0.05
"""Standard deviation of the length over which the ground below a path is averaged; deviation of its outliers."""
MARGIN_M = 0.35
"""Margin of an instance's box within which points are its own: mirrors."""
MIN_POINTS = 5
"""Points of a parked vehicle in a sweep from which it was seen."""
MIN_PARKED_POINTS = 60
"""Points in all sweeps from which a parked vehicle has a box."""
ROW_LENGTH_M, ROW_WIDTH_M = 5.4, 2.5
"""Place of a vehicle in a row of vehicles that touch: behind one another, and side by side."""
VISIBLE_M = 60.0
"""Range from which the scanner's positions count for the sides of a parked vehicle that were seen."""
OVERLAP_DROPPED_M = 0.5
"""Depth of overlap from which one of two boxes is wrong; boxes that overlap less are made narrower."""
CLEARANCE_M = 0.02
"""Gap between boxes after that."""
COLOUR_HEIGHT_M = (0.4, 1.0)
"""Heights of paint: below are wheels, above panes."""
NO_COLOUR = (0, 128)
"""Values of points that no photo shows: black, and the grey of imported sweeps."""
MIN_COLOURED = 20
"""Points with a colour from which a track has one."""


@dataclass(frozen=True)
class Candidate:
    """A detected instance: `centre` (2,), `yaw` (rad), `length`, `width` in local metres, `kind`, `moved`."""

    centre: F64
    yaw: float
    length: float
    width: float
    kind: str
    moved: bool


def assemble(
    cloud: PointCloud, moving: PointCloud, path: Trajectory, instances: Sequence[Candidate]
) -> tuple[list[Track], dict[str, int]]:
    """Tracks, the recording vehicle's first; and numbers of `moving` and `parked` ones and `sweeps`.

    Args:
        cloud: classified static points with times, which passing objects at a distance are still a part of.
        moving: points that `dynamic_objects` removed.
        path: path of the scanner.
        instances: detected vehicles and people.
    """
    assert cloud.time is not None and cloud.classification is not None
    xyz = np.concatenate([cloud.xyz, moving.xyz]).astype(np.float64)
    times = np.concatenate([cloud.time, moving.time if moving.time is not None else np.zeros(0)])
    classes = np.concatenate([cloud.classification, np.full(len(moving), CODE["vehicle"], np.uint8)])
    rgb = np.concatenate([cloud.rgb, moving.rgb])
    sweep = sweep_numbers(times, path.times[np.isfinite(path.times)])
    sweep_times = np.bincount(sweep, times - times[0]) / np.bincount(sweep) + times[0]
    ground = _ground(cloud)
    held_out = np.bincount(sweep[: len(cloud)], minlength=len(sweep_times)) == 0  # sweeps without static points
    chosen = np.flatnonzero(np.isin(classes, (CODE["vehicle"], CODE["person"])) & ~held_out[sweep])
    height = height_above(ground, xyz[chosen])
    returns = Returns(xyz[chosen], height, times[chosen], sweep[chosen], path)
    still = [one for one in instances if not one.moved and one.kind != "person"]
    static = _inside_any(returns, still, len(cloud), chosen)
    loose = np.flatnonzero(~static)
    drawn = [_moving_track(one, ground, rgb[chosen[loose[one.index]]], returns.height[loose[one.index]])
             for one in follow(returns.take(loose), sweep_times)]  # fmt: skip
    right = _keeps_right(drawn, path)
    for candidate in still:
        drawn += _parked_tracks(candidate, returns, ground, rgb[chosen], path, sweep_times, right)
    accepted = without_overlaps([_ego(path, ground, sweep_times), *drawn])
    numbered = [replace(track, id=k) for k, track in enumerate(accepted)]
    count = sum(track.moving for track in numbered[1:])
    return numbered, {"moving": count, "parked": len(numbered) - 1 - count, "sweeps": len(sweep_times)}


def without_overlaps(tracks: Sequence[Track]) -> list[Track]:
    """Tracks that don't overlap, in their order: later ones are narrowed, or dropped where they overlap deeply."""
    accepted: list[Track] = []
    for track in tracks:
        for other in accepted:
            deep = overlaps.deepest(track, other)
            if deep <= 0:
                continue
            if deep > OVERLAP_DROPPED_M:
                break
            track = _narrowed(track, other, deep + CLEARANCE_M)
            if overlaps.deepest(track, other) > 0:
                break
        else:
            accepted.append(track)
    return accepted


def _narrowed(track: Track, other: Track, by: float) -> Track:
    """The track with a box smaller by twice `by` along the axis on which the other one lies."""
    closest = int(np.argmin(np.hypot(*(track.poses[:, :2] - other.at(track.times)[:, :2]).T)))
    offset = (other.at(track.times[closest : closest + 1])[0, :2] - track.poses[closest, :2]) @ axes(
        float(track.poses[closest, 3])
    )
    length, width, height = track.size
    if abs(offset[0]) / length > abs(offset[1]) / width:
        return replace(track, size=(length - 2 * by, width, height))
    return replace(track, size=(length, width - 2 * by, height))


def _ground(cloud: PointCloud) -> F64:
    """(G, 3) lowest cells of the ground, local metres."""
    assert cloud.classification is not None
    xyz = cloud.xyz[group_of()[cloud.classification] == 0].astype(np.float64)
    if not len(xyz):
        return np.zeros((0, 3))
    cell = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / GROUND_CELL_M).astype(np.int64)
    key = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    order = np.lexsort((xyz[:, 2], key))
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(np.append(starts, len(order)))
    median = xyz[order[starts + count // 2], 2]
    middle = (cell[order[starts]] + 0.5) * GROUND_CELL_M + xyz[:, :2].min(axis=0)
    return np.column_stack([middle, median])


def _z(ground: F64, xy: F64) -> F64:
    """Heights (N,) of the ground below positions (N, 2): medians of the nearest cells."""
    if not len(ground):
        return np.zeros(len(xy))
    near = cKDTree(ground[:, :2]).query(xy, k=min(5, len(ground)))[1].reshape(len(xy), -1)
    return np.asarray(np.median(ground[near, 2], axis=1))


def _z_along(ground: F64, xy: F64) -> F64:
    """Heights (T,) of the ground below a path (T, 2), without jumps: cells far from the scanner are few and uneven."""
    z = _z(ground, xy)
    driven = np.concatenate([np.zeros(1), np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    weight = np.exp(-(((driven[:, None] - driven) / LEVELLED_M) ** 2) / 2)
    level = weight @ z / weight.sum(axis=1)
    weight = weight / (1 + ((z - level) / UNEVEN_M) ** 2)
    return np.asarray(weight @ z / weight.sum(axis=1))


def _inside_any(returns: Returns, still: Sequence[Candidate], static: int, chosen: I64) -> Bools:
    """(N,) whether a return of the static cloud (its first `static` points) lies in the box of a parked vehicle."""
    out = np.zeros(len(chosen), bool)
    for one in still:
        out |= _inside(returns.xyz, one)
    return out & (chosen < static)


def _inside(xyz: F64, one: Candidate) -> Bools:
    local = (xyz[:, :2] - one.centre) @ axes(one.yaw)
    return np.asarray((np.abs(local) < np.array([one.length, one.width]) / 2 + MARGIN_M).all(axis=1))


def _moving_track(one: Followed, ground: F64, rgb: U8, height: F64) -> Track:
    fit = one.fit
    poses = np.column_stack([fit.states[:, :2], _z_along(ground, fit.states[:, :2]), fit.yaw])
    return Track(0, fit.category, fit.size, fit.times, poses, fit.sigma, True, _colour(rgb, height))


def _parked_tracks(
    candidate: Candidate,
    returns: Returns,
    ground: F64,
    rgb: U8,
    path: Trajectory,
    sweep_times: F64,
    right: bool,
) -> list[Track]:
    """The vehicles of an instance: several for a row."""
    own = np.flatnonzero(_inside(returns.xyz, candidate))
    parts = 1
    yaw = candidate.yaw
    if candidate.kind == "row":
        abreast = candidate.width > ROW_WIDTH_M
        parts = max(1, round(candidate.length / (ROW_WIDTH_M if abreast else ROW_LENGTH_M)))
        yaw += np.pi / 2 if abreast else 0.0
    u = (returns.xyz[own, :2] - candidate.centre) @ axes(candidate.yaw)[:, 0] + candidate.length / 2
    place = np.clip(np.floor(u / candidate.length * parts), 0, parts - 1)
    found = []
    for k in range(parts):
        index = own[place == k]
        usable = index[(returns.height[index] > 0.15) & (returns.height[index] < 4.3)]
        if len(usable) < MIN_PARKED_POINTS or not parked.has_body(
            returns.xyz[usable], returns.height[usable], candidate.centre, candidate.yaw
        ):
            continue
        number, count = np.unique(returns.sweep[usable], return_counts=True)
        number = number[count >= MIN_POINTS]
        if not len(number):
            continue
        times = sweep_times[number]
        scanner = path.at(times)[:, :2]
        near = np.hypot(*(scanner - candidate.centre).T) < VISIBLE_M
        box = parked.fit(
            returns.xyz[usable], returns.height[usable], yaw, scanner[near] if near.any() else scanner, right
        )
        corners = footprint(box.size, [*box.centre, 0.0, box.yaw])
        z = float(np.median(_z(ground, np.concatenate([box.centre[None], (corners + box.centre) / 2]))))
        poses = np.tile([*box.centre, z, box.yaw], (len(times), 1))
        colour = _colour(rgb[usable], returns.height[usable])
        sigma = np.tile(box.sigma, (len(times), 1))
        found.append(Track(0, box.category, box.size, times, poses, sigma, False, colour))
    return found


def _ego(path: Trajectory, ground: F64, sweep_times: F64) -> Track:
    """The recording vehicle: its scanner is taken for the middle of its box."""
    known = np.isfinite(path.times)
    path = Trajectory(path.times[known], path.positions[known])
    times = np.clip(sweep_times, path.times[0], path.times[-1])
    times = times[np.diff(times, prepend=-np.inf) > 0]
    xy = path.at(times)[:, :2]
    step = path.at(times + 0.25)[:, :2] - path.at(times - 0.25)[:, :2]
    moves = np.hypot(*step.T) > 0.05
    yaw = np.zeros(len(times))
    if moves.any():
        angle = np.unwrap(np.arctan2(step[moves, 1], step[moves, 0]))
        yaw = np.interp(times, times[moves], angle)
    poses = np.column_stack([xy, _z_along(ground, xy), yaw])
    sigma = np.tile([0.05, 0.01], (len(times), 1))
    return Track(
        0,
        "ego",
        (TYPICAL["ego"].length, TYPICAL["ego"].width, TYPICAL["ego"].height),
        times,
        poses,
        sigma,
        bool(moves.any()),
        None,
    )


def _keeps_right(tracks: Sequence[Track], path: Trajectory) -> bool:
    """Whether traffic keeps to the right: oncoming vehicles pass on the left of the scanner."""
    votes = 0
    for track in tracks:
        at = path.at(track.times)[:, :2]
        step = path.at(track.times + 0.25)[:, :2] - path.at(track.times - 0.25)[:, :2]
        heading = np.column_stack([np.cos(track.poses[:, 3]), np.sin(track.poses[:, 3])])
        oncoming = (step * heading).sum(axis=1) < -0.8 * np.hypot(*step.T)
        offset = track.poses[:, :2] - at
        left = step[:, 0] * offset[:, 1] - step[:, 1] * offset[:, 0] > 0
        votes += int(left[oncoming].sum()) - int((~left[oncoming]).sum())
    return votes >= 0


def _colour(rgb: U8, height: F64) -> tuple[int, int, int] | None:
    """Median colour of the paint among points with colours."""
    chosen = (height > COLOUR_HEIGHT_M[0]) & (height < COLOUR_HEIGHT_M[1])
    chosen &= ~np.isin(rgb, NO_COLOUR).all(axis=1)
    if int(chosen.sum()) < MIN_COLOURED:
        return None
    r, g, b = (int(value) for value in np.median(rgb[chosen], axis=0))
    return r, g, b

"""Frames of `/tf_static` and `/tf`: fixed transforms between frames, and poses of a frame over time."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.poses import interpolate
from scan2sim.pipeline.core.types import F64, Bools
from scan2sim.pipeline.importers.bag.reader import plain

WORLD_FRAMES = ("map", "world", "odom", "earth")
"""Names of frames that don't move with the vehicle (REP 105), the preferred one first."""
BODY_FRAMES = ("base_link", "base_footprint", "base", "body")
"""Names of the vehicle's frame (REP 105), the preferred one first."""
CONSTANT = 1e-6
"""Largest change of a transform that never changes: metres, and elements of the rotation matrix."""
EARTH_RADII_M, MAX_HEIGHT_M = (6.33e6, 6.42e6), 12_000.0
"""Distances of the ground from the earth's centre; coordinates of projections have heights below the second number."""
MIN_SIDEWAYS = 0.2
"""Extent of a path across its main direction, as a share of that along it, that a vehicle needs turns for."""
MAX_STEP_S, STEP_RATIO = 2.0, 5.0
"""A longer time without messages than both, seconds and times the usual interval, is a gap."""
MAX_SHIFT_M, MIN_SPEED_MS = 1.0, 0.1
"""A link that changes by more than that during a gap moved; a link that is faster on average is that of a vehicle."""
SAME_M, SAME_DEG, UNIT_TOLERANCE = 0.005, 0.2, 0.01
"""Largest difference of equal transforms, and of a unit quaternion's length from 1."""
MAX_LISTED = 20
"""Links that an error lists."""
Link = tuple[str, str]
"""Parent and child."""
GIVE_LINK = "Give the transform with --transform 'PARENT CHILD x y z qx qy qz qw', or the robot's --urdf"


def earth_centred(T: F64) -> bool:
    """Whether poses (N, 4, 4) are in an earth-centred frame (ECEF), whose z axis isn't up."""
    if not len(T):
        return False
    middle = np.median(T[:, :3, 3], axis=0)
    return bool(EARTH_RADII_M[0] < np.linalg.norm(middle) < EARTH_RADII_M[1] and abs(middle[2]) > MAX_HEIGHT_M)


def without_turns(T: F64) -> bool:
    """Whether poses (N, 4, 4) are positions without orientations: they move along two axes and never turn."""
    if len(T) < 3 or np.ptp(T[:, :3, :3], axis=0).max() > CONSTANT:
        return False
    less, more = sorted(np.ptp((T[:, :3, 3] - T[0, :3, 3]) @ T[0, :3, :3], axis=0)[:2])
    return bool(less > MIN_SIDEWAYS * max(more, 1e-3))


def in_gap(at: F64, times: F64) -> Bools:
    """Whether times (N,) are in a gap between the ascending times `at` (T,) of messages."""
    steps = np.diff(at)
    if not len(steps):
        return np.zeros(len(times), bool)
    before = np.clip(np.searchsorted(at, times) - 1, 0, len(steps) - 1)
    return np.asarray((steps[before] > _longest_step(steps)) & (times > at[before]) & (times < at[before + 1]))


def covered(at: F64, poses: F64, times: F64) -> Bools:
    """Whether a link with `poses` (T, 4, 4) at ascending times `at` (T,) is known at `times` (N,).

    It isn't in a gap during which it moved, and, if it moves at all, far before the first pose or after the last one:
    corrections of an odometry may be rare, the poses of a vehicle may not.
    """
    steps, shifts = np.diff(at), np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    if not len(steps):
        return np.ones(len(times), bool)
    before = np.clip(np.searchsorted(at, times) - 1, 0, len(steps) - 1)
    gap = in_gap(at, times) & (shifts[before] > MAX_SHIFT_M)
    moves = shifts.sum() > MIN_SPEED_MS * (at[-1] - at[0])
    beyond = np.maximum(at[0] - times, times - at[-1]) > _longest_step(steps)
    return np.asarray(~gap & ~(moves & beyond))


def _longest_step(steps: F64) -> float:
    """Seconds between messages up to which poses are interpolated."""
    return max(MAX_STEP_S, STEP_RATIO * float(np.median(steps)))


def matrix(position: Any, quaternion: Any) -> F64:
    """(4, 4) of position (x, y, z) in metres and quaternion (x, y, z, w).

    Raises:
        ValueError: the quaternion has no length, or a number isn't finite.
    """
    from scipy.spatial.transform import Rotation

    values = np.array([*position, *quaternion], np.float64)
    if not np.isfinite(values).all() or not np.linalg.norm(values[3:]) > 1e-6:
        raise ValueError("invalid pose")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
    return T


def pose_matrix(pose: Any) -> F64:
    """(4, 4) of a `geometry_msgs/Pose`. Raises ValueError as `matrix`."""
    p, q = pose.position, pose.orientation
    return matrix((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def transform_matrix(transform: Any) -> F64:
    """(4, 4) of a `geometry_msgs/Transform`: child to parent axes. Raises ValueError as `matrix`."""
    p, q = transform.translation, transform.rotation
    return matrix((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


class Series:
    """Poses over time, gathered in any order: 104 bytes each, as recordings of hours have millions."""

    def __init__(self) -> None:
        self._times, self._rows = array("d"), array("d")

    def __len__(self) -> int:
        return len(self._times)

    def add(self, time: float, pose: F64) -> None:
        """Add a pose (4, 4)."""
        self._times.append(time)
        self._rows.extend(pose[:3].ravel().tolist())

    def poses(self) -> F64:
        """Poses (T, 4, 4) in the order in which they were added."""
        T = np.tile(np.eye(4), (len(self._times), 1, 1))
        T[:, :3] = np.array(self._rows).reshape(-1, 3, 4)
        return T

    def sorted(self) -> tuple[F64, F64]:
        """Times (T,), ascending, each once (the last pose of a time counts), and poses (T, 4, 4)."""
        times = np.array(self._times, np.float64)
        order = np.argsort(times, kind="stable")
        last = np.append(np.diff(times[order]) > 0, True)[: len(order)]
        keep = order[last]
        return times[keep], self.poses()[keep]


@dataclass
class Frames:
    """Links between frames: `static` and `moving` by (parent, child)."""

    path: Path
    static: dict[tuple[str, str], F64] = field(default_factory=dict)
    moving: dict[tuple[str, str], Series] = field(default_factory=dict)

    def add_given(self, links: Iterable[str]) -> list[str]:
        """Add static links of the user, "PARENT CHILD x y z qx qy qz qw", instead of what the bag has between them.

        Returns:
            Warnings of links that differ from the bag's.

        Raises:
            SettingError: a text has another form.
        """
        warnings = []
        for text in links:
            words = text.split()
            try:
                parent, child, *numbers = words
                x, y, z, *quaternion = map(float, numbers)
                if len(quaternion) != 4 or abs(np.linalg.norm(quaternion) - 1) > UNIT_TOLERANCE:
                    raise ValueError
                T, link = matrix((x, y, z), quaternion), (plain(parent), plain(child))
            except ValueError:
                remedy = "Write 'PARENT CHILD x y z qx qy qz qw': metres, and a unit quaternion"
                raise SettingError("--transform", f"{text!r} is not a transform", remedy) from None
            warnings += self._replace(link, T)
        return warnings

    def _replace(self, link: Link, T: F64) -> list[str]:
        """Set a static link, and remove those that connected the child with the parent; warn of a difference."""
        (parent, child), warnings = link, list[str]()
        while (known := self._connected(child).get(parent)) is not None and known[1] is not None:
            off = np.linalg.inv(known[0]) @ T
            shift, turn = (
                float(np.linalg.norm(off[:3, 3])),
                np.degrees(np.arccos(np.clip((np.trace(off) - 2) / 2, -1, 1))),
            )
            if shift > SAME_M or turn > SAME_DEG:
                warnings = [
                    f"{parent} > {child} of --transform differs by {shift:.3f} m and {turn:.1f} degrees from what the "
                    "bag or an earlier --transform says, which isn't used"
                ]
            del self.static[known[1]]
        self.static[link] = T
        return warnings

    def fix_constant(self) -> None:
        """Make moving links static that have the same transform at all times."""
        for link, series in list(self.moving.items()):
            poses = series.poses()
            if len(poses) > 1 and np.ptp(poses, axis=0).max() < CONSTANT:
                del self.moving[link]
                self.static[link] = poses[0]

    def between(self, target: str, source: str) -> F64:
        """T_target_source (4, 4) by static links.

        Raises:
            InputError: no chain of static links connects them; names the frames that there are.
        """
        found = self._connected(source).get(target)
        if found is None:
            cause = f"has no static transform between the frames {target!r} and {source!r}; {self.listed()}"
            raise InputError(self.path, cause, f"{GIVE_LINK}, or leave out the topic in that frame")
        return found[0]

    def connected(self, target: str, source: str) -> bool:
        """Whether static links connect two frames."""
        return target in self._connected(source)

    def _connected(self, source: str) -> dict[str, tuple[F64, Link | None]]:
        """Frames that static links connect with `source`: T_frame_source (4, 4), and the link next to `source`."""
        reached, queue = dict[str, tuple[F64, Link | None]]({source: (np.eye(4), None)}), [source]
        while queue:
            frame = queue.pop(0)
            before, first = reached[frame]
            for (parent, child), T in self.static.items():
                for here, other, step in ((child, parent, T), (parent, child, np.linalg.inv(T))):
                    if here == frame and other not in reached:
                        reached[other] = step @ before, first or (parent, child)
                        queue.append(other)
        return reached

    def parents(self, frame: str) -> list[str]:
        """Parents of a frame: one in a valid tree; those with most moving transforms first."""
        links = [link for link in dict.fromkeys([*self.moving, *self.static]) if link[1] == frame]
        return [parent for parent, _ in sorted(links, key=lambda link: -len(self.moving.get(link, ())))]

    def ancestors(self, frame: str, world: str | None = None) -> list[tuple[str, str]]:
        """Links from a frame up to `world`, or to the root of its tree, the nearest first.

        Of several parents, the one that leads to `world` counts, else to one of `WORLD_FRAMES`, else the first.
        """
        chains, queue = list[list[tuple[str, str]]](), [[(parent, frame)] for parent in self.parents(frame)]
        while queue:
            chain = queue.pop(0)
            top, below = chain[-1][0], {child for _, child in chain}
            above = [] if top == world else [parent for parent in self.parents(top) if parent not in below]
            queue += [[*chain, (parent, top)] for parent in above]
            if not above:
                chains.append(chain)

        def rank(chain: list[tuple[str, str]]) -> int:
            names = [world, *WORLD_FRAMES]
            return min((names.index(parent) for parent, _ in chain if parent in names), default=len(names))

        return min(chains, key=rank, default=[])

    def world_frame(self, frame: str, given: str | None = None) -> str | None:
        """Frame above `frame` that it moves in: the given one, else one of `WORLD_FRAMES`, else the root; or None.

        Raises:
            InputError: the given one isn't above `frame`, or nothing moves between them.
        """
        above, moves = [], False
        for link in self.ancestors(frame, None if given is None else plain(given)):
            moves = moves or link in self.moving
            if moves:
                above.append(link[0])
        if given is not None and plain(given) not in above:
            cause = f"has no moving transform from {given!r} to {frame!r}; {self.listed()}"
            raise InputError(self.path, cause, "Give another --world-frame, or other --poses")
        if given is not None:
            return plain(given)
        return next((name for name in WORLD_FRAMES if name in above), above[-1] if above else None)

    def poses_of(self, frame: str, world: str) -> tuple[F64, F64]:
        """Times (T,) and poses (T, 4, 4) of a frame in a frame above it, at the times of its most frequent link.

        Times in a gap of another link that moved meanwhile are left out.
        """
        links = self.ancestors(frame, world)
        series = {link: self.moving[link].sorted() for link in links if link in self.moving}
        times = max((times for times, _ in series.values()), key=len)
        others = [covered(at, poses, times) for at, poses in series.values() if at is not times]
        times = times[np.logical_and.reduce([np.ones(len(times), bool), *others])]
        T = np.tile(np.eye(4), (len(times), 1, 1))
        for link in reversed(links):
            if link in series:
                at, poses = series[link]
                T = T @ interpolate(poses, at, np.clip(times, at[0], at[-1]))
            else:
                T = T @ self.static[link]
        return times, T

    def listed(self) -> str:
        """The links as text, for errors."""
        links = [f"{p} > {c}" for p, c in sorted(self.static)] + [f"{p} > {c} (moving)" for p, c in sorted(self.moving)]
        if not links:
            return "it has no transforms at all"
        return f"its transforms: {_some(links)}"


def _some(texts: Sequence[str]) -> str:
    more = len(texts) - MAX_LISTED
    return ", ".join(texts[:MAX_LISTED]) + (f" and {more} more" if more > 0 else "")

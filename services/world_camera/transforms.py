"""Transforms between frames over time, as `/tf` and `/tf_static` publish them: a bounded buffer that interpolates."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, field
from time import monotonic_ns

import numpy as np

from scan2sim.pipeline.core.poses import interpolate
from scan2sim.pipeline.core.types import F64

HISTORY_NS = 10 * 10**9
"""Age, relative to the newest, up to which transforms are kept, as in tf2."""
MAX_LINKS, MAX_POSES = 10_000, 20_000
"""Frames, and transforms of a frame, that are kept at most."""
RESTART_COUNT, RESTART_NS = 3, 10**9
"""Number of transforms older than the newest, and the time in which nothing else arrives, after which the simulation
counts as begun again: late transforms come in bursts, or between others."""


@dataclass
class _Fixed:
    """A transform that never changes."""

    parent: str
    pose: F64
    newest: int | None = None

    def at(self, _: int) -> F64 | None:
        """The transform."""
        return self.pose


@dataclass
class _Moving:
    """Transforms of a frame to its parent over time: `times` in nanoseconds, ascending, and `poses` (4, 4)."""

    parent: str
    times: list[int] = field(default_factory=list)
    poses: list[F64] = field(default_factory=list)
    _late: list[tuple[int, F64]] = field(default_factory=list)
    _late_since: int = 0

    @property
    def newest(self) -> int:
        """Time of the newest transform."""
        return self.times[-1]

    def add(self, time: int, pose: F64, arrived: int) -> None:
        """Add a transform that arrived at a time of this machine's clock, nanoseconds.

        Late ones are sorted in, and those that are too old are ignored.
        """
        if not self.times or time >= self.newest:
            self._late.clear()
        elif self._is_restart(time, pose, arrived):
            self.times, self.poses = [one for one, _ in self._late], [one for _, one in self._late]
            self._late.clear()
            return
        if self.times and time < self.newest - HISTORY_NS:
            return
        k = bisect_left(self.times, time)
        if k < len(self.times) and self.times[k] == time:
            self.poses[k] = pose
            return
        self.times.insert(k, time)
        self.poses.insert(k, pose)
        first = max(bisect_left(self.times, self.newest - HISTORY_NS), len(self.times) - MAX_POSES)
        del self.times[:first], self.poses[:first]

    def _is_restart(self, time: int, pose: F64, arrived: int) -> bool:
        """Store a late transform; whether only late ones have arrived for some time, in ascending order."""
        if not self._late or time < self._late[-1][0]:
            self._late, self._late_since = [], arrived
        if not self._late or time > self._late[-1][0]:
            self._late.append((time, pose))
        del self._late[:-MAX_POSES]
        return len(self._late) >= RESTART_COUNT and arrived - self._late_since >= RESTART_NS

    def at(self, time: int) -> F64 | None:
        """The transform at a time; None before the oldest and after the newest."""
        if not self.times[0] <= time <= self.times[-1]:
            return None
        k = bisect_left(self.times, time)
        if self.times[k] == time:
            return self.poses[k]
        span = np.array([0, self.times[k] - self.times[k - 1]], np.float64)
        since = np.array([time - self.times[k - 1]], np.float64)
        return interpolate(np.stack(self.poses[k - 1 : k + 1]), span, since)[0]


class Transforms:
    """Trees of frames; a transform takes coordinates of a frame to those of its parent. Times are nanoseconds."""

    def __init__(self, clock: Callable[[], int] = monotonic_ns) -> None:
        """`clock`: this machine's, nanoseconds."""
        self._clock = clock
        self._links: dict[str, _Fixed | _Moving] = {}

    def add(self, parent: str, child: str, time: int, pose: F64) -> None:
        """Add the transform (4, 4) of a frame that moves."""
        link = self._links.get(child)
        if not isinstance(link, _Moving) or link.parent != parent:
            link = _Moving(parent)
        link.add(time, pose, self._clock())
        self._set(child, link)

    def add_static(self, parent: str, child: str, pose: F64) -> None:
        """Set the transform (4, 4) of a frame that is fixed to its parent."""
        self._set(child, _Fixed(parent, pose))

    def _set(self, child: str, link: _Fixed | _Moving) -> None:
        if child in self._links or len(self._links) < MAX_LINKS:
            self._links[child] = link

    def frames(self) -> list[str]:
        """Names of all frames, sorted."""
        return sorted({*self._links, *(link.parent for link in self._links.values())})

    def are_connected(self, target: str, source: str) -> bool:
        """Whether there is a chain of transforms between two frames."""
        return self._chains(target, source) is not None

    def newest(self, target: str, source: str) -> int | None:
        """Latest time at which all transforms between two frames are known; None if none of them moves.

        Raises:
            KeyError: the frames aren't connected.
        """
        chains = self._chains(target, source)
        if chains is None:
            raise KeyError(target, source)
        times = [self._links[name].newest for chain in chains for name in chain]
        return min((time for time in times if time is not None), default=None)

    def at(self, target: str, source: str, time: int) -> F64 | None:
        """`T_target_source` (4, 4) at a time; None if it isn't known then."""
        chains = self._chains(target, source)
        if chains is None:
            return None
        T_top_target, T_top_source = (self._product(chain, time) for chain in chains)
        if T_top_target is None or T_top_source is None:
            return None
        return np.asarray(np.linalg.inv(T_top_target) @ T_top_source, np.float64)

    def _product(self, chain: list[str], time: int) -> F64 | None:
        T = np.eye(4)
        for name in chain:
            pose = self._links[name].at(time)
            if pose is None:
                return None
            T = pose @ T
        return T

    def _chains(self, target: str, source: str) -> tuple[list[str], list[str]] | None:
        """Frames from the target, and from the source, up to below the nearest frame above both; None: none is."""
        above = self._ancestors(target)
        chain: list[str] = []
        for name in self._ancestors(source):
            if name in above:
                return above[: above.index(name)], chain
            chain.append(name)
        return None

    def _ancestors(self, frame: str) -> list[str]:
        """A frame and those above it, the nearest first; a loop ends where it begins again."""
        found = [frame]
        while found[-1] in self._links and (parent := self._links[found[-1]].parent) not in found:
            found.append(parent)
        return found

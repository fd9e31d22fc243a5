"""Odometry: frames to poses, one after the other (D3.2, section 4.1).

Every frame, features are followed and the camera is placed by those whose points are known; every few metres a
keyframe is added to the local map. When too few points agree, or speed and GPS don't, the car is lost: poses are
carried on at the last speed, or GPS's, and marked unsure; the last keyframes are looked for; where they aren't found, a
new map begins where the car is believed to be, never at the origin.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from scan2sim.pipeline.camera.poses import interpolate
from scan2sim.pipeline.core.parameters import Seed
from scan2sim.pipeline.core.types import F64, U8, Camera, GpsTrack
from scan2sim.slam.geometry import exp_so3, inverse, log_so3, relative_pose, rigid
from scan2sim.slam.mapping.local_map import Keyframe, LocalMap, MapParams, gps_distance
from scan2sim.slam.odometry.relocalization import Remembered, describe, relocalise
from scan2sim.slam.odometry.track_pose import Located, locate
from scan2sim.slam.odometry.virtual_cameras import Facets
from scan2sim.slam.trackers import Tracker, Tracks
from scan2sim.slam.trackers import named as tracker_named

AROUND, AHEAD = 3.0, 1.0
"""Degrees of parallax to a keyframe, for 360 cameras and for others; the latter's maps begin with no more, whatever is
asked: straight ahead features leave the view before they have moved much."""
LOST = 0.4
"""Seconds after which a new map is begun."""
QUARREL = 0.4, 2.5
"""Vision that says less, or more, of GPS's distance over two seconds is mistaken: it followed a bus, say."""
SETTLED = 15.0, 60.0
"""Metres after which a map's scale, first taken from two keyframes, is set by GPS anew."""
STILL = 1e-6 * np.eye(6)
"""Square metres, square radians: of a car that stands."""
REMEMBER = 20.0
"""Seconds for which the keyframes before a loss are looked for."""


class OdometryParams(MapParams):
    """How frames become poses, besides `MapParams`.

    Attributes:
        count: of features followed at a time.
        parallax: degrees; a keyframe where the median feature has moved so far, turning apart; None: 3 for a 360
            camera, 1 for others, in whose view little moves.
        survival: or where fewer than this share of the last keyframe's are still followed.
        seed: of random samples.
    """

    count: int = Field(700, ge=50, le=20_000)
    parallax: float | None = Field(None, ge=0.05, le=90)
    survival: float = Field(0.65, ge=0.01, le=0.99)
    seed: Seed = 0


@dataclass
class Placed:
    """Where a frame is.

    Attributes:
        time: seconds.
        keyframe: number of the one whose axes the pose is in.
        T_key_cam: (4, 4).
        unsure: it was bridged, not seen; or nothing ties the map that it was seen in to those before.
        covariance: (6, 6) of its pose against the map's points, metres and radians about world axes; None: bridged.
    """

    time: float
    keyframe: int
    T_key_cam: F64
    unsure: bool
    covariance: F64 | None = None


class Odometry:
    """Feed `add` with frames; `placed` and `map` hold what came out."""

    STATE = (
        "placed", "_rng", "_pose", "_time", "_velocity", "_started", "_blind", "_waiting", "_settled", "_adrift",
        "_lost_at", "_memory", "_known",
    )  # fmt: skip
    PARTS = ("map", "tracker")

    def __init__(
        self,
        camera: Camera,
        params: OdometryParams,
        *,
        mask: U8 | None = None,
        gps: GpsTrack | None = None,
        backend: str = "lm",
        tracker: Tracker | None = None,
        keep: bool = False,
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Begin.

        Args:
            camera: of the frames.
            params: see there.
            mask: (H, W), 0 where the car itself is seen.
            gps: the track, in the frames' times, smoothed; its distances are used.
            backend: name of one of `slam.solvers`.
            tracker: what follows features; default: corners.
            keep: keep all points and what keyframes see of them, for loops, adjustment and COLMAP.
            warn: receives what went wrong, and when.
        """
        self.params, self.gps, self.warn = params, gps, warn
        self.facets = Facets(camera)
        self.tracker = tracker or tracker_named("corners", self.facets, mask, params.count)
        self.map = LocalMap(camera, params, self.facets.pixel, gps=gps, backend=backend, keep=keep)
        self.placed: list[Placed] = []
        self._rng = np.random.default_rng(params.seed)
        self._masks = None if mask is None else self.facets.pictures(mask)
        self._pose, self._time = np.eye(4), 0.0
        self._velocity = np.zeros(6)
        self._started = self._blind = False
        self._parallax = math.radians(params.parallax or (AHEAD if self.facets.whole else AROUND))
        self._begins = min(self._parallax, math.radians(AHEAD)) if self.facets.whole else self._parallax
        self._waiting: list[Tracks] = []  # of frames since the first keyframe of a map, or since the car moved
        self._settled = 0
        self._adrift = False  # nothing ties this map to those before
        self._lost_at: float | None = None
        self._memory: list[tuple[list[U8], F64]] = []  # facets and poses of the last good keyframes
        self._known: tuple[float, list[Remembered]] | None = None

    # each frame

    def add(self, time: float, grey: U8) -> None:
        """The next frame (H, W), `time` in seconds, later than the last."""
        guess = self._predicted(time)
        self.tracker.track(grey, self._expected(guess))
        if not self.map.keyframes:
            self._time = time
            self._begin(time, np.eye(4))
        elif self._blind:
            self._anew(time, guess)
        elif not self._started:
            self._initialise(time, guess)
        else:
            self._continue(time, guess)

    def pose_of(self, placed: Placed) -> F64:
        """(4, 4) camera to world, as the map knows it now."""
        return self.map.keyframes[placed.keyframe].T_world_cam @ placed.T_key_cam

    def _predicted(self, time: float) -> F64:
        """The pose at the last speed; at GPS's while lost."""
        dt = time - self._time
        step = self._velocity[:3] * dt
        if self._lost_at is not None and self.gps is not None:
            far = gps_distance(self.gps, time - 1.0, time)
            length = float(np.linalg.norm(step))
            if far is not None and length > 0:
                step = step * (far * dt / length)
        return self._pose @ rigid(exp_so3(self._velocity[3:] * dt), step)

    def _expected(self, guess: F64) -> F64:
        """(N, 3) where tracks will probably be seen: known points at their place, others as the camera turns."""
        tracks = self.tracker.tracks
        expected = tracks.bearing @ (guess[:3, :3].T @ self._pose[:3, :3]).T
        rows, known = self.map.landmarks.find(tracks.ids)
        if self._started and known.any():
            seen = (self.map.landmarks.xyz[rows[known]] - guess[:3, 3]) @ guess[:3, :3]
            expected[known] = seen / np.maximum(np.linalg.norm(seen, axis=1, keepdims=True), 1e-9)
        return expected

    def _place(self, time: float, pose: F64, *, unsure: bool, covariance: F64 | None = None) -> None:
        """Keep a frame's pose, and what it says of the car's speed."""
        dt = time - self._time
        if dt > 0:
            moved = inverse(self._pose) @ pose
            self._velocity = np.concatenate([moved[:3, 3], log_so3(moved[:3, :3])]) / dt
        self._pose, self._time = pose, time
        last = len(self.map.keyframes) - 1
        from_key = inverse(self.map.keyframes[last].T_world_cam) @ pose
        self.placed.append(Placed(time, last, from_key, unsure or self._adrift, covariance))

    def _continue(self, time: float, guess: F64) -> None:
        found = locate(self.map, self.tracker.tracks, guess, self._velocity)
        self.tracker.drop(found.wrong)
        if not self._sound(time, found):
            self._bridge(time, guess)
            return
        if self._lost_at is not None:
            self.warn(f"{time:.2f} s: found again, {time - self._lost_at:.2f} s after it was lost")
            self._lost_at = None
        self._place(time, found.pose, unsure=False, covariance=found.covariance)
        if self._due():
            self._keyframe(time)

    def _sound(self, time: float, found: Located) -> bool:
        """Whether a pose can be believed: enough points agree, and no quarrel with GPS."""
        if found.agree < 20 or found.agree < 0.3 * found.known:
            return False
        if self.gps is None:
            return True
        since = time - 2.0
        far = gps_distance(self.gps, since, time)
        back = next((p for p in reversed(self.placed) if p.time <= since), None)
        if far is None or back is None or back.unsure:
            return True
        moved = float(np.linalg.norm(found.pose[:3, 3] - self.pose_of(back)[:3, 3]))
        return QUARREL[0] * far - 3 < moved < QUARREL[1] * far + 5

    def _common(self, keyframe: Keyframe) -> tuple[F64, F64]:
        """Bearings (M, 3) of what a keyframe saw and is still followed: there, and now."""
        tracks = self.tracker.tracks
        _, mine, his = np.intersect1d(tracks.ids, keyframe.ids, return_indices=True)
        return keyframe.bearing[his], tracks.bearing[mine]

    def _due(self) -> bool:
        """Whether this frame is to be a keyframe."""
        last = self.map.keyframes[-1]
        there, now = self._common(last)
        if len(now) < self.params.survival * len(last.ids):
            return True
        turn = last.T_world_cam[:3, :3].T @ self._pose[:3, :3]
        return _median_angle(now @ turn.T, there) > self._parallax

    def _keyframe(self, time: float) -> None:
        """Make the frame just placed a keyframe."""
        tracks = self.tracker.tracks
        self.tracker.drop(
            self.map.add(Keyframe(time, self._pose, tracks.ids, tracks.bearing, self.map.part, self._velocity))
        )
        self.tracker.refill()
        self.map.see(self.tracker.tracks.ids, self.tracker.tracks.bearing)
        self._settle()
        self._pose = self.map.keyframes[-1].T_world_cam
        self.placed[-1].keyframe, self.placed[-1].T_key_cam = len(self.map.keyframes) - 1, np.eye(4)
        self._memory = [*self._memory[-3:], (self.tracker.pictures, self._pose)]

    def _settle(self) -> None:
        """Set the scale of a map that has just become so long that GPS knows it well."""
        mine = [k for k in self.map.keyframes if k.part == self.map.part]
        if self.gps is None or self._settled >= len(SETTLED):
            return
        far = gps_distance(self.gps, mine[0].time, mine[-1].time)
        length = float(np.linalg.norm(mine[-1].T_world_cam[:3, 3] - mine[0].T_world_cam[:3, 3]))
        if far is None or far < SETTLED[self._settled] or length < 1e-6:
            return
        self._settled += 1
        self.map.rescale(far / length)
        first = len(self.map.keyframes) - len(mine)
        for placed in reversed(self.placed):
            if placed.keyframe < first:
                break
            placed.T_key_cam[:3, 3] *= far / length
        self._velocity = self._velocity * np.repeat([far / length, 1.0], 3)

    # beginning, and beginning anew

    def _begin(self, time: float, pose: F64, *, tied: bool = True) -> None:
        """The first keyframe of a map, unless there is nothing to see; `tied`: its place has been seen."""
        found = self.tracker.refill()
        tracks = self.tracker.tracks
        self._blind, self._started, self._waiting, self._settled = found < 30, False, [], 0
        if not self.map.keyframes or not self._blind:
            keyframe = Keyframe(time, pose, tracks.ids, tracks.bearing, self.map.part, self._velocity, tied)
            self.map.begin(keyframe)
        self._place(time, pose, unsure=self.map.part > 0 or self._blind)

    def _initialise(self, time: float, guess: F64) -> None:
        """A map's second keyframe, once features have moved enough against the first."""
        first = self.map.keyframes[-1]
        there, now = self._common(first)
        if len(now) < max(30, 0.2 * len(first.ids)):
            self._anew(time, guess)
            return
        moved, found = _median_angle(there, now), None
        if not self.map.part and moved < self.map.gate:  # the car stands
            self._waiting = []
            self._place(time, first.T_world_cam, unsure=False, covariance=STILL)
            return
        if moved > math.radians(0.5):
            found = relative_pose(there, now, threshold=self.map.gate, rng=self._rng)
        if found is None or _median_angle(now @ found[0][:3, :3].T, there) < self._begins:
            self._waiting.append(self.tracker.tracks)
            self._place(time, guess if self.map.part else first.T_world_cam, unsure=self.map.part > 0)
            return
        self._second(time, found[0], self._baseline(first, time, guess))

    def _second(self, time: float, T: F64, baseline: float) -> None:
        """A map's second keyframe, at T (4, 4) from the first, whose length is `baseline`; the frames between."""
        T[:3, 3] *= baseline
        since = self.placed[-1 - len(self._waiting)].time
        self._place(time, self.map.keyframes[-1].T_world_cam @ T, unsure=self.map.part > 0)
        self._velocity = np.concatenate([T[:3, 3], log_so3(T[:3, :3])]) / (time - since)
        self._started = True
        self._keyframe(time)
        if self.map.landmarks.find(self.tracker.tracks.ids)[1].sum() < 30:
            self.map.keyframes.pop()
            self.placed.pop()
            self._time = self.placed[-1].time
            self._anew(time, self._pose)
            return
        between, ends = self.placed[-1 - len(self._waiting) : -1], self.map.poses([-2, -1])
        guesses = interpolate(ends, np.array([since, time]), np.array([p.time for p in between]))
        for placed, tracks, guess in zip(between, self._waiting, guesses, strict=True):
            found = locate(self.map, tracks, guess, self._velocity)
            placed.T_key_cam = inverse(ends[0]) @ (guess if placed.unsure else found.pose)
            placed.covariance = None if placed.unsure else found.covariance

    def _baseline(self, first: Keyframe, time: float, guess: F64) -> float:
        """Metres between a map's first two keyframes: GPS's, else at the speed before, else 1."""
        far = gps_distance(self.gps, first.time, time)
        if far:
            return far
        moved = float(np.linalg.norm(guess[:3, 3] - first.T_world_cam[:3, 3]))
        return moved if self.map.part and moved > 0 else 1.0

    def _bridge(self, time: float, guess: F64) -> None:
        """A frame that can't be placed is carried on; after a while a new map begins."""
        if self._lost_at is None:
            self._lost_at = time
            self._known = None
            self.warn(f"{time:.2f} s: lost, poses are carried on")
        if time - self._lost_at > LOST:
            self._anew(time, guess)
        else:
            self._place(time, guess, unsure=True)

    def _anew(self, time: float, guess: F64) -> None:
        """A new map where the last keyframes say that the car is, else where it is believed to be."""
        if self._lost_at is None:
            self._lost_at = time
            self.warn(f"{time:.2f} s: lost, poses are carried on")
        self.map.part += 1
        self.tracker.tracks = Tracks()
        found = self._recognised(time)
        self._adrift = found is None and not self._bridged_by_gps(time)
        self._begin(time, guess if found is None else found, tied=found is not None)

    def _bridged_by_gps(self, time: float) -> bool:
        """Whether GPS tells how far the car came while it was lost."""
        return self._lost_at is not None and gps_distance(self.gps, self._lost_at - 1.0, time) is not None

    def _recognised(self, time: float) -> F64 | None:
        """The pose by the keyframes before the loss."""
        if self._lost_at is None or time - self._lost_at > REMEMBER or len(self._memory) < 2:
            return None
        if self._known is None:
            few = (self._memory[-1], self._memory[max(0, len(self._memory) - 3)])
            self._known = time, [Remembered(describe(self.facets, c, self._masks), pose) for c, pose in few]
        now = describe(self.facets, self.tracker.pictures, self._masks)
        found = relocalise(now, *self._known[1], sigma=self.map.sigma, rng=self._rng)
        if found is not None:
            self.warn(f"{time:.2f} s: recognised the place")
        return found


def _median_angle(a: F64, b: F64) -> float:
    """Radians between unit vectors (N, 3), the median."""
    return float(np.median(np.arccos(np.clip(np.einsum("ij,ij->i", a, b), -1, 1)))) if len(a) else 0.0

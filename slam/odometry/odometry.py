"""Visual odometry: estimates the camera pose of each frame in turn (D3.2, section 4.1).

In every frame, features are tracked, and the pose is estimated from those whose map points are known; every few metres
a keyframe is added to the local map. When too few points are inliers, or the displacement contradicts GPS, tracking is
lost: poses are dead-reckoned at the last velocity, or GPS's speed, and marked unsure, while relocalization searches
for the last keyframes. If it fails, a new map starts at the dead-reckoned pose, never at the origin.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Seed
from scan2sim.pipeline.core.poses import interpolate
from scan2sim.pipeline.core.types import F64, U8, Bools, Camera, GpsTrack
from scan2sim.slam.geometry import exp_so3, inverse, log_so3, relative_pose, rigid
from scan2sim.slam.mapping.local_map import (
    TRIANGULATION_SIGMAS,
    Keyframe,
    LocalMap,
    MapParams,
    gps_distance,
)
from scan2sim.slam.odometry.relocalization import KeyframeFeatures, detect_features, relocalize
from scan2sim.slam.odometry.track_pose import PoseEstimate, estimate_pose
from scan2sim.slam.trackers import Tracker, Tracks
from scan2sim.slam.trackers import named as tracker_named
from scan2sim.slam.virtual_cameras import VirtualViews

KEYFRAME_PARALLAX_DEG = 3.0
"""Median parallax to the last keyframe that triggers a new one, for 360 cameras."""
KEYFRAME_PARALLAX_PERSPECTIVE_DEG = 1.0
"""The same for perspective cameras, and an upper limit for the two-view initialization of their maps whatever
`parallax` is set to: when driving straight ahead, features leave the view before they have moved much."""
NEW_MAP_AFTER_S = 0.4
"""Seconds of lost tracking after which a new map is started."""
GPS_DISTANCE_RATIO_MIN, GPS_DISTANCE_RATIO_MAX = 0.4, 2.5
"""Accepted ratio of visual to GPS displacement over `GPS_CHECK_S`. Outside it the visual pose is rejected: it may have
tracked a moving bus."""
GPS_DISTANCE_SLACK_M = 3.0, 5.0
"""Metres by which the displacement may be below the minimum, or above the maximum, of that ratio."""
GPS_CHECK_S = 2.0
RESCALE_AT_M = 15.0, 60.0
"""Lengths of a map at which its scale, initially that of its first two keyframes, is reset from GPS."""
STANDSTILL_COVARIANCE = 1e-6 * np.eye(6)
"""Pose covariance of a standing car, square metres and square radians."""
RELOCALIZATION_S = 20.0
"""Seconds after a loss of tracking for which the keyframes before it are searched for."""
INLIERS_MIN, INLIER_SHARE_MIN = 20, 0.3
"""Inliers, and their share of the known points, that a pose needs to be plausible."""
MAP_FEATURES_MIN = 30
"""Features that a map's first keyframe needs, and points that its second one needs."""
INIT_TRACKED_SHARE_MIN = 0.2
"""Share of the features of a map's first keyframe that must still be tracked when its second one is added."""


class OdometryParams(MapParams):
    """Settings of feature tracking and keyframe selection, in addition to `MapParams`.

    Attributes:
        count: number of features tracked at a time.
        parallax: degrees; a frame becomes a keyframe when its median parallax to the last keyframe, rotation
            compensated, exceeds this. None: 3 for a 360 camera, 1 for a perspective one, in whose view little moves.
        min_tracked_share: a frame also becomes a keyframe when less than this share of the last keyframe's features is
        tracked.
        seed: seed of the random samples (RANSAC).
    """

    count: int = Field(700, ge=50, le=20_000)
    parallax: float | None = Field(None, ge=0.05, le=90)
    min_tracked_share: float = Field(0.65, ge=0.01, le=0.99)
    seed: Seed = 0


class Failure(NamedTuple):
    """Why tracking was lost: a measured number that is too small, or out of range.

    Attributes:
        what: what was measured.
        measured: its value.
        needed: least value; None if a greatest value was exceeded.
        allowed: greatest value; None if there is none.
    """

    what: str
    measured: float
    needed: float | None = None
    allowed: float | None = None

    def __str__(self) -> str:
        limits = [f"at least {self.needed:.4g}"] if self.needed is not None else []
        limits += [f"at most {self.allowed:.4g}"] if self.allowed is not None else []
        return f"{self.what}: {self.measured:.4g}, expected {' and '.join(limits)}"


@dataclass
class Loss:
    """A loss of tracking.

    Attributes:
        time: seconds.
        frame: index of the frame among the processed ones.
        failure: what failed.
        new_maps: number of maps that were started until tracking resumed.
        resumed: seconds of the first frame that was tracked again; None if there is none.
    """

    time: float
    frame: int
    failure: Failure
    new_maps: int = 0
    resumed: float | None = None


@dataclass
class Placed:
    """Pose of a frame, relative to a keyframe.

    Attributes:
        time: seconds.
        keyframe: index of the keyframe that the pose is relative to.
        T_key_cam: (4, 4) camera to keyframe.
        unsure: the pose was dead-reckoned, or the map it was estimated in is unanchored.
        covariance: (6, 6) of the pose relative to the map's points, metres and radians about world axes; None if it was
            dead-reckoned.
    """

    time: float
    keyframe: int
    T_key_cam: F64
    unsure: bool
    covariance: F64 | None = None


class Odometry:
    """Visual odometry: pass frames to `add`; `placed` holds their poses, `map` the local map, `losses` what failed."""

    STATE = (
        "placed", "_rng", "_pose", "_time", "_velocity", "_initialized", "_featureless", "_pending_tracks", "_rescaled",
        "_unanchored", "_lost_at", "_recent_keyframes", "_relocalization", "losses",
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
        """Odometry before its first frame.

        Args:
            camera: camera of the frames.
            params: settings.
            mask: (H, W) ego-vehicle mask, 0 where the car itself is visible.
            gps: smoothed GPS track in the frames' times; only its distances are used.
            backend: name of a solver in `slam.solvers`.
            tracker: feature tracker; default: corners by Lucas-Kanade.
            keep: keep all points and observations, for loop closure, global adjustment and the COLMAP model.
            warn: receives warnings, each beginning with its time.
        """
        self.params, self.gps, self.warn = params, gps, warn
        self.views = VirtualViews(camera)
        self.tracker = tracker or tracker_named("corners", self.views, mask, params.count)
        self.map = LocalMap(camera, params, self.views.pixel, gps=gps, backend=backend, keep=keep)
        self.placed: list[Placed] = []
        self.losses: list[Loss] = []
        self._rng = np.random.default_rng(params.seed)
        self._masks = None if mask is None else self.views.images(mask)
        self._pose, self._time = np.eye(4), 0.0
        self._velocity = np.zeros(6)
        self._initialized = self._featureless = False
        perspective = KEYFRAME_PARALLAX_PERSPECTIVE_DEG
        self._parallax = math.radians(params.parallax or (perspective if self.views.single else KEYFRAME_PARALLAX_DEG))
        self._init_parallax = min(self._parallax, math.radians(perspective)) if self.views.single else self._parallax
        self._pending_tracks: list[Tracks] = []  # of frames since the first keyframe of a map, or since the car moved
        self._rescaled = 0  # number of lengths in `RESCALE_AT_M` that this map has passed
        self._unanchored = False  # neither relocalization nor GPS connects this map to the previous ones
        self._lost_at: float | None = None
        self._recent_keyframes: list[tuple[list[U8], F64]] = []  # views and poses of the last good keyframes
        self._relocalization: tuple[float, list[KeyframeFeatures]] | None = None

    # --- each frame

    def add(self, time: float, grey: U8) -> None:
        """Process the next frame (H, W); `time` in seconds, later than that of the last frame."""
        guess = self._predicted_pose(time)
        self.tracker.track(grey, self._predicted_bearings(guess))
        if not self.map.keyframes:
            self._time = time
            self._first_keyframe(time, np.eye(4))
        elif self._featureless:
            self._start_new_map(time, guess, None)
        elif not self._initialized:
            self._initialize(time, guess)
        else:
            self._track_frame(time, guess)

    def pose_of(self, placed: Placed) -> F64:
        """(4, 4) camera to world, by the current pose of its keyframe."""
        return self.map.keyframes[placed.keyframe].T_world_cam @ placed.T_key_cam

    def _predicted_pose(self, time: float) -> F64:
        """(4, 4) pose at constant velocity; at GPS's speed while tracking is lost."""
        dt = time - self._time
        step = self._velocity[:3] * dt
        if self._lost_at is not None and self.gps is not None:
            gps_metres = gps_distance(self.gps, time - 1.0, time)
            length = float(np.linalg.norm(step))
            if gps_metres is not None and length > 0:
                step = step * (gps_metres * dt / length)
        return self._pose @ rigid(exp_so3(self._velocity[3:] * dt), step)

    def _predicted_bearings(self, guess: F64) -> F64:
        """(N, 3) predicted bearings of the tracks: known points are projected, the others turn with the camera."""
        tracks = self.tracker.tracks
        expected = tracks.bearing @ (guess[:3, :3].T @ self._pose[:3, :3]).T
        rows, known = self.map.landmarks.find(tracks.ids)
        if self._initialized and known.any():
            seen = (self.map.landmarks.xyz[rows[known]] - guess[:3, 3]) @ guess[:3, :3]
            expected[known] = seen / np.maximum(np.linalg.norm(seen, axis=1, keepdims=True), 1e-9)
        return expected

    def _append_pose(self, time: float, pose: F64, *, unsure: bool, covariance: F64 | None = None) -> None:
        """Store a frame's pose, and update the velocity from it."""
        dt = time - self._time
        if dt > 0:
            moved = inverse(self._pose) @ pose
            self._velocity = np.concatenate([moved[:3, 3], log_so3(moved[:3, :3])]) / dt
        self._pose, self._time = pose, time
        last = len(self.map.keyframes) - 1
        from_key = inverse(self.map.keyframes[last].T_world_cam) @ pose
        self.placed.append(Placed(time, last, from_key, unsure or self._unanchored, covariance))

    def _track_frame(self, time: float, guess: F64) -> None:
        """Estimate a frame's pose by the map, or dead-reckon it; make the frame a keyframe if one is needed."""
        found = estimate_pose(self.map, self.tracker.tracks, guess, self._velocity)
        self.tracker.drop(found.outliers)
        failure = self._failure(time, found)
        if failure is not None:
            self._dead_reckon(time, guess, failure)
            return
        if self._lost_at is not None:
            self.warn(f"{time:.2f} s: tracking resumed, {time - self._lost_at:.2f} s after it was lost")
            self.losses[-1].resumed = time
            self._lost_at = None
        self._append_pose(time, found.pose, unsure=False, covariance=found.covariance)
        if self._needs_keyframe():
            self._add_keyframe(time)

    def _failure(self, time: float, found: PoseEstimate) -> Failure | None:
        """What makes a pose implausible: too few inliers, or a displacement over `GPS_CHECK_S` that contradicts GPS."""
        needed = max(INLIERS_MIN, math.ceil(INLIER_SHARE_MIN * found.known))
        if found.inliers < needed:
            tracked = len(self.tracker.tracks)
            what = f"inliers among {found.known} map points observed by {tracked} tracked features"
            return Failure(what, found.inliers, needed)
        if self.gps is None:
            return None
        since = time - GPS_CHECK_S
        gps_metres = gps_distance(self.gps, since, time)
        back = next((p for p in reversed(self.placed) if p.time <= since), None)
        if gps_metres is None or back is None or back.unsure:
            return None
        moved = float(np.linalg.norm(found.pose[:3, 3] - self.pose_of(back)[:3, 3]))
        below, above = GPS_DISTANCE_SLACK_M
        least, most = GPS_DISTANCE_RATIO_MIN * gps_metres - below, GPS_DISTANCE_RATIO_MAX * gps_metres + above
        if least < moved < most:
            return None
        return Failure(f"metres over {GPS_CHECK_S:.0f} s, where GPS measured {gps_metres:.1f}", moved, least, most)

    def _common_bearings(self, keyframe: Keyframe) -> tuple[F64, F64]:
        """Bearings (M, 3) of a keyframe's features that are still tracked: in the keyframe, and now."""
        tracks = self.tracker.tracks
        _, now, then = np.intersect1d(tracks.ids, keyframe.ids, return_indices=True)
        return keyframe.bearing[then], tracks.bearing[now]

    def _needs_keyframe(self) -> bool:
        """Whether the current frame should become a keyframe: too few common features, or enough parallax."""
        last = self.map.keyframes[-1]
        then, now = self._common_bearings(last)
        if len(now) < self.params.min_tracked_share * len(last.ids):
            return True
        turn = last.T_world_cam[:3, :3].T @ self._pose[:3, :3]
        return _median_angle(now @ turn.T, then) > self._parallax

    def _add_keyframe(self, time: float) -> None:
        """Make the frame whose pose was appended last a keyframe."""
        tracks = self.tracker.tracks
        self.tracker.drop(
            self.map.add(Keyframe(time, self._pose, tracks.ids, tracks.bearing, self.map.part, self._velocity))
        )
        self.tracker.refill()
        self.map.add_observations(self.tracker.tracks.ids, self.tracker.tracks.bearing)
        self._rescale_to_gps()
        self._pose = self.map.keyframes[-1].T_world_cam
        self.placed[-1].keyframe, self.placed[-1].T_key_cam = len(self.map.keyframes) - 1, np.eye(4)
        self._recent_keyframes = [*self._recent_keyframes[-3:], (self.tracker.images, self._pose)]

    def _rescale_to_gps(self) -> None:
        """Reset the current map's scale from GPS when its length passes one of `RESCALE_AT_M`."""
        keyframes = [k for k in self.map.keyframes if k.part == self.map.part]
        if self.gps is None or self._rescaled >= len(RESCALE_AT_M):
            return
        gps_metres = gps_distance(self.gps, keyframes[0].time, keyframes[-1].time)
        length = float(np.linalg.norm(keyframes[-1].T_world_cam[:3, 3] - keyframes[0].T_world_cam[:3, 3]))
        if gps_metres is None or gps_metres < RESCALE_AT_M[self._rescaled] or length < 1e-6:
            return
        self._rescaled += 1
        self.map.rescale(gps_metres / length)
        first = len(self.map.keyframes) - len(keyframes)
        for placed in reversed(self.placed):
            if placed.keyframe < first:
                break
            placed.T_key_cam[:3, 3] *= gps_metres / length
        self._velocity = self._velocity * np.repeat([gps_metres / length, 1.0], 3)

    # --- initialization, loss of tracking, new maps

    def _first_keyframe(self, time: float, pose: F64, *, tied: bool = True) -> None:
        """Add a map's first keyframe, unless the image has too few features; `tied`: its pose was relocalized."""
        found = self.tracker.refill()
        tracks = self.tracker.tracks
        if found < MAP_FEATURES_MIN and not self._featureless:
            self._record_loss(time, Failure("features detected in the image", found, MAP_FEATURES_MIN))
        self._featureless = found < MAP_FEATURES_MIN
        self._initialized, self._pending_tracks, self._rescaled = False, [], 0
        if not self.map.keyframes or not self._featureless:
            keyframe = Keyframe(time, pose, tracks.ids, tracks.bearing, self.map.part, self._velocity, tied)
            self.map.start(keyframe)
        self._append_pose(time, pose, unsure=self.map.part > 0 or self._featureless)

    def _initialize(self, time: float, guess: F64) -> None:
        """Add a map's second keyframe once there is enough parallax to the first; until then keep the tracks."""
        first = self.map.keyframes[-1]
        then, now = self._common_bearings(first)
        moved, found = _median_angle(then, now), None
        if not self.map.part and len(now) >= MAP_FEATURES_MIN and moved < self.map.gate:  # the car does not move
            self._pending_tracks = []
            self._append_pose(time, first.T_world_cam, unsure=False, covariance=STANDSTILL_COVARIANCE)
            return
        if moved > math.radians(0.5):
            found = relative_pose(then, now, threshold=self.map.gate, rng=self._rng)
        tracked_share = len(now) / max(len(first.ids), 1)
        if found is not None and self._has_parallax(then, now, *found, tracked_share):
            self._two_view_init(time, found[0], self._baseline(first, time, guess))
            return
        needed = max(MAP_FEATURES_MIN, math.ceil(INIT_TRACKED_SHARE_MIN * len(first.ids)))
        if len(now) < needed:
            what = f"features still tracked of the {len(first.ids)} in the map's first keyframe"
            self._start_new_map(time, guess, Failure(what, len(now), needed))
            return
        self._pending_tracks.append(self.tracker.tracks)
        self._append_pose(time, guess if self.map.part else first.T_world_cam, unsure=self.map.part > 0)

    def _has_parallax(self, then: F64, now: F64, T: F64, inlier: Bools, tracked_share: float) -> bool:
        """Whether two views suffice to start a map: enough median parallax.

        In sharp turns, near features leave the view before the median, that of far features, has grown. So when
        features run out as for any keyframe, twice the points that a map needs suffice, with triangulable parallax.

        Args:
            then, now: (N, 3) bearings of common features in both views.
            T: (4, 4) pose of the second view in the first one's axes.
            inlier: (N,) features that fit it.
            tracked_share: share of the first view's features that are common.
        """
        parallax = _angles(now @ T[:3, :3].T, then)
        if np.median(parallax) >= self._init_parallax:
            return True
        triangulable = inlier & (parallax > TRIANGULATION_SIGMAS * self.map.sigma)
        return tracked_share < self.params.min_tracked_share and int(triangulable.sum()) >= 2 * MAP_FEATURES_MIN

    def _two_view_init(self, time: float, T: F64, baseline: float) -> None:
        """Add the second keyframe, and estimate the pending frames' poses by the points of both keyframes.

        Args:
            time: seconds.
            T: (4, 4) pose of the second keyframe in the first one's axes, with a unit baseline; is scaled in place.
            baseline: metres.
        """
        T[:3, 3] *= baseline
        since = self.placed[-1 - len(self._pending_tracks)].time
        self._append_pose(time, self.map.keyframes[-1].T_world_cam @ T, unsure=self.map.part > 0)
        self._velocity = np.concatenate([T[:3, 3], log_so3(T[:3, :3])]) / (time - since)
        self._initialized = True
        self._add_keyframe(time)
        points = int(self.map.landmarks.find(self.tracker.tracks.ids)[1].sum())
        if points < MAP_FEATURES_MIN:
            self.map.keyframes.pop()
            self.placed.pop()
            self._time = self.placed[-1].time
            failure = Failure("points triangulated from the map's first two keyframes", points, MAP_FEATURES_MIN)
            self._start_new_map(time, self._pose, failure)
            return
        between, ends = self.placed[-1 - len(self._pending_tracks) : -1], self.map.poses([-2, -1])
        guesses = interpolate(ends, np.array([since, time]), np.array([p.time for p in between]))
        for placed, tracks, guess in zip(between, self._pending_tracks, guesses, strict=True):
            found = estimate_pose(self.map, tracks, guess, self._velocity)
            placed.T_key_cam = inverse(ends[0]) @ (guess if placed.unsure else found.pose)
            placed.covariance = None if placed.unsure else found.covariance

    def _baseline(self, first: Keyframe, time: float, guess: F64) -> float:
        """Metres between a map's first two keyframes: by GPS, else by the previous map's velocity, else 1."""
        gps_metres = gps_distance(self.gps, first.time, time)
        if gps_metres:
            return gps_metres
        moved = float(np.linalg.norm(guess[:3, 3] - first.T_world_cam[:3, 3]))
        return moved if self.map.part and moved > 0 else 1.0

    def _dead_reckon(self, time: float, guess: F64, failure: Failure) -> None:
        """Extrapolate the pose of a frame that can't be tracked; after `NEW_MAP_AFTER_S` start a new map."""
        if self._lost_at is None:
            self._relocalization = None
            self._record_loss(time, failure)
        if self._lost_at is not None and time - self._lost_at > NEW_MAP_AFTER_S:
            self._start_new_map(time, guess, failure)
        else:
            self._append_pose(time, guess, unsure=True)

    def _record_loss(self, time: float, failure: Failure) -> None:
        """Store why tracking was lost, and warn, unless it was lost before."""
        if self._lost_at is None:
            self._lost_at = time
            self.losses.append(Loss(time, len(self.placed), failure))
            self.warn(f"{time:.2f} s: tracking lost, poses are dead-reckoned ({failure})")

    def _start_new_map(self, time: float, guess: F64, failure: Failure | None) -> None:
        """Start a map at the relocalized pose, or else at the dead-reckoned one; `failure`: of the last map."""
        if failure is not None:
            self._record_loss(time, failure)
        self.losses[-1].new_maps += 1
        self.map.part += 1
        self.tracker.tracks = Tracks()
        found = self._relocalized_pose(time)
        self._unanchored = found is None and not self._gps_spans_loss(time)
        self._first_keyframe(time, guess if found is None else found, tied=found is not None)

    def _gps_spans_loss(self, time: float) -> bool:
        """Whether GPS knows the distance driven since tracking was lost."""
        return self._lost_at is not None and gps_distance(self.gps, self._lost_at - 1.0, time) is not None

    def _relocalized_pose(self, time: float) -> F64 | None:
        """(4, 4) pose by two of the keyframes before the loss; None if they don't match, or it was too long ago."""
        if self._lost_at is None or time - self._lost_at > RELOCALIZATION_S or len(self._recent_keyframes) < 2:
            return None
        if self._relocalization is None:
            two = (self._recent_keyframes[-1], self._recent_keyframes[max(0, len(self._recent_keyframes) - 3)])
            features = [
                KeyframeFeatures(detect_features(self.views, images, self._masks), pose) for images, pose in two
            ]
            self._relocalization = time, features
        now = detect_features(self.views, self.tracker.images, self._masks)
        found = relocalize(now, *self._relocalization[1], sigma=self.map.sigma, rng=self._rng)
        if found is not None:
            self.warn(f"{time:.2f} s: relocalized by the keyframes before the loss")
        return found


def _angles(a: F64, b: F64) -> F64:
    """(N,) angles between unit vectors a and b (N, 3), radians."""
    return np.arccos(np.clip(np.einsum("ij,ij->i", a, b), -1, 1))


def _median_angle(a: F64, b: F64) -> float:
    """Median angle between unit vectors a and b (N, 3), radians; 0 if there are none."""
    return float(np.median(_angles(a, b))) if len(a) else 0.0

"""Local map: keyframes, their points, and the sliding window in which both are optimized (D3.2, section 4.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Distance
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.core.types import F64, I32, I64, Bools, Camera, GpsTrack
from scan2sim.slam import solvers
from scan2sim.slam.factor_graph import DistanceConstraint, Graph, errors
from scan2sim.slam.geometry import angles, triangulate
from scan2sim.slam.lens import lens_information
from scan2sim.slam.mapping import rolling_shutter as shared
from scan2sim.slam.mapping.marginalization import Information
from scan2sim.slam.solvers import lm

HELD_OUT_EVERY = 10
"""With `keep`, one in this number of features is held out: it never becomes a point, and serves cross-validation."""
TRIANGULATION_SIGMAS = 10
"""Least parallax of a new point, in standard deviations of a bearing."""
GPS_DISTANCE_MIN_M = 20
"""Shorter "long" GPS distances aren't used as constraints."""


class MapParams(Params):
    """Creation and rejection of points, and optimization; defaults are those of D3.2 where it gives any.

    Attributes:
        window: number of keyframes optimized together (D3.2: 20).
        fixed_keyframes: number of fixed keyframes before the window.
        sigma: standard deviation of a bearing, pixels.
        max_below_camera: metres; points farther below the camera are rejected (D3.2: 10).
        max_distance: metres; points farther away are rejected (D3.2: 500).
        max_error_deg: degrees; points whose median reprojection error is larger are rejected (D3.2: 0.7).
        min_views: number of keyframes that must observe a point (D3.2: 3).
        gps_distances: relative distance constraints from GPS within the window: "long" ones, "adjacent" ones (D3.2), or
            "none".
        gps_sigma: standard deviation of a GPS distance, metres.
        rolling_shutter: estimate the readout time, one value for all frames.
        lens_offset: estimate the distance between the front and back lens of a 360 camera.
    """

    window: int = Field(20, ge=3, le=500)
    fixed_keyframes: int = Field(5, ge=1, le=500)
    sigma: float = Field(0.5, ge=0.01, le=50)
    max_below_camera: Distance = 10.0
    max_distance: float = Field(500.0, ge=1, le=1_000_000)
    max_error_deg: float = Field(0.7, ge=0.001, le=180)
    min_views: int = Field(3, ge=2, le=100)
    gps_distances: Literal["long", "adjacent", "none"] = "long"
    gps_sigma: float = Field(1.5, ge=0.001, le=10_000)
    rolling_shutter: bool = False
    lens_offset: bool = False


@dataclass
class Keyframe:
    """A keyframe.

    Attributes:
        time: seconds.
        T_world_cam: (4, 4) camera to world.
        ids, bearing: (N,) ids and (N, 3) unit bearings of the observed features.
        part: index of the map it belongs to.
        velocity: (6,) metres and radians per second, in the camera's axes.
        tied: whether its pose was estimated relative to previous keyframes; otherwise it was dead-reckoned.
    """

    time: float
    T_world_cam: F64
    ids: I64
    bearing: F64
    part: int
    velocity: F64
    tied: bool = True


@dataclass
class Landmarks:
    """Map points: `ids` (P,) ascending, `xyz` (P, 3)."""

    ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    xyz: F64 = field(default_factory=lambda: np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.ids)

    def find(self, ids: I64) -> tuple[I64, Bools]:
        """(N,) rows of ids, and whether each id is a map point."""
        if not len(self.ids):
            return np.zeros(len(ids), np.int64), np.zeros(len(ids), bool)
        rows = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return rows, self.ids[rows] == ids

    def put(self, ids: I64, xyz: F64) -> None:
        """Add points, or replace those of the same ids."""
        keep = ~np.isin(self.ids, ids)
        ids, xyz = np.concatenate([self.ids[keep], ids]), np.concatenate([self.xyz[keep], xyz])
        order = np.argsort(ids)
        self.ids, self.xyz = ids[order], xyz[order]

    def keep(self, mask: Bools) -> Landmarks:
        """Remove all points but those selected by `mask` (P,); returns the removed ones."""
        removed = Landmarks(self.ids[~mask], self.xyz[~mask])
        self.ids, self.xyz = self.ids[mask], self.xyz[mask]
        return removed


@dataclass(frozen=True)
class Observations:
    """Observations by some keyframes, sorted by id.

    Attributes:
        ids: (O,) features.
        camera_of: (O,) index of the observing keyframe in the given list.
        bearing: (O, 3) unit vectors, camera axes.
    """

    ids: I64
    camera_of: I32
    bearing: F64

    def keep(self, mask: Bools) -> Observations:
        """Observations selected by `mask` (O,)."""
        return Observations(self.ids[mask], self.camera_of[mask], self.bearing[mask])


class LocalMap:
    """Keyframes and landmarks.

    Attributes:
        keyframes: all keyframes; without `keep`, older ones than the window have no observations.
        landmarks: points observed in the window.
        retired: marginalized points, which have left the window; only with `keep`.
        part: index of the current map; a new map is started when tracking was lost.
        information: information matrix of all keyframes' poses, from marginalized points.
        misfits: information on the lens from windows that turn (`slam.lens.lens_information`).
        pixel, sigma, gate: radians: a pixel, a bearing's standard deviation, and the inlier threshold.
        names, shared: names and values of the shared parameters (`slam.mapping.rolling_shutter`).
    """

    STATE = ("keyframes", "landmarks", "retired", "_others", "part", "shared", "misfits")
    PARTS = ("information",)

    def __init__(
        self, camera: Camera, params: MapParams, pixel: float, *, gps: GpsTrack | None, backend: str, keep: bool
    ) -> None:
        """`pixel`: radians; `backend`: a solver in `slam.solvers`; `keep`: keep points and observations of all time."""
        self.camera, self.params, self.gps, self.backend, self.keep = camera, params, gps, backend, keep
        self.solver = solvers.named(backend)
        self.pixel, self.sigma = pixel, params.sigma * pixel
        self.gate = 4 * self.sigma
        self.keyframes: list[Keyframe] = []
        self.landmarks = Landmarks()
        self.retired: list[Landmarks] = []
        self.information = Information(params.window + params.fixed_keyframes + 1)
        self.misfits: list[F64] = []
        self._others = 0  # number of entries in `retired` that belong to earlier maps
        self.part = 0
        available = zip(shared.NAMES, shared.SIGMA, (params.rolling_shutter, params.lens_offset), strict=True)
        chosen = [(name, sigma) for name, sigma, enabled in available if enabled]
        self.names = tuple(name for name, _ in chosen)
        self.shared, self._shared_sigma = np.zeros(len(chosen)), np.array([sigma for _, sigma in chosen])

    def start(self, keyframe: Keyframe) -> None:
        """Start a new map with its first keyframe."""
        self.marginalize()
        self._retire(self.landmarks)
        self.landmarks, self._others = Landmarks(), len(self.retired)
        self.keyframes.append(keyframe)
        self._leave_window()

    def add(self, keyframe: Keyframe) -> I64:
        """Add a keyframe: triangulate new points, optimize, reject outliers; returns ids of features to drop."""
        self.keyframes.append(keyframe)
        window = self.window()
        seen = self.observations(window)
        self._triangulate_new_points(window, seen)
        self._optimize(window, seen)
        if self.camera.model != "equirectangular" and len(self.keyframes) % (self.params.window // 2) == 0:
            self._check_lens(window, seen)
        self._leave_window()
        return self._reject_outliers(window, seen)

    def add_observations(self, ids: I64, bearing: F64) -> None:
        """Add newly detected features (N,), with bearings (N, 3), to the newest keyframe."""
        newest = self.keyframes[-1]
        fresh = ~np.isin(ids, newest.ids)
        newest.ids = np.concatenate([newest.ids, ids[fresh]])
        newest.bearing = np.concatenate([newest.bearing, bearing[fresh]])

    def rescale(self, factor: float) -> None:
        """Scale the current map about its first keyframe."""
        current = [k for k in self.keyframes if k.part == self.part]
        centre = current[0].T_world_cam[:3, 3].copy()
        for keyframe in current:
            keyframe.T_world_cam = keyframe.T_world_cam.copy()
            keyframe.T_world_cam[:3, 3] = centre + factor * (keyframe.T_world_cam[:3, 3] - centre)
            keyframe.velocity = keyframe.velocity * np.repeat([factor, 1.0], 3)
        for points in (self.landmarks, *self.retired[self._others :]):
            points.xyz = centre + factor * (points.xyz - centre)
        self.information.rescale(len(self.keyframes) - len(current), factor)

    def marginalize(self) -> None:
        """Add all current points' information on the keyframes to `information`; repeating it adds nothing."""
        if self.keyframes:
            part = self.keyframes[-1].part
            first = max(0, len(self.keyframes) - self.params.window - self.params.fixed_keyframes - 1)
            for k in range(first, len(self.keyframes)):
                if self.keyframes[k].part == part:
                    self._marginalize_points_of(k)

    def _marginalize_points_of(self, first: int) -> None:
        """Add the information of the points that keyframe `first` observes, on it and the later ones."""
        which = list(range(first, len(self.keyframes)))
        ids = self.information.not_added(self.keyframes[first].ids, first)
        seen = self.observations(which)
        seen = seen.keep(np.isin(seen.ids, ids[self.landmarks.find(ids)[1]]))
        if not len(seen.ids):
            return
        xyz = self.landmarks.xyz[self.landmarks.find(seen.ids)[0]]
        error = angles(self.poses(which)[seen.camera_of], xyz, seen.bearing)
        seen, error = seen.keep(error < self.gate), error[error < self.gate]
        point_ids, rows, counts = np.unique(seen.ids, return_inverse=True, return_counts=True)
        several = counts[rows] >= 2
        seen, error, point_ids = seen.keep(several), error[several], point_ids[counts >= 2]
        if len(point_ids):
            xyz = self.landmarks.xyz[self.landmarks.find(point_ids)[0]]
            graph = self.graph(which, seen, point_ids, xyz, np.zeros(len(which), bool))
            self.information.add(which, point_ids, lm.information(graph), error)

    def _retire(self, removed: Landmarks) -> None:
        if self.keep and len(removed):
            self.retired.append(removed)

    def _leave_window(self) -> None:
        """Marginalize the points of the keyframe that just left the window, and free its observations."""
        last = len(self.keyframes) - self.params.window - self.params.fixed_keyframes - 1
        if last < 0:
            return
        if self.keyframes[last].part == self.part:
            self._marginalize_points_of(last)
        if not self.keep:
            self.keyframes[last].ids, self.keyframes[last].bearing = np.zeros(0, np.int64), np.zeros((0, 3))

    def window(self) -> list[int]:
        """Indices of the current map's keyframes that are optimized or fixed in the optimization, oldest first."""
        first = max(0, len(self.keyframes) - self.params.window - self.params.fixed_keyframes)
        return [k for k in range(first, len(self.keyframes)) if self.keyframes[k].part == self.part]

    def poses(self, which: list[int]) -> F64:
        """(C, 4, 4) poses of keyframes, camera to world."""
        return np.stack([self.keyframes[k].T_world_cam for k in which])

    def observations(self, which: list[int]) -> Observations:
        """All observations by keyframes."""
        ids = np.concatenate([self.keyframes[k].ids for k in which])
        camera_of = np.repeat(np.arange(len(which), dtype=np.int32), [len(self.keyframes[k].ids) for k in which])
        bearing = np.concatenate([self.keyframes[k].bearing for k in which])
        order = np.lexsort((camera_of, ids))
        return Observations(ids[order], camera_of[order], bearing[order])

    def graph(
        self,
        which: list[int],
        seen: Observations,
        point_ids: I64,
        xyz: F64,
        fixed: Bools,
        distances: tuple[DistanceConstraint, ...] = (),
    ) -> Graph:
        """Factor graph of keyframes `which`, points `point_ids` (P,) ascending, at (P, 3), and their observations."""
        poses = self.poses(which)
        velocity = np.stack([self.keyframes[k].velocity for k in which])
        point_of = np.searchsorted(point_ids, seen.ids).astype(np.int32)
        return Graph(
            poses, xyz, point_of, seen.camera_of, seen.bearing, fixed, self.sigma, distances=distances,
            shared_jacobian=self.shared_jacobian(poses, velocity, seen.camera_of, seen.bearing), shared=self.shared,
            shared_sigma=self._shared_sigma,
        )  # fmt: skip

    def shared_jacobian(self, poses: F64, velocity: F64, camera_of: I32, bearing: F64) -> F64:
        """See `slam.mapping.rolling_shutter.shared_jacobian`."""
        if not self.names:
            return np.zeros((0, 0, 6))
        return shared.shared_jacobian(self.camera, self.names, poses, velocity, camera_of, bearing)

    def _triangulate_new_points(self, window: list[int], seen: Observations) -> None:
        """Triangulate tracks that enough keyframes observe, with enough parallax."""
        seen = seen.keep(~self.landmarks.find(seen.ids)[1])
        if self.keep:
            seen = seen.keep(seen.ids % HELD_OUT_EVERY > 0)
        point_ids, counts = np.unique(seen.ids, return_counts=True)
        needed = min(len(window), self.params.min_views)
        point_ids = point_ids[(counts >= needed) & np.isin(point_ids, self.keyframes[-1].ids)]
        seen = seen.keep(np.isin(seen.ids, point_ids))
        if not len(point_ids):
            return
        starts = np.append(np.searchsorted(seen.ids, point_ids), len(seen.ids))
        xyz, angle = triangulate(self.poses(window), starts, seen.camera_of, seen.bearing)
        good = np.isfinite(xyz[:, 0]) & (angle > TRIANGULATION_SIGMAS * self.sigma)
        graph = self.graph(window, seen, point_ids, xyz, np.zeros(len(window), bool))
        with np.errstate(invalid="ignore"):
            worst = np.maximum.reduceat(errors(graph, graph.poses, xyz, self.shared), starts[:-1])
            good &= (worst < 1.5 * self.gate) & self._in_range(xyz)
        self.landmarks.put(point_ids[good], xyz[good])

    def _in_range(self, xyz: F64) -> Bools:
        """(P,) whether points are neither too far below the newest camera nor too far away."""
        newest = self.keyframes[-1].T_world_cam
        seen = xyz - newest[:3, 3]
        return (seen @ newest[:3, 1] < self.params.max_below_camera) & (
            np.linalg.norm(seen, axis=1) < self.params.max_distance
        )

    def _optimize(self, window: list[int], seen: Observations) -> None:
        """Optimize the window's keyframes and points; the oldest keyframes are fixed."""
        seen = seen.keep(self.landmarks.find(seen.ids)[1])
        point_ids, counts = np.unique(seen.ids, return_counts=True)
        point_ids = point_ids[counts >= 2]
        seen = seen.keep(np.isin(seen.ids, point_ids))
        if not len(point_ids):
            return
        fixed = np.arange(len(window)) < max(1, len(window) - self.params.window)
        distances = self._gps_constraints(window)
        if fixed.sum() == 1 and not distances:  # nothing else fixes the scale
            start, end = self.poses(window[:2])[:, :3, 3]
            length = max(float(np.linalg.norm(end - start)), 1e-6)
            distances = (DistanceConstraint(0, 1, length, 1e-3 * length),)
        xyz = self.landmarks.xyz[self.landmarks.find(point_ids)[0]]
        solved = self.solver.solve(self.graph(window, seen, point_ids, xyz, fixed, distances))
        for k, pose in zip(window, solved.poses, strict=True):
            self.keyframes[k].T_world_cam = pose
        self.landmarks.put(point_ids, solved.points)
        self.shared = solved.shared

    def _check_lens(self, window: list[int], seen: Observations) -> None:
        """Collect the window's information on the lens."""
        seen = seen.keep(self.landmarks.find(seen.ids)[1])
        point_ids, rows, counts = np.unique(seen.ids, return_inverse=True, return_counts=True)
        point_ids, seen = point_ids[counts > 2], seen.keep(counts[rows] > 2)
        if len(point_ids) and len(window) > 2:
            xyz = self.landmarks.xyz[self.landmarks.find(point_ids)[0]]
            information = lens_information(
                self.camera, self.graph(window, seen, point_ids, xyz, np.zeros(len(window), bool))
            )
            self.misfits += [] if information is None else [information]

    def _gps_constraints(self, window: list[int]) -> tuple[DistanceConstraint, ...]:
        """Relative distance constraints from GPS within the window."""
        if self.gps is None or self.params.gps_distances == "none" or len(window) < 3:
            return ()
        adjacent = self.params.gps_distances == "adjacent"
        n = len(window)
        pairs = [(i, i + 1) for i in range(n - 1)] if adjacent else [(0, j) for j in range(n // 2, n)]
        constraints = []
        for i, j in pairs:
            metres = gps_distance(self.gps, self.keyframes[window[i]].time, self.keyframes[window[j]].time)
            if metres is not None and (adjacent or metres > GPS_DISTANCE_MIN_M):
                sigma = self.params.gps_sigma * math.sqrt(len(pairs))
                constraints.append(DistanceConstraint(i, j, metres, sigma))
        return tuple(constraints)

    def _reject_outliers(self, window: list[int], seen: Observations) -> I64:
        """Remove points by the criteria of D3.2, and retire those that left the window; returns the removed ids."""
        rows, known = self.landmarks.find(seen.ids)
        seen, rows = seen.keep(known), rows[known]
        xyz = self.landmarks.xyz
        graph = self.graph(window, seen, self.landmarks.ids, xyz, np.zeros(len(window), bool))
        error = errors(graph, graph.poses, xyz, self.shared)
        counts = np.bincount(rows, minlength=len(xyz))
        middle = np.cumsum(counts) - counts + counts // 2
        median = np.full(len(xyz), np.inf)
        median[counts > 0] = error[np.lexsort((error, rows))][middle[counts > 0]]
        bad = (median > min(math.radians(self.params.max_error_deg), 2 * self.gate)) | ~self._in_range(xyz)
        ids = self.landmarks.ids[bad & (counts > 0)]
        self._retire(self.landmarks.keep(counts > 0))
        self.landmarks.keep(~np.isin(self.landmarks.ids, ids))
        return ids


def gps_distance(gps: GpsTrack | None, start: float, end: float) -> float | None:
    """Distance between the GPS positions at two times, metres; None if unknown.

    The track is extrapolated by up to a second before its first and after its last fix.
    """
    if gps is None:
        return None
    first, last = np.clip((start, end), gps.times[0], gps.times[-1])
    if last <= first or max(first - start, end - last) > 1.0:
        return None
    metres = float(gps.distance(first, last)) * (end - start) / (last - first)
    return None if math.isnan(metres) else metres

"""The local map: keyframes, the points they see, and the window in which both are optimised (D3.2, section 4.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Reach
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.core.types import F64, I32, I64, Bools, Camera, GpsTrack
from scan2sim.slam import solvers
from scan2sim.slam.calibration.lens import misfit
from scan2sim.slam.geometry import angles, triangulate
from scan2sim.slam.mapping import rolling_shutter as shared
from scan2sim.slam.mapping.factor_graph import Chord, Graph, errors
from scan2sim.slam.mapping.marginalization import Information
from scan2sim.slam.solvers import lm

WITNESSES = 10
"""Of so many features one never becomes a point where all is kept: a path is judged by them that they had no say in."""


class MapParams(Params):
    """How points come and go, and what is optimised; the mission's numbers where it gives any.

    Attributes:
        window: keyframes that are optimised together (D3.2: 20).
        anchors: older ones that stay and hold the window.
        sigma: pixels, of a bearing.
        below: metres; points farther below the camera are rejected (D3.2: 10).
        beyond: metres; points farther away are rejected (D3.2: 500).
        off: degrees; points whose median error is larger are rejected (D3.2: 0.7).
        views: keyframes that must see a point (D3.2: 3).
        gps_chords: distances by GPS within the window: "long" ones, "adjacent" ones (D3.2), or "none".
        gps_sigma: metres, of a GPS distance.
        rolling_shutter: estimate the readout time, one for all frames.
        lens_offset: estimate how far the front and back lens of a 360 camera are apart.
    """

    window: int = Field(20, ge=3, le=500)
    anchors: int = Field(5, ge=1, le=500)
    sigma: float = Field(0.5, ge=0.01, le=50)
    below: Reach = 10.0
    beyond: float = Field(500.0, ge=1, le=1_000_000)
    off: float = Field(0.7, ge=0.001, le=180)
    views: int = Field(3, ge=2, le=100)
    gps_chords: Literal["long", "adjacent", "none"] = "long"
    gps_sigma: float = Field(1.5, ge=0.001, le=10_000)
    rolling_shutter: bool = False
    lens_offset: bool = False


@dataclass
class Keyframe:
    """A frame of the graph.

    Attributes:
        time: seconds.
        T_world_cam: (4, 4).
        ids, bearing: (N,), (N, 3) the features it sees.
        part: number of the map it belongs to.
        velocity: (6,) metres and radians a second, in the camera's axes.
        tied: whether it was placed by what the keyframes before it see; else it is where it is believed to be.
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
    """Points that are known: `ids` (P,) ascending, `xyz` (P, 3)."""

    ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    xyz: F64 = field(default_factory=lambda: np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.ids)

    def find(self, ids: I64) -> tuple[I64, Bools]:
        """(N,) rows of ids, and whether each is known."""
        if not len(self.ids):
            return np.zeros(len(ids), np.int64), np.zeros(len(ids), bool)
        rows = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return rows, self.ids[rows] == ids

    def put(self, ids: I64, xyz: F64) -> None:
        """Add, or replace."""
        keep = ~np.isin(self.ids, ids)
        ids, xyz = np.concatenate([self.ids[keep], ids]), np.concatenate([self.xyz[keep], xyz])
        order = np.argsort(ids)
        self.ids, self.xyz = ids[order], xyz[order]

    def keep(self, mask: Bools) -> Landmarks:
        """Drop all but those that `mask` (P,) selects; returns the dropped."""
        gone = Landmarks(self.ids[~mask], self.xyz[~mask])
        self.ids, self.xyz = self.ids[mask], self.xyz[mask]
        return gone


@dataclass(frozen=True)
class Observations:
    """Of some keyframes, sorted by id: `ids` (O,), `of` (O,) place of the keyframe among them, `bearing` (O, 3)."""

    ids: I64
    of: I32
    bearing: F64

    def keep(self, mask: Bools) -> Observations:
        """Those that `mask` (O,) selects."""
        return Observations(self.ids[mask], self.of[mask], self.bearing[mask])


class LocalMap:
    """Keyframes and landmarks; `part` counts the maps begun."""

    STATE = ("keyframes", "landmarks", "retired", "_others", "part", "shared", "misfits")
    PARTS = ("information",)

    def __init__(
        self, camera: Camera, params: MapParams, pixel: float, *, gps: GpsTrack | None, backend: str, keep: bool
    ) -> None:
        """`pixel`: radians; `backend`: name of one of `slam.solvers`; `keep`: remember what has left the window."""
        self.camera, self.params, self.gps, self.backend, self.keep = camera, params, gps, backend, keep
        self.pixel, self.sigma = pixel, params.sigma * pixel
        self.gate = 4 * self.sigma
        self.keyframes: list[Keyframe] = []
        self.landmarks = Landmarks()
        self.retired: list[Landmarks] = []
        self.information = Information(params.window + params.anchors + 1)
        self.misfits: list[F64] = []  # what windows that turn say of the lens
        self._others = 0  # of those retired, how many are of earlier maps
        self.part = 0
        wanted = zip(shared.NAMES, shared.SIGMA, (params.rolling_shutter, params.lens_offset), strict=True)
        chosen = [(name, sigma) for name, sigma, on in wanted if on]
        self.names = tuple(name for name, _ in chosen)
        self.shared, self._shared_sigma = np.zeros(len(chosen)), np.array([sigma for _, sigma in chosen])

    def begin(self, keyframe: Keyframe) -> None:
        """A new map, of one keyframe."""
        self.tell()
        self._retire(self.landmarks)
        self.landmarks, self._others = Landmarks(), len(self.retired)
        self.keyframes.append(keyframe)
        self._forget()

    def add(self, keyframe: Keyframe) -> I64:
        """A keyframe more: new points, optimisation, rejections; ids of features that are no good."""
        self.keyframes.append(keyframe)
        self._new_points()
        self._optimise()
        if self.camera.model != "equirectangular" and len(self.keyframes) % (self.params.window // 2) == 0:
            self._check_lens()
        self._forget()
        return self._reject()

    def see(self, ids: I64, bearing: F64) -> None:
        """The newest keyframe sees features that have just been found, too."""
        newest = self.keyframes[-1]
        fresh = ~np.isin(ids, newest.ids)
        newest.ids = np.concatenate([newest.ids, ids[fresh]])
        newest.bearing = np.concatenate([newest.bearing, bearing[fresh]])

    def rescale(self, factor: float) -> None:
        """Enlarge this map about its first keyframe."""
        mine = [k for k in self.keyframes if k.part == self.part]
        centre = mine[0].T_world_cam[:3, 3].copy()
        for keyframe in mine:
            keyframe.T_world_cam = keyframe.T_world_cam.copy()
            keyframe.T_world_cam[:3, 3] = centre + factor * (keyframe.T_world_cam[:3, 3] - centre)
            keyframe.velocity = keyframe.velocity * np.repeat([factor, 1.0], 3)
        for points in (self.landmarks, *self.retired[self._others :]):
            points.xyz = centre + factor * (points.xyz - centre)
        self.information.rescale(len(self.keyframes) - len(mine), factor)

    def tell(self) -> None:
        """Let all points that are known say what they do of the keyframes; twice is once."""
        if self.keyframes:
            part = self.keyframes[-1].part
            first = max(0, len(self.keyframes) - self.params.window - self.params.anchors - 1)
            for k in range(first, len(self.keyframes)):
                if self.keyframes[k].part == part:
                    self._tell(k)

    def _tell(self, first: int) -> None:
        """Let the points that a keyframe sees say what they do of it and of those after it."""
        which = list(range(first, len(self.keyframes)))
        ids = self.information.untold(self.keyframes[first].ids, first)
        seen = self.observations(which)
        seen = seen.keep(np.isin(seen.ids, ids[self.landmarks.find(ids)[1]]))
        if not len(seen.ids):
            return
        xyz = self.landmarks.xyz[self.landmarks.find(seen.ids)[0]]
        error = angles(self.poses(which)[seen.of], xyz, seen.bearing)
        seen, error = seen.keep(error < self.gate), error[error < self.gate]
        names, rows, counts = np.unique(seen.ids, return_inverse=True, return_counts=True)
        several = counts[rows] >= 2
        seen, error, names = seen.keep(several), error[several], names[counts >= 2]
        if len(names):
            xyz = self.landmarks.xyz[self.landmarks.find(names)[0]]
            graph = self.graph(which, seen, names, xyz, np.zeros(len(which), bool))
            self.information.tell(which, names, lm.information(graph), error)

    def _retire(self, gone: Landmarks) -> None:
        if self.keep and len(gone):
            self.retired.append(gone)

    def _forget(self) -> None:
        """What keyframes saw that have left the window, so that memory doesn't grow."""
        last = len(self.keyframes) - self.params.window - self.params.anchors - 1
        if last < 0:
            return
        if self.keyframes[last].part == self.part:
            self._tell(last)
        if not self.keep:
            self.keyframes[last].ids, self.keyframes[last].bearing = np.zeros(0, np.int64), np.zeros((0, 3))

    def window(self) -> list[int]:
        """Keyframes of this map that are optimised or hold those that are, oldest first."""
        first = max(0, len(self.keyframes) - self.params.window - self.params.anchors)
        return [k for k in range(first, len(self.keyframes)) if self.keyframes[k].part == self.part]

    def poses(self, which: list[int]) -> F64:
        """(C, 4, 4)."""
        return np.stack([self.keyframes[k].T_world_cam for k in which])

    def observations(self, which: list[int]) -> Observations:
        """What keyframes see."""
        ids = np.concatenate([self.keyframes[k].ids for k in which])
        of = np.repeat(np.arange(len(which), dtype=np.int32), [len(self.keyframes[k].ids) for k in which])
        bearing = np.concatenate([self.keyframes[k].bearing for k in which])
        order = np.lexsort((of, ids))
        return Observations(ids[order], of[order], bearing[order])

    def graph(
        self, which: list[int], seen: Observations, names: I64, xyz: F64, fixed: Bools, chords: tuple[Chord, ...] = ()
    ) -> Graph:
        """Keyframes `which`, points `names` (P,) ascending at (P, 3), and what is seen of them."""
        poses = self.poses(which)
        velocity = np.stack([self.keyframes[k].velocity for k in which])
        return Graph(
            poses, xyz, np.searchsorted(names, seen.ids).astype(np.int32), seen.of, seen.bearing, fixed, self.sigma,
            chords=chords, bend=self.bend(poses, velocity, seen.of, seen.bearing), shared=self.shared,
            shared_sigma=self._shared_sigma,
        )  # fmt: skip

    def bend(self, poses: F64, velocity: F64, of: I32, bearing: F64) -> F64:
        """See `slam.mapping.rolling_shutter.bend`."""
        if not self.names:
            return np.zeros((0, 0, 6))
        return shared.bend(self.camera, self.names, poses, velocity, of, bearing)

    def _new_points(self) -> None:
        """Tracks that enough keyframes see, from directions that differ, become points."""
        window = self.window()
        seen = self.observations(window)
        seen = seen.keep(~self.landmarks.find(seen.ids)[1])
        if self.keep:
            seen = seen.keep(seen.ids % WITNESSES > 0)
        names, counts = np.unique(seen.ids, return_counts=True)
        needed = min(len(window), self.params.views)
        names = names[(counts >= needed) & np.isin(names, self.keyframes[-1].ids)]
        seen = seen.keep(np.isin(seen.ids, names))
        if not len(names):
            return
        starts = np.append(np.searchsorted(seen.ids, names), len(seen.ids))
        xyz, angle = triangulate(self.poses(window), starts, seen.of, seen.bearing)
        good = np.isfinite(xyz[:, 0]) & (angle > 10 * self.sigma)
        graph = self.graph(window, seen, names, xyz, np.zeros(len(window), bool))
        with np.errstate(invalid="ignore"):
            worst = np.maximum.reduceat(errors(graph, graph.poses, xyz, self.shared), starts[:-1])
            good &= (worst < 1.5 * self.gate) & self._within(xyz)
        self.landmarks.put(names[good], xyz[good])

    def _within(self, xyz: F64) -> Bools:
        """(P,) not too far below the newest camera, nor too far away."""
        newest = self.keyframes[-1].T_world_cam
        seen = xyz - newest[:3, 3]
        return (seen @ newest[:3, 1] < self.params.below) & (np.linalg.norm(seen, axis=1) < self.params.beyond)

    def _optimise(self) -> None:
        """The window's keyframes and points; the oldest hold still."""
        window = self.window()
        seen = self.observations(window)
        seen = seen.keep(self.landmarks.find(seen.ids)[1])
        names, counts = np.unique(seen.ids, return_counts=True)
        names = names[counts >= 2]
        seen = seen.keep(np.isin(seen.ids, names))
        if not len(names):
            return
        fixed = np.arange(len(window)) < max(1, len(window) - self.params.window)
        chords = self._chords(window)
        if fixed.sum() == 1 and not chords:  # nothing else holds the scale
            start, end = self.poses(window[:2])[:, :3, 3]
            length = max(float(np.linalg.norm(end - start)), 1e-6)
            chords = (Chord(0, 1, length, 1e-3 * length),)
        xyz = self.landmarks.xyz[self.landmarks.find(names)[0]]
        solved = solvers.named(self.backend).solve(self.graph(window, seen, names, xyz, fixed, chords))
        for k, pose in zip(window, solved.poses, strict=True):
            self.keyframes[k].T_world_cam = pose
        self.landmarks.put(names, solved.points)
        self.shared = solved.shared

    def _check_lens(self) -> None:
        """Ask the window whether the lens fits."""
        window = self.window()
        seen = self.observations(window)
        seen = seen.keep(self.landmarks.find(seen.ids)[1])
        names, rows, counts = np.unique(seen.ids, return_inverse=True, return_counts=True)
        names, seen = names[counts > 2], seen.keep(counts[rows] > 2)
        if len(names) and len(window) > 2:
            xyz = self.landmarks.xyz[self.landmarks.find(names)[0]]
            says = misfit(self.camera, self.graph(window, seen, names, xyz, np.zeros(len(window), bool)))
            self.misfits += [] if says is None else [says]

    def _chords(self, window: list[int]) -> tuple[Chord, ...]:
        """GPS distances within the window."""
        if self.gps is None or self.params.gps_chords == "none" or len(window) < 3:
            return ()
        near = self.params.gps_chords == "adjacent"
        n = len(window)
        pairs = [(i, i + 1) for i in range(n - 1)] if near else [(0, j) for j in range(n // 2, n)]
        chords = []
        for i, j in pairs:
            far = gps_distance(self.gps, self.keyframes[window[i]].time, self.keyframes[window[j]].time)
            if far is not None and (near or far > 20):
                chords.append(Chord(i, j, far, self.params.gps_sigma * math.sqrt(len(pairs))))
        return tuple(chords)

    def _reject(self) -> I64:
        """The mission's rejections; points that have left the window are retired."""
        window = self.window()
        seen = self.observations(window)
        rows, known = self.landmarks.find(seen.ids)
        seen, rows = seen.keep(known), rows[known]
        xyz = self.landmarks.xyz
        graph = self.graph(window, seen, self.landmarks.ids, xyz, np.zeros(len(window), bool))
        error = errors(graph, graph.poses, xyz, self.shared)
        counts = np.bincount(rows, minlength=len(xyz))
        middle = np.cumsum(counts) - counts + counts // 2
        median = np.full(len(xyz), np.inf)
        median[counts > 0] = error[np.lexsort((error, rows))][middle[counts > 0]]
        bad = (median > min(math.radians(self.params.off), 2 * self.gate)) | ~self._within(xyz)
        ids = self.landmarks.ids[bad & (counts > 0)]
        self._retire(self.landmarks.keep(counts > 0))
        self.landmarks.keep(~np.isin(self.landmarks.ids, ids))
        return ids


def gps_distance(gps: GpsTrack | None, start: float, end: float) -> float | None:
    """Metres between two times, None where GPS doesn't say; a second before and after its fixes it is believed to."""
    if gps is None:
        return None
    first, last = np.clip((start, end), gps.times[0], gps.times[-1])
    if last <= first or max(first - start, end - last) > 1.0:
        return None
    far = float(gps.distance(first, last)) * (end - start) / (last - first)
    return None if math.isnan(far) else far

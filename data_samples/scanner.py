"""Drive of the recording vehicle, and its lidar scanner: a rotating fan of beams."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.data_samples.layout import FRAME, Layout
from scan2sim.data_samples.paints import Material
from scan2sim.data_samples.scene import TRUTH_FOOTPRINT_M, CarPoses, Scene, srgb
from scan2sim.data_samples.shapes import Part
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32, F64, I32, Bools, PointCloud, Trajectory

START_TIME_S = 412_300.0  # GPS time of week, seconds
SPEED_M_S = 10.0
PASS_BREAK_S = 24.0  # between passes
BEAMS = 64
ROTATION_HZ = 10.0
ELEVATION_MIN_DEG, ELEVATION_MAX_DEG = -38.0, 50.0
"""Ends of the fan of beams: from the road beside the vehicle to 12 m high facades."""
AXIS_TILT_DEG = 14.0
"""Forward tilt of the rotation axis: a vertical one would leave a stripe unscanned at the scanner's height."""
SCANNER_HEIGHT_M = 2.0
RANGE_MAX_M = 70.0
RANGE_NOISE_M = 0.01  # standard deviation
COLOUR_NOISE = 2.5  # standard deviation, in 8-bit levels
POINTS_PER_METRE_MAX = 150_000.0  # points per metre of road from two passes; denser clouds need more passes
RAYS_PER_BLOCK = 1 << 20  # cast at a time
REFLECTIVITY = {
    Material.FOLIAGE: 0.55,
    Material.GRASS: 0.45,
    Material.SIGN: 0.95,
    Material.WINDOW: 0.12,
    Material.CAR_GLASS: 0.10,
}


@dataclass(frozen=True)
class Drive:
    """Motion of the vehicle: passes up and down the street, each in the right-hand lane."""

    layout: Layout
    passes: int

    @property
    def duration(self) -> float:
        """Duration of a pass, seconds."""
        return self.layout.axis.length / SPEED_M_S

    def start(self, index: int) -> float:
        """GPS time at which a pass starts."""
        return START_TIME_S + index * (self.duration + PASS_BREAK_S)

    def time_at(self, s: float) -> float:
        """GPS time at which the first pass is at chainage `s`."""
        return START_TIME_S + s / SPEED_M_S

    def ground(self, time: F64) -> tuple[F64, F64]:
        """(N, 3) local point on the ground below the scanner, and (N,) heading, at times (N,)."""
        index, along = self._where(time)
        forwards = index % 2 == 0
        s = np.where(forwards, along, self.layout.axis.length - along)
        t = np.where(forwards, -0.5, 0.5) * self.layout.lane
        xy, heading = self.layout.axis.place(s, t)
        z = self.layout.height(s, t)
        return np.concatenate([xy, z[:, None]], axis=1), heading + np.where(forwards, 0.0, np.pi)

    def _where(self, time: F64) -> tuple[F64, F64]:
        """(N,) index of the pass, and (N,) metres driven in it."""
        since = np.asarray(time, np.float64) - START_TIME_S
        index = np.clip(np.floor(since / (self.duration + PASS_BREAK_S)), 0, self.passes - 1)
        return index, np.clip(since - index * (self.duration + PASS_BREAK_S), 0, self.duration) * SPEED_M_S

    def car(self, scene: Scene, time: F64) -> CarPoses:
        """Poses of all that moves at `time` (N,): a car approaches the vehicle in the other lane, once per pass."""
        position, heading, inside = (np.stack(values, axis=1) for values in zip(*self.movers(scene, time), strict=True))
        return CarPoses(position.astype(np.float32), heading.astype(np.float32), inside)

    def movers(self, scene: Scene, time: F64) -> list[tuple[F64, F64, Bools]]:
        """Position (N, 3), heading (N,) and presence (N,) of the oncoming car and of each road user."""
        index, along = self._where(time)
        way = np.where(index % 2 == 0, 1.0, -1.0)
        since = along / SPEED_M_S
        oncoming = scene.car_at(since - self.duration / 2 - 0.15, way=-way)
        return [oncoming, *(user.pose(self.layout, since, way) for user in scene.road_users)]

    def trajectory(self, step: float = 0.05) -> Trajectory:
        """Trajectory of the scanner during the passes; `step`: seconds between poses."""
        count = max(2, round(self.duration / step) + 1)
        times = np.concatenate([self.start(i) + np.linspace(0, self.duration, count) for i in range(self.passes)])
        return Trajectory(times, self.ground(times)[0] + [0, 0, SCANNER_HEIGHT_M])


def plan_drive(layout: Layout, points: float) -> Drive:
    """Drive with the number of passes that the point density requires, at least two."""
    return Drive(layout, max(2, int(np.ceil(points / layout.axis.length / POINTS_PER_METRE_MAX * 2))))


def scan(scene: Scene, drive: Drive, points: float, report: Report = silent) -> PointCloud:
    """Scan the street; returns exactly `points` returns.

    The number of firings per revolution is estimated from a trial with few rays; surplus returns are dropped at random.

    Raises:
        DataError: almost no ray hits anything.
    """
    rng = np.random.default_rng([scene.layout.seed, 4])
    target = round(points)
    revolutions = max(1, round(drive.duration * ROTATION_HZ)) * drive.passes
    trial = _shots(drive, rng, revolutions, max(8, round(60_000 / BEAMS / revolutions)))
    origins, rays, _ = next(_rays(drive, trial, 1 << 30))
    share = float(_valid(scene.cast(origins, rays).distance).mean())
    if share < 0.02:
        raise DataError("street", "almost no ray of the scanner hits anything", "Increase the length of the street")
    steps = max(1, int(np.ceil(1.02 * target / share / BEAMS / revolutions)))
    while True:
        cloud = _returns(scene, drive, rng, revolutions, steps, report)
        if len(cloud) >= target:
            keep = np.sort(rng.permutation(len(cloud))[:target])
            return cloud.take(keep)
        steps = int(np.ceil(steps * 1.02 * target / len(cloud))) + 1


def _shots(drive: Drive, rng: np.random.Generator, revolutions: int, steps: int) -> F64:
    """(S, 2) time and azimuth of every firing of the fan of beams, in order of time."""
    per_pass = revolutions // drive.passes
    phase = np.arange(per_pass * steps) / steps  # revolutions
    blocks = []
    for i in range(drive.passes):
        time = drive.start(i) + phase / per_pass * drive.duration
        azimuth = 2 * np.pi * (phase + rng.random())
        blocks.append(np.column_stack([time, azimuth]))
    return np.concatenate(blocks)


def _rays(drive: Drive, shots: F64, block: int) -> Iterator[tuple[F32, F32, F64]]:
    """Blocks of complete firings: origins (N, 3), unit directions (N, 3) and times (N,) of rays."""
    beams = np.radians(np.linspace(ELEVATION_MIN_DEG, ELEVATION_MAX_DEG, BEAMS))
    stagger = np.radians(1.7) * (np.arange(BEAMS) % 4 - 1.5) / 4  # beams aren't exactly in one plane
    tilt = np.radians(AXIS_TILT_DEG)
    per = max(1, block // BEAMS)
    for i in range(0, len(shots), per):
        time, azimuth = shots[i : i + per].T
        position, heading = drive.ground(time)
        a = azimuth[:, None] + stagger
        x, y, z = np.cos(a) * np.cos(beams), np.sin(a) * np.cos(beams), np.broadcast_to(np.sin(beams), a.shape)
        x, z = x * np.cos(tilt) + z * np.sin(tilt), z * np.cos(tilt) - x * np.sin(tilt)
        c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
        d = np.stack([c * x - s * y, s * x + c * y, z], axis=-1)
        origins = np.repeat((position + np.array([0, 0, SCANNER_HEIGHT_M])).astype(np.float32), BEAMS, axis=0)
        yield origins, d.reshape(-1, 3).astype(np.float32), np.repeat(time, BEAMS)


def _valid(distance: F32) -> Bools:
    return np.isfinite(distance) & (distance < RANGE_MAX_M) & (distance > 0.8)


def _returns(
    scene: Scene, drive: Drive, rng: np.random.Generator, revolutions: int, steps: int, report: Report
) -> PointCloud:
    shots = _shots(drive, rng, revolutions, steps)
    total = len(shots) * BEAMS
    parts: list[PointCloud] = []
    for i, (origins, rays, times) in enumerate(_rays(drive, shots, RAYS_PER_BLOCK)):
        car = drive.car(scene, times[::BEAMS]).repeated(BEAMS)
        hits = scene.cast(origins, rays, car)
        keep = np.flatnonzero(_valid(hits.distance))
        o, d, t = origins[keep], rays[keep], times[keep]
        face, distance = hits.face[keep], hits.distance[keep]
        xyz = o + d * distance[:, None]
        colour = scene.lit(
            xyz, face, hits.bary[keep], hits.heading[keep], np.full(len(keep), TRUTH_FOOTPRINT_M), car.take(keep)
        )
        rgb = srgb(colour) + rng.standard_normal(colour.shape, np.float32) * np.float32(COLOUR_NOISE)
        ranged = distance + rng.standard_normal(len(keep), np.float32) * np.float32(RANGE_NOISE_M)
        parts.append(
            PointCloud(
                FRAME,
                (o + d * ranged[:, None]).astype(np.float32),
                rgb=np.clip(rgb + 0.5, 0, 255).astype(np.uint8),
                classification=scene.surface.classification[face],
                time=t,
                intensity=_intensity(scene, face, d, distance),
            )
        )
        report(min(1.0, (i + 1) * RAYS_PER_BLOCK / total), "scanning")
    names = ("xyz", "rgb", "classification", "time", "intensity")
    return PointCloud(FRAME, **{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


def _intensity(scene: Scene, face: I32, directions: F32, distance: F32) -> npt.NDArray[np.uint16]:
    """(N,) intensity: near-infrared reflectivity times incidence, partly corrected for range."""
    p = scene.surface
    c = p.vertices[p.faces[face]]
    normal = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
    facing = np.abs(np.einsum("ij,ij->i", normal, directions)) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    value = reflectivity(p)[face] * (0.25 + 0.75 * facing) * np.clip(18 / (distance + 8), 0, 1)
    return (np.clip(value, 0, 1) * 40_000).astype(np.uint16)


def reflectivity(surface: Part) -> F32:
    """(F,) near-infrared reflectivity of faces, 0 to 1."""
    value = 0.15 + 0.75 * surface.colour.mean(axis=1)
    for material, one in REFLECTIVITY.items():
        value[surface.material == material] = one
    return value.astype(np.float32)

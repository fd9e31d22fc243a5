"""The recording vehicle's drive, and its lidar: a spinning fan of beams."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.data_samples.layout import FRAME, Layout
from scan2sim.data_samples.paints import Material
from scan2sim.data_samples.scene import FINE, CarPoses, Scene, srgb
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32, F64, I32, Bools, PointCloud, Trajectory

START = 412_300.0  # GPS time of week, seconds
SPEED = 10.0
BREAK = 24.0  # seconds between passes
BEAMS = 64
SPINS = 10.0  # revolutions a second
LOWEST, HIGHEST = -38.0, 50.0  # elevation of the fan's ends, degrees: the road beside the vehicle to 12 m high facades
TILT = 14.0  # degrees that the axis leans forward: an upright one leaves a stripe unseen at its own height
HEIGHT = 2.0
RANGE = 70.0
NOISE = 0.01  # standard deviation of a range, metres
COLOUR_NOISE = 2.5  # of a point's colour, of 255
DENSE = 150_000.0  # points a metre of road that two passes take; denser clouds take more
BLOCK = 1 << 20  # rays at a time
REFLECTIVITY = {
    Material.FOLIAGE: 0.55,
    Material.GRASS: 0.45,
    Material.SIGN: 0.95,
    Material.WINDOW: 0.12,
    Material.CAR_GLASS: 0.10,
}


@dataclass(frozen=True)
class Drive:
    """Where the vehicle is when: passes up and down the street, each in its right-hand lane."""

    layout: Layout
    passes: int

    @property
    def duration(self) -> float:
        """Seconds of a pass."""
        return self.layout.axis.length / SPEED

    def start(self, index: int) -> float:
        """GPS time at which a pass starts."""
        return START + index * (self.duration + BREAK)

    def time_at(self, s: float) -> float:
        """When the first pass is at chainage `s`."""
        return START + s / SPEED

    def ground(self, time: F64) -> tuple[F64, F64]:
        """Local point (N, 3) on the ground below the scanner, and heading (N,)."""
        index, along = self._where(time)
        forwards = index % 2 == 0
        s = np.where(forwards, along, self.layout.axis.length - along)
        t = np.where(forwards, -0.5, 0.5) * self.layout.lane
        xy, heading = self.layout.axis.place(s, t)
        z = self.layout.height(s, t)
        return np.concatenate([xy, z[:, None]], axis=1), heading + np.where(forwards, 0.0, np.pi)

    def _where(self, time: F64) -> tuple[F64, F64]:
        """Pass, and metres driven in it."""
        since = np.asarray(time, np.float64) - START
        index = np.clip(np.floor(since / (self.duration + BREAK)), 0, self.passes - 1)
        return index, np.clip(since - index * (self.duration + BREAK), 0, self.duration) * SPEED

    def car(self, scene: Scene, time: F64) -> CarPoses:
        """The moving car at `time` (N,): it comes towards the vehicle in the other lane, once a pass."""
        index, along = self._where(time)
        way = np.where(index % 2 == 0, -1.0, 1.0)
        position, heading, inside = scene.car_at(along / SPEED - self.duration / 2 - 0.15, way=way)
        return CarPoses(position.astype(np.float32), heading.astype(np.float32), inside)

    def trajectory(self, step: float = 0.05) -> Trajectory:
        """The scanner's path, passes only."""
        count = max(2, round(self.duration / step) + 1)
        times = np.concatenate([self.start(i) + np.linspace(0, self.duration, count) for i in range(self.passes)])
        return Trajectory(times, self.ground(times)[0] + [0, 0, HEIGHT])


def plan_drive(layout: Layout, points: float) -> Drive:
    """As many passes as the density asks for, two at least."""
    return Drive(layout, max(2, int(np.ceil(points / layout.axis.length / DENSE * 2))))


def scan(scene: Scene, drive: Drive, points: float, report: Report = silent) -> PointCloud:
    """Scan the street until there are `points` returns, to the point.

    The number of shots a revolution follows from a trial with few rays; what comes out too many is dropped at random.

    Raises:
        DataError: if hardly anything is hit.
    """
    rng = np.random.default_rng([scene.layout.seed, 4])
    wanted = round(points)
    revolutions = max(1, round(drive.duration * SPINS)) * drive.passes
    trial = _shots(drive, rng, revolutions, max(8, round(60_000 / BEAMS / revolutions)))
    origins, rays, _ = next(_rays(drive, trial, 1 << 30))
    share = float(_valid(scene.cast(origins, rays).distance).mean())
    if share < 0.02:
        raise DataError("street", "the scanner hits hardly anything", "Make the street longer")
    steps = max(1, int(np.ceil(1.02 * wanted / share / BEAMS / revolutions)))
    while True:
        cloud = _returns(scene, drive, rng, revolutions, steps, report)
        if len(cloud) >= wanted:
            keep = np.sort(rng.permutation(len(cloud))[:wanted])
            return cloud.take(keep)
        steps = int(np.ceil(steps * 1.02 * wanted / len(cloud))) + 1


def _shots(drive: Drive, rng: np.random.Generator, revolutions: int, steps: int) -> F64:
    """(S, 2) time and azimuth of every firing of the fan, in order of time."""
    per_pass = revolutions // drive.passes
    phase = np.arange(per_pass * steps) / steps  # revolutions
    blocks = []
    for i in range(drive.passes):
        time = drive.start(i) + phase / per_pass * drive.duration
        azimuth = 2 * np.pi * (phase + rng.random())
        blocks.append(np.column_stack([time, azimuth]))
    return np.concatenate(blocks)


def _rays(drive: Drive, shots: F64, block: int) -> Iterator[tuple[F32, F32, F64]]:
    """Origins (N, 3), directions (N, 3) and times (N,) of blocks of whole firings."""
    beams = np.radians(np.linspace(LOWEST, HIGHEST, BEAMS))
    stagger = np.radians(1.7) * (np.arange(BEAMS) % 4 - 1.5) / 4  # beams aren't quite in one plane
    tilt = np.radians(TILT)
    per = max(1, block // BEAMS)
    for i in range(0, len(shots), per):
        time, azimuth = shots[i : i + per].T
        position, heading = drive.ground(time)
        a = azimuth[:, None] + stagger
        x, y, z = np.cos(a) * np.cos(beams), np.sin(a) * np.cos(beams), np.broadcast_to(np.sin(beams), a.shape)
        x, z = x * np.cos(tilt) + z * np.sin(tilt), z * np.cos(tilt) - x * np.sin(tilt)
        c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
        d = np.stack([c * x - s * y, s * x + c * y, z], axis=-1)
        origins = np.repeat((position + np.array([0, 0, HEIGHT])).astype(np.float32), BEAMS, axis=0)
        yield origins, d.reshape(-1, 3).astype(np.float32), np.repeat(time, BEAMS)


def _valid(distance: F32) -> Bools:
    return np.isfinite(distance) & (distance < RANGE) & (distance > 0.8)


def _returns(
    scene: Scene, drive: Drive, rng: np.random.Generator, revolutions: int, steps: int, report: Report
) -> PointCloud:
    shots = _shots(drive, rng, revolutions, steps)
    total = len(shots) * BEAMS
    parts: list[PointCloud] = []
    for i, (origins, rays, times) in enumerate(_rays(drive, shots, BLOCK)):
        car = drive.car(scene, times[::BEAMS]).repeated(BEAMS)
        hits = scene.cast(origins, rays, car)
        keep = np.flatnonzero(_valid(hits.distance))
        o, d, t = origins[keep], rays[keep], times[keep]
        face, distance = hits.face[keep], hits.distance[keep]
        xyz = o + d * distance[:, None]
        colour = scene.lit(xyz, face, hits.bary[keep], hits.heading[keep], np.full(len(keep), FINE), car.take(keep))
        rgb = srgb(colour) + rng.standard_normal(colour.shape, np.float32) * np.float32(COLOUR_NOISE)
        ranged = distance + rng.standard_normal(len(keep), np.float32) * np.float32(NOISE)
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
        report(min(1.0, (i + 1) * BLOCK / total), "scanning")
    names = ("xyz", "rgb", "classification", "time", "intensity")
    return PointCloud(FRAME, **{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


def _intensity(scene: Scene, face: I32, directions: F32, distance: F32) -> npt.NDArray[np.uint16]:
    """Reflectivity in the near infrared times incidence, partly corrected for range."""
    p = scene.surface
    reflectivity = 0.15 + 0.75 * p.colour.mean(axis=1)
    for material, value in REFLECTIVITY.items():
        reflectivity[p.material == material] = value
    c = p.vertices[p.faces[face]]
    normal = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
    facing = np.abs(np.einsum("ij,ij->i", normal, directions)) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    value = reflectivity[face] * (0.25 + 0.75 * facing) * np.clip(18 / (distance + 8), 0, 1)
    return (np.clip(value, 0, 1) * 40_000).astype(np.uint16)

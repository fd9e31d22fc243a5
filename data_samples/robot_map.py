"""Maps as a robot's SLAM writes them: a spinning lidar driven through a synthetic building, with point labels.

`python -m scan2sim.data_samples.robot_map OUT [--seed 0] [--storeys 2 --stairs] [--glass] [--people 2] [--voxel 0.05]
[--axes loam] [--random-start]` writes OUT/map.pcd (x y z intensity), OUT/trajectory.csv (of the sensor, in the map's
frame) and OUT/truth: mesh.npz (building, z up), points.npz (label and time of each point), free_<storey>.npz
(occupancy at the robot's height), map.json (T_map_world, settings). The same arguments write the same bytes.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scan2sim.data_samples.building import LAS_CODE, Building, Style, Surface, build
from scan2sim.data_samples.scene import cast_rays, caster
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F32, F64, I32, U8, Trajectory
from scan2sim.pipeline.geometry.voxel_grid import voxel_groups
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.navigation import pcd

SPEED_M_S, TURN_RAD_S = 0.6, 1.2
LIFT_S = 20.0  # time between two routes
PERSON_RADIUS_M, PERSON_HEIGHT_M, PERSON_SPEED_M_S = 0.22, 1.75, 1.2
ALBEDO = {
    Surface.FLOOR: 0.3, Surface.WALL: 0.75, Surface.CEILING: 0.85, Surface.STAIRS: 0.4, Surface.FURNITURE: 0.55,
    Surface.PILLAR: 0.65, Surface.WINDOW: 0.2, Surface.PERSON: 0.45,
}  # fmt: skip
"""Near-infrared albedo of surfaces."""
INTENSITY_RANGE_M = 12.0  # range at which the intensity has fallen to a half
POLISHED_CELL_M = 1.5  # side of the squares of polished floor
SPECULAR_SHARE = 0.5  # share of the beams on polished floor that are mirrored
MIXED_PIXEL_SHARE = 0.6  # share of outliers that lie along their beam; the others are anywhere around the building
OUTLIER_DISTANCE_M = 30.0  # from the building
RAYS_PER_BLOCK = 1 << 20

AXES: dict[str, F64] = {
    "z-up": np.eye(3),
    "loam": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),  # x left, y up, z forward
    "camera": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),  # x right, y down, z forward
    "ned": np.diag([1.0, -1, -1]),  # x forward, y right, z down
    "x-up": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "x-down": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
}
"""Rotations from x forward, y left, z up to the axes of a convention."""


@dataclass(frozen=True)
class Lidar:
    """A spinning lidar; the default resembles a Velodyne VLP-16.

    Attributes:
        lines: number of beams, evenly spaced between the elevations.
        elevation: lowest and highest beam, degrees.
        azimuth_step: degrees between two firings.
        rate: revolutions per second.
        height: of the sensor above the floor, metres.
        pitch, roll: mounting angles in degrees; positive pitch looks down.
        range_min, range_max: metres.
        noise: standard deviation of ranges, metres.
    """

    lines: int = 16
    elevation: tuple[float, float] = (-15.0, 15.0)
    azimuth_step: float = 0.4
    rate: float = 10.0
    height: float = 0.5
    pitch: float = 0.0
    roll: float = 0.0
    range_min: float = 0.3
    range_max: float = 80.0
    noise: float = 0.05

    @property
    def mounting(self) -> F64:
        """(3, 3) sensor axes to the robot's."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_euler("yx", [self.pitch, self.roll], degrees=True).as_matrix()


@dataclass(frozen=True)
class Mapping:
    """How a map is made from sweeps.

    Attributes:
        keyframe: metres (or turns by 30 degrees) between sweeps that are added to the map.
        voxel: side of the voxels to which the map is thinned (mean position), metres; 0: not thinned.
        outliers: share of points that are noise.
        reflections: share of the floor that is polished: it mirrors half of the beams, whose points lie below it.
        people: number of people who walk through the rooms meanwhile.
        axes: axis convention, a key of `AXES`.
        start: (3, 3) rotation of the first pose that the SLAM didn't know of, applied before `axes`.
        first_pose: coordinates relative to the first sensor pose; otherwise the building's.
        unit: metres per unit of the map.
    """

    keyframe: float = 0.5
    voxel: float = 0.05
    outliers: float = 0.0
    reflections: float = 0.0
    people: int = 0
    axes: str = "z-up"
    start: F64 = field(default_factory=lambda: np.eye(3))
    first_pose: bool = True
    unit: float = 1.0


class Motion(NamedTuple):
    """Motion over a floor: times (T,), positions (T, 3) on it, headings (T,) in radians, continuous."""

    times: F64
    positions: F64
    headings: F64

    def at(self, times: F64) -> tuple[F64, F64]:
        """(N, 3) positions and (N,) headings at times (N,), linearly interpolated."""
        xyz = np.stack([np.interp(times, self.times, self.positions[:, k]) for k in range(3)], axis=1)
        return xyz, np.interp(times, self.times, self.headings)


class Returns(NamedTuple):
    """Returns of a lidar in world coordinates.

    Attributes:
        xyz, exact: (N, 3) measured positions, and without noise.
        origin: (N, 3) position of the sensor.
        surface: (N,) `Surface`.
        face: (N,) hit face of `Building.mesh`, -1 for people and outliers.
        intensity: (N,) 0 to 255.
        time: (N,) seconds.
        sweep: (N,) index of the sweep.
    """

    xyz: F64
    exact: F64
    origin: F64
    surface: U8
    face: I32
    intensity: F32
    time: F64
    sweep: I32

    def take(self, index: Any) -> Returns:
        """The returns that `index` selects."""
        return Returns(*(column[index] for column in self))


@dataclass(frozen=True)
class RobotMap:
    """A map in its own frame and unit, and its truth.

    Attributes:
        xyz: (N, 3) coordinates in the map's frame and unit.
        intensity: (N,) 0 to 255.
        surface: (N,) `Surface` of each point (of one of the points averaged in a voxel).
        time: (N,) seconds.
        trajectory: sensor poses of the sweeps in the map, in the map's frame, positions in its unit.
        T_map_world: (4, 4) world coordinates to the map's: a similarity, scaled by 1 / unit.
        returns: the returns before thinning, in world coordinates.
    """

    xyz: F64
    intensity: F32
    surface: U8
    time: F64
    trajectory: Trajectory
    T_map_world: F64
    returns: Returns

    @property
    def world(self) -> F64:
        """(N, 3) the points in the building's coordinates, metres."""
        inverse = np.linalg.inv(self.T_map_world)
        return self.xyz @ inverse[:3, :3].T + inverse[:3, 3]

    @property
    def up(self) -> F64:
        """(3,) the world's up in the map's axes, unit."""
        up = self.T_map_world[:3, 2]
        return np.asarray(up / np.linalg.norm(up))


def drive(routes: tuple[F64, ...], speed: float = SPEED_M_S, start: float = 0.0) -> Motion:
    """Motion along routes (N, 3): straight at a constant speed, turning on the spot at their corners."""
    times, positions, headings = [start], [routes[0][0]], [0.0]
    for n, route in enumerate(routes):
        if n:
            times.append(times[-1] + LIFT_S)
            positions.append(route[0])
            headings.append(headings[-1])
        for target in route[1:]:
            way = target - positions[-1]
            if np.linalg.norm(way) < 1e-6:
                continue
            if np.linalg.norm(way[:2]) > 1e-6:
                turn = np.arctan2(way[1], way[0]) - headings[-1]
                turn = float((turn + np.pi) % (2 * np.pi) - np.pi)
                if abs(turn) > 1e-6:
                    times.append(times[-1] + abs(turn) / TURN_RAD_S)
                    positions.append(positions[-1])
                    headings.append(headings[-1] + turn)
            times.append(times[-1] + float(np.linalg.norm(way)) / speed)
            positions.append(target)
            headings.append(headings[-1])
    return Motion(np.array(times), np.array(positions), np.array(headings))


def sensor_poses(motion: Motion, lidar: Lidar, times: F64) -> F64:
    """(N, 4, 4) sensor to world at times (N,)."""
    xyz, heading = motion.at(times)
    c, s = np.cos(heading), np.sin(heading)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = c, -s, s, c
    poses[:, :3, :3] = poses[:, :3, :3] @ lidar.mounting
    poses[:, :3, 3] = xyz + [0, 0, lidar.height]
    return poses


def beam_directions(lidar: Lidar) -> F64:
    """(A, L, 3) unit directions of the beams of a revolution in the sensor's axes, in order of their firing."""
    count = round(360 / lidar.azimuth_step)
    azimuth = -2 * np.pi * np.arange(count)[:, None] / count  # clockwise seen from above, as most lidars turn
    high = np.radians(np.linspace(*lidar.elevation, lidar.lines))
    flat = np.cos(azimuth) * np.cos(high), np.sin(azimuth) * np.cos(high), np.sin(high)
    return np.stack(np.broadcast_arrays(*flat), axis=-1)


def keyframes(motion: Motion, lidar: Lidar, spacing: float) -> F64:
    """(K,) start times of sweeps that are `spacing` metres, or a turn by 30 degrees, from the one before."""
    times = np.arange(motion.times[0], motion.times[-1], 1 / lidar.rate)
    xyz, heading = motion.at(times)
    moved = np.linalg.norm(np.diff(xyz, axis=0), axis=1) + np.abs(np.degrees(np.diff(heading))) * spacing / 30
    lift = np.concatenate([[False], moved > 2.0])
    along = np.cumsum(np.append(0.0, np.where(lift[1:], 0.0, moved)))
    return times[np.unique(np.floor(along / spacing), return_index=True)[1]]


def scan(
    building: Building, motion: Motion, lidar: Lidar, starts: F64, *, seed: int = 0, people: int = 0,
    reflections: float = 0.0,
) -> Returns:  # fmt: skip
    """Returns of the sweeps that begin at `starts` (K,); beams without a return are left out.

    Args:
        building: what is scanned; glass returns nothing.
        motion: of the robot over the floor.
        lidar: the sensor.
        starts: seconds, times at which sweeps begin.
        seed: of noise and people.
        people, reflections: as in `Mapping`.
    """
    opaque = np.flatnonzero(building.surface != Surface.GLASS)
    scene = caster(replace(building.mesh, faces=building.mesh.faces[opaque]))
    surface, normal = building.surface[opaque], building.mesh.face_normal[opaque]
    walks = [_walk(building, np.random.default_rng([seed, 92, i]), starts) for i in range(people)]
    albedo = np.zeros(256, np.float32)
    albedo[list(ALBEDO)] = list(ALBEDO.values())
    parts = []
    for block, (origin, ray, time, sweep) in enumerate(_rays(motion, lidar, starts)):
        rng = np.random.default_rng([seed, 93, block])
        hits = cast_rays(scene, np.concatenate([origin, ray], axis=1).astype(np.float32))
        far, face = hits.distance.astype(np.float64), hits.face
        hit = face >= 0
        kind = np.where(hit, surface[face], 0).astype(np.uint8)
        facing = np.where(hit, np.abs(np.einsum("ij,ij->i", normal[face], ray)), 0.0)
        face = np.where(hit, opaque[face], -1).astype(np.int32)
        if reflections > 0:
            exact = origin + far[:, None] * ray
            with np.errstate(invalid="ignore"):
                square = np.floor(np.nan_to_num(exact[:, :2], posinf=0, neginf=0) / POLISHED_CELL_M)
            polished = _hash(square) < reflections
            mirrored = np.flatnonzero((kind == Surface.FLOOR) & polished & (rng.random(len(ray)) < SPECULAR_SHARE))
            up = ray[mirrored] * [1, 1, -1]
            again = cast_rays(scene, np.concatenate([exact[mirrored] + 1e-3 * up, up], axis=1).astype(np.float32))
            far[mirrored] += again.distance
            kind[mirrored], face[mirrored] = Surface.REFLECTION, -1
        for walk in walks:
            near = _cylinder(origin, ray, walk.at(time)[0])
            closer = near < far
            far[closer], kind[closer], face[closer], facing[closer] = near[closer], Surface.PERSON, -1, 0.7
        noise = rng.normal(0, lidar.noise, len(ray))
        keep = (far > lidar.range_min) & (far < lidar.range_max) & (kind > 0)
        strength = (
            albedo[kind] * (0.25 + 0.75 * facing) * INTENSITY_RANGE_M / (INTENSITY_RANGE_M + np.minimum(far, 1e6))
        )
        strength = np.where(kind == Surface.REFLECTION, 0.1, strength)
        parts.append(
            Returns(
                origin + (far + noise)[:, None] * ray, origin + far[:, None] * ray, origin, kind, face,
                (255 * strength).astype(np.float32), time, sweep,
            ).take(keep)
        )  # fmt: skip
    return Returns(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def record(building: Building, lidar: Lidar | None = None, mapping: Mapping | None = None, seed: int = 0) -> RobotMap:
    """Map of a robot that drives all routes of a building.

    Raises:
        SettingError: unknown axis convention.
    """
    lidar, mapping = lidar or Lidar(), mapping or Mapping()
    if mapping.axes not in AXES:
        raise SettingError("axes", f"there is no convention {mapping.axes!r}", f"Use one of {', '.join(AXES)}")
    motion = drive(building.routes)
    starts = keyframes(motion, lidar, mapping.keyframe)
    returns = scan(
        building, motion, lidar, starts, seed=seed, people=mapping.people, reflections=mapping.reflections
    )  # fmt: skip
    if mapping.outliers > 0:
        returns = _with_outliers(returns, mapping.outliers, np.random.default_rng([seed, 94]))
    poses = sensor_poses(motion, lidar, starts)
    T = np.eye(4)
    if mapping.first_pose:
        T = np.linalg.inv(poses[0])
    turned = np.eye(4)
    turned[:3, :3] = AXES[mapping.axes] @ mapping.start
    rigid = turned @ T
    scaled = np.diag([1 / mapping.unit] * 3 + [1.0]) @ rigid
    xyz = returns.xyz @ rigid[:3, :3].T + rigid[:3, 3]
    intensity, first = returns.intensity, np.arange(len(xyz))
    if mapping.voxel > 0:
        order, begin = voxel_groups(xyz.astype(np.float32), mapping.voxel)
        count = np.diff(np.append(begin, len(order)))
        xyz = np.stack([np.add.reduceat(xyz[order, k], begin) / count for k in range(3)], axis=1)
        intensity = (np.add.reduceat(intensity[order].astype(np.float64), begin) / count).astype(np.float32)
        first = order[begin]
    placed = rigid @ poses
    path = Trajectory(starts, placed[:, :3, 3] / mapping.unit, placed[:, :3, :3])
    return RobotMap(
        xyz / mapping.unit, intensity, returns.surface[first], returns.time[first], path, scaled, returns
    )  # fmt: skip


def write(out: Path, building: Building, robot_map: RobotMap, lidar: Lidar, settings: dict[str, Any]) -> None:
    """Write a map and its truth; the module's docstring lists the files."""
    truth = out / "truth"
    truth.mkdir(parents=True, exist_ok=True)
    pcd.write(out / "map.pcd", robot_map.xyz, robot_map.intensity)
    trajectory_io.write(out / "trajectory.csv", robot_map.trajectory)
    building.mesh.save(truth / "mesh.npz")
    code = np.zeros(256, np.uint8)
    code[list(LAS_CODE)] = list(LAS_CODE.values())
    np.savez(
        truth / "points.npz", surface=robot_map.surface, classification=code[robot_map.surface], time=robot_map.time
    )
    for k in range(len(building.floors)):
        free = building.free_space(k, high=max(lidar.height, 0.3))
        np.savez(truth / f"free_{k}.npz", **free._asdict())
    info = {"T_map_world": robot_map.T_map_world.tolist(), "doors": building.doors.tolist(), "settings": settings}
    (truth / "map.json").write_text(json.dumps(info, indent=1), encoding="utf-8")


def _rays(motion: Motion, lidar: Lidar, starts: F64) -> Iterator[tuple[F64, F64, F64, I32]]:
    """Blocks of complete sweeps: origins (N, 3), unit directions (N, 3), times (N,) and sweeps (N,) of beams."""
    own = beam_directions(lidar)
    count = len(own)
    per = max(1, RAYS_PER_BLOCK // (count * lidar.lines))
    for first in range(0, len(starts), per):
        some = starts[first : first + per]
        time = (some[:, None] + np.arange(count) / count / lidar.rate).ravel()
        pose = sensor_poses(motion, lidar, time)
        ray = np.einsum("nij,nlj->nli", pose[:, :3, :3], np.tile(own, (len(some), 1, 1)))
        origin, sweep = np.repeat(pose[:, :3, 3], lidar.lines, axis=0), first + np.arange(len(some))
        times = np.repeat(time, lidar.lines)
        yield origin, ray.reshape(-1, 3), times, np.repeat(sweep, count * lidar.lines).astype(np.int32)


def _walk(building: Building, rng: np.random.Generator, starts: F64) -> Motion:
    """Somebody who walks the routes up and down while the robot drives, from a random time on."""
    there = building.routes[0][:, :3]
    lap = drive((np.concatenate([there, there[::-1]]),), PERSON_SPEED_M_S)
    length = lap.times[-1]
    begin = starts[0] - rng.uniform(0, length)
    laps = int(np.ceil((starts[-1] + 1 - begin) / length)) + 1
    times = np.concatenate([begin + i * (length + 1e-3) + lap.times for i in range(laps)])
    return Motion(times, np.tile(lap.positions, (laps, 1)), np.tile(lap.headings, laps))


def _cylinder(origin: F64, ray: F64, foot: F64) -> F64:
    """(N,) distance to upright cylinders of a person's size at `foot` (N, 3), infinite where a ray misses."""
    to, flat = origin[:, :2] - foot[:, :2], ray[:, :2]
    a, b = (flat**2).sum(axis=1), (to * flat).sum(axis=1)
    c = (to**2).sum(axis=1) - PERSON_RADIUS_M**2
    with np.errstate(invalid="ignore", divide="ignore"):
        near = (-b - np.sqrt(b * b - a * c)) / a
    height = origin[:, 2] + near * ray[:, 2] - foot[:, 2]
    hit = np.isfinite(near) & (near > 0) & (height > 0) & (height < PERSON_HEIGHT_M)
    return np.where(hit, near, np.inf)


def _hash(square: F64) -> F64:
    """(N,) pseudo-random number in [0, 1) for each pair of integers (N, 2)."""
    value = np.sin(square @ [12.9898, 78.233]) * 43758.5453
    return np.asarray(value - np.floor(value))


def _with_outliers(returns: Returns, share: float, rng: np.random.Generator) -> Returns:
    """The returns, a share of them replaced by outliers."""
    index = rng.permutation(len(returns.xyz))[: round(share * len(returns.xyz))]
    mixed, free = np.split(index, [round(MIXED_PIXEL_SHARE * len(index))])
    xyz, surface, face = returns.xyz.copy(), returns.surface.copy(), returns.face.copy()
    to = xyz[mixed] - returns.origin[mixed]
    xyz[mixed] = returns.origin[mixed] + to * rng.uniform(0.3, 1.5, (len(mixed), 1))
    low, high = returns.xyz.min(axis=0), returns.xyz.max(axis=0)
    xyz[free] = rng.uniform(low - OUTLIER_DISTANCE_M, high + OUTLIER_DISTANCE_M, (len(free), 3))
    surface[index], face[index] = Surface.OUTLIER, -1
    return returns._replace(xyz=xyz, surface=surface, face=face)


def random_rotation(seed: int) -> F64:
    """(3, 3) uniformly distributed rotation."""
    from scipy.spatial.transform import Rotation

    return Rotation.random(random_state=np.random.default_rng([seed, 95])).as_matrix()


def main() -> None:
    """Write a map."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--storeys", type=int, default=1)
    parser.add_argument("--rooms", type=int, default=3, help="rooms on each side of the corridor")
    parser.add_argument("--stairs", action="store_true")
    parser.add_argument("--glass", action="store_true")
    parser.add_argument("--people", type=int, default=0)
    parser.add_argument("--height", type=float, default=0.5, help="of the lidar, metres")
    parser.add_argument("--pitch", type=float, default=0.0, help="of the lidar, degrees")
    parser.add_argument("--noise", type=float, default=0.05, help="standard deviation of ranges, metres")
    parser.add_argument("--voxel", type=float, default=0.05, help="metres; 0: not thinned")
    parser.add_argument("--outliers", type=float, default=0.002, help="share of points")
    parser.add_argument("--reflections", type=float, default=0.0, help="polished share of the floor")
    parser.add_argument("--axes", default="z-up", choices=AXES)
    parser.add_argument("--random-start", action="store_true", help="rotate the first pose at random")
    parser.add_argument("--unit", type=float, default=1.0, help="metres per unit of the map")
    a = parser.parse_args()
    building = build(a.seed, Style(a.storeys, a.rooms, a.stairs, a.glass))
    lidar = Lidar(height=a.height, pitch=a.pitch, noise=a.noise)
    start = random_rotation(a.seed) if a.random_start else np.eye(3)
    mapping = Mapping(0.5, a.voxel, a.outliers, a.reflections, a.people, a.axes, start, unit=a.unit)
    robot_map = record(building, lidar, mapping, a.seed)
    settings = {k: v for k, v in vars(a).items() if k != "out"} | {"lidar": asdict(lidar)}
    write(a.out, building, robot_map, lidar, settings)
    print(f"{a.out / 'map.pcd'}: {len(robot_map.xyz):,} points from {len(robot_map.trajectory)} sweeps")


if __name__ == "__main__":
    main()

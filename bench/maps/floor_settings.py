"""Settings of the floor map, measured on simulated buildings with the noise of SLAM maps.

`python -m bench.maps.floor_settings`

Ground points have their true class, so that only the floor map is measured.

- noise: noise of heights, as errors of poses cause it, against the strength of smoothing (`noise_smoothing`): height
  errors of the floor, and slopes over the length of a robot, where the floor is not snapped to planes.
- foot: all points up to 10 to 40 cm above the floor are removed as by a ground filter, against `foot_smoothing` and
  `foot_percentile`: how much errors vary (their median is the filter's height), and slopes.

Ends with `RESULT {json}`.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from scan2sim.data_samples.building import Building, Style, Surface, build
from scan2sim.data_samples.robot_map import Lidar, Mapping, RobotMap, record
from scan2sim.pipeline.core.types import F32, F64
from scan2sim.pipeline.geometry.height_map import exact_point_spacing
from scan2sim.pipeline.terrain import assumed_floor, floor_map, scanned_floor
from scan2sim.pipeline.terrain.floor_limits import LIMITS, FloorLimits

NOISES_M = (0.02, 0.05, 0.1)
SMOOTHINGS = (0.0, 20.0, 60.0, 120.0)
FOOT_SMOOTHINGS_M = (0.5, 1.5, 3.0, 6.0)
FOOT_PERCENTILES = (5.0, 20.0, 50.0)
REMOVED_M = (0.1, 0.4)
"""Range of heights up to which a ground filter removes points, which changes from place to place."""
PATCH_M = 2.0
ROBOT_LENGTH_M = 0.4
SEEDS = (1, 2)


def main() -> None:
    """Print both tables."""
    result: dict[str, dict[str, list[float]]] = {"noise": {}, "foot": {}}
    maps = {(noise, seed): simulated(noise, seed) for noise in NOISES_M for seed in SEEDS}
    for noise in NOISES_M:
        for smoothing in SMOOTHINGS:
            limits = replace(LIMITS, noise_smoothing=smoothing)
            found = [errors(*maps[noise, seed], limits, removed=False) for seed in SEEDS]
            row = [float(np.percentile(np.concatenate(part), 95)) for part in zip(*found, strict=True)]
            result["noise"][f"{noise:g} m, {smoothing:g}"] = [round(row[0], 4), round(row[1], 2)]
            print(f"noise {noise:.2f} m, smoothing {smoothing:5.0f}: height 95 % {100 * row[0]:.1f} cm, "
                  f"slope 95 % {row[1]:.2f} degrees", flush=True)  # fmt: skip
    for smoothing in FOOT_SMOOTHINGS_M:
        for percentile in FOOT_PERCENTILES:
            limits = replace(LIMITS, foot_smoothing=smoothing, foot_percentile=percentile)
            found = [errors(*maps[NOISES_M[1], seed], limits, removed=True) for seed in SEEDS]
            spread, slope = (float(np.percentile(np.concatenate(part), 95)) for part in zip(*found, strict=True))
            result["foot"][f"{smoothing:g} m, {percentile:g} %"] = [round(spread, 4), round(slope, 2)]
            print(f"feet: smoothing {smoothing:.1f} m, percentile {percentile:2.0f}: from their median 95 % "
                  f"{100 * spread:.1f} cm, slope 95 % {slope:.2f} degrees", flush=True)  # fmt: skip
    print("RESULT " + json.dumps(result))


def simulated(noise: float, seed: int) -> tuple[Building, RobotMap]:
    """A building and its map, with noise of heights in metres besides that of the lidar."""
    building = build(seed, Style(rooms=2))
    made = record(building, Lidar(), Mapping(), seed)
    up = np.random.default_rng(seed).normal(0, noise, (len(made.xyz), 1)) * made.up
    return building, replace(made, xyz=made.xyz + up)


def errors(building: Building, made: RobotMap, limits: FloorLimits, *, removed: bool) -> tuple[F64, F64]:
    """Absolute height errors (N,) of the floor in metres, and its slopes (M,) in degrees over a robot's length."""
    xyz = made.world.astype(np.float32)
    floor = np.isin(made.surface, [Surface.FLOOR]) & (np.abs(xyz[:, 2]) < 0.5)
    ground, others = xyz[floor], xyz[~floor]
    if removed:
        ground, others = ground[:0], others[others[:, 2] > _filter_heights(others)]
    for module in (scanned_floor, assumed_floor, floor_map):
        module.LIMITS = limits  # type: ignore[attr-defined]
    found = floor_map.floor_map(ground, others, spacing=exact_point_spacing(xyz), gap=1.5, level=False)
    height = found.storeys[0].height
    truth = building.free_space(0, low=0.1, high=0.6)
    inside = np.zeros(height.shape, bool)
    inside[np.isfinite(height)] = truth.at(found.raster.centres(np.isfinite(height)))
    off = height[inside] - (np.median(height[inside]) if removed else building.floors[0])
    step = round(ROBOT_LENGTH_M / found.raster.cell)
    slope = np.abs(height[step:] - height[:-step])[inside[step:] & inside[:-step]] / (step * found.raster.cell)
    return np.abs(off), np.degrees(np.arctan(slope))


def _filter_heights(xyz: F32) -> F64:
    """(N,) height up to which a ground filter removes points near positions (N, 3)."""
    patch = np.floor(xyz[:, :2] / PATCH_M).astype(np.int64) % 64
    return np.random.default_rng(0).uniform(*REMOVED_M, (64, 64))[patch[:, 0], patch[:, 1]]


if __name__ == "__main__":
    main()

"""An assembled cloud of a synthetic street: two passes that differ, after `import clouds --trajectory`.

The points of the street are moved as by an INS that drifts 0.2 m in 10 m, turns by 0.1 degrees, and differs by 0.25 m
between the two passes; the trajectory contains the same errors. `strips_gap_cm`: largest distance, of all sections of
5 m that both passes scanned, between their surfaces; `strips_given_gap_cm`: before the import; `strips_offset_cm`:
distance of the mean position from the given one; `strips_unchanged`: whether the files of a cloud without errors
remain.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.maps.command import scan2sim
from scan2sim.data_samples.street import generate
from scan2sim.pipeline.core.types import F64, PointCloud, Trajectory
from scan2sim.pipeline.importers.path_correction import PathCorrection
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile

LENGTH_M, POINTS = 60.0, 1_500_000
DRIFT_M, WAVELENGTH_M, TURN_RAD = 0.1, 20.0, 0.0017
BETWEEN_M = np.array([0.15, 0.18, 0.09])
SECTION_M, NEAR_M, POINTS_MIN = 5.0, 15.0, 500


def measure(out: Path) -> dict[str, Any]:
    """Figures of the part."""
    shutil.rmtree(out, ignore_errors=True)
    street = read_tile(generate(out / "street", length=LENGTH_M, points=POINTS, photos=0, seed=3))
    assert street.trajectory is not None
    true = clouds.read(street.clouds[0], street.frame)
    error = ins_error(street.trajectory)
    write(out / "drifting", true, error)
    figures = {"strips_given_gap_cm": 0.0, "strips_gap_cm": 0.0}
    for name, folder in (("drifting", out / "drifting"), ("correct", out / "street")):
        path = folder / ("path.csv" if name == "drifting" else "trajectory.csv")
        words = ("import", "clouds", folder / "cloud.laz", "--trajectory", path, "--out", out / name / "tile")
        scan2sim(out / f"{name}.log", *words)
    given = clouds.read(out / "drifting" / "cloud.laz", street.frame)
    tile = read_tile(out / "drifting" / "tile")
    found = clouds.read(tile.clouds[0], street.frame)
    for key, cloud in (("strips_given_gap_cm", given), ("strips_gap_cm", found)):
        gap = gaps(cloud, true, error)
        figures[key] = round(100 * float(gap.max()), 2)
        print(f"{key}: median {100 * np.median(gap):.2f} cm, largest {100 * gap.max():.2f} cm", flush=True)
    offset = (found.xyz - given.xyz).astype(np.float64).mean(axis=0)
    same = (out / "street" / "cloud.laz").read_bytes() == (out / "correct" / "tile" / "cloud.laz").read_bytes()
    return figures | {"strips_offset_cm": round(100 * float(np.linalg.norm(offset)), 2), "strips_unchanged": same}


def ins_error(path: Trajectory) -> PathCorrection:
    """Error of an INS along a path."""
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path.positions, axis=0), axis=1))])
    ahead = np.gradient(path.positions[:, :2], axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    wave = np.sin(2 * np.pi * along / WAVELENGTH_M)
    shift = np.column_stack([-ahead[:, 1] * wave, ahead[:, 0] * wave, 0.3 * np.cos(2 * np.pi * along / 35)]) * DRIFT_M
    shift[_second(path.times, path)] += BETWEEN_M
    turn = np.column_stack([np.zeros((len(along), 2)), TURN_RAD * np.sin(2 * np.pi * along / 30)])
    return PathCorrection(path, path.times, shift, turn)


def write(folder: Path, true: PointCloud, error: PathCorrection) -> None:
    """Write cloud.laz and path.csv (time,x,y,z) with the error."""
    assert true.time is not None
    folder.mkdir(parents=True)
    moved = error.points(true.xyz.astype(np.float64), true.time).astype(np.float32)
    las.write(folder / "cloud.laz", replace(true, xyz=moved))
    path = error.trajectory()
    trajectory_io.write(folder / "path.csv", path, true.frame)


def gaps(cloud: PointCloud, true: PointCloud, error: PathCorrection) -> F64:
    """(K,) distances between the surfaces of both passes, metres, in sections of the first one."""
    assert true.time is not None
    near = np.linalg.norm(true.xyz - error.path.at(true.time), axis=1) < NEAR_M
    wrong = (cloud.xyz - true.xyz)[near].astype(np.float64)
    second = _second(true.time[near], error.path)
    first_pass = error.path.positions[~_second(error.path.times, error.path)]
    ahead = first_pass[-1] - first_pass[0]
    section = np.floor((true.xyz[near] - first_pass[0]) @ (ahead / np.linalg.norm(ahead)) / SECTION_M).astype(int)
    out = []
    for k in np.unique(section):
        one, other = (wrong[(section == k) & which] for which in (~second, second))
        if min(len(one), len(other)) >= POINTS_MIN:
            out.append(np.linalg.norm(one.mean(axis=0) - other.mean(axis=0)))
    return np.array(out)


def _second(times: F64, path: Trajectory) -> np.ndarray:
    """Whether (N,) times are of the second pass."""
    return times > path.times[int(np.diff(path.times).argmax())] + 1e-6

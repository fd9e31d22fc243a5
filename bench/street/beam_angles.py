"""Error of the scanner's beam angles on the real streets: agreement of sweeps on the ground by an offset of elevations.

`python -m bench.street.beam_angles [--parts raw0013 odo04 ...] [--offsets 0 0.1 0.15 0.205] [--out bench-out/street]`

If beams point higher than the calibration says, far ground of one sweep lies below near ground of another. Returns of
every sweep (3 to 35 m) are turned up by the offset, placed by the tile's poses, and compared with the planes of the
other sweeps' returns around them: median distance, and its sign by range. Deschaud ("IMLS-SLAM: scan-to-model matching
based on 3D data", ICRA 2018) corrects KITTI's sweeps by .205 degrees. Needs the worlds of `bench.street`. Ends with
`RESULT {json}`: by street and offset, the median distance in centimetres.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from bench.paths import ROOT
from bench.street.lidar import newest, street_drive
from bench.street.run import STREETS
from bench.street.world import photos
from scan2sim.pipeline.core.classes import GROUPS, group_of
from scan2sim.pipeline.core.types import F64, I64, PointCloud
from scan2sim.pipeline.importers.kitti_raw import point_times, raise_beams, read_drive_sweep
from scan2sim.pipeline.importers.scanner_path import ScannerPath

RANGES_M = (3.0, 6.0, 10.0, 15.0, 20.0, 35.0)
RETURNS = 6000
"""Returns of a sweep that are compared."""
GROUND_DISTANCE_M = 0.15
"""Distance from a point of the ground within which a return is compared."""
NEIGHBOURS, RADIUS_M, MIN_NEIGHBOURS = 30, 0.5, 8
"""Other sweeps' returns around one, that a plane is fitted to."""
MIN_UP = 0.95
"""Least vertical component of a plane's normal."""


def ground_distances(data: Path, tile: Path, run: Path, offsets_deg: Sequence[float]) -> dict[float, tuple[F64, F64]]:
    """Signed distances (N,) in metres of returns above the planes of other sweeps, and their ranges, by offset."""
    cloud = PointCloud.load(newest(run, "instances", "cloud.npz"))
    views = photos(tile, tile, np.asarray(cloud.frame.origin))
    drive, deskew = street_drive(data)
    rig = next(iter(drive.rigs.values()))
    poses = np.array([views[n].T @ np.linalg.inv(rig.T_velo_cam) for n in drive.sweeps])
    path = ScannerPath(drive.spans[:, 1], poses)
    ground = cKDTree(cloud.xyz[group_of()[cloud.classification] == GROUPS.index("terrain")][::3])
    rng, chosen = np.random.default_rng(0), []
    for file, (start, _, end) in zip(drive.sweeps.values(), drive.spans, strict=True):
        sweep = read_drive_sweep(file, RANGES_M[-1])
        times, distance = point_times(sweep, start, end, deskew), np.linalg.norm(sweep.xyz, axis=1)
        index = np.flatnonzero(distance > RANGES_M[0])
        index = rng.choice(index, min(RETURNS, len(index)), replace=False)
        near = ground.query(path.to_local(sweep.xyz[index], times[index]), distance_upper_bound=GROUND_DISTANCE_M)[0]
        index = index[np.isfinite(near)]
        chosen.append((sweep.xyz[index], times[index]))
    ranges = np.concatenate([np.linalg.norm(xyz, axis=1) for xyz, _ in chosen])
    number = np.repeat(np.arange(len(chosen)), [len(xyz) for xyz, _ in chosen])
    found = {}
    for offset in offsets_deg:
        placed = np.concatenate([path.to_local(raise_beams(xyz, offset), times) for xyz, times in chosen])
        above = _above_others(placed.astype(np.float64), number)
        known = np.isfinite(above)
        found[offset] = above[known], ranges[known]
    return found


def _above_others(xyz: F64, number: I64) -> F64:
    """(N,) metres above the plane of the returns around it of other sweeps; NaN if there is none that is level."""
    near, index = cKDTree(xyz[:, :2]).query(xyz[:, :2], k=NEIGHBOURS, distance_upper_bound=RADIUS_M)
    other = np.isfinite(near)
    index = np.where(other, index, 0)
    other &= number[index] != number[:, None]
    count, weight = other.sum(axis=1), other[..., None]
    centre = (xyz[index] * weight).sum(axis=1) / np.maximum(count, 1)[:, None]
    offset = (xyz[index] - centre[:, None]) * weight
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))[1][:, :, 0]
    above = np.einsum("ni,ni->n", xyz - centre, normal) * np.sign(normal[:, 2])
    above[(count < MIN_NEIGHBOURS) | (np.abs(normal[:, 2]) < MIN_UP) | (np.abs(above) > GROUND_DISTANCE_M)] = np.nan
    return np.asarray(above)


def main() -> None:
    """Compare the offsets, and print a table and the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="*", choices=list(STREETS), default=list(STREETS))
    parser.add_argument("--offsets", nargs="+", type=float, default=[0.0, 0.1, 0.15, 0.205], help="degrees")
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "street")
    arguments = parser.parse_args()
    result: dict[str, dict[str, float]] = {}
    for name in arguments.parts:
        folder = arguments.out.resolve() / name
        found = ground_distances(STREETS[name].data, folder / "tile", folder / "run", arguments.offsets)
        print(f"{name}: median distance, and signed median by range, cm")
        for offset, (above, ranges) in found.items():
            result.setdefault(name, {})[f"{offset:g}"] = median = round(100 * float(np.median(np.abs(above))), 3)
            parts = [
                f"{low:.0f}-{high:.0f} m {100 * np.median(above[(ranges >= low) & (ranges < high)]):+.2f}"
                for low, high in pairwise(RANGES_M)
            ]
            print(f"  {offset:5.3f} degrees: {median:.2f}; " + ", ".join(parts), flush=True)
    print("RESULT " + json.dumps(result))


if __name__ == "__main__":
    main()

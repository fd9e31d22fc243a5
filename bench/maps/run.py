"""Worlds from robots' maps (`scan2sim run map.pcd --out world`), measured against ground truth.

`python -m bench.maps [--parts up runs rest walls ground indoor localization time large] [--maps NAME ...]
[--out bench-out/maps]`

Maps: the robots' real ones and KITTI's drives in the folder that SCAN2SIM_REAL_DATA gives (drives cut to maps of 5, 20
and 50 cm, in the axes of the first sensor pose), and simulated buildings with ground truth (`data_samples.robot_map`).

- up: 40 maps, rotated at random and in different axis conventions; `up_failed`: those whose up is found more than .5
  degrees off (real maps, whose up is known less exactly: 2; drives: 3).
- runs: all maps, or those whose names begin with one of `--maps`; `maps_failed`: runs that fail, or aren't upright (the
  same limits); `lobby_triangles`. Writes <map>_above.png and <map>_inside.png.
- rest: 200 robots (boxes) are dropped in each world's free space (Nav2 maps) in MuJoCo; `rest_share` of all comes to
  rest within 10 cm of the floor, the true one if it is known, else the world's. `rest_share_with_room`: of those whose
  box is clear of everything that isn't free; others, beside walls, may start inside one. `floor_p95_cm`: 95th
  percentile of the distance between the world's floor and the map's lowest points, of the worst map. `free_iou`: the
  free space compared with the true one that the robot reaches.
- walls: `wall_median_cm` and `wall_p95_cm`, from the world's walls to the true ones, `wall_truth_*` from true walls
  that the robot saw to the world's; 16 lines, 5 cm of range noise.
- ground: `ground_mislabelled`: share of true ground points that were labelled as something standing, on a grid of
  50 cm; mean of a sweep of SemanticKITTI and a synthetic street.
- indoor: `indoor_miou`: mean IoU of floor, wall, ceiling and furniture over the points of simulated buildings.
- ghosts: `ghost_recall` and `ghost_precision`: share of people's points that were proposed as ghosts or got the class
  `person`, and share of such points that are people's, in simulated buildings.
- localization: `localization_cm`: median position error of a lidar simulated in the world, localized in the user's map.
- time: `seconds_100k`: wall time of the run of a map of 100,000 points. large (only if selected): `seconds_10m`, of ten
  million, and `peak_gb_10m`.

A part whose map, package or step is missing fails with the reason; its figures are null, and the exit status is 1.
Finished steps of earlier runs in `--out` are reused, except by time and large. Ends with `RESULT {json}`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.maps import chain, inputs, labels, localization, pictures, rest, surfaces
from bench.maps.command import Missing
from bench.maps.inputs import BenchMap
from bench.paths import ROOT
from scan2sim.data_samples.building import Style
from scan2sim.data_samples.robot_map import AXES, Lidar, Mapping, random_rotation
from scan2sim.pipeline.core.types import F64

KEYS = (
    "maps_failed", "rest_share", "wall_median_cm", "lobby_triangles", "ground_mislabelled", "up_failed", "seconds_100k",
    "indoor_miou", "localization_cm",
)  # fmt: skip
"""Figures of the result line; null if their part failed or wasn't run."""
ROTATIONS = 4
"""Number of rotations of each map of part `up`."""
UP_DRIVE, UP_DRIVE_VOXEL_M = "raw0009", 0.2
REST_MAPS = ("plain", "tilted", "coarse", "stairs", "hdl501", "lobby", "dddmr")
WALL_MAPS, INDOOR_MAPS, LOCALIZATION_MAPS = ("plain", "tilted"), ("plain", "loam", "coarse"), ("plain", "tilted")
GHOST_MAPS = ("loam", "oblique")
TIMED_POINTS, TIMED_VOXEL_M = 100_000, 0.08
LARGE_POINTS = 10_000_000
LARGE = Style(rooms=8), Lidar(azimuth_step=0.2), Mapping(voxel=0.0)


class Bench:
    """The parts; maps and worlds are made once, below `out`."""

    def __init__(self, out: Path, names: Sequence[str]) -> None:
        self.out, self.names = out, names
        self._maps: dict[str, BenchMap] = {}
        self._worlds: dict[str, chain.World] = {}

    def map(self, name: str) -> BenchMap:
        """A real or a simulated map."""
        if name not in self._maps:
            known = name in inputs.BUILDINGS
            self._maps[name] = inputs.simulated(name, self.out / "maps") if known else inputs.real(name)
        return self._maps[name]

    def world(self, one: BenchMap) -> chain.World:
        """The world of a map."""
        if one.name not in self._worlds:
            self._worlds[one.name], measured = chain.build(one, self.out / "worlds" / one.name)
            print(f"{one.name:16} {len(one.xyz):9,} points, {measured.seconds:.0f} s", flush=True)
        return self._worlds[one.name]

    def up(self) -> dict[str, Any]:
        """`up_failed`."""
        maps: list[Callable[[], BenchMap]] = [
            partial(self.map, name) for name in (*inputs.BUILDINGS, *inputs.real_names())
        ]
        maps.append(partial(inputs.drive, UP_DRIVE, UP_DRIVE_VOXEL_M, self.out / "maps"))
        off, failed = [], 0
        for i, make in enumerate(maps):
            one = make()
            for k in range(ROTATIONS):
                R = list(AXES.values())[(i + k) % len(AXES)] @ random_rotation(ROTATIONS * i + k)
                angle = _angle(chain.find_up(one.xyz @ R.T), R @ one.up)
                failed += angle > one.tolerance_deg
                off.append(angle)
            row = ", ".join(f"{angle:.2f}" for angle in off[-ROTATIONS:])
            print(f"up {one.name:16} {row} degrees off; limit {one.tolerance_deg:g}", flush=True)
        return {"up_failed": failed, "up_maps": len(off), "up_median_deg": round(float(np.median(off)), 3)}

    def runs(self) -> dict[str, Any]:
        """`maps_failed` and `lobby_triangles`; a recording that is missing makes the part fail at its end."""
        failed, count, missing = [], 0, []
        result: dict[str, Any] = {}
        for one in inputs.all_maps(self.out / "maps", self.names):
            if isinstance(one, Missing):
                missing.append(str(one))
                continue
            count += 1
            try:
                world = self.world(one)
                pictures.take(one, world, self.out / "pictures" / one.name)
                if one.name == "lobby":
                    result["lobby_triangles"] = world.triangles
                off = _angle(world.T_world_map[2, :3], one.up)
                why = f"up is {off:.1f} degrees off" if off > one.tolerance_deg else ""
                print(f"run {one.name:16} {world.triangles:,} triangles, up {off:.2f} degrees off", flush=True)
            except Missing as error:
                why = str(error)
            if why:
                print(f"run {one.name:16} FAILED: {why}", flush=True)
                failed.append(one.name)
        if missing:
            raise Missing("; ".join(missing))
        return result | {"maps_failed": len(failed), "maps": count, "failed_maps": failed}

    def rest(self) -> dict[str, Any]:
        """`rest_share`, `rest_share_with_room`, `floor_p95_cm` and `free_iou`."""
        rests, rooms, agreements, errors = [], [], [], []
        for name in REST_MAPS:
            one = self.map(name)
            world = self.world(one)
            at_rest, room = rest.drop(one, world, self.out / "mujoco" / name)
            rests.append(at_rest)
            rooms.append(room)
            off = 100 * rest.floor_errors(one, world)
            line = f"rest {name:16} {at_rest.mean():.3f} of {len(at_rest)} robots"
            line += f", {at_rest[room].mean():.3f} of {room.sum()} with room"
            if len(off):
                errors.append(float(np.percentile(off, 95)))
                line += f", floor to points: median {np.median(off):.1f}, 95 % {errors[-1]:.1f} cm"
            if one.truth is not None:
                agreements.append(rest.free_agreement(one, world))
                line += f", IoU of free space {agreements[-1]:.3f}"
            print(line, flush=True)
        return {
            "rest_share": round(float(np.concatenate(rests).mean()), 4),
            "rest_share_with_room": round(float(np.concatenate(rests)[np.concatenate(rooms)].mean()), 4),
            "rest_worst": round(float(min(r.mean() for r in rests)), 4),
            "floor_p95_cm": round(max(errors), 1) if errors else None,
            "free_iou": round(float(np.mean(agreements)), 4),
        }

    def walls(self) -> dict[str, Any]:
        """`wall_median_cm` and the other distances, pooled over the maps."""
        found = []
        for name in WALL_MAPS:
            found.append(surfaces.wall_distances(self.map(name), self.world(self.map(name))))
            print(f"walls {name:16} {json.dumps(found[-1].summary())}", flush=True)
        pooled = (np.concatenate(part) for part in zip(*((f.to_truth, f.from_truth) for f in found), strict=True))
        return surfaces.WallDistances(*pooled).summary()

    def ground(self) -> dict[str, Any]:
        """`ground_mislabelled`."""
        shares = {}
        for make in (labels.semantic_kitti, labels.street):
            one, ground = make(self.out / "maps")
            shares[one.name] = labels.ground_mislabelled(one, ground, self.world(one))
            print(f"ground {one.name:16} {shares[one.name]:.4f} of {ground.sum():,} points mislabelled", flush=True)
        rounded = {f"ground_mislabelled_{name}": round(share, 4) for name, share in shares.items()}
        return {"ground_mislabelled": round(float(np.mean(list(shares.values()))), 4)} | rounded

    def indoor(self) -> dict[str, Any]:
        """`indoor_miou` and the IoU of each kind."""
        found = []
        for name in INDOOR_MAPS:
            found.append(labels.indoor_iou(self.map(name), self.world(self.map(name))))
            print(f"indoor {name:16} {json.dumps({k: round(v, 3) for k, v in found[-1].items()})}", flush=True)
        means = {kind: round(float(np.mean([f[kind] for f in found])), 4) for kind in labels.INDOOR}
        return {"indoor_miou": round(float(np.mean(list(means.values()))), 4), "indoor_iou": means}

    def ghosts(self) -> dict[str, Any]:
        """`ghost_recall`, `ghost_precision`: of people's points and proposed ghosts' points."""
        found = []
        for name in GHOST_MAPS:
            one = self.map(name)
            found.append(labels.ghost_shares(one, self.world(one), inputs.BUILDINGS[name][2].voxel))
            print(f"ghosts {name:16} recall {found[-1][0]:.3f}, precision {found[-1][1]:.3f}", flush=True)
        recall, precision = np.mean(found, axis=0).round(4).tolist()
        return {"ghost_recall": recall, "ghost_precision": precision}

    def localization(self) -> dict[str, Any]:
        """`localization_cm` and its 95th percentile."""
        found = []
        for name in LOCALIZATION_MAPS:
            found.append(localization.localization_errors(self.map(name), self.world(self.map(name))))
            print(f"localization {name:16} median {100 * np.median(found[-1]):.1f} cm", flush=True)
        errors = 100 * np.concatenate(found)
        median, p95 = (float(np.percentile(errors, q, method="lower")) for q in (50, 95))
        return {"localization_cm": round(median, 2), "localization_p95_cm": round(p95, 2)}

    def time(self) -> dict[str, Any]:
        """`seconds_100k`."""
        style, lidar = Style(), Lidar(azimuth_step=0.2)
        one = inputs.simulate(
            "time", style, lidar, Mapping(voxel=TIMED_VOXEL_M), self.out / "maps", seed=0, points=TIMED_POINTS
        )
        return {"seconds_100k": round(self._timed(one).seconds, 1)}

    def large(self) -> dict[str, Any]:
        """`seconds_10m` and `peak_gb_10m`."""
        one = inputs.simulate("large", *LARGE, self.out / "maps", seed=0, points=LARGE_POINTS)
        measured = self._timed(one)
        return {"seconds_10m": round(measured.seconds, 1), "peak_gb_10m": round(measured.peak_gb, 2)}

    def _timed(self, one: BenchMap) -> Any:
        folder = self.out / "worlds" / one.name
        shutil.rmtree(folder, ignore_errors=True)
        return chain.build(one, folder)[1]


def _angle(a: F64, b: F64) -> float:
    """Angle between two directions, degrees."""
    cosine = float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


PARTS: dict[str, Callable[[Bench], dict[str, Any]]] = {
    "up": Bench.up, "runs": Bench.runs, "rest": Bench.rest, "walls": Bench.walls, "ground": Bench.ground,
    "indoor": Bench.indoor, "ghosts": Bench.ghosts, "localization": Bench.localization,
    "time": Bench.time, "large": Bench.large,
}  # fmt: skip


def main() -> None:
    """Run the parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=[name for name in PARTS if name != "large"])
    parser.add_argument("--maps", nargs="+", default=[], metavar="NAME", help="maps of part runs; default: all")
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "maps")
    arguments = parser.parse_args()
    bench = Bench(arguments.out.resolve(), arguments.maps)
    result: dict[str, Any] = dict.fromkeys(KEYS)
    failed: dict[str, str] = {}
    for name in arguments.parts:
        try:
            result |= PARTS[name](bench)
        except Missing as error:
            failed[name] = str(error)
            print(f"PART {name} FAILED: {error}", flush=True)
    print("RESULT " + json.dumps(result | {"failed_parts": failed}))
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()

"""Visual SLAM compared with the truth of a rendered drive and of KITTI, with pycolmap, and with the method of D3.2.

`python -m bench.slam [--parts drive hard kitti real turn adjust trust solvers pano memory] [--length 1500] [--out DIR]`

- drive: 360-degree video (1024 px high, 10 Mbit/s, 15 fps) along a real path (KITTI 00; without the data a generated
  one) through a synthetic town with traffic: odometry scaled by a consumer GPS receiver; D3.2's two errors; frames
  per second; the first 40 seconds also with the method of D3.2 (`--backend adam`, adjacent distances).
- hard: drives of 100 m with hills, sharp turns, motion blur, rolling shutter, offset lenses and glare, each alone and
  all together: drift, share of extrapolated frames, estimated and true rolling shutter and lens offset.
- kitti: 51 frames of KITTI odometry 06 (perspective, real): ATE after a similarity alignment, for odometry alone and
  with global adjustment; pycolmap's incremental mapping of the same frames, and the ratio of the times.
- real: KITTI odometry 00 (frames 60-179), 01, 04 and 06, and raw 0009 against its scan-matched poses, tracked by the
  step `track` with the published lens: ATE, share of unsure poses, lens; pycolmap's mapping with its better lens (as
  published, or focal length and k1 free), and the ratio of CPU times; `real_ratio_max` is the worst ratio of all
  drives, `odometry_ratio_max` that of those with ground truth. `--reuse`: read pycolmap's earlier results.
- turn: 51 frames of a rendered turn of 98 degrees (perspective, 52 m): ATE, alone and adjusted, and pycolmap's; the
  effect of dimming every other frame to 0.45 of its brightness, here and on KITTI; focal length from
  self-calibration.
- adjust: odometry alone and adjusted on the above, two more streets (KITTI 04, 0009) and 20 simulated drives; how often
  the better path is kept, and the ratio of the kept path's error to the better one's (geometric mean).
- trust: share of positions inside their 95 % ellipsoids over 20 simulated drives, with plots; error of a turn whose
  scale drifts like KITTI's (step lengths .885, 1.001, 1.048) with 10 cm GPS, relative to without; number of drives with
  a warning for a focal length or a centre that is 5 % off.
- pano: rotation and direction of motion between two real 360 frames, compared with a reference.
- solvers: `adam` and `lm` with equal distance constraints and equal GPS on ten simulated drives, with a paired test.
- memory: peak memory of the process over 10,000 frames.

Ends with `RESULT {json}`; null for parts that were not run.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bench.paths import DATA, ROOT
from bench.slam.adjust import chosen
from bench.slam.covariance import covariance, gps_gain, lens
from bench.slam.drive import drive
from bench.slam.frames import Sequence, constant_light, odometry, positions, pycolmap
from bench.slam.hard import hard
from bench.slam.memory import memory
from bench.slam.real import DRIVES, real
from bench.slam.solvers import solvers
from scan2sim.pipeline.core.types import Camera
from scan2sim.slam.calibration.calibrate import calibrated_from_scratch
from scan2sim.slam.geometry import log_so3, relative_pose
from scan2sim.slam.global_map.global_adjustment import adjust
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.odometry.relocalization import detect_features, match_descriptors
from scan2sim.slam.odometry.track_log import record_tracks
from scan2sim.slam.trackers import named
from scan2sim.slam.video import open_video
from scan2sim.slam.virtual_cameras import VirtualViews

PARTS = ("drive", "hard", "kitti", "real", "turn", "adjust", "trust", "solvers", "pano", "memory")
DEFAULT_PARTS = ("drive", "kitti", "real", "turn", "adjust", "trust", "pano")


def kitti(out: Path) -> dict[str, float | None]:
    """ATE on 51 real frames, and the time relative to pycolmap's incremental mapping."""
    sequence = Sequence.of(DATA / "kitti_odo06_vo51", "KITTI 06")
    odometry(sequence)  # warm up compiled code and file caches
    began = time.perf_counter()
    alone = sequence.ate(positions(odometry(sequence)[0]))
    seconds = time.perf_counter() - began
    found, _ = odometry(sequence, keep=True)
    began = time.perf_counter()
    adjust(MapCheckpoint.of(found, []))
    adjusting = time.perf_counter() - began
    theirs, their_seconds, _, registered = pycolmap(sequence, out / "pycolmap")
    print(f"KITTI 06, 51 frames: odometry {100 * alone:.2f} cm in {seconds:.1f} s")
    print(f"  with global adjustment {100 * sequence.ate(positions(found)):.2f} cm, {adjusting:.1f} s more")
    print(f"  pycolmap {100 * theirs:.2f} cm in {their_seconds:.1f} s, {registered} frames", flush=True)
    return {"kitti06_ate_m": alone, "pycolmap_time_ratio": their_seconds / seconds}


def pictures(out: Path) -> list[Sequence]:
    """The rendered turn, generated if missing, and KITTI odometry 06 and 04 if available."""
    from scan2sim.data_samples.turn import generate_turn

    folder = out / "turn"
    if not (folder / "calib.txt").is_file():
        print("rendering a turn: about ten seconds per frame", flush=True)
        generate_turn(folder)
    known = [(DATA / "kitti_odo06_vo51", "KITTI 06", 0), (DATA / "kitti_odo04_f00-24", "KITTI 04", 2)]
    return [Sequence.of(folder, "turn"), *(Sequence.of(*one) for one in known if one[0].is_dir())]


def turn(out: Path) -> dict[str, float | None]:
    """ATE in a rendered turn, compared with pycolmap's; the effect of flickering light here and on KITTI's frames."""
    sequence, *streets = pictures(out)
    ratios = [_flicker(one) for one in (sequence, *streets)]
    found, busy = odometry(sequence)
    alone = sequence.ate(positions(found))
    found, _ = odometry(sequence, keep=True)
    began = time.process_time()
    adjust(MapCheckpoint.of(found, []))
    adjusting, adjusted = time.process_time() - began, sequence.ate(positions(found))
    theirs, _, their_busy, registered = pycolmap(sequence, out / "pycolmap_turn")
    print(f"turn, 51 frames: odometry {100 * alone:.2f} cm in {busy:.1f} s of CPU time")
    print(f"  with global adjustment {100 * adjusted:.2f} cm, {adjusting:.1f} s more")
    print(f"  pycolmap {100 * theirs:.2f} cm in {their_busy:.1f} s, {registered} frames", flush=True)
    return {
        "turn_ate_m": alone, "turn_adjusted_m": adjusted, "turn_pycolmap_ratio": alone / theirs,
        "turn_pycolmap_time_ratio": their_busy / busy, "gain_ate_ratio": max(ratios),
        "calibrate_error_percent": _calibrated(sequence),
    }  # fmt: skip


def _calibrated(sequence: Sequence) -> float | None:
    """Error in percent of the focal length found by self-calibration without prior knowledge."""
    known = calibrated_from_scratch(record_tracks(open_video(sequence.frames), None))
    if known is None:
        print(f"{sequence.name}: self-calibration failed")
        return None
    true, own = sequence.camera, known.camera
    print(
        f"{sequence.name}: focal length {own.fx:.1f} +- {known.sigma[0] * own.fx:.1f} found ({true.fx:.1f}), centre "
        f"{own.cx:.1f}, {own.cy:.1f} ({true.cx:.1f}, {true.cy:.1f})",
        flush=True,
    )
    return 100 * abs(own.fx / true.fx - 1)


def _flicker(sequence: Sequence) -> float:
    """ATE with every other frame dimmed to 0.45, relative to without; means over three numbers of features."""
    lights: list[Callable[[int], float]] = [
        constant_light,
        lambda k: 0.45 if k % 2 else 1.0,
        lambda k: 0.35 if k >= 12 else 1.0,
    ]
    means = [
        np.mean([sequence.ate(positions(odometry(sequence, light, count=n)[0])) for n in (640, 700, 760)])
        for light in lights
    ]
    text = ", ".join(f"{100 * mean:.2f}" for mean in means)
    print(f"{sequence.name}: {text} cm (original; every other frame at .45; .35 from the 13th on)", flush=True)
    return float(means[1] / means[0])


def pano() -> None:
    """Rotation and direction of motion between two real 360 frames, by descriptors and by tracked corners.

    The reference has world-to-camera poses with axes x back, y right, z up (inferred from its motion).
    """
    import cv2

    folder = DATA / "pano360"
    numbers = (folder / "dense_transformation.dat").read_text(encoding="utf-8").splitlines()[1].split()[1:]
    axes = np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])  # ours to the reference's
    R = np.array(numbers[3:], float).reshape(3, 3)
    turn, way = axes.T @ R.T @ axes, axes.T @ (-R.T @ np.array(numbers[:3], float))
    way /= np.linalg.norm(way)
    first, second = (
        cv2.resize(cv2.imread(str(f), cv2.IMREAD_GRAYSCALE), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        for f in sorted(folder.glob("2019*.jpg"))
    )
    views, rng = VirtualViews(Camera("equirectangular", 1024, 512)), np.random.default_rng(0)
    a, b = (detect_features(views, views.images(grey)) for grey in (first, second))
    pairs = match_descriptors(a.descriptor, b.descriptor)
    tracker = named("corners", views, None, 600)
    tracker.track(first)
    tracker.refill()
    before = tracker.tracks
    tracker.track(second)
    followed = np.searchsorted(before.ids, tracker.tracks.ids)
    for kind, there, now in (
        ("ORB", a.bearing[pairs[:, 0]], b.bearing[pairs[:, 1]]),
        ("corners", before.bearing[followed], tracker.tracks.bearing),
    ):
        found = relative_pose(there, now, threshold=np.radians(0.5), rng=rng)
        if found is None:
            print(f"pano360, {kind}: no pose found")
            continue
        off = np.degrees(np.linalg.norm(log_so3(found[0][:3, :3].T @ turn)))
        aside = np.degrees(np.arccos(np.clip(found[0][:3, 3] @ way, -1, 1)))
        print(
            f"pano360, {kind}: {found[1].sum()} of {len(there)} agree; rotation {off:.2f} degrees from the reference, "
            f"direction of motion {aside:.2f} (a pixel is 0.70)",
            flush=True,
        )


def main() -> None:
    """Run the parts, and print tables and the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=DEFAULT_PARTS)
    parser.add_argument("--path", default="00", help="name of the path in kitti_gt_poses")
    parser.add_argument("--length", type=float, default=1500.0)
    parser.add_argument("--adam", type=float, default=40.0, help="seconds for the method of D3.2; 0: skip it")
    parser.add_argument("--reuse", action="store_true", help="read pycolmap's results of an earlier run of part real")
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "slam")
    arguments = parser.parse_args()
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    keys = (
        "drift_percent", "local400_m", "adam_drift_percent", "kitti06_ate_m", "pycolmap_time_ratio", "fps",
        "turn_ate_m", "turn_adjusted_m", "turn_pycolmap_ratio", "turn_pycolmap_time_ratio", "gain_ate_ratio",
        "adjust_right", "adjust_over_best", "covariance_95", "gps_gain", "focal_noticed",
        "centre_noticed", "focal_false_alarms", "hard_drift_percent", "adam_lm_p", "memory_10000_growth",
        "calibrate_error_percent", "odo01_ate_m", "odo01_pycolmap_m", "odo01_unsure", "real_ratio_max",
        "odometry_ratio_max", "cpu_ratio_min",
    )  # fmt: skip
    result: dict[str, float | None] = dict.fromkeys(keys)
    if "drive" in arguments.parts:
        result |= drive(out, arguments.path, arguments.length, arguments.adam)
    if "turn" in arguments.parts:
        result |= turn(out)
    if "adjust" in arguments.parts:
        result |= chosen(pictures(out))
    if "trust" in arguments.parts:
        result |= covariance(out) | gps_gain() | lens()
    for part, needed in (("kitti", "kitti_odo06_vo51"), ("pano", "pano360")):
        if part not in arguments.parts:
            continue
        if not (DATA / needed).is_dir():
            print(f"{part}: skipped, {DATA / needed} doesn't exist")
        elif part == "kitti":
            result |= kitti(out)
        else:
            pano()
    if "real" in arguments.parts:
        missing = [folder for folder, _ in DRIVES.values() if not (DATA / folder).is_dir()]
        if missing:
            print(f"real: skipped, {DATA} has no {', '.join(missing)}")
        else:
            result |= real(out, reuse=arguments.reuse)
    if "hard" in arguments.parts:
        result |= hard(out)
    if "solvers" in arguments.parts:
        result |= solvers()
    if "memory" in arguments.parts:
        result |= memory(out)
    print("RESULT " + json.dumps({k: None if v is None else round(v, 4) for k, v in result.items()}))

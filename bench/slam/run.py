"""Visual SLAM against a rendered drive's truth, KITTI's, pycolmap, and the mission's own method.

`python -m bench.slam [--parts drive hard kitti turn adjust trust solvers pano memory] [--length 1500] [--out DIR]`

- drive: 360-degree video (1024 px high, 10 Mbit/s, 15 fps) along a real path (KITTI 00; without the data a made-up one)
  through a synthetic town with traffic, odometry alone, a consumer receiver's GPS for the scale: D3.2's two errors;
  frames a second; the first 40 seconds by the mission's method, too (`--backend adam`, adjacent distances).
- hard: drives of 100 m with hills, sharp turns, motion blur, rolling shutter, offset lenses and glare, each alone and
  all together: drift, the share of unsure frames, rolling shutter and lens offset estimated against what was rendered.
- kitti: 51 frames of KITTI odometry 06 (perspective, real): ATE after a similarity, odometry alone and with the
  global adjustment; pycolmap's incremental mapping of the same frames, and the ratio of the times.
- turn: 51 frames of a rendered turn of 98 degrees (perspective, 52 m): ATE, alone and adjusted, and pycolmap's; what
  it costs there and on KITTI's frames when every other frame has .45 of its brightness; its focal length, found from
  nothing.
- adjust: odometry alone and adjusted on the above, two more streets (KITTI 04, 0009) and 20 simulated drives; how often
  the better one is kept, and by how much what is kept is worse than the better one (geometric mean).
- trust: the share of positions that lie in their 95 % ellipsoids, over 20 simulated drives; pictures of these;
  what GPS of 10 cm leaves of the error of a turn whose scale drifts as KITTI's did (step lengths .885, 1.001, 1.048);
  on how many drives a focal length 5 % off, or a centre off by as much, is noticed.
- pano: rotation and direction of motion between two real 360 frames, against their reference.
- solvers: `adam` against `lm` with equal chords and equal GPS over ten simulated drives, a paired test.
- memory: peak of the process over 10,000 frames.

Ends with `RESULT {json}`; null where a part was left out.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bench.paths import ROOT
from bench.slam.adjust import chosen
from bench.slam.covariance import covariance, gps_gain, lens
from bench.slam.drive import DATA, drive
from bench.slam.frames import Sequence, lit, odometry, places, pycolmap
from bench.slam.hard import hard
from bench.slam.memory import memory
from bench.slam.solvers import solvers
from scan2sim.pipeline.core.types import Camera
from scan2sim.slam.calibration.calibrate import looked_for
from scan2sim.slam.geometry import log_so3, relative_pose
from scan2sim.slam.mapping.global_adjustment import adjust
from scan2sim.slam.mapping.map_file import Mapped
from scan2sim.slam.odometry.relocalization import describe, matches
from scan2sim.slam.odometry.track_log import record
from scan2sim.slam.odometry.virtual_cameras import Facets
from scan2sim.slam.trackers import named
from scan2sim.slam.video import open_video

PARTS = ("drive", "hard", "kitti", "turn", "adjust", "trust", "solvers", "pano", "memory")
USUAL = ("drive", "kitti", "turn", "adjust", "trust", "pano")


def kitti(out: Path) -> dict[str, float | None]:
    """ATE on 51 real frames, and the time against pycolmap's incremental mapping."""
    sequence = Sequence.of(DATA / "kitti_odo06_vo51", "KITTI 06")
    odometry(sequence)  # compiled code and file caches are no part of either's time
    began = time.perf_counter()
    alone = sequence.ate(places(odometry(sequence)[0]))
    seconds = time.perf_counter() - began
    found, _ = odometry(sequence, keep=True)
    began = time.perf_counter()
    adjust(Mapped.of(found, []))
    adjusting = time.perf_counter() - began
    theirs, their_seconds, _, registered = pycolmap(sequence, out / "pycolmap")
    print(f"KITTI 06, 51 frames: odometry {100 * alone:.2f} cm in {seconds:.1f} s")
    print(f"  with global adjustment {100 * sequence.ate(places(found)):.2f} cm, {adjusting:.1f} s more")
    print(f"  pycolmap {100 * theirs:.2f} cm in {their_seconds:.1f} s, {registered} frames", flush=True)
    return {"kitti06_ate_m": alone, "pycolmap_time_ratio": their_seconds / seconds}


def pictures(out: Path) -> list[Sequence]:
    """The rendered turn, made if absent, and KITTI's odometry 06 and 04 where they are."""
    from scan2sim.data_samples.turn import generate_turn

    folder = out / "turn"
    if not (folder / "calib.txt").is_file():
        print("rendering a turn: about ten seconds a frame", flush=True)
        generate_turn(folder)
    known = [(DATA / "kitti_odo06_vo51", "KITTI 06", 0), (DATA / "kitti_odo04_f00-24", "KITTI 04", 2)]
    return [Sequence.of(folder, "turn"), *(Sequence.of(*one) for one in known if one[0].is_dir())]


def turn(out: Path) -> dict[str, float | None]:
    """ATE in a rendered turn, against pycolmap's; what light that flickers costs there, and on KITTI's frames."""
    sequence, *streets = pictures(out)
    ratios = [_flicker(one) for one in (sequence, *streets)]
    found, busy = odometry(sequence)
    alone = sequence.ate(places(found))
    found, _ = odometry(sequence, keep=True)
    began = time.process_time()
    adjust(Mapped.of(found, []))
    adjusting, adjusted = time.process_time() - began, sequence.ate(places(found))
    theirs, _, their_busy, registered = pycolmap(sequence, out / "pycolmap_turn")
    print(f"turn, 51 frames: odometry {100 * alone:.2f} cm in {busy:.1f} s of processor time")
    print(f"  with global adjustment {100 * adjusted:.2f} cm, {adjusting:.1f} s more")
    print(f"  pycolmap {100 * theirs:.2f} cm in {their_busy:.1f} s, {registered} frames", flush=True)
    return {
        "turn_ate_m": alone, "turn_adjusted_m": adjusted, "turn_pycolmap_ratio": alone / theirs,
        "turn_pycolmap_time_ratio": their_busy / busy, "gain_ate_ratio": max(ratios),
        "calibrate_error_percent": _calibrated(sequence),
    }  # fmt: skip


def _calibrated(sequence: Sequence) -> float | None:
    """By how many percent the focal length is off that calibration finds, of which nothing is known before."""
    known = looked_for(record(open_video(sequence.frames), None))
    if known is None:
        print(f"{sequence.name}: no lens is found")
        return None
    true, own = sequence.camera, known.camera
    print(
        f"{sequence.name}: focal length {own.fx:.1f} +- {known.sigma[0] * own.fx:.1f} found ({true.fx:.1f}), centre "
        f"{own.cx:.1f}, {own.cy:.1f} ({true.cx:.1f}, {true.cy:.1f})",
        flush=True,
    )
    return 100 * abs(own.fx / true.fx - 1)


def _flicker(sequence: Sequence) -> float:
    """ATE with every other frame at .45 of its brightness, over that without: means over three numbers of features."""
    lights: list[Callable[[int], float]] = [lit, lambda k: 0.45 if k % 2 else 1.0, lambda k: 0.35 if k >= 12 else 1.0]
    means = [
        np.mean([sequence.ate(places(odometry(sequence, light, count=n)[0])) for n in (640, 700, 760)])
        for light in lights
    ]
    told = ", ".join(f"{100 * mean:.2f}" for mean in means)
    print(f"{sequence.name}: {told} cm (as it is; every other frame at .45; .35 from the 13th on)", flush=True)
    return float(means[1] / means[0])


def pano() -> None:
    """Rotation and direction of motion between two real 360 frames, by descriptors and by tracked corners.

    The reference holds world-to-camera poses in axes of its own: x back, y right, z up (told by its motion).
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
    facets, rng = Facets(Camera("equirectangular", 1024, 512)), np.random.default_rng(0)
    a, b = (describe(facets, facets.pictures(grey)) for grey in (first, second))
    pairs = matches(a.descriptor, b.descriptor)
    tracker = named("corners", facets, None, 600)
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
    """Run the parts, print tables and the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=USUAL)
    parser.add_argument("--path", default="00", help="of kitti_gt_poses")
    parser.add_argument("--length", type=float, default=1500.0)
    parser.add_argument("--adam", type=float, default=40.0, help="seconds for the mission's method; 0: leave it out")
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "slam")
    arguments = parser.parse_args()
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    keys = (
        "drift_percent", "local400_m", "adam_drift_percent", "kitti06_ate_m", "pycolmap_time_ratio", "fps",
        "turn_ate_m", "turn_adjusted_m", "turn_pycolmap_ratio", "turn_pycolmap_time_ratio", "gain_ate_ratio",
        "adjust_right", "adjust_over_best", "covariance_95", "gps_gain", "focal_noticed",
        "centre_noticed", "focal_false_alarms", "hard_drift_percent", "adam_lm_p", "memory_10000_growth",
        "calibrate_error_percent",
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
            print(f"{part}: left out, there is no {DATA / needed}")
        elif part == "kitti":
            result |= kitti(out)
        else:
            pano()
    if "hard" in arguments.parts:
        result |= hard(out)
    if "solvers" in arguments.parts:
        result |= solvers()
    if "memory" in arguments.parts:
        result |= memory(out)
    print("RESULT " + json.dumps({k: None if v is None else round(v, 4) for k, v in result.items()}))

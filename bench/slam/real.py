"""Real drives: the path that `scan2sim slam` finds, compared with ground truth and with pycolmap's mapping."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.paths import DATA
from bench.slam.adjust import street
from bench.slam.frames import Sequence, pycolmap, pycolmap_positions
from bench.slam.world import DRIVE, seconds
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.steps.track import TrackParams, track_video

DRIVES = {
    "odo00": ("kitti_odo00_f60-179", 0),
    "odo01": ("kitti_odo01_vo51", 0),
    "odo04": ("kitti_odo04_f00-24", 2),
    "odo06": ("kitti_odo06_vo51", 0),
}
"""Folders of KITTI odometry's drives, and their cameras."""
RAW = "raw0009"
"""Name of the drive whose truth are scan-matched poses: not independent of its sweeps, but of its images."""


class Tracked(NamedTuple):
    """Result of `scan2sim slam` on a drive.

    Attributes:
        ate: metres.
        positions: (T, 3) of the camera.
        unsure: share of unsure poses.
        metrics: those of the step.
        busy: seconds of CPU time.
    """

    ate: float
    positions: F64
    unsure: float
    metrics: dict[str, Any]
    busy: float


def tracked(sequence: Sequence, **options: Any) -> Tracked:
    """Track a drive by the step `track`, with the lens published for it, and `options` of that step."""
    camera = sequence.camera
    params = TrackParams(focal=camera.fx, centre=(camera.cx, camera.cy), **options)
    with tempfile.TemporaryDirectory() as folder:
        out, checkpoint = Path(folder) / "out", Path(folder) / "checkpoint"
        out.mkdir()
        checkpoint.mkdir()
        began = time.process_time()
        done = track_video({"video": sequence.frames}, params, out, silent, checkpoint)
        busy = time.process_time() - began
        found = MapCheckpoint.read(out / "map.npz")
    places = np.stack([(found.map.keyframes[p.keyframe].T_world_cam @ p.T_key_cam)[:3, 3] for p in found.placed])
    unsure = float(np.mean([p.unsure for p in found.placed]))
    return Tracked(sequence.ate(places), places, unsure, done.metrics, busy)


def odometer_error(positions: F64) -> float:
    """RMS error in metres of raw 0009's positions (T, 3) along its straight street, by the INS's forward velocity.

    The velocity (Doppler and accelerometers) is integrated over the time stamps, and fitted with an offset and a scale.
    """
    drive = next(next(p for p in DRIVE.iterdir() if p.is_dir()).glob("*_sync"))
    start = seconds(drive / "image_02" / "timestamps.txt", 0.0)[0]
    times, stamps = (seconds(drive / name / "timestamps.txt", start) for name in ("image_02", "oxts"))
    times, stamps = times[: len(positions)], stamps[: len(positions) + 1]
    files = sorted((drive / "oxts" / "data").glob("*.txt"))[: len(stamps)]
    speed = np.array([float(file.read_text(encoding="utf-8").split()[8]) for file in files])
    stamps = stamps[: len(speed)]
    driven = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(stamps))])
    at = np.interp(times, stamps, driven) + np.minimum(times - stamps[0], 0) * speed[0]
    heading = (positions[-1] - positions[0]) / np.linalg.norm(positions[-1] - positions[0])
    design = np.column_stack([positions @ heading, np.ones(len(at))])
    off = at - design @ np.linalg.lstsq(design, at, rcond=None)[0]
    return float(np.sqrt((off**2).mean()))


def real(out: Path, *, reuse: bool) -> dict[str, float | None]:
    """Compare each drive with the truth, and with pycolmap with its better lens.

    Args:
        out: folder for pycolmap's results.
        reuse: read pycolmap's results of an earlier run in `out`.

    Returns:
        For each drive, ATE of both, and the share of unsure poses; `real_ratio_max`, the greatest ratio of the ATE to
        pycolmap's, and `odometry_ratio_max`, that of the drives with ground truth; `cpu_ratio_min`, the least ratio of
        pycolmap's CPU time to ours.
    """
    result: dict[str, float | None] = {}
    drives = [Sequence.of(DATA / folder, name, camera) for name, (folder, camera) in DRIVES.items()]
    drives += [replace(street(), name=RAW)] if DRIVE.is_dir() else []
    tracked(drives[-1])  # warm up compiled code
    ratios, cpu_ratios = {}, {}
    for sequence in drives:
        name, ours = sequence.name, tracked(sequence)
        lenses = {"published lens": False, "free focal length and k1": True}
        theirs = {
            lens: pycolmap(sequence, out / f"pycolmap_{name}_{free:d}", free_lens=free, reuse=reuse)
            for lens, free in lenses.items()
        }
        better = min(theirs, key=lambda lens: theirs[lens][0])
        ate, _, busy, registered = theirs[better]
        ratios[name], cpu_ratios[name] = ours.ate / ate, busy / ours.busy
        found = ours.metrics.get("lens")
        lens = f"refined: {found['options']}" if found else "as published"
        print(
            f"{name}, {len(sequence.truth)} frames: ATE {ours.ate:.4f} m in {ours.busy:.1f} s of CPU time, lens {lens}"
        )
        print(
            f"  {ours.unsure:.0%} unsure, {ours.metrics['maps']} maps, {len(ours.metrics['losses'])} losses of tracking"
        )
        print("  pycolmap: " + ", ".join(f"{lens} {one[0]:.4f} m in {one[2]:.1f} s" for lens, one in theirs.items()))
        print(
            f"  ratio of the errors {ratios[name]:.2f} ({registered} frames), of the times {cpu_ratios[name]:.1f}",
            flush=True,
        )
        if name == RAW:
            paths = {"ours": ours.positions, "pycolmap": pycolmap_positions(sequence, out / f"pycolmap_{name}_0")[0]}
            errors = {who: odometer_error(path) for who, path in (paths | {"truth": sequence.truth}).items()}
            text = ", ".join(f"{who} {1e3 * error:.1f}" for who, error in errors.items())
            print(f"  error along the street by the INS's velocity, mm: {text}", flush=True)
            result |= {f"{name}_odometer_{who}_m": error for who, error in errors.items()}
        result |= {f"{name}_ate_m": ours.ate, f"{name}_pycolmap_m": ate, f"{name}_unsure": ours.unsure}
    result["real_ratio_max"] = max(ratios.values())
    result["odometry_ratio_max"] = max(ratio for name, ratio in ratios.items() if name in DRIVES)
    result["cpu_ratio_min"] = min(cpu_ratios.values())
    return result

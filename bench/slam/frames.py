"""Odometry and pycolmap's mapping on folders of perspective frames, such as KITTI odometry's."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.geometry.similarity import umeyama
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.video import open_video


@dataclass(frozen=True)
class Sequence:
    """Frames with their true path.

    Attributes:
        name: name for tables.
        frames: folder of images.
        camera: their camera.
        truth: (T, 3) camera positions in metres.
    """

    name: str
    frames: Path
    camera: Camera
    truth: F64

    @classmethod
    def of(cls, folder: Path, name: str, camera: int = 0) -> Sequence:
        """From a folder with `poses.txt`, `calib.txt` and the images of one of its cameras."""
        lines = (folder / "calib.txt").read_text(encoding="utf-8").splitlines()
        P = [float(v) for v in next((x.split(":")[1] for x in lines if x.startswith(f"P{camera}:")), lines[0]).split()]
        frames = folder / ("image_2" if camera == 2 else "image_l")
        video = open_video(frames)
        truth = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)[:, :, 3]
        return cls(name, frames, Camera("pinhole", video.width, video.height, P[0], P[5], P[2], P[6]), truth)

    def ate(self, found: F64, rows: slice | list[int] = slice(None)) -> float:
        """Absolute trajectory error: RMS distance in metres of (T, 3) positions after a similarity alignment."""
        off = umeyama(found, self.truth[rows], scaled=True).apply(found) - self.truth[rows]
        return float(np.sqrt((off**2).sum(axis=1).mean()))


def constant_light(_: int) -> float:
    """Constant brightness."""
    return 1.0


def odometry(
    sequence: Sequence, light: Callable[[int], float] = constant_light, *, keep: bool = False, **params: object
) -> tuple[Odometry, float]:
    """Odometry of a sequence, each frame's brightness multiplied by `light`; and seconds of CPU time."""
    found = Odometry(sequence.camera, OdometryParams.model_validate(params), keep=keep)
    began = time.process_time()
    for frame in open_video(sequence.frames).frames():
        found.add(frame.time, (frame.grey * light(frame.number)).astype(np.uint8))
    return found, time.process_time() - began


def positions(found: Odometry) -> F64:
    """(T, 3) positions of the camera."""
    return np.stack([found.pose_of(p)[:3, 3] for p in found.placed])


def pycolmap(sequence: Sequence, out: Path) -> tuple[float, float, float, int]:
    """ATE, seconds, CPU seconds and number of frames of pycolmap's incremental mapping with known intrinsics."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    camera = sequence.camera
    code = f"""
import pycolmap, json, time, numpy as np
from pathlib import Path
out, images = Path({str(out)!r}), Path({str(sequence.frames)!r})
reader = pycolmap.ImageReaderOptions()
reader.camera_model = "PINHOLE"
reader.camera_params = "{camera.fx},{camera.fy},{camera.cx + 0.5},{camera.cy + 0.5}"
pycolmap.extract_features(out / "db.db", images, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader)
pycolmap.match_sequential(out / "db.db")
options = pycolmap.IncrementalPipelineOptions()
options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
options.mapper.init_max_forward_motion = 1
options.mapper.init_min_tri_angle = 2
models = pycolmap.incremental_mapping(out / "db.db", images, out, options)
best = max(models.values(), key=lambda m: m.num_reg_images())
positions = {{best.images[i].name: best.images[i].projection_center().tolist() for i in best.reg_image_ids()}}
(out / "positions.json").write_text(json.dumps([positions, time.process_time()]))
"""
    began = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    seconds = time.perf_counter() - began
    if done.returncode:
        sys.exit(f"pycolmap failed: {done.stderr[-500:]}")
    found, busy = json.loads((out / "positions.json").read_text(encoding="utf-8"))
    rows = sorted((int(Path(name).stem), place) for name, place in found.items())
    return sequence.ate(np.array([p for _, p in rows]), [i for i, _ in rows]), seconds, busy, len(rows)

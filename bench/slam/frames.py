"""Odometry and pycolmap's mapping over folders of perspective pictures, as KITTI's odometry has them."""

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
    """Pictures with their truth.

    Attributes:
        name: for tables.
        frames: folder of pictures.
        camera: of them.
        truth: (T, 3) metres, of the camera.
    """

    name: str
    frames: Path
    camera: Camera
    truth: F64

    @classmethod
    def of(cls, folder: Path, name: str, camera: int = 0) -> Sequence:
        """A folder with `poses.txt`, `calib.txt`, and pictures of one of its cameras."""
        lines = (folder / "calib.txt").read_text(encoding="utf-8").splitlines()
        P = [float(v) for v in next((x.split(":")[1] for x in lines if x.startswith(f"P{camera}:")), lines[0]).split()]
        frames = folder / ("image_2" if camera == 2 else "image_l")
        video = open_video(frames)
        truth = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)[:, :, 3]
        return cls(name, frames, Camera("pinhole", video.width, video.height, P[0], P[5], P[2], P[6]), truth)

    def ate(self, found: F64, rows: slice | list[int] = slice(None)) -> float:
        """Root mean square metres of (T, 3) places after a similarity."""
        off = umeyama(found, self.truth[rows], scaled=True).apply(found) - self.truth[rows]
        return float(np.sqrt((off**2).sum(axis=1).mean()))


def lit(_: int) -> float:
    """Light as it is."""
    return 1.0


def odometry(
    sequence: Sequence, light: Callable[[int], float] = lit, *, keep: bool = False, **params: object
) -> tuple[Odometry, float]:
    """Odometry over a sequence, each frame's brightness multiplied by `light`; seconds of processor time."""
    found = Odometry(sequence.camera, OdometryParams.model_validate(params), keep=keep)
    began = time.process_time()
    for frame in open_video(sequence.frames).frames():
        found.add(frame.time, (frame.grey * light(frame.number)).astype(np.uint8))
    return found, time.process_time() - began


def places(found: Odometry) -> F64:
    """(T, 3) of the camera."""
    return np.stack([found.pose_of(p)[:3, 3] for p in found.placed])


def pycolmap(sequence: Sequence, out: Path) -> tuple[float, float, float, int]:
    """ATE, seconds, seconds of processor time and frames of pycolmap's incremental mapping with known intrinsics."""
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
places = {{best.images[i].name: best.images[i].projection_center().tolist() for i in best.reg_image_ids()}}
(out / "places.json").write_text(json.dumps([places, time.process_time()]))
"""
    began = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    seconds = time.perf_counter() - began
    if done.returncode:
        sys.exit(f"pycolmap failed: {done.stderr[-500:]}")
    found, busy = json.loads((out / "places.json").read_text(encoding="utf-8"))
    rows = sorted((int(Path(name).stem), place) for name, place in found.items())
    return sequence.ate(np.array([p for _, p in rows]), [i for i, _ in rows]), seconds, busy, len(rows)

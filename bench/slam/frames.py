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
from scan2sim.slam.reconstruction.colmap import Lens
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
        frames = next(path for name in (f"image_{camera}", "image_l") if (path := folder / name).is_dir())
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


def pycolmap(
    sequence: Sequence, out: Path, *, free_lens: bool = False, reuse: bool = False
) -> tuple[float, float, float, int]:
    """ATE, seconds, CPU seconds and number of frames of pycolmap's incremental mapping.

    Args:
        sequence: the frames.
        out: folder of its database and result.
        free_lens: optimize focal length and k1, too; otherwise, the intrinsics are known.
        reuse: read the result of an earlier run from `out` if there is one.
    """
    file = out / "positions.json"
    if not (reuse and file.is_file()):
        _run_pycolmap(sequence, out, free_lens)
    _, seconds, busy = json.loads(file.read_text(encoding="utf-8"))
    found, rows = pycolmap_positions(sequence, out)
    return sequence.ate(found, rows), seconds, busy, len(rows)


def pycolmap_positions(sequence: Sequence, out: Path) -> tuple[F64, list[int]]:
    """(N, 3) camera positions of pycolmap's result in a folder, and the numbers of their frames."""
    found = json.loads((out / "positions.json").read_text(encoding="utf-8"))[0]
    names = [frame.name for frame in open_video(sequence.frames).frames()]
    rows = sorted((names.index(name), place) for name, place in found.items())
    return np.array([place for _, place in rows]), [row for row, _ in rows]


def _run_pycolmap(sequence: Sequence, out: Path, free_lens: bool) -> None:
    """Run pycolmap in a process of its own; writes positions by frame, seconds and CPU seconds to positions.json."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    camera = sequence.camera
    lens = Lens(camera.fx, (camera.cx, camera.cy), (0.0,) if free_lens else None, fixed=not free_lens)
    code = f"""
import json, time
began = time.perf_counter()
import pycolmap
from pathlib import Path
from scan2sim.slam.reconstruction import colmap
from scan2sim.slam.reconstruction.colmap import Lens
from scan2sim.slam.reconstruction.photos import list_photos
out, images, lens = Path({str(out)!r}), Path({str(sequence.frames)!r}), {lens!r}
names = list_photos(images)
camera = colmap.add_photos(out / "db.db", images, names, lens)
colmap.extract(out / "db.db", images, names)
colmap.match(out / "db.db", list(colmap.sequential_pairs(names)))
best = pycolmap.Reconstruction(colmap.reconstruct(out / "db.db", images, out, [camera] * lens.fixed)[0].folder)
positions = {{best.images[i].name: best.images[i].projection_center().tolist() for i in best.reg_image_ids()}}
seconds = time.perf_counter() - began
(out / "positions.json").write_text(json.dumps([positions, seconds, time.process_time()]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"pycolmap failed: {done.stderr[-500:]}")

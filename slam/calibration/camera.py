"""Camera: what a video was filmed with: as is said, as its EXIF or metadata say, or as its pictures fit best."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.io.images import exif
from scan2sim.slam.calibration.calibrate import calibrated, looked_for
from scan2sim.slam.calibration.lens import Known, changed
from scan2sim.slam.odometry.track_log import Recording, plain
from scan2sim.slam.video import Video

EXIF = np.array([0.05, 0.05, 0.05, 0.0])
"""How well EXIF knows a lens, as `lens.LIKELY` names it: whole millimetres, of a sensor of which videos show a part."""
DIAGONAL = math.hypot(36, 24)
"""Millimetres, of the film that "35 mm equivalent" means (CIPA DCG-001)."""


@dataclass(frozen=True)
class Found:
    """A camera that wasn't simply told.

    Attributes:
        camera: it.
        sigma: (4,) how well it is known, as `lens.LIKELY` names it.
        how: it was found.
    """

    camera: Camera
    sigma: F64
    how: str

    @classmethod
    def of(cls, known: Known, how: str) -> Self:
        """What calibration found."""
        return cls(known.camera, known.sigma, how)

    def facts(self) -> dict[str, Any]:
        """For `slam.json`: pixels with their standard deviations, and the options that say the same."""
        camera, pixels = self.camera, np.round(self.sigma[:3] * self.camera.fx, 1).tolist()
        k1 = (camera.distortion or (0.0,))[0]
        options = f"--focal {camera.fx:.2f} --centre {camera.cx:.2f} {camera.cy:.2f}"
        lens = {
            "focal": round(camera.fx, 2), "focal_sigma": pixels[0],
            "centre": [round(camera.cx, 2), round(camera.cy, 2)], "centre_sigma": pixels[1:],
            **({"k1": round(k1, 4), "k1_sigma": round(float(self.sigma[3]), 4)} if k1 else {}),
            "how": self.how, "options": options + (f" --k1 {k1:.4f}" if k1 else ""),
        }  # fmt: skip
        return {"lens": lens}

    def told(self) -> str:
        """For a user."""
        return (
            f"the camera's focal length is {self.camera.fx:.0f} +- {self.sigma[0] * self.camera.fx:.0f} pixels by "
            f"{self.how}: {self.facts()['lens']['options']}"
        )

    def write(self, path: Path) -> None:
        """As JSON."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            json.dumps({"camera": asdict(self.camera), "sigma": self.sigma.tolist(), "how": self.how}), encoding="utf-8"
        )

    @classmethod
    def read(cls, path: Path) -> Self | None:
        """What `write` wrote; None where it isn't whole."""
        try:
            tree = json.loads(path.read_text(encoding="utf-8"))
            camera = Camera(**tree["camera"] | {"distortion": tuple(tree["camera"]["distortion"])})
            return cls(camera, np.array(tree["sigma"], np.float64), str(tree["how"]))
        except (OSError, ValueError, KeyError, TypeError):
            return None


def camera_of(
    video: Video, model: str, focal: float | None, centre: tuple[float, float] | None, k1: float | None = None
) -> Camera | None:
    """The camera of a video: equirectangular if it is twice as wide as high and nothing else is said.

    None: a perspective one whose focal length isn't said.

    Raises:
        InputError: a 360 video of another shape.
    """
    w, h = video.width, video.height
    if model == "auto":
        model = "equirectangular" if w == 2 * h and focal is None else "pinhole"
    if model == "equirectangular":
        if abs(w - 2 * h) > 2:
            raise InputError(video.path, f"is {w}x{h}, not twice as wide as high", "Name its camera: --camera pinhole")
        return Camera("equirectangular", w, h)
    if focal is None:
        return None
    cx, cy = centre or ((w - 1) / 2, (h - 1) / 2)
    return changed(Camera("pinhole", w, h, focal, focal, cx, cy), np.array([0, 0, 0, k1 or 0.0]))


def found(video: Video, camera: Camera | None, record: Callable[[], Recording], *, calibrate: bool) -> Found | None:
    """What the video's camera is, where that isn't said, or is to be calibrated; None: as is said.

    Args:
        camera: as is said; None: it isn't.
        record: follows the video's features.
        calibrate: find what fits the whole drive best, even where a camera is said, or EXIF tells one.

    Raises:
        InputError: nothing tells it.
    """
    if camera is not None and camera.model == "equirectangular":
        if calibrate:
            raise InputError(video.path, "is a 360 video, whose lens is no question", "Leave --calibrate out")
        return None
    if camera is not None and not calibrate:
        return None
    written = focal_written(video) if camera is None else None
    if written is not None and not calibrate:
        return Found(plain(video.width, video.height, written[0]), EXIF, written[1])
    recording = record()
    start = plain(video.width, video.height, written[0]) if written else camera
    known = None if start is None else calibrated(recording, start)
    known = known or looked_for(recording)
    if known is not None:
        return Found.of(known, f"self-calibration over {len(recording.times)} frames")
    if camera is None:
        raise InputError(
            video.path, "nothing tells its focal length: no EXIF, and the camera turns too little to calibrate it",
            "Give --focal (pixels), a part of the video that turns by 45 degrees or more, or a tile whose camera it is",
        )  # fmt: skip
    raise InputError(
        video.path, "doesn't tell its lens: the camera turns too little",
        "Leave --calibrate out, or give a part of the video that turns by 45 degrees or more",
    )  # fmt: skip


def focal_written(video: Video) -> tuple[float, str] | None:
    """Pixels, and where they are from: the first picture's EXIF, or the video's metadata; None where neither tells."""
    if video.path.is_dir():
        equivalent, source = exif.focal_35mm(video.first), "EXIF"
    else:
        equivalent, source = video.focal_35mm, "the video's metadata"
    if equivalent is None:
        return None
    return equivalent / DIAGONAL * math.hypot(video.width, video.height), source

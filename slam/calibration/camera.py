"""Camera of a video: given by the user, read from EXIF or video metadata, or estimated by self-calibration."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from scan2sim.pipeline.camera import panorama
from scan2sim.pipeline.camera.lens import changed_lens
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.io.images import exif
from scan2sim.slam.calibration.calibrate import calibrated, calibrated_from_scratch
from scan2sim.slam.lens import LensEstimate
from scan2sim.slam.odometry.track_log import TrackLog, centred_pinhole
from scan2sim.slam.video import Video

EXIF_SIGMA = np.array([0.05, 0.05, 0.05, 0.1, 0.03])
"""Standard deviation of a lens from EXIF, in the parameters of `lens.UNKNOWN_SIGMA`: it is in whole millimetres,
videos show only a part of the sensor, and distortion isn't known."""
MODELS = ("auto", "pinhole", "equirectangular")
"""Camera models that can be named."""
FILM_DIAGONAL_MM = math.hypot(36, 24)
"""Diagonal of the film that "35 mm equivalent" refers to (CIPA DCG-001)."""


@dataclass(frozen=True)
class EstimatedCamera:
    """A camera from metadata or self-calibration.

    Attributes:
        camera: the camera.
        sigma: (5,) standard deviations of the parameters of `lens.UNKNOWN_SIGMA`.
        how: source of the estimate, for messages.
        final: it comes from the drive itself, which therefore can't improve it.
    """

    camera: Camera
    sigma: F64
    how: str
    final: bool = True

    @classmethod
    def of(cls, estimate: LensEstimate, how: str) -> Self:
        """Camera of a calibration result."""
        return cls(estimate.camera, estimate.sigma, how)

    def metrics(self) -> dict[str, Any]:
        """Entry for `slam.json`: values in pixels, their standard deviations, and the equivalent options."""
        camera, pixels = self.camera, np.round(self.sigma[:3] * self.camera.fx, 1).tolist()
        distortion = {name: value for name, value in zip(("k1", "k2"), camera.distortion, strict=False) if value}
        options = f"--focal {camera.fx:.2f} --centre {camera.cx:.2f} {camera.cy:.2f}"
        options += "".join(f" --{name} {value:.4f}" for name, value in distortion.items())
        lens = {
            "focal": round(camera.fx, 2), "focal_sigma": pixels[0],
            "centre": [round(camera.cx, 2), round(camera.cy, 2)], "centre_sigma": pixels[1:],
            **{name: round(value, 4) for name, value in distortion.items()},
            **{f"{name}_sigma": round(float(self.sigma[3 + (name == "k2")]), 4) for name in distortion},
            "how": self.how, "options": options,
        }  # fmt: skip
        return {"lens": lens}

    def message(self) -> str:
        """Message for the user."""
        return (
            f"the camera's focal length is {self.camera.fx:.0f} +- {self.sigma[0] * self.camera.fx:.0f} pixels by "
            f"{self.how}: {self.metrics()['lens']['options']}"
        )

    def write(self, path: Path) -> None:
        """Write as JSON."""
        path.parent.mkdir(parents=True, exist_ok=True)
        work = path.with_suffix(".part")
        work.write_text(json.dumps(asdict(self) | {"sigma": self.sigma.tolist()}), encoding="utf-8")
        work.replace(path)

    @classmethod
    def read(cls, path: Path) -> Self | None:
        """Read a file written by `write`; None if it is missing or damaged."""
        try:
            tree = json.loads(path.read_text(encoding="utf-8"))
            camera = Camera(**tree["camera"] | {"distortion": tuple(tree["camera"]["distortion"])})
            return cls(camera, np.array(tree["sigma"], np.float64), str(tree["how"]), bool(tree["final"]))
        except (OSError, ValueError, KeyError, TypeError):
            return None


def camera_of(
    video: Video,
    model: str,
    focal: float | None,
    centre: tuple[float, float] | None,
    k1: float | None = None,
    k2: float | None = None,
) -> Camera | None:
    """Camera of a video from the options; "auto" is equirectangular if the frames have an aspect ratio of 2:1.

    None for a perspective camera without a focal length.

    Raises:
        SettingError: unknown model.
        InputError: the camera is equirectangular, but the aspect ratio isn't 2:1; or the camera is to be found, and
            frames of that ratio don't show the whole sphere.
    """
    if model not in MODELS:
        remedy = f"Use {', '.join(MODELS)}, or a file (docs/inputs.md)"
        raise SettingError("--camera", f"unknown model {model!r}", remedy)
    w, h = video.width, video.height
    if model == "auto" and w == 2 * h and focal is None:
        panorama.check(video.path, video.first_grey())
        model = "equirectangular"
    if model == "equirectangular":
        if abs(w - 2 * h) > 2:
            raise InputError(
                video.path,
                f"is {w}x{h}, not twice as wide as high like a 360 video",
                "Set the camera: --camera pinhole",
            )
        return Camera("equirectangular", w, h)
    if focal is None:
        return None
    cx, cy = centre or ((w - 1) / 2, (h - 1) / 2)
    return changed_lens(Camera("pinhole", w, h, focal, focal, cx, cy), np.array([0, 0, 0, k1 or 0.0, k2 or 0.0]))


def estimated_camera(
    video: Video, camera: Camera | None, record: Callable[[], TrackLog], *, calibrate: bool
) -> EstimatedCamera | None:
    """Camera from metadata or self-calibration; None if the given camera is used.

    Args:
        video: the video.
        camera: camera given by the user or the tile; None: unknown.
        record: tracks corners through the video.
        calibrate: calibrate over the whole drive even if the camera is given, or in EXIF.

    Raises:
        InputError: the camera is unknown and can't be calibrated.
    """
    if camera is not None and camera.model == "equirectangular":
        if calibrate:
            raise InputError(video.path, "is a 360 video, which has no lens to calibrate", "Remove --calibrate")
        return None
    if camera is not None and not calibrate:
        return None
    from_metadata = metadata_focal(video) if camera is None else None
    if from_metadata is not None and not calibrate:
        focal, source = from_metadata
        return EstimatedCamera(centred_pinhole(video.width, video.height, focal), EXIF_SIGMA, source, final=False)
    log = record()
    start = centred_pinhole(video.width, video.height, from_metadata[0]) if from_metadata else camera
    estimate = None if start is None else calibrated(log, start)
    estimate = estimate or calibrated_from_scratch(log)
    if estimate is not None:
        return EstimatedCamera.of(estimate, f"self-calibration over {len(log.times)} frames")
    if camera is None:
        raise InputError(
            video.path, "focal length unknown: there is no EXIF, and the camera turns too little for self-calibration",
            "Give --focal (pixels), a part of the video with a turn of 45 degrees or more, or the tile with its camera",
        )  # fmt: skip
    raise InputError(
        video.path, "can't be calibrated: the camera turns too little",
        "Remove --calibrate, or give a part of the video with a turn of 45 degrees or more",
    )  # fmt: skip


def metadata_focal(video: Video) -> tuple[float, str] | None:
    """Focal length in pixels, and its source: EXIF of the first image, or the video's metadata; None if in neither."""
    if video.path.is_dir():
        equivalent, source = exif.focal_35mm(video.first), "EXIF"
    else:
        equivalent, source = video.focal_35mm, "the video's metadata"
    if equivalent is None:
        return None
    return equivalent / FILM_DIAGONAL_MM * math.hypot(video.width, video.height), source

"""Pictures that consumers take of a world from a photo's own pose, beside that photo."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from bench.consumers import Fault
from bench.gate.places import Places
from bench.texture.renderings import side_by_side
from scan2sim.pipeline.core.types import F64, U8, Camera
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.evaluate import score

ALONG = 0.9
"""Cosine of the angle to the road up to which a photo looks along it."""
PART = 0.25
"""Of the way, from its beginning, near which it was taken."""
OFF = 0.01
"""Of a picture's width, by which it may lie beside the photo."""

BLUR = 2.0
"""Pixels of blur before outlines are looked for."""


class Photo(NamedTuple):
    """A photo without its lens' distortion.

    Attributes:
        rgb: (H, W, 3).
        camera: a pinhole.
        pose: (4, 4) camera to the world; x right, y down, z ahead.
    """

    rgb: U8
    camera: Camera
    pose: F64


def photo(places: Places) -> Photo:
    """A photo that looks along the road, with much of it ahead.

    Raises:
        Fault: no photo is flat.
    """
    way = places.ways[0]
    start, ahead = way[int(PART * len(way))], way[-1] - way[0]
    ahead = ahead / np.linalg.norm(ahead)
    flat = [view for view in places.views if view.camera.model in ("pinhole", "opencv")]
    if not flat:
        raise Fault("there is no flat photo to compare with")
    most = max(float(view.T_world_cam[:3, 2] @ ahead) for view in flat)
    looking = [view for view in flat if view.T_world_cam[:3, 2] @ ahead >= min(most, ALONG)]
    view = min(looking, key=lambda one: float(np.linalg.norm(one.centre - start)))
    rgb, own = image.read_rgb(view.photo), view.camera
    if own.distortion:
        matrix = np.array([[own.fx, 0, own.cx], [0, own.fy, own.cy], [0, 0, 1.0]])
        rgb = np.asarray(cv2.undistort(rgb, matrix, np.asarray(own.distortion)))
    plain = Camera("pinhole", own.width, own.height, own.fx, own.fy, own.cx, own.cy)
    return Photo(rgb, plain, np.asarray(view.T_world_cam))


def compare(export: Path, name: str, seen: Photo, taken: U8, shown: Any) -> dict[str, Any]:
    """Figures of a picture (H, W, 3) taken from a photo's pose, and both side by side in a file.

    Args:
        export: of the world; the file is `pictures/<name>.png` beside the folder of exports.
        name: of the consumer.
        seen, taken: the photo and the picture.
        shown: (H, W) where the picture shows the world, and not the sky.

    Returns:
        `picture_psnr_db` and `picture_ssim`, after one gain a channel, where the world is shown; `picture_off_px`: by
        how many pixels it lies beside the photo.

    Raises:
        Fault: it shows nothing, or something else than the photo does.
    """
    folder = export.parents[1] / "pictures"
    folder.mkdir(exist_ok=True)
    side_by_side(folder, name, [("photo", seen.rgb), (name, taken)])
    likeness = score(seen.rgb, taken, np.asarray(shown, bool))
    figures = {
        "picture_psnr_db": round(likeness["psnr_gain_db"], 2),
        "picture_ssim": round(likeness["ssim"], 3),
        "picture_off_px": round(_off(seen.rgb, taken), 2),
    }
    if not np.any(shown) or figures["picture_off_px"] > OFF * seen.camera.width:
        raise Fault("its picture isn't what the photo shows", figures)
    return figures


def _off(photo: U8, taken: U8) -> float:
    """Pixels between two pictures of the same, by the phase of their outlines' spectra."""
    grey = [cv2.GaussianBlur(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), (0, 0), BLUR) for picture in (photo, taken)]
    edges = [cv2.Laplacian(picture, cv2.CV_64F) for picture in grey]
    window = cv2.createHanningWindow((photo.shape[1], photo.shape[0]), cv2.CV_64F)
    (x, y), _ = cv2.phaseCorrelate(edges[0], edges[1], window)
    return float(np.hypot(x, y))

"""Images of a world rendered by consumers from a photo's pose, compared with the photo."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scan2sim.pipeline.core.types import U8, Camera
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.evaluate import score
from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import Photo, WorldReference
from tests.fakes.world_checks.side_by_side import side_by_side

MIN_ALONG_ROAD = 0.9
"""Minimum cosine of the angle between the photo's axis and the road."""
ROUTE_SHARE = 0.25
"""Position along the route, as a share of its length, near which the photo was taken."""
MAX_SHIFT = 0.01
"""Maximum shift of the image relative to the photo, as a share of its width."""

BLUR_PX = 2.0
"""Blur before edge detection, pixels."""


def photo(reference: WorldReference) -> Photo:
    """A photo along the road, with much of the road in view; without photos, the renderer's view from the robot.

    Raises:
        Fault: there is no perspective photo.
    """
    if reference.rendered is not None:
        return reference.rendered
    way = reference.ways[0]
    start, ahead = way[int(ROUTE_SHARE * len(way))], way[-1] - way[0]
    ahead = ahead / np.linalg.norm(ahead)
    flat = [view for view in reference.views if view.camera.model in ("pinhole", "opencv")]
    if not flat:
        raise Fault("there is no perspective photo to compare with")
    most = max(float(view.T_world_cam[:3, 2] @ ahead) for view in flat)
    looking = [view for view in flat if view.T_world_cam[:3, 2] @ ahead >= min(most, MIN_ALONG_ROAD)]
    view = min(looking, key=lambda one: float(np.linalg.norm(one.centre - start)))
    rgb, camera = image.read_rgb(view.photo), view.camera
    if camera.distortion:
        matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
        rgb = np.asarray(cv2.undistort(rgb, matrix, np.asarray(camera.distortion)))
    plain = Camera("pinhole", camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return Photo(rgb, plain, np.asarray(view.T_world_cam))


def compare(export: Path, name: str, reference: Photo, rendering: U8, covered: Any) -> dict[str, Any]:
    """Compare an image (H, W, 3) rendered from a photo's pose with the photo, and write both side by side.

    Args:
        export: folder of the export; the image is written to `pictures/<name>.png` beside the folder of exports.
        name: name of the consumer.
        reference: the photo.
        rendering: the image.
        covered: (H, W) pixels of the image that show the world, not the sky.

    Returns:
        `picture_psnr_db` and `picture_ssim` of these pixels, after a gain per channel; `picture_off_px`: shift of the
        image in pixels.

    Raises:
        Fault: the image shows nothing, or differs from the photo.
    """
    folder = export.parents[1] / "pictures"
    folder.mkdir(exist_ok=True)
    side_by_side(folder, name, [("photo", reference.rgb), (name, rendering)])
    likeness = score(reference.rgb, rendering, np.asarray(covered, bool))
    metrics = {
        "picture_psnr_db": round(likeness["psnr_gain_db"], 2),
        "picture_ssim": round(likeness["ssim"], 3),
        "picture_off_px": round(_shift(reference.rgb, rendering), 2),
    }
    if not np.any(covered) or metrics["picture_off_px"] > MAX_SHIFT * reference.camera.width:
        raise Fault("its image differs from the photo", metrics)
    return metrics


def _shift(photo: U8, rendering: U8) -> float:
    """Shift in pixels between two images, from the phase correlation of their edges."""
    grey = [cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in (photo, rendering)]
    edges = [cv2.Laplacian(cv2.GaussianBlur(one, (0, 0), BLUR_PX), cv2.CV_64F) for one in grey]
    window = cv2.createHanningWindow((photo.shape[1], photo.shape[0]), cv2.CV_64F)
    (x, y), _ = cv2.phaseCorrelate(edges[0], edges[1], window)
    return float(np.hypot(x, y))

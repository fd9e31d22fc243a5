"""COLMAP models (text or binary): cameras, images, points3D.

COLMAP stores world-to-camera poses with OpenCV's axes and puts the centre of the top left pixel at
(0.5, 0.5): poses are inverted, principal points move by half a pixel.

Source: https://colmap.github.io/format.html, https://colmap.github.io/cameras.html
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.errors import InputError
from scan2sim.pipeline.extras import need
from scan2sim.pipeline.io.models import Model, Photos, Shot
from scan2sim.pipeline.types import F64, Camera, CameraModel

# COLMAP's model: ours, number of focal lengths, places of COLMAP's coefficients among ours
MODELS: dict[str, tuple[CameraModel, int, tuple[int, ...]]] = {
    "SIMPLE_PINHOLE": ("pinhole", 1, ()),
    "PINHOLE": ("pinhole", 2, ()),
    "SIMPLE_RADIAL": ("opencv", 1, (0,)),
    "RADIAL": ("opencv", 1, (0, 1)),
    "OPENCV": ("opencv", 2, (0, 1, 2, 3)),
    "FULL_OPENCV": ("opencv", 2, (0, 1, 2, 3, 4, 5, 6, 7)),
    "SIMPLE_FISHEYE": ("fisheye", 1, ()),
    "FISHEYE": ("fisheye", 2, ()),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", 1, (0,)),
    "RADIAL_FISHEYE": ("fisheye", 1, (0, 1)),
    "OPENCV_FISHEYE": ("fisheye", 2, (0, 1, 2, 3)),
}


def read(model: Path, photos: Photos) -> Model:
    """A folder of cameras, images and points3D, .bin or .txt (often `sparse/0`)."""
    found = _read(model)
    images = sorted((image for image in found.images.values() if image.has_pose), key=lambda image: image.name)
    used = sorted({image.camera_id for image in images})
    keys = sorted(found.points3D)
    return Model(
        {f"camera_{key}": camera_of(model, found.cameras[key]) for key in used},
        tuple(Shot(image.name, f"camera_{image.camera_id}", _camera_to_world(image)) for image in images),
        np.array([found.points3D[key].xyz for key in keys]).reshape(-1, 3),
        np.array([found.points3D[key].color for key in keys], np.uint8).reshape(-1, 3),
    )


def camera_of(model: Path, camera: Any) -> Camera:
    """The counterpart of a `pycolmap.Camera`.

    Raises:
        InputError: naming the camera's model, where there is none.
    """
    kind = camera.model_name
    if kind == "EQUIRECTANGULAR":
        return Camera("equirectangular", camera.width, camera.height)
    if kind not in MODELS:
        raise InputError(
            model,
            f"camera {camera.camera_id} has the model {kind}, which is not supported",
            "Undistort the photos (`colmap image_undistorter`), or use one of " + ", ".join(MODELS),
        )
    ours, focals, places = MODELS[kind]
    p = [float(value) for value in camera.params]
    fx, fy, cx, cy, *rest = [p[0], *p] if focals == 1 else p
    size = 0 if ours == "pinhole" or not places else 8 if max(places) > 3 else 4
    distortion = [0.0] * size
    for at, value in zip(places, rest, strict=True):
        distortion[at] = value
    return Camera(ours, camera.width, camera.height, fx, fy, cx - 0.5, cy - 0.5, tuple(distortion))


def _read(model: Path) -> Any:
    need("import colmap", "pycolmap")
    import pycolmap

    if not any((model / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
        raise InputError(
            model, "holds no COLMAP model (no cameras.bin or cameras.txt)", "Name its folder, often sparse/0"
        )
    try:
        return pycolmap.Reconstruction(model)
    except (ValueError, RuntimeError, IndexError, OSError) as error:
        raise InputError(model, f"is no readable COLMAP model ({error})", "Export it again") from None


def _camera_to_world(shot: Any) -> F64:
    pose = np.eye(4)
    pose[:3] = shot.cam_from_world().inverse().matrix()
    return pose

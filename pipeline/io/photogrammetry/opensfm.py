"""OpenSfM and OpenDroneMap (ODM) models, `reconstruction.json`.

Poses are world to camera (axis-angle and translation) with OpenCV's axes. Pixels are normalised: the origin is the
middle of the image, its longer side has length 1. The world is topocentric: metres east, north and up of
`reference_lla`. It is transformed to a projected CRS: that of the ODM project (`coords.txt`), or UTM.

ODM renames that file to `reconstruction.topocentric.json`, and its `reconstruction.json` is in the project's CRS
minus the offset of `coords.txt`: turned by the meridian convergence, and shifted. The former is read.

Source: OpenSfM's documentation (https://opensfm.org/docs/geometry.html, dataset.html) and its
`opensfm/src/geometry/camera_distortions_functions.h`; its Brown model has OpenCV's order of coefficients. ODM's
`stages/run_opensfm.py` and the command export_geocoords of its OpenSfM.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera, CameraModel
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.geodata.crs import utm_zone
from scan2sim.pipeline.io.photogrammetry import Model, Photos, Shot

REMEDY = "Export it again, or give the reconstruction.json of a finished project"
RECONSTRUCTION, TOPOCENTRIC = "reconstruction.json", "reconstruction.topocentric.json"
FILES = (RECONSTRUCTION, f"opensfm/{RECONSTRUCTION}")
# projection type: our model, and its coefficients in our order
MODELS: dict[str, tuple[CameraModel, tuple[str, ...]]] = {
    "perspective": ("opencv", ("k1", "k2", "", "")),
    "simple_radial": ("opencv", ("k1", "", "", "")),
    "radial": ("opencv", ("k1", "k2", "", "")),
    "brown": ("opencv", ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": ("fisheye", ("k1", "k2", "", "")),
    "fisheye_opencv": ("fisheye", ("k1", "k2", "k3", "k4")),
}


def read(model: Path, photos: Photos) -> Model:
    """Read the largest part of a reconstruction.json, or of the one in a project folder of OpenSfM or ODM."""
    path = _file(model)
    parts = _parts(path)
    part = max(parts, key=lambda part: len(part["shots"]))
    left = sum(len(other["shots"]) for other in parts) - len(part["shots"])
    try:
        cameras = {str(key): _camera(path, str(key), entry) for key, entry in part["cameras"].items()}
        shots = tuple(Shot(str(name), str(shot["camera"]), _pose(shot)) for name, shot in sorted(part["shots"].items()))
        points = list(part.get("points", {}).values())
        xyz = np.array([point["coordinates"] for point in points], np.float64).reshape(-1, 3)
        rgb = np.array([point["color"] for point in points], np.float64).reshape(-1, 3)
        earth = _enu_to_geocentric(part.get("reference_lla"))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(path, f"has missing or invalid values: {str(error)[:100]}", REMEDY) from None
    for shot in shots:
        if shot.camera not in cameras:
            raise InputError(path, f"{shot.file} has the unknown camera {shot.camera!r}", REMEDY)
    note = (f"{left} photos of {len(parts) - 1} smaller parts are left out",) if left else ()
    return Model(cameras, shots, xyz, np.clip(rgb, 0, 255).astype(np.uint8), earth, _crs(path), note)


def _file(model: Path) -> Path:
    """The topocentric reconstruction of a file or project folder.

    Raises:
        InputError: it is ODM's reconstruction of undistorted photos, which is in projected coordinates.
    """
    path = next((model / name for name in FILES if (model / name).is_file()), model) if model.is_dir() else model
    if (path.parent / TOPOCENTRIC).is_file():
        return path.parent / TOPOCENTRIC
    if path.parent.name == "undistorted" and (path.parent.parent / TOPOCENTRIC).is_file():
        cause = "is ODM's model of undistorted photos, in projected coordinates without their offset"
        raise InputError(path, cause, f"Give {path.parent.parent / TOPOCENTRIC} and the original photos")
    return path


def _parts(path: Path) -> list[Any]:
    file_checks.check(path, "Give a reconstruction.json, or the folder that contains it")
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path, f"is not readable JSON ({str(error)[:100]})", REMEDY) from None
    parts = body if isinstance(body, list) else [body]
    good = bool(parts) and all(
        isinstance(part, dict) and isinstance(part.get("shots"), dict) and isinstance(part.get("cameras"), dict)
        for part in parts
    )
    if not good:
        raise InputError(path, "is not an OpenSfM reconstruction (no shots and cameras)", REMEDY)
    return parts


def _camera(path: Path, key: str, entry: dict[str, Any]) -> Camera:
    kind, width, height = entry["projection_type"], int(entry["width"]), int(entry["height"])
    if kind in ("spherical", "equirectangular"):
        return Camera("equirectangular", width, height)
    if kind not in MODELS:
        raise InputError(
            path,
            f"camera {key!r} has the projection {kind!r}, which is not supported",
            f"Use one of {', '.join(MODELS)}, spherical, or undistort the photos",
        )
    ours, names = MODELS[kind]
    size = max(width, height)
    focal_x = float(entry["focal_x"] if "focal_x" in entry else entry["focal"])
    focal_y = float(entry.get("focal_y", focal_x))
    return Camera(
        ours,
        width,
        height,
        focal_x * size,
        focal_y * size,
        float(entry.get("c_x", 0.0)) * size + width / 2 - 0.5,
        float(entry.get("c_y", 0.0)) * size + height / 2 - 0.5,
        tuple(float(entry.get(name, 0.0)) if name else 0.0 for name in names),
    )


def _pose(shot: dict[str, Any]) -> F64:
    """Pose (4, 4) camera to world."""
    from scipy.spatial.transform import Rotation

    world_to_cam = Rotation.from_rotvec(np.array(shot["rotation"], np.float64).reshape(3)).as_matrix()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = world_to_cam.T, -world_to_cam.T @ np.array(shot["translation"], np.float64).reshape(3)
    return pose


def _enu_to_geocentric(reference: Any) -> F64 | None:
    """Transform (4, 4) from east, north, up of the reference to geocentric; None without one (all zero without GPS)."""
    from pyproj import Transformer

    if not reference:
        return None
    lat, lon, height = (float(reference[key]) for key in ("latitude", "longitude", "altitude"))
    if lat == 0 and lon == 0:
        return None
    if not (abs(lat) <= 84 and abs(lon) <= 180 and np.isfinite(height)):
        raise ValueError(f"reference_lla {lat}, {lon}, {height}")
    phi, lam = np.radians([lat, lon])
    T = np.eye(4)
    T[:3, :3] = [
        [-np.sin(lam), -np.sin(phi) * np.cos(lam), np.cos(phi) * np.cos(lam)],
        [np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi) * np.sin(lam)],
        [0.0, np.cos(phi), np.sin(phi)],
    ]
    T[:3, 3] = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(lon, lat, height)
    return T


def _crs(path: Path) -> str | None:
    """CRS of an ODM project: `WGS84 UTM 32N` in the first line of coords.txt; None without one."""
    file = path.parent.parent / "odm_georeferencing" / "coords.txt"
    if not file.is_file():
        return None
    with open(file, encoding="utf-8", errors="replace") as lines:
        match = re.match(r"WGS84 UTM (\d{1,2})([NS])", lines.readline(200))
    return utm_zone(int(match[1]), north=match[2] == "N") if match and 1 <= int(match[1]) <= 60 else None

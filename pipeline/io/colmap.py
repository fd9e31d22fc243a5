"""COLMAP models (text or binary) as tiles.

COLMAP stores world-to-camera poses with OpenCV's axes and puts the centre of the top left pixel at
(0.5, 0.5): poses are inverted, principal points move by half a pixel.

A model that was not aligned has an arbitrary orientation and scale, while a tile is z-up and in
metres: align it first (`colmap model_aligner`), or say `up` and `scale`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scan2sim.pipeline.errors import InputError, SettingError
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io import las
from scan2sim.pipeline.io.importing import place, tile_folder
from scan2sim.pipeline.io.tile import read_tile, tile_name, write_tile
from scan2sim.pipeline.step import Report, silent
from scan2sim.pipeline.types import F64, Camera, CameraModel, Frame, PointCloud

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


def import_colmap(
    model: Path,
    images: Path,
    out: Path,
    *,
    cloud: Path | None = None,
    crs: str = "local",
    up: tuple[float, float, float] | Literal["photos"] | None = None,
    scale: float = 1.0,
    link: bool = False,
    overwrite: bool = False,
    name: str | None = None,
    classes: Mapping[int, int] | None = None,
    report: Report = silent,
) -> Path:
    """Make a tile of a COLMAP model and its photos.

    Args:
        model: folder of cameras, images and points3D, .bin or .txt (often `sparse/0`).
        images: folder of the photos.
        out: the tile's folder to make.
        cloud: LAS, LAZ, COPC or PLY cloud in the model's coordinates; the model's own sparse points
            by default.
        crs: of a model that was aligned to one (its coordinates are in that CRS's units); "local" otherwise.
        up: direction of the model that becomes +z, or "photos" for the mean of the photos' up; the
            model's +z by default.
        scale: metres per unit of the model.
        classes: codes of the cloud and what they are here, where they differ (`pipeline.classes`).
        link: link to the photos and the cloud instead of copying them.

    Returns:
        Path of the `tile.toml`.

    Raises:
        InputError: the model can't be read, has no posed photo, a camera model that has no
            counterpart here, or a photo is missing.
        SettingError: `out` is not empty, or `up` or `scale` goes with a cloud of its own.
    """
    if cloud is not None and (up is not None or scale != 1.0):
        raise SettingError("up, scale", f"would move the photos away from {cloud}", "Align model and cloud first")
    if cloud is not None:
        cloud_io.read_header(cloud)  # refuses what is no cloud
    found = _read(model)
    shots = sorted((image for image in found.images.values() if image.has_pose), key=lambda image: image.name)
    if not shots:
        raise InputError(model, "has no posed photo", "Name the folder of a finished reconstruction")
    used = sorted({shot.camera_id for shot in shots})
    cameras = {f"camera_{key}": camera_of(model, found.cameras[key]) for key in used}
    poses = np.stack([_camera_to_world(shot) for shot in shots])
    turn = scale * _upright(poses, up)

    with tile_folder(out, overwrite) as folder:
        if cloud is not None:
            file = place(cloud, folder, f"cloud{cloud.suffix.lower()}", link)
        else:
            points = _sparse(model, found, turn, crs)
            file = "cloud.laz"
            las.write(folder / file, points)
        entries: list[dict[str, Any]] = []
        for i, (shot, pose) in enumerate(zip(shots, poses, strict=True)):
            report(i / len(shots), shot.name)
            entries.append(
                {
                    "file": place(images / shot.name, folder, f"photos/{shot.name}", link),
                    "camera": f"camera_{shot.camera_id}",
                    "position": turn @ pose[:3, 3],
                    "rotation": turn @ pose[:3, :3] / scale,
                }
            )
        write_tile(
            folder, name=tile_name(name or Path(out).name), crs=crs, clouds=[file], cameras=cameras, photos=entries,
            classes=classes,
        )  # fmt: skip
        read_tile(folder)  # what it refuses is refused here, before the tile appears
    report(1.0, "done")
    return Path(out) / "tile.toml"


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


def _upright(poses: F64, up: tuple[float, float, float] | Literal["photos"] | None) -> F64:
    """(3, 3) the smallest rotation that takes `up` to +z."""
    from scipy.spatial.transform import Rotation

    if up is None:
        return np.eye(3)
    direction = -poses[:, :3, 1].mean(axis=0) if up == "photos" else np.array(up, np.float64)
    length = np.linalg.norm(direction)
    if not length > 1e-6:
        raise SettingError("up", f"{up} is no direction", "Give three numbers that are not all zero")
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(direction / length, z)
    sine, cosine = np.linalg.norm(axis), direction[2] / length
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix()


def _sparse(model: Path, found: Any, turn: F64, crs: str) -> PointCloud:
    keys = sorted(found.points3D)
    if not keys:
        raise InputError(model, "has no 3D points", "Give a cloud")
    xyz = np.array([found.points3D[key].xyz for key in keys]) @ turn.T
    rgb = np.array([found.points3D[key].color for key in keys], np.uint8)
    origin = np.floor(np.median(xyz, axis=0)).tolist()
    frame = Frame(crs, (origin[0], origin[1], origin[2]))  # in the CRS's units: it is written at once
    return PointCloud(frame, frame.to_local(xyz).astype(np.float32), rgb)

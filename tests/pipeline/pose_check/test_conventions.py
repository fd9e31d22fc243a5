"""Poses and cameras of photos in other conventions: the import option converts them to the correct ones."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import Camera, Frame, PointCloud, Tile
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.pose_check import conventions
from scan2sim.pipeline.pose_check.conventions import PhotoConventions, PosedPhotos

FRAME = Frame("EPSG:32632", (457_000.0, 5_428_000.0, 110.0))
CAMERA = Camera("pinhole", 64, 48, 50.0, 50.0, 30.0, 25.0)
PHOTOS = 4


def correct() -> PosedPhotos:
    """Four photos along a curve, in world coordinates."""
    T = np.tile(np.eye(4), (PHOTOS, 1, 1))
    heading = Rotation.from_euler("z", np.linspace(0.3, 0.9, PHOTOS)[:, None]).as_matrix()
    T[:, :3, :3] = heading @ conventions.AXES["ros"] @ Rotation.from_euler("x", 0.1).as_matrix()
    T[:, :3, 3] = np.asarray(FRAME.origin) + np.outer(np.arange(PHOTOS), [2.0, 1.0, 0.1])
    return PosedPhotos(T, (CAMERA,) * PHOTOS, FRAME)


def for_images_twice_as_large(photos: PosedPhotos) -> PosedPhotos:
    larger = Camera("pinhole", 64, 48, 100.0, 100.0, 60.5, 50.5)
    return PosedPhotos(photos.T, (larger,) * PHOTOS, photos.frame)


def in_feet(photos: PosedPhotos) -> PosedPhotos:
    return photos.at(photos.positions / 0.3048)


def swapped_degrees(photos: PosedPhotos) -> PosedPhotos:
    return conventions.swapped_axes(conventions.to_crs(photos, "EPSG:4326"))


MISTAKES: dict[str, tuple[Callable[[PosedPhotos], PosedPhotos], dict[str, object]]] = {
    "correct": (lambda photos: photos, {}),
    "transposed": (conventions.transposed, {"rotations": "T_cam_world"}),
    "opengl": (lambda photos: photos.rotated(photos.R @ conventions.AXES["opengl"].T), {"camera_axes": "opengl"}),
    "ros": (lambda photos: photos.rotated(photos.R @ conventions.AXES["ros"].T), {"camera_axes": "ros"}),
    "quaternions": (lambda photos: conventions.reordered_quaternions(photos, -1), {"quaternions": "xyzw"}),
    "northing first": (conventions.swapped_axes, {"position_axes": "yx"}),
    "degrees": (lambda photos: conventions.to_crs(photos, "EPSG:4326"), {"photos_crs": "EPSG:4326"}),
    "swapped degrees": (swapped_degrees, {"photos_crs": "EPSG:4326", "position_axes": "yx"}),
    "next zone": (lambda photos: conventions.to_crs(photos, "EPSG:32633"), {"photos_crs": "EPSG:32633"}),
    "feet": (in_feet, {"photos_units": "ft"}),
    "larger images": (for_images_twice_as_large, {"intrinsics_size": "128x96"}),
    "next pose": (lambda photos: conventions.shifted(photos, 1)[0], {"pose_shift": -1}),
}


def imported(folder: Path, photos: PosedPhotos, options: PhotoConventions | None, notes: list[str]) -> Tile:
    """The tile of a cloud and a CSV of these photos."""
    with open(folder / "photos.csv", "w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["file", "x", "y", "z", "qx", "qy", "qz", "qw", "width", "height", "fx", "fy", "cx", "cy"])
        for k, (T, c) in enumerate(zip(photos.T, photos.cameras, strict=True)):
            cv2.imwrite(str(folder / f"{k}.png"), np.zeros((c.height, c.width, 3), np.uint8))
            quaternion = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
            rows.writerow([f"{k}.png", *T[:3, 3].tolist(), *quaternion, c.width, c.height, c.fx, c.fy, c.cx, c.cy])
    xyz = np.random.default_rng(0).uniform(0, 20, (50, 3)).astype(np.float32)
    las.write(folder / "cloud.laz", PointCloud(FRAME, xyz))
    out, table = folder / "tile", folder / "photos.csv"
    return read_tile(
        import_las([folder / "cloud.laz"], out, photos=table, conventions=options, warn=notes.append, overwrite=True)
    )


@pytest.mark.parametrize("name", MISTAKES)
def test_import_with_the_option_gives_the_correct_poses(tmp_path: Path, name: str) -> None:
    change, values = MISTAKES[name]
    notes: list[str] = []
    tile = imported(tmp_path, change(correct()), PhotoConventions.of("", values), notes)
    expected = {f"{k}.png": T for k, T in enumerate(correct().T)}
    assert len(tile.views) == PHOTOS - abs(int(str(values.get("pose_shift", 0)))) and len(notes) == (
        len(tile.views) < PHOTOS
    )
    for view in tile.views:
        T = expected[view.photo.name]
        np.testing.assert_allclose(view.centre + tile.frame.origin, T[:3, 3], atol=1e-3)
        np.testing.assert_allclose(view.T_world_cam[:3, :3], T[:3, :3], atol=1e-4)
        camera = view.camera
        np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [50, 50, 30, 25], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "value"),
    [("rotations", "both"), ("intrinsics_size", "1242"), ("pose_shift", 0.5), ("photos_crs", "EPSG:1")],
)
def test_invalid_option_is_rejected_with_its_name(tmp_path: Path, name: str, value: object) -> None:
    with pytest.raises(SettingError, match=name.replace("_", "-")):
        imported(tmp_path, correct(), PhotoConventions.of("", {name: value}), [])

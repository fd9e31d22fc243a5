"""Reading of extrinsics and cameras."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.io.calibration import camera_of_photos, read_camera, read_extrinsics

T_CAMERA_SCANNER = np.eye(4)
T_CAMERA_SCANNER[:3, :3] = Rotation.from_rotvec([0.02, -0.03, 0.01]).as_matrix() @ [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
T_CAMERA_SCANNER[:3, 3] = [0.1, 0.4, -0.3]


@pytest.mark.parametrize("form", ["rows", "three", "velo_to_cam", "odometry"])
def test_extrinsics_are_read_from_all_file_formats(tmp_path: Path, form: str) -> None:
    T, file = T_CAMERA_SCANNER, tmp_path / "T.txt"

    def text(values: F64) -> str:
        return " ".join(f"{v:.9f}" for v in values.ravel())

    file.write_text(
        {
            "rows": "# camera, scanner\n" + "\n".join(map(text, T)),
            "three": "\n".join(map(text, T[:3])).replace(" ", ", "),
            "velo_to_cam": f"calib_time: 15-Mar-2012 11:37:16\nR: {text(T[:3, :3])}\nT: {text(T[:3, 3])}\n",
            "odometry": f"P0: 1 2 3\nTr: {text(T[:3])}\n",
        }[form],
        encoding="utf-8",
    )
    assert np.allclose(read_extrinsics(file), T, atol=1e-8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0\n0 1 0\n", r"T\.txt: contains no 3x4 or 4x4 matrix \(2 rows\)"),
        ("1 0 0 0\n0 1 0 zero\n0 0 1 0", r"T\.txt: contains no 3x4 or 4x4 matrix"),
        ("1 0 0 0\n0 1 0 0\n0 0 -1 0", r"T\.txt: its left 3x3 is not a rotation matrix"),
        ("2 0 0 0\n0 2 0 0\n0 0 2 0", r"T\.txt: its left 3x3 is not a rotation matrix"),
        ("1 0 0 95\n0 1 0 -410\n0 0 1 0", r"T\.txt: puts the camera 421 m from the scanner.*in metres"),
    ],
)
def test_invalid_extrinsics_are_rejected(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "T.txt").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_extrinsics(tmp_path / "T.txt")


def test_camera_is_read_from_a_file_or_given_by_numbers(tmp_path: Path) -> None:
    file, photos = tmp_path / "camera.toml", tmp_path / "photos"
    photos.mkdir()
    cv2.imwrite(str(photos / "0.png"), np.zeros((256, 512, 3), np.uint8))
    file.write_text(
        '[[cameras]]\nid = "a"\nmodel = "pinhole"\nsize = [100, 50]\nfocal = [80.0, 80.0]\ncentre = [49.5, 24.5]\n'
        '[[cameras]]\nid = "b"\nmodel = "opencv"\n'
        "size = [512, 256]\nfocal = [90.0, 91.0]\ndistortion = [0.1, 0, 0, 0]\n",
        encoding="utf-8",
    )
    camera = Camera("opencv", 512, 256, 90.0, 91.0, 0.0, 0.0, (0.1, 0.0, 0.0, 0.0))
    assert camera_of_photos(photos, file=file) == read_camera(file, 512, 256) == camera
    with pytest.raises(InputError, match=r"has no camera of 64x64 \(it has 100x50, 512x256\)"):
        read_camera(file, 64, 64)
    file.write_text('[[cameras]]\nid = "a"\nmodel = "spherical"\nsize = [100, 50]\n', encoding="utf-8")
    with pytest.raises(InputError, match=r"camera\.toml: field `cameras\.model`"):
        read_camera(file, 100, 50)
    assert camera_of_photos(photos) == Camera("equirectangular", 512, 256)
    pinhole = camera_of_photos(photos, model="pinhole", focal=100.0)
    assert pinhole == Camera("pinhole", 512, 256, 100.0, 100.0, 255.5, 127.5)
    with pytest.raises(InputError, match=r"photos: have no camera.*--focal"):
        camera_of_photos(photos, model="pinhole")

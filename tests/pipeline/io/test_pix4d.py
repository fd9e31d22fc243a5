"""Pix4D's calibrated camera parameters, written after its manual: cameras, poses, offset, CRS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io.photogrammetry import Model, read

OFFSET = np.array([391200.0, 5820372.0, 35.0])
HEADER = """fileName imageWidth imageHeight
camera matrix K [3x3]
radial distortion [3x1]
tangential distortion [2x1]
camera position t [3x1]
camera rotation R [3x3]
camera model m = K [R|-Rt] X

"""
NAMES = ("DJI 0001.JPG", "DJI 0002.JPG")


def rows(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value:.12f}" for value in row) for row in np.atleast_2d(matrix))


def project(folder: Path, *, skew: float = 0.0, k3: float = 0.001, offset: str | None = None) -> Path:
    """A project's parameters; returns the file."""
    text = HEADER
    for seed, name in enumerate(NAMES):
        K = np.array([[496.0, skew, 403.2], [0, 500.0, 297.6], [0, 0, 1]])
        R, t = Rotation.random(random_state=seed).as_matrix(), np.random.default_rng(seed).normal(0, 20, 3)
        parts = (K, np.array([-0.12, 0.03, k3]), np.array([0.0006, -0.0004]), t, R)
        text += f"{name} 800 600\n" + "\n".join(map(rows, parts)) + "\n"
    path = folder / "street_calibrated_camera_parameters.txt"
    path.write_text(text, encoding="utf-8")
    (folder / "street_offset.xyz").write_text(offset or " ".join(map(str, OFFSET)), encoding="utf-8")
    return path


def model(path: Path) -> Model:
    return read("pix4d", path, path.parent)


@pytest.mark.parametrize("give", ["file", "folder"])
def test_pixels_are_those_of_pix4ds_model(tmp_path: Path, give: str) -> None:
    path = project(tmp_path)
    found = model(path if give == "file" else tmp_path)
    assert [shot.file for shot in found.shots] == list(NAMES) and len(found.cameras) == 1 and not found.notes
    for seed, shot in enumerate(found.shots):
        R, t = Rotation.random(random_state=seed).as_matrix(), np.random.default_rng(seed).normal(0, 20, 3)
        X = t + R.T @ (0.3, -0.2, 2.0) + OFFSET  # a point in front of the camera
        x, y, z = shot.pose[:3, :3].T @ (X - shot.pose[:3, 3])
        assert np.allclose((x / z, y / z), (0.15, -0.1))
        camera = found.cameras[shot.camera]
        assert (camera.cx + 0.5, camera.cy + 0.5) == pytest.approx((403.2, 297.6))
        assert (camera.fx, camera.fy) == (496, 500) and camera.distortion == (-0.12, 0.03, 0.0006, -0.0004, 0.001)


def test_the_crs_is_read_if_it_was_exported(tmp_path: Path) -> None:
    path = project(tmp_path)
    assert model(path).crs is None
    (tmp_path / "street_wkt.prj").write_text(CRS.from_epsg(32633).to_wkt("WKT1_ESRI"), encoding="utf-8")
    assert "33N" in CRS.from_user_input(model(path).crs).name
    (tmp_path / "street_wkt.prj").write_text("PROJCS[nonsense", encoding="utf-8")
    found = model(path)
    assert found.crs is None and "can't be read" in found.notes[0]


def test_a_missing_offset_is_named(tmp_path: Path) -> None:
    path = project(tmp_path)
    (tmp_path / "street_offset.xyz").unlink()
    found = model(path)
    assert "street_offset.xyz" in found.notes[0] and np.abs(found.centres).max() < 100


@pytest.mark.parametrize("damage", ["truncated", "other file", "rotation", "skew", "offset"])
def test_damaged_files_are_refused_with_their_cause(tmp_path: Path, damage: str) -> None:
    skew, offset = (3.0 if damage == "skew" else 0.0), ("1 2" if damage == "offset" else None)
    path = project(tmp_path, skew=skew, offset=offset)
    text = path.read_text(encoding="utf-8")
    if damage == "truncated":
        path.write_text("\n".join(text.splitlines()[:-2]), encoding="utf-8")
    elif damage == "other file":
        path.write_text("imageName X Y Z Omega Phi Kappa\na.jpg 1 2 3 4 5 6\n", encoding="utf-8")
    elif damage == "rotation":
        lines = text.splitlines()
        path.write_text("\n".join([*lines[:-1], "1 1 1"]), encoding="utf-8")
    cause = {"truncated": "truncated", "other file": "is not a file of calibrated", "rotation": "rotation matrix",
             "skew": "skew", "offset": "is not an offset"}[damage]  # fmt: skip
    with pytest.raises(InputError, match=cause):
        model(path)

"""Orthophotos as orthographic views."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image, TiffImagePlugin

from scan2sim.pipeline.camera.models import project, ray_origins, unproject
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, Frame, View
from scan2sim.pipeline.io.geodata.orthophoto import read_view
from scan2sim.pipeline.io.images import image

FEET = Frame("local", (300.0, 600.0, 10.0), 0.3048)
UTM = Frame("EPSG:32633", (500000.0, 5400000.0, 200.0))


def write_image(path: Path, **how: Any) -> Path:
    Image.fromarray(np.zeros((40, 60, 3), np.uint8)).save(path, **how)
    return path


def pixel_of(view: View, xyz: npt.ArrayLike) -> F32:
    T = np.linalg.inv(view.T_world_cam)
    uv, valid = project(view.camera, np.atleast_2d(xyz) @ T[:3, :3].T + T[:3, 3])
    assert valid.all()
    return uv


@pytest.mark.parametrize("suffix", [".wld", ".jgw", ".jpgw", ".JGW"])
def test_world_file_in_feet_gives_the_view(suffix: str, tmp_path: Path) -> None:
    file = write_image(tmp_path / "map.jpg")
    (tmp_path / f"map{suffix}").write_text("2.0\n0\n0\n-2.0\n1000\n2000\n", encoding="utf-8")
    view = read_view(file, FEET, highest=50.0)
    corner, other = FEET.to_local([(1000, 2000, 0), (1020, 1990, 100)])
    np.testing.assert_allclose(pixel_of(view, [corner, other]), [(0, 0), (10, 5)], atol=1e-3)
    assert view.camera.model == "orthographic" and view.camera.fx == pytest.approx(1 / 0.6096)
    back = view.T_world_cam[:3, :3] @ ray_origins(view.camera, [[10, 5]])[0] + view.centre
    np.testing.assert_allclose(back[:2], other[:2], atol=1e-6)
    np.testing.assert_allclose(view.T_world_cam[:3, :3] @ unproject(view.camera, [[3, 4]])[0], [0, 0, -1], atol=1e-9)


@pytest.mark.parametrize(("raster", "shift"), [(1, 0.5), (2, 0.0)])
def test_geotiff_tags_give_the_view(raster: int, shift: float, tmp_path: Path) -> None:
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[33550], tags.tagtype[33550] = (0.2, 0.2, 0.0), 12
    tags[33922], tags.tagtype[33922] = (0.0, 0.0, 0.0, 500000.0, 5400010.0, 0.0), 12
    tags[34735], tags.tagtype[34735] = (1, 1, 0, 2, 1025, 0, 1, raster, 3072, 0, 1, 32633), 3
    file = write_image(tmp_path / "map.tif", tiffinfo=tags)
    view = read_view(file, UTM, highest=230.0)
    np.testing.assert_allclose(pixel_of(view, [(2.0, 8.0, 5.0)]), [(10 - shift, 10 - shift)], atol=1e-2)
    with pytest.raises(InputError, match="EPSG:32633"):
        read_view(file, Frame("EPSG:32632", UTM.origin), highest=230.0)


@pytest.mark.parametrize("text", ["", "1 2 3", "a b c d e f", "0 0 0 0 1 2", "1 1 0 -1 5 5", "1 0 0 1 5 5",
                                  "nan 0 0 -1 0 0"])  # fmt: skip
def test_invalid_world_files_are_rejected(text: str, tmp_path: Path) -> None:
    file = write_image(tmp_path / "map.png")
    (tmp_path / "map.pgw").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="map.pgw"):
        read_view(file, FEET, highest=1.0)


def test_orthophoto_without_georeference_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="world file"):
        read_view(write_image(tmp_path / "map.png"), FEET, highest=1.0)
    (tmp_path / "torn.tif").write_bytes(b"II*\0")
    with pytest.raises(InputError, match="torn"):
        read_view(tmp_path / "torn.tif", FEET, highest=1.0)


def test_image_size_limit_is_that_of_the_project_not_of_pillow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write_image(tmp_path / "map.png")
    (tmp_path / "map.pgw").write_text("1\n0\n0\n-1\n0\n0\n", encoding="utf-8")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    assert read_view(file, FEET, highest=0.0).camera.width == 60
    monkeypatch.setattr(image, "MAX_PIXELS", 100)
    with pytest.raises(InputError, match="60 x 40 pixels, more than 100"):
        read_view(file, FEET, highest=0.0)

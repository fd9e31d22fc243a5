"""Photos of all formats are read as 8-bit sRGB; errors of unreadable ones."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from scan2sim.pipeline.core.errors import InputError, UnavailableError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import U8, Camera, Frame, PointCloud, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import exif, image
from scan2sim.pipeline.io.images.decoders import heif
from scan2sim.pipeline.steps.views import ViewsParams, views
from tests.fakes.photo_files import ADOBE, P3, SRGB, decoded, encoded, profile, to_xyz, write
from tests.fakes.steps import step_params
from tests.present import present

WIDTH, HEIGHT = 90, 70
"""No multiples of a tile's 16."""


@pytest.fixture(scope="module")
def rgb() -> U8:
    rng = np.random.default_rng(0)
    return cv2.resize(rng.integers(0, 256, (9, 12, 3), np.uint8), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def linear(rgb: U8) -> Any:
    return decoded(rgb / 255).astype(np.float32)


@pytest.mark.parametrize("name", ["a.png", "a.bmp", "a.webp", "a.JPG", "a.tif", "a.TIFF"])
def test_8_bit_images_are_read_losslessly(tmp_path: Path, rgb: U8, name: str) -> None:
    options = {"a.webp": [cv2.IMWRITE_WEBP_QUALITY, 101], "a.JPG": [cv2.IMWRITE_JPEG_QUALITY, 100]}
    cv2.imwrite(str(tmp_path / name), rgb[..., ::-1], options.get(name, []))
    assert image.size_of(tmp_path / name) == (WIDTH, HEIGHT)
    image.check_decodes(tmp_path / name)
    truth = cv2.imread(str(tmp_path / name))[..., ::-1] if name == "a.JPG" else rgb
    assert (image.read_rgb(tmp_path / name) == truth).all()
    grey = cv2.imread(str(tmp_path / name), cv2.IMREAD_GRAYSCALE)
    assert np.abs(image.read_levels(tmp_path / name).astype(int) - grey).max() <= (name == "a.TIFF" or name == "a.tif")


@pytest.mark.parametrize(
    ("name", "kind", "tile"),
    [
        ("a.png", "uint16", 0),
        ("a.tif", "uint16", 0),
        ("a.tif", "uint16", 16),
        ("a.tif", "float", 16),
        ("a.exr", "half", 0),
        ("a.exr", "float", 0),
        ("a.exr", "half", 16),
        ("a.hdr", "float", 0),
    ],
)
def test_16_bit_images_are_scaled_and_linear_light_is_encoded(
    tmp_path: Path, rgb: U8, name: str, kind: str, tile: int
) -> None:
    pixels = linear(rgb) if kind != "uint16" else (rgb * 257.0 + 100).clip(0, 65535).astype(np.uint16)
    write(tmp_path / name, pixels, kind, tile)
    assert image.size_of(tmp_path / name) == (WIDTH, HEIGHT)
    image.check_decodes(tmp_path / name)
    away = np.abs(image.read_rgb(tmp_path / name).astype(int) - rgb)
    assert (away.mean() if name == "a.hdr" else away.max()) <= 1  # Radiance's channels share an exponent
    if name != "a.png":  # libpng makes grey of linear light if the file has a gamma
        assert np.abs(image.read_levels(tmp_path / name) - rgb @ [0.299, 0.587, 0.114]).mean() <= 1


def test_linear_light_out_of_range_or_not_finite_is_clipped(tmp_path: Path) -> None:
    light = np.array([[(-1, 0, 0.5), (1, 7, np.inf), (np.nan, -np.inf, 0.0031308)]], np.float32)
    write(tmp_path / "a.exr", light, "float")
    assert image.read_rgb(tmp_path / "a.exr").tolist() == [[[0, 0, 188], [255, 255, 255], [0, 0, 10]]]


def test_exr_with_other_primaries_is_converted_to_srgb(tmp_path: Path, rgb: U8) -> None:
    there = np.linalg.inv(to_xyz(P3)) @ to_xyz(SRGB)
    write(tmp_path / "a.exr", (linear(rgb) @ there.T).astype(np.float32), "float", oiio__ColorSpace="lin_p3d65_scene")
    assert np.abs(image.read_rgb(tmp_path / "a.exr").astype(int) - rgb).max() <= 1


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.webp"])
@pytest.mark.parametrize(("primaries", "gamma"), [(P3, None), (ADOBE, 563 / 256)])
def test_colour_profile_is_applied(tmp_path: Path, rgb: U8, name: str, primaries: Any, gamma: float | None) -> None:
    Image.fromarray(rgb).save(tmp_path / name, icc_profile=profile(primaries, gamma), lossless=True)
    light = linear(rgb) if gamma is None else (rgb / 255) ** gamma
    truth = encoded(light @ (np.linalg.inv(to_xyz(SRGB)) @ to_xyz(primaries)).T) * 255
    assert np.abs(truth - rgb).max() > 15
    assert np.abs(image.read_rgb(tmp_path / name) - truth).max() <= 2


def test_profiles_of_srgb_and_cmyk_are_not_applied(tmp_path: Path, rgb: U8) -> None:
    Image.fromarray(rgb).save(tmp_path / "a.png", icc_profile=profile(SRGB, None))
    assert (image.read_rgb(tmp_path / "a.png") == rgb).all()
    inks = profile(SRGB, None).replace(b"RGB ", b"CMYK", 1)
    Image.fromarray(rgb).convert("CMYK").save(tmp_path / "a.jpg", icc_profile=inks, quality=100)
    assert np.abs(image.read_rgb(tmp_path / "a.jpg").astype(int) - rgb).mean() <= 2


def test_damaged_colour_profile_is_reported(tmp_path: Path, rgb: U8) -> None:
    Image.fromarray(rgb).save(tmp_path / "a.png", icc_profile=b"none at all" * 20)
    with pytest.raises(InputError, match=r"a\.png: has a colour profile that can't be read .*\. Save it as sRGB"):
        image.read_rgb(tmp_path / "a.png")


def test_exif_orientation_is_ignored(tmp_path: Path, rgb: U8) -> None:
    turned = Image.Exif()
    turned[0x112] = 6
    Image.fromarray(rgb).save(tmp_path / "a.jpg", exif=turned, quality=100)
    assert image.read_rgb(tmp_path / "a.jpg").shape == rgb.shape


@pytest.mark.parametrize("names", [("R", "G", "B", "A"), ("Y",)])
def test_alpha_channel_is_ignored_and_grey_becomes_rgb(tmp_path: Path, rgb: U8, names: tuple[str, ...]) -> None:
    extra = np.concatenate([rgb, 255 - rgb[..., :1]], axis=2)[..., : len(names)]
    write(tmp_path / "a.tif", extra, "uint8", oiio__UnassociatedAlpha=1)
    assert (image.read_rgb(tmp_path / "a.tif") == (rgb if len(names) > 1 else rgb[..., :1])).all()


@pytest.mark.parametrize("tile", [0, 16])
def test_cropped_reading_equals_the_full_image(tmp_path: Path, rgb: U8, tile: int) -> None:
    write(tmp_path / "a.tif", rgb, "uint8", tile)
    cv2.imwrite(str(tmp_path / "a.png"), rgb[..., ::-1])
    for box in ((0, 0, WIDTH, HEIGHT), (5, 17, 40, 18), (80, 64, 90, 70)):
        for name in ("a.tif", "a.png"):
            assert (image.read_rgb(tmp_path / name, box) == rgb[box[1] : box[3], box[0] : box[2]]).all()


def orthophoto(folder: Path, name: str, rgb: U8) -> tuple[View, Path]:
    """Write an orthophoto; return its view, and a cloud below a part of it."""

    write(folder / name, rgb, "uint8", 16 if name.endswith("f") else 0)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = 0, 0, 50
    view = View("o", Camera("orthographic", WIDTH, HEIGHT, 1.0, 1.0, 0.0, 0.0), pose, folder / name)
    xyz = np.random.default_rng(0).uniform((40, -50, 0), (60, -30, 5), (500, 3)).astype(np.float32)
    PointCloud(Frame("local", (0, 0, 0)), xyz).save(folder / "c.npz")
    return view, folder / "c.npz"


def test_tile_reads_its_part_of_a_huge_orthophoto(tmp_path: Path, rgb: U8, monkeypatch: pytest.MonkeyPatch) -> None:
    view, cloud = orthophoto(tmp_path, "o.tif", rgb)
    monkeypatch.setattr(image, "MAX_PIXELS", 40 * 40)
    with pytest.raises(InputError, match=r"6,?300|90 x 70"):
        image.size_of(view.photo)
    (tmp_path / "out").mkdir()
    params = step_params(ViewsParams, poses=(views_io.to_json(view),))
    done = views({"photo.0": view.photo, "cloud.0": cloud}, params, tmp_path / "out", silent)
    assert not done.warnings
    kept = views_io.load(done.files["views"])[0]
    part = image.read_rgb(kept.photo)
    left, top = (round(a - b) for a, b in zip((0, 0), (kept.camera.cx, kept.camera.cy), strict=True))
    assert part.size < rgb.size / 3
    assert (part == rgb[top : top + part.shape[0], left : left + part.shape[1]]).all()


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.webp", "a.tif", "a.exr", "a.hdr"])
@pytest.mark.parametrize("kept", [0.0, 0.01, 0.5])
def test_error_of_a_damaged_file_has_cause_and_remedy(tmp_path: Path, rgb: U8, name: str, kept: float) -> None:
    path = tmp_path / name
    write(path, linear(rgb), "float") if name in ("a.exr", "a.hdr") else write(
        path, rgb, "uint8", 16 * (name == "a.tif")
    )
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    try:
        found = image.read_rgb(path)
    except InputError as error:
        assert error.where == str(path) and "can't be read (" in error.cause and "Copy it again" in error.remedy
    else:  # some decoders fill missing rows; `views` detects it
        assert found.shape == rgb.shape
        with pytest.raises(InputError, match="can't be read"):
            image.check_decodes(path)


def test_file_that_is_no_image_is_reported(tmp_path: Path, rgb: U8) -> None:
    write(tmp_path / "depth.exr", linear(rgb)[..., :1], "float", channelnames="Z")
    with pytest.raises(InputError, match=r"depth\.exr: has the unsupported channels Z\. Export it as R, G, B"):
        image.read_rgb(tmp_path / "depth.exr")


def test_missing_library_is_reported(tmp_path: Path, rgb: U8, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "a.exr", linear(rgb), "half")
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *more: None if n == "OpenImageIO" else real(n, *more))
    with pytest.raises(UnavailableError, match=r"a\.exr: needs OpenImageIO.*pip install OpenImageIO"):
        image.read_rgb(tmp_path / "a.exr")


@pytest.mark.skipif(importlib.util.find_spec("pillow_heif") is None, reason="the extra heif isn't installed")
def test_photo_of_an_iphone_is_read_upright_with_its_metadata(tmp_path: Path, rgb: U8) -> None:
    heif.register()
    taken = Image.fromarray(np.ascontiguousarray(np.rot90(rgb)))
    tags = taken.getexif()
    tags[274] = 6  # stored on its side
    tags.get_ifd(0x8769).update({36867: "2026:05:01 12:00:00", 36881: "+02:00", 41989: 26})
    tags.get_ifd(0x8825).update({1: "N", 2: (48.0, 8.0, 30.0), 3: "E", 4: (11.0, 34.0, 12.0)})
    file = tmp_path / "IMG_0001.HEIC"
    taken.save(file, format="HEIF", exif=tags.tobytes(), quality=-1, chroma=444)
    assert image.size_of(file) == (WIDTH, HEIGHT)
    image.check_decodes(file)
    assert np.abs(image.read_rgb(file).astype(int) - rgb).mean() < 2
    assert image.read_levels(file).shape == (HEIGHT, WIDTH)
    assert (image.read_rgb(file, (10, 20, 50, 60)) == image.read_rgb(file)[20:60, 10:50]).all()
    assert exif.orientation(file) == 1 and exif.focal_35mm(file) == 26
    latitude, longitude, _ = present(exif.gps_position(file))
    assert (latitude, longitude) == pytest.approx((48 + 8.5 / 60, 11.57), abs=1e-4)
    assert exif.time_taken(file) == (1777629600.0, True)

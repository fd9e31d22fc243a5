"""Georeferencing of models by the GPS of photos: synthetic EXIF on a known path, model in arbitrary axes and scale."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pyproj import Transformer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.core.errors import DataError, SettingError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.importers.georeference import from_photo_gps
from scan2sim.pipeline.importers.photogrammetry import import_model
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.images import exif
from scan2sim.pipeline.io.tile import read_tile
from tests.present import present

CRS = "EPSG:32633"
AT = np.array([390_000.0, 5_820_000.0, 50.0])
TURN = Rotation.from_rotvec([1.2, -0.7, 0.4])
SCALE = 0.137  # model units per metre


def photo(path: Path, place: F64 | None, altitude: bool = True) -> Path:
    """A photo with the EXIF of a position in `CRS`, to a hundredth of an arc second and a cm."""
    tags = Image.Exif()
    if place is not None:
        lon, lat = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True).transform(*place[:2])

        def angle(value: float) -> tuple[float, float, float]:
            degrees, minutes = int(value), int(value * 60 % 60)
            return float(degrees), float(minutes), round(value * 3600 % 60, 4)

        fixes: dict[int, Any] = {1: "N", 2: angle(lat), 3: "E", 4: angle(lon)}
        if altitude:
            fixes |= {5: b"\x00", 6: round(float(place[2]), 2)}
        tags.get_ifd(exif.GPS).update(fixes)
        tags[exif.GPS] = fixes
    Image.new("RGB", (64, 48)).save(path, exif=tags)
    return path


def circle(n: int = 16) -> F64:
    """(n, 3) around a block, uphill."""
    a = np.linspace(0, 5, n)
    return AT + np.column_stack([60 * np.cos(a), 40 * np.sin(a), 3 * np.sin(2 * a)])


def line(n: int = 16, length: float = 90.0) -> F64:
    return AT + np.linspace(0, length, n)[:, None] * [0.6, 0.8, 0.0]


def in_model(places: F64) -> F64:
    return SCALE * TURN.apply(places - AT) + [5.0, -3.0, 8.0]


def ups(n: int) -> F64:
    return np.tile(TURN.apply([0.0, 0.0, 1.0]), (n, 1)) + np.random.default_rng(2).normal(0, 0.02, (n, 3))


def photos(folder: Path, places: F64, altitude: bool = True) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    return [photo(folder / f"{i:03d}.jpg", place, altitude) for i, place in enumerate(places)]


def test_exif_positions_are_read_and_missing_ones_are_none(tmp_path: Path) -> None:
    lat, lon, altitude = exif.gps_position(photo(tmp_path / "a.jpg", AT)) or (0, 0, 0)
    east, north = Transformer.from_crs("EPSG:4326", CRS, always_xy=True).transform(lon, lat)
    assert np.abs(np.array([east, north]) - AT[:2]).max() < 0.01 and altitude == 50
    assert exif.gps_position(photo(tmp_path / "b.jpg", None)) is None
    assert (exif.gps_position(photo(tmp_path / "c.jpg", AT, altitude=False)) or (0, 0, 0))[2] is None
    (tmp_path / "d.jpg").write_bytes((tmp_path / "a.jpg").read_bytes()[:80])
    assert exif.gps_position(tmp_path / "d.jpg") is None


def test_model_is_georeferenced_in_spite_of_noise_and_outliers(tmp_path: Path) -> None:
    places, random = circle(40), np.random.default_rng(0)
    fixes = places + random.normal(0, 1.5, places.shape)
    fixes[[3, 17, 30]] += [120.0, -60.0, 10.0]
    fit = from_photo_gps(tmp_path, in_model(places), ups(40), photos(tmp_path, fixes), None)
    assert fit.crs == CRS and len(fit.used) == 37 and not {3, 17, 30} & set(fit.used)
    assert 1.5 < present(fit.rms) < 3.5  # 1.5 m in each of three directions
    assert np.abs(fit.onto.apply(in_model(places)) - places).max() < 2.0
    assert fit.onto.scale == pytest.approx(1 / SCALE, rel=0.02)
    assert "37 of 40 photos" in fit.notes[0] and f"rms {fit.rms:.2f} m" in fit.notes[0] and len(fit.notes) == 1


def test_exact_gps_gives_exact_positions(tmp_path: Path) -> None:
    fit = from_photo_gps(tmp_path, in_model(circle()), ups(16), photos(tmp_path, circle()), CRS)
    assert np.abs(fit.onto.apply(in_model(circle())) - circle()).max() < 0.02 and present(fit.rms) < 0.01
    assert np.allclose(fit.onto.rotation @ TURN.as_matrix(), np.eye(3), atol=1e-3)


def test_model_is_georeferenced_in_a_crs_in_feet(tmp_path: Path) -> None:
    feet = "+proj=utm +zone=33 +datum=WGS84 +units=us-ft +type=crs"
    fixes = circle() + np.random.default_rng(0).normal(0, 1.5, (16, 3))
    fit = from_photo_gps(tmp_path, in_model(circle()), ups(16), photos(tmp_path, fixes), feet)
    assert np.abs(fit.onto.apply(in_model(circle())) * 1200 / 3937 - circle()).max() < 3
    assert len(fit.used) == 16 and fit.rms is not None and fit.rms < 3.5


def test_roll_on_a_straight_track_comes_from_the_photos_up_axis(tmp_path: Path) -> None:
    fixes = line() + np.random.default_rng(0).normal(0, 1, (16, 3))
    fit = from_photo_gps(tmp_path, in_model(line()), ups(16), photos(tmp_path, fixes), CRS)
    up = fit.onto.rotation @ TURN.apply([0.0, 0.0, 1.0])
    assert np.degrees(np.arccos(up[2])) < 3
    assert "GPS doesn't determine the roll" in fit.notes[1]


@pytest.mark.parametrize(
    ("places", "noise", "cause"),
    [
        (line(16, 4.0), 2.0, "too little for GPS with an error of"),
        (line(2), 0.0, "only 2 of 2 photos have GPS"),
        (np.tile(AT, (9, 1)), 0.0, "the photos' GPS doesn't fit"),
    ],
)
def test_track_that_is_too_short_is_rejected(tmp_path: Path, places: F64, noise: float, cause: str) -> None:
    fixes = places + np.random.default_rng(0).normal(0, 1, places.shape) * noise
    with pytest.raises(DataError, match=cause):
        from_photo_gps(tmp_path, in_model(places), ups(len(places)), photos(tmp_path, fixes), CRS)


def test_photos_without_altitude_are_reported(tmp_path: Path) -> None:
    flat = circle() * [1, 1, 0]
    fit = from_photo_gps(tmp_path, in_model(flat), ups(16), photos(tmp_path, flat, altitude=False), CRS)
    assert "no altitudes" in fit.notes[1] and np.abs(fit.onto.apply(in_model(flat)) - flat).max() < 0.02


def test_command_georeferences_model_and_cloud(tmp_path: Path) -> None:
    places = circle()
    photos(tmp_path / "images", places)
    photo(tmp_path / "images" / "none.jpg", None)
    axes = Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # ahead is north: x east, y down
    shots = {}
    for i, centre in enumerate(in_model(places)):
        turn = (TURN * axes).inv()
        pose = {"rotation": turn.as_rotvec().tolist(), "translation": (-turn.apply(centre)).tolist()}
        shots[f"{i:03d}.jpg"] = {**pose, "camera": "c"}
    camera = {"projection_type": "perspective", "width": 64, "height": 48, "focal": 0.9}
    (tmp_path / "reconstruction.json").write_text(
        json.dumps([{"cameras": {"c": camera}, "shots": shots}]), encoding="utf-8"
    )
    points = places + [2.0, 3.0, 1.0]
    np.savetxt(tmp_path / "dense.xyz", in_model(points), "%.6f")
    options = [str(tmp_path / "reconstruction.json"), str(tmp_path / "images"), "-o", str(tmp_path / "t")]
    options += ["--cloud", str(tmp_path / "dense.xyz"), "--gps"]
    done = CliRunner().invoke(app, ["import", "opensfm", *options])
    assert done.exit_code == 0 and "georeferenced by the GPS of 16 of 16 photos" in done.output.replace("\n", " ")
    tile = read_tile(tmp_path / "t")
    assert tile.frame.crs == CRS
    assert np.abs(np.array([tile.frame.to_crs(v.centre) for v in tile.views]) - places).max() < 0.03
    assert all(np.allclose(v.T_world_cam[:3, :3], axes.as_matrix(), atol=2e-3) for v in tile.views)
    cloud = clouds.read(tile.clouds[0], tile.frame)
    assert np.abs(tile.frame.to_crs(cloud.xyz) - points).max() < 0.03
    with pytest.raises(SettingError, match="are determined by GPS"):
        import_model(
            "opensfm", tmp_path / "reconstruction.json", tmp_path / "images", tmp_path / "u", gps=True, scale=2.0
        )

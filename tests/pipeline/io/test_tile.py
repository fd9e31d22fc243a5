"""`tile.toml`: reading, and errors of invalid ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Camera, Frame, PointCloud
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile, tile_name, write_tile

FT_CRS = "EPSG:2994"  # Oregon Lambert, international feet


def cloud(path: Path, crs: str = "EPSG:32632", unit: float = 1.0, n: int = 100) -> Path:
    frame = Frame(crs, (500_000.0, 5_400_000.0, 100.0), unit)
    xyz = np.random.default_rng(0).uniform(0, 20, (n, 3)).astype(np.float32)
    las.write(path, PointCloud(frame, xyz, classification=np.full(n, 2, np.uint8)))
    return path


def body(folder: Path, **changes: Any) -> dict[str, Any]:
    """A valid tile with `changes`; `photo` changes fields of its photo, `camera` those of its camera."""
    cloud(folder / "cloud.laz")
    camera: dict[str, Any] = {
        "id": "front",
        "model": "pinhole",
        "size": [64, 48],
        "focal": [50.0, 50.0],
        "centre": [31.5, 23.5],
    }
    photo: dict[str, Any] = {
        "file": "1.jpg",
        "camera": "front",
        "position": [500_010.0, 5_400_010.0, 102.0],
        "rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    }
    photo |= changes.pop("photo", {})
    camera |= changes.pop("camera", {})
    return {"name": "t", "clouds": ["cloud.laz"], "cameras": [camera], "photos": [photo]} | changes


def save(folder: Path, content: dict[str, Any]) -> Path:
    (folder / "tile.toml").write_text(tomli_w.dumps(content), encoding="utf-8")
    return folder


@pytest.mark.parametrize("name", ["world", "__street__"])
def test_names_that_simulators_reserve_are_rejected(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="reserved by simulators"):
        read_tile(save(tmp_path, body(tmp_path, name=name)))
    assert tile_name(name) == {"world": "world_tile"}.get(name, "street")  # of a map "world.pcd", for example


def test_written_tile_is_read_back_before_its_photos_exist(tmp_path: Path) -> None:
    tile = read_tile(save(tmp_path, body(tmp_path)))
    assert (tile.name, tile.frame.crs, tile.frame.unit) == ("t", read_tile(tmp_path).frame.crs, 1.0)
    assert np.allclose(tile.frame.to_crs(tile.views[0].centre), [500_010, 5_400_010, 102])
    assert not tile.views[0].photo.exists()
    xyz = clouds.read(tile.clouds[0], tile.frame).xyz
    assert np.abs(xyz).max() < 30  # local: near the origin


def test_tile_round_trip(tmp_path: Path) -> None:
    cloud(tmp_path / "cloud.laz")
    (tmp_path / "path.csv").write_text("time,x,y,z\n2,500001,5400000,101\n1,500000,5400000,101\n", encoding="utf-8")
    camera = Camera("opencv", 64, 48, 50.0, 51.0, 31.0, 23.0, (0.1, 0.0, 0.0, 0.0))
    rotation = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    position = np.array([500_001.0, 5_400_002.0, 103.0])
    photo = {"file": "a/1.jpg", "camera": "c", "position": position, "rotation": rotation, "time": 3.0}
    written = write_tile(
        tmp_path,
        name="t",
        crs="EPSG:32632",
        clouds=["cloud.laz"],
        cameras={"c": camera},
        photos=[photo],
        trajectory="path.csv",
    )
    tile = read_tile(written)
    view = tile.views[0]
    assert (view.camera, view.name, view.time, view.mask) == (camera, "a/1", 3.0, None)
    assert np.allclose(view.T_world_cam[:3, :3], rotation)
    assert np.allclose(tile.frame.to_crs(view.centre), position)
    assert tile.trajectory is not None and tile.trajectory.times.tolist() == [1, 2]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"photo": {"position": [float("nan"), 0, 0]}}, r"photo 0 \(1\.jpg\): its pose contains NaN.*remove the photo"),
        (
            {"photo": {"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}},
            r"1\.jpg.*is not a rotation matrix.*camera-to-world",
        ),
        ({"photo": {"rotation": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]}}, r"1\.jpg.*is not a rotation matrix.*determinant"),
        ({"photo": {"camera": "back"}}, r"1\.jpg.*unknown camera `back`.*Cameras are: front"),
        ({"photo": {"postion": [0, 0, 0]}}, r"field `photos\.0\.postion`.*docs/reference/formats\.md"),
        ({"camera": {"model": "pinhole", "distortion": [0.1]}}, r"camera `front`: 1 distortion coef.*takes 0"),
        ({"camera": {"focal": [0.0, 0.0]}}, r"camera `front`: focal .* is not positive.*fx and fy"),
        ({"camera": {"focal": [float("nan"), 1.0]}}, r"camera `front`: focal .* is not positive"),
        ({"camera": {"focal": [1e300, 1.0]}}, r"camera `front`: focal"),
        ({"camera": {"centre": [float("nan"), 0.0]}}, r"camera `front`: centre .*cx and cy"),
        ({"camera": {"centre": [1e300, 0.0]}}, r"camera `front`: centre .*cx and cy"),
        ({"camera": {"model": "opencv", "distortion": [float("nan"), 0, 0, 0]}}, r"camera `front`: distortion"),
        ({"camera": {"model": "opencv", "distortion": [0, -1e300, 0, 0]}}, r"camera `front`: distortion"),
        ({"camera": {"model": "fish"}}, r"field `cameras\.0\.model`"),
        ({"units": "yards"}, r"field `units`.*docs/reference/formats\.md"),
        ({"crs": "EPSG:99999"}, r"EPSG:99999.* is not a valid CRS.*EPSG:32633"),
        ({"crs": "EPSG:4326", "clouds": ["bare.laz"]}, r"is not projected.*UTM"),
        ({"crs": "EPSG:4978", "clouds": ["bare.laz"]}, r"is geocentric.*UTM, or name"),
        ({"clouds": ["none.laz"]}, r"none\.laz: file not found.*Check the path"),
        ({"clouds": ["bare.laz"]}, r'bare\.laz: has no CRS, and neither has the tile.*crs = "local"'),
        ({"clouds": ["cloud.laz", "lambert.laz"]}, r"lambert\.laz: is in EPSG:2154, but cloud\.laz is in EPSG:32632"),
        ({"clouds": ["cloud.shp"]}, r"cloud\.shp: has an unknown cloud format.*LAS, LAZ, COPC, PLY"),
        ({"clouds": ["text.laz"]}, r"text\.laz: is not a readable LAS file.*again"),
        ({"trajectory": "bad.csv"}, r"bad\.csv: is not a valid trajectory.*time,x,y,z"),
    ],
)
def test_invalid_tiles_are_rejected_with_cause_and_remedy(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    cloud(tmp_path / "bare.laz", crs="local")
    cloud(tmp_path / "lambert.laz", crs="EPSG:2154")
    (tmp_path / "cloud.shp").write_text("0 0 0", encoding="utf-8")
    (tmp_path / "text.laz").write_text("no cloud", encoding="utf-8")
    (tmp_path / "bad.csv").write_text("time,x,y,z\n1,2\n", encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_tile(save(tmp_path, body(tmp_path, **changes)))


def test_duplicate_camera_ids_are_rejected(tmp_path: Path) -> None:
    content = body(tmp_path)
    content["cameras"] *= 2
    with pytest.raises(InputError, match=r"has two cameras `front`.*a unique id"):
        read_tile(save(tmp_path, content))


def test_missing_tile_and_invalid_toml_are_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"tile\.toml: no tile found.*scan2sim import"):
        read_tile(tmp_path)
    (tmp_path / "tile.toml").write_text("name = \n", encoding="utf-8")
    with pytest.raises(InputError, match=r"tile\.toml: is not valid TOML \(.*line 1.*Fix the line"):
        read_tile(tmp_path)


@pytest.mark.parametrize("kept", [0.3, 0.6, 0.95])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_truncated_cloud_is_reported(tmp_path: Path, suffix: str, kept: float) -> None:
    path = cloud(tmp_path / f"cloud{suffix}", n=20_000)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    (tmp_path / "tile.toml").write_text(f'name = "t"\nclouds = ["{path.name}"]\n', encoding="utf-8")
    with pytest.raises(InputError, match=rf"cloud{suffix}: is .*again"):
        clouds.read(path, read_tile(tmp_path).frame)


def test_coordinates_in_feet_are_converted_to_metres(tmp_path: Path) -> None:
    frame = Frame(FT_CRS, (200_000.0, 250_000.0, 100.0), 0.3048)
    xyz = np.array([[0, 0, 0], [30.48, 60.96, 3.048]], np.float32)
    las.write(tmp_path / "feet.laz", PointCloud(frame, xyz))
    (tmp_path / "tile.toml").write_text('name = "t"\nclouds = ["feet.laz"]\n', encoding="utf-8")
    tile = read_tile(tmp_path)
    read = clouds.read(tile.clouds[0], tile.frame).xyz
    assert tile.frame.unit == pytest.approx(0.3048)
    assert np.allclose(read[1] - read[0], [30.48, 60.96, 3.048], atol=2e-3)
    header = clouds.read_header(tile.clouds[0])
    assert np.allclose(header.high - header.low, [100, 200, 10], atol=0.01)  # the file itself is in feet


def test_local_tile_may_be_in_feet(tmp_path: Path) -> None:
    cloud(tmp_path / "bare.las", crs="local")
    (tmp_path / "tile.toml").write_text(
        'name = "t"\ncrs = "local"\nunits = "ft"\nclouds = ["bare.las"]\n', encoding="utf-8"
    )
    tile = read_tile(tmp_path)
    assert tile.frame.unit == 0.3048
    assert np.ptp(clouds.read(tile.clouds[0], tile.frame).xyz[:, 0]) < 20 * 0.31


def test_real_survey_in_feet_has_metric_size(real_data: Path, tmp_path: Path) -> None:
    (tmp_path / "autzen.laz").write_bytes((real_data / "las" / "autzen_trim.laz").read_bytes())
    (tmp_path / "tile.toml").write_text('name = "autzen"\nclouds = ["autzen.laz"]\n', encoding="utf-8")
    tile = read_tile(tmp_path)
    xyz = clouds.read(tile.clouds[0], tile.frame).xyz
    assert tile.frame.unit == pytest.approx(0.3048)
    assert np.allclose(np.ptp(xyz, axis=0)[:2], np.array([1178.46, 562.7]) * 0.3048, atol=0.5)

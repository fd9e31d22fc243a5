"""`scan2sim import images`: photos without poses, with a cloud or without, and errors of bad input."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from pyproj import Transformer
from typer.testing import CliRunner, Result

from scan2sim.flows.cli import app
from scan2sim.flows.commands import display
from scan2sim.flows.engine.planning import plan
from scan2sim.flows.pipelines.images import Images, build_graph
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import DataError, InputError, SettingError, UnavailableError
from scan2sim.pipeline.core.types import F64, Frame
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.pose_check.check import find_mistake
from tests.fakes import textured_street

pytest.importorskip("pycolmap")
FRAME = Frame("EPSG:32633", (391000.0, 5820000.0, 40.0))
COUNT = 8
GEOID_M = 45.0
"""Height of GPS above the cloud's: they are above different surfaces."""


@pytest.fixture(autouse=True)
def _wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(display.console, "_width", 200)  # undoing `width` would fix it at its present value


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, F64]:
    """Folder with photos, cloud, times, and a GPS track that is off by more than a metre; true poses."""
    folder = tmp_path_factory.mktemp("street")
    truth = textured_street.write(folder, FRAME, COUNT)
    random = np.random.default_rng(0)
    xyz = FRAME.to_crs(truth[:, :3, 3] + [1.1, -0.8, GEOID_M] + random.normal(size=(COUNT, 3)) * 0.2)
    lon, lat = Transformer.from_crs(FRAME.crs, "EPSG:4326", always_xy=True).transform(xyz[:, 0], xyz[:, 1])
    rows = [f"{i},{lat[i]:.8f},{lon[i]:.8f},{xyz[i, 2]:.2f}\n" for i in range(COUNT)]
    (folder / "gps.csv").write_text("time,latitude,longitude,altitude\n" + "".join(rows), encoding="utf-8")
    (folder / "times.txt").write_text("".join(f"{i}\n" for i in range(COUNT)), encoding="utf-8")
    return folder, truth


def command(*words: object) -> Result:
    return CliRunner().invoke(app, ["import", "images", *(str(word) for word in words)])


@pytest.mark.slow
def test_unposed_photos_and_a_cloud_become_a_tile(street: tuple[Path, F64], tmp_path: Path) -> None:
    folder, truth = street
    photos, out = tmp_path / "my photos", tmp_path / "tile"
    shutil.copytree(folder / "photos", photos)
    for i in range(COUNT):
        (photos / f"{i:02d}.jpg").rename(photos / f"photo {i:02d}.jpg")
    (photos / "photo 99.jpg").write_bytes((photos / "photo 00.jpg").read_bytes()[:3000])
    (tmp_path / "times.txt").write_text("".join(f"{i}\n" for i in [*range(COUNT), 99]), encoding="utf-8")
    arguments = ("--cloud", folder / "cloud.laz", "--gps", folder / "gps.csv", "--times", tmp_path / "times.txt")
    result = command(photos, "--out", out, *arguments, "--features", 1500)
    assert result.exit_code == 0, result.output
    assert "photo 99.jpg is skipped" in result.output
    tile = read_tile(out)
    assert tile.frame.crs == FRAME.crs and len(tile.views) == COUNT
    poses = np.array([view.T_world_cam for view in tile.views])
    errors = FRAME.to_local(tile.frame.to_crs(poses[:, :3, 3])) - truth[:, :3, 3]
    assert np.linalg.norm(errors, axis=1).max() < 0.15
    turns = np.einsum("nji,njk->nik", poses[:, :3, :3], truth[:, :3, :3])
    assert np.degrees(np.arccos((np.trace(turns, axis1=1, axis2=2) - 1) / 2)).max() < 0.6
    assert abs(tile.views[0].camera.fx / textured_street.FOCAL - 1) < 0.02
    assert find_mistake(tile) is None
    beside = out.with_name("tile-photos")
    path = trajectory_io.read(beside / "trajectory.csv", FRAME)
    assert np.allclose(path.positions[0], truth[0, :3, 3], atol=0.15) and (beside / "colmap" / "cameras.bin").is_file()

    again = command(photos, "--out", out, *arguments, "--features", 1500, "--overwrite")
    assert again.exit_code == 0 and "2 of 2 results reused" in again.output


def test_without_a_cloud_or_cuda_the_model_is_written_and_a_cloud_asked_for(
    street: tuple[Path, F64], tmp_path: Path
) -> None:
    folder, _ = street
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(4):
        shutil.copy(folder / "photos" / f"{i:02d}.jpg", photos)
    result = command(photos, "--out", tmp_path / "tile", "--features", 1000)
    error = result.exception
    assert isinstance(error, UnavailableError) and "--cloud" in error.remedy and "CUDA" in error.remedy
    assert "trajectory.csv isn't in metres" in result.output
    beside = tmp_path / "tile-photos"
    assert len(trajectory_io.read(beside / "trajectory.csv")) == 4
    assert (beside / "colmap" / "points3D.bin").is_file() and not (tmp_path / "tile").exists()


def test_photos_in_subfolders_are_read_again_when_they_change(street: tuple[Path, F64], tmp_path: Path) -> None:
    photos, store = tmp_path / "photos", Store(tmp_path / "store")
    shutil.copytree(street[0] / "photos", photos / "left")
    source = Images.model_validate({"photos": photos})
    before = [item.key for item in plan(build_graph(source, Path()), store)]
    assert [item.key for item in plan(build_graph(source, Path()), store)] == before
    shutil.copy(photos / "left" / "01.jpg", photos / "left" / "00.jpg")
    assert plan(build_graph(source, Path()), store)[0].key != before[0]


def test_features_and_matches_are_kept_with_a_longer_time_limit(street: tuple[Path, F64], tmp_path: Path) -> None:
    store, photos = Store(tmp_path / "store"), street[0] / "photos"
    keys = [
        plan(build_graph(Images.model_validate({"photos": photos, **given}), Path()), store)[0].key
        for given in ({}, {"time_limit": 48}, {"features": 500})
    ]
    assert keys[0] == keys[1] != keys[2]


def test_another_calibration_reconstructs_the_photos_again(street: tuple[Path, F64], tmp_path: Path) -> None:
    store, file, keys = Store(tmp_path / "store"), tmp_path / "camera.toml", list[str]()
    for focal in (400, 401):
        text = f'[[cameras]]\nid = "a"\nmodel = "pinhole"\nsize = [480, 360]\nfocal = [{focal}, {focal}]\n'
        file.write_text(text + "centre = [239.5, 179.5]\n", encoding="utf-8")
        source = Images.model_validate({"photos": street[0] / "photos", "camera": str(file), "refine_lens": True})
        keys.append(plan(build_graph(source, Path()), store)[0].key)
    assert keys[0] != keys[1]


def test_a_tile_inside_the_folder_of_its_photos_is_refused(street: tuple[Path, F64], tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    shutil.copytree(street[0] / "photos", photos)
    error = command(photos, "--out", photos / "tile").exception
    assert isinstance(error, SettingError) and "inside the folder of the photos" in error.cause
    photos.rename(tmp_path / "street-photos")
    error = command(tmp_path / "street-photos", "--out", tmp_path / "street").exception
    assert isinstance(error, SettingError) and "isn't from an earlier run" in error.cause
    assert [path.name for path in tmp_path.iterdir()] == ["street-photos"]


def test_missing_inputs_are_reported_before_anything_is_computed(street: tuple[Path, F64], tmp_path: Path) -> None:
    folder, _ = street
    photos, out, cloud = folder / "photos", tmp_path / "tile", ("--cloud", folder / "cloud.laz")
    gps = ("--gps", folder / "gps.csv", "--times", folder / "times.txt")
    empty, single = tmp_path / "empty", tmp_path / "single"
    empty.mkdir()
    single.mkdir()
    shutil.copy(photos / "00.jpg", single)
    local = (*cloud, "--crs", "local")
    calibration = tmp_path / "camera.yaml"
    calibration.write_text(
        "image_width: 960\nimage_height: 720\ncamera_matrix: {data: [800, 0, 480, 0, 800, 360, 0, 0, 1]}\n"
        "distortion_model: plumb_bob\ndistortion_coefficients: {data: [0.1, 0, 0, 0, 0]}\n",
        encoding="utf-8",
    )
    cases: list[tuple[tuple[object, ...], type[Exception], str]] = [
        ((tmp_path / "none",), InputError, "not found"),
        ((empty,), InputError, "no photos"),
        ((single,), DataError, "only 1 photo"),
        ((photos, *cloud), DataError, "0 of its photos have GPS"),
        ((photos, *local, *gps), DataError, "no CRS"),
        ((photos, *cloud, "--gps", folder / "gps.csv"), DataError, "00.jpg has no time"),
        ((photos, *cloud, *gps, "--positions", folder / "gps.csv"), SettingError, "both"),
        ((photos, "--refine-lens"), SettingError, "no lens"),
        ((photos, "--camera", tmp_path / "camera.toml"), InputError, "file not found"),
        ((photos, "--camera", calibration), InputError, "no camera of 480x360, the size of 00.jpg and 7 other photos"),
        ((photos, "--camera", calibration, "--focal", "400"), SettingError, "beside a file with the camera"),
        ((photos, "--k1", "0.1"), SettingError, "needs a focal length"),
    ]
    for words, kind, text in cases:
        failed = command(*words, "--out", out)
        assert isinstance(failed.exception, kind) and text in str(failed.exception), (words, failed.exception)
        assert not out.with_name("tile-photos").exists()
    without = command(photos, *cloud, "--out", out).exception
    assert isinstance(without, DataError) and "--gps" in without.remedy and "--positions" in without.remedy


def test_photos_that_do_not_overlap_and_a_static_camera(street: tuple[Path, F64], tmp_path: Path) -> None:
    folder, _ = street
    random = np.random.default_rng(0)
    apart, static = tmp_path / "apart", tmp_path / "static"
    apart.mkdir()
    static.mkdir()
    photo = cv2.imread(str(folder / "photos" / "00.jpg"))
    for i in range(3):
        noise = cv2.resize(random.integers(0, 255, (24, 32), np.uint8), (320, 240), interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(apart / f"{i}.png"), noise)
        seen = np.clip(photo + random.normal(size=photo.shape) * 3, 0, 255).astype(np.uint8)
        cv2.imwrite(str(static / f"{i}.png"), seen)
    for photos, text in ((apart, "no two of its photos"), (static, "doesn't move")):
        failed = command(photos, "--out", tmp_path / "tile", "--features", 500)
        assert isinstance(failed.exception, DataError) and text in str(failed.exception)


@pytest.mark.slow
def test_rough_positions_locate_photos_in_a_local_cloud(street: tuple[Path, F64], tmp_path: Path) -> None:
    folder, truth = street
    rows = [
        f"{i:02d}.jpg,{x + 1:.1f},{y - 1:.1f},{z:.1f}\n" for i, (x, y, z) in enumerate(truth[:, :3, 3]) if i % 2 == 0
    ]
    (tmp_path / "rough.csv").write_text("file,x,y,z\n" + "".join(rows), encoding="utf-8")
    textured_street.write(tmp_path / "local", Frame(), COUNT)
    out = tmp_path / "tile"
    result = command(
        folder / "photos", "--cloud", tmp_path / "local" / "cloud.laz", "--positions", tmp_path / "rough.csv",
        "--out", out, "--features", 1500,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    tile = read_tile(out)
    found = tile.frame.to_crs(np.array([view.centre for view in tile.views]))
    assert tile.frame.crs == "local" and np.linalg.norm(found - truth[:, :3, 3], axis=1).max() < 0.15
    assert json.loads((tmp_path / "tile-photos" / "reconstruction.json").read_text())["posed"] == COUNT

"""nuScenes and PandaSet: a drive with ground truth in both layouts, and errors of damaged copies."""

from __future__ import annotations

import gzip
import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Geod, Transformer
from scipy.spatial import KDTree
from typer.testing import CliRunner, Result

from scan2sim.flows.cli import app
from scan2sim.flows.commands import display
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import F64, Tile
from scan2sim.pipeline.importers.datasets import nuscenes, pandaset
from scan2sim.pipeline.importers.datasets.nuscenes import NuScenesParams
from scan2sim.pipeline.importers.datasets.recording import DatasetParams
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.pandas_pickle import read_columns
from scan2sim.pipeline.io.tile import read_tile
from tests.fakes.datasets import (
    CAMERA,
    COLOURS,
    NAMES,
    PLACE,
    T_EGO_CAMERA,
    Drive,
    pickled_table,
    write_nuscenes,
    write_pandaset,
)
from tests.flows.test_prepare import drive as drive_file
from tests.flows.test_prepare import survey_of

pytestmark = pytest.mark.usefixtures("steps_in_process")

DRIVE = Drive()
ONENORTH = (1.2882100868743724, 103.78475189208984)
SPHERE = Geod(a=6_378_137.0, b=6_378_137.0)


@pytest.fixture(autouse=True)
def _wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(display.console, "_width", 200)  # undoing `width` would fix it at its present value


def command(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def imported(kind: str, folder: Path, out: Path, *words: object) -> tuple[Tile, str]:
    result = command("import", kind, folder, "--out", out, *words)
    assert result.exit_code == 0, result.exception or result.output
    return read_tile(out), result.output


def on_grid(xyz: F64) -> F64:
    """Positions on the map in UTM: the first pose by the devkit's formula, the others beside it, by true north."""
    first = DRIVE.scanner(DRIVE.times[0])[:3, 3]
    lon, lat, _ = SPHERE.fwd(ONENORTH[1], ONENORTH[0], np.degrees(np.arctan2(*first[:2])), np.hypot(*first[:2]))
    to_utm = Transformer.from_crs("EPSG:4326", "EPSG:32648", always_xy=True)
    anchor, north = np.array([to_utm.transform(lon, lat), to_utm.transform(lon, lat + 1e-4)])
    up = (north - anchor) / np.linalg.norm(north - anchor)
    turn = np.array([[up[1], up[0], 0], [-up[0], up[1], 0], [0, 0, 1]])
    return np.asarray((xyz - first * [1, 1, 0]) @ turn.T + [*anchor, 0])


def check_points(tile: Tile, expected: F64, turned: Callable[[F64], F64] = lambda xyz: xyz) -> None:
    """Each sweep has all points that are in range, each within a millimetre."""
    found = tile.frame.to_crs(np.concatenate([clouds.read(one, tile.frame).xyz for one in tile.clouds]))
    used = sum(int((np.linalg.norm(DRIVE.sweep(t), axis=1) < 50).sum()) for t in DRIVE.times)
    near, _ = KDTree(turned(expected)).query(found)
    assert len(found) == used and near.max() < 1e-3


def check_photos(tile: Tile, names: dict[str, str], turned: Callable[[F64], F64], tolerance: float) -> None:
    """Each photo has the pose of its own time."""
    assert len(tile.views) == sum(len(DRIVE.photo_times(name)) for name in names)
    for name, folder in names.items():
        views = [view for view in tile.views if view.photo.parent.name == folder]
        for view, time in zip(views, DRIVE.photo_times(name), strict=True):
            T = DRIVE.ego(time) @ T_EGO_CAMERA[name]
            ends = turned(T[:3, 3] + np.vstack([np.zeros(3), T[:3, :3].T]))  # centre, and one metre along each axis
            found = tile.frame.to_crs(view.centre + np.vstack([np.zeros(3), view.T_world_cam[:3, :3].T]))
            assert view.time is not None and abs(view.time - time) < 1e-6 and view.camera == CAMERA
            assert np.abs(found - ends).max() < tolerance


def test_nuscenes_files_are_placed_by_their_own_poses(tmp_path: Path) -> None:
    folder = write_nuscenes(tmp_path / "nuscenes", DRIVE)
    tile, text = imported("nuscenes", folder, tmp_path / "tile", "--scene", "scene-0061", "--pose-source", "given")
    assert tile.frame.crs == "EPSG:32648"
    assert "8 sweeps and 10 photos in 0.3 s of scene-0061; singapore-onenorth; poses are planar" in text
    check_points(tile, DRIVE.world, on_grid)
    check_photos(tile, {name: name for name in T_EGO_CAMERA}, on_grid, 2e-5)
    cloud = clouds.read(tile.clouds[0], tile.frame)
    assert cloud.rgb is not None and cloud.intensity is not None and set(cloud.intensity) == {51 * 257}
    for name, rgb in COLOURS.items():  # points in front of a camera have the colour of its image
        view = next(view for view in tile.views if view.photo.parent.name == name)
        ahead = cloud.xyz[(cloud.xyz - view.centre) @ view.T_world_cam[:3, 2] > 5]
        seen = cloud.rgb[(cloud.xyz - view.centre) @ view.T_world_cam[:3, 2] > 5]
        assert len(ahead) > 50 and np.median(np.abs(seen.astype(int) - rgb), axis=0).max() < 12


def test_drive_on_an_unknown_map_stays_in_map_coordinates(tmp_path: Path) -> None:
    folder = write_nuscenes(tmp_path, DRIVE, location="somewhere else")
    words = ("--scene", "token scene-0061", "--camera", "CAM_BACK", "--photo-interval", 0.2, "--link")
    tile, _ = imported("nuscenes", folder / "v1.0-mini", tmp_path / "tile", *words)
    check_points(tile, DRIVE.world)
    assert tile.frame.crs == "local" and [view.photo.parent.name for view in tile.views] == ["CAM_BACK"] * 2
    assert tile.views[0].photo.resolve().parent == folder / "samples" / "CAM_BACK"
    refused = command(
        "import", "nuscenes", folder, "--scene", "scene-0061", "--crs", "EPSG:32648", "--out", tmp_path / "b"
    )
    assert "the origin of the map 'somewhere else' isn't known" in str(refused.exception)


def test_missing_sweeps_are_reported_by_a_warning(tmp_path: Path) -> None:
    folder = write_nuscenes(tmp_path / "data", DRIVE)
    for path in (folder / "sweeps").rglob("*.*"):
        path.unlink()
    tile, text = imported("nuscenes", folder, tmp_path / "tile", "--scene", "scene-0061")
    assert "2 sweeps and 4 photos" in text and len(tile.views) == 4
    assert "6 of 8 files of LIDAR_TOP are missing, and only keyframes are left" in text
    for path in (folder / "samples" / "LIDAR_TOP").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="none of the 8 sweeps of scene-0061 exist"):
        read(folder)


def read(folder: Path, scene: str | None = "scene-0061", **params: Any) -> None:
    """Read a scene and all its sweeps."""
    drive = nuscenes.read_scene(nuscenes.find_scene(folder, scene), NuScenesParams(crs="local", **params))
    for _, path in drive.sweeps:
        nuscenes.read_sweep(path)


def change(table: str, **fields: Any) -> Callable[[Path], None]:
    """Damage: fields of all records of a table; None removes them."""

    def damage(folder: Path) -> None:
        path = folder / "v1.0-mini" / f"{table}.json"
        rows = [
            {k: v for k, v in (row | fields).items() if v is not None} for row in json.loads(path.read_text("utf-8"))
        ]
        path.write_text(json.dumps(rows), encoding="utf-8")

    return damage


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def cut(name: str, size: int) -> Callable[[Path], None]:
    """Damage: the end of a file, or of the first one that matches a pattern, is missing."""

    def damage(folder: Path) -> None:
        path = min(folder.glob(name))
        path.write_bytes(path.read_bytes()[:size])

    return damage


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (remove("v1.0-mini/scene.json"), "contains no nuScenes tables"),
        (remove("v1.0-mini/ego_pose.json"), r"ego_pose\.json: file not found"),
        (cut("v1.0-mini/sample_data.json", 5000), r"sample_data\.json: is not a nuScenes table \(it ends within"),
        (cut("v1.0-mini/sensor.json", 0), r"sensor\.json: is not a nuScenes table \(no list"),
        (cut("samples/LIDAR_TOP/*.bin", 1001), "is not a nuScenes sweep: 1001 bytes"),
        (cut("samples/LIDAR_TOP/*.bin", 0), "is not a nuScenes sweep: 0 bytes"),
        (change("ego_pose", token="x"), r"there is no record for its ego_pose_token 'pose scene-0061 LIDAR_TOP 0'"),
        (change("calibrated_sensor", sensor_token="x"), r"there is no record for its sensor_token 'x'"),
        (change("scene", log_token="x"), r"there is no record for its log_token 'x'"),
        (change("sample", scene_token="x"), "has no lidar sweep of scene-0061"),
        (change("sample_data", filename=None), r"record 'scene-0061 LIDAR_TOP 0': field `filename`"),
        (change("sample_data", filename="../../etc/passwd"), "leaves the data set"),
        (change("sample_data", width=0), "has no width and height"),
        (change("ego_pose", rotation=[0, 0, 0, 0]), "record 'pose scene-0061 LIDAR_TOP 0' is not a pose"),
        (change("calibrated_sensor", camera_intrinsic=[]), "has no camera_intrinsic"),
    ],
)
def test_damaged_nuscenes_files_are_reported(tmp_path: Path, damage: Callable[[Path], None], message: str) -> None:
    folder = write_nuscenes(tmp_path, DRIVE)
    read(folder)
    damage(folder)
    with pytest.raises(InputError, match=message):
        read(folder)


def test_unknown_scene_or_camera_lists_available_ones(tmp_path: Path) -> None:
    folder = write_nuscenes(tmp_path, DRIVE)
    with pytest.raises(SettingError, match=r"no scene 'scene-0001' in .*Give one of them: another, scene-0061"):
        read(folder, "scene-0001")
    with pytest.raises(SettingError, match=r"has 2 scenes\. Give one of them: another, scene-0061"):
        read(folder, None)
    with pytest.raises(SettingError, match=r"no camera 'front'.*has CAM_BACK, CAM_FRONT"):
        read(folder, camera=("front",))
    write_nuscenes(tmp_path, DRIVE, version="v1.0-trainval")
    with pytest.raises(SettingError, match=r"'scene-0061' is in 2 versions\. Give one of the folders v1\.0-mini, v1"):
        read(folder)


def test_tables_are_read_in_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_nuscenes(tmp_path, DRIVE)
    monkeypatch.setattr(nuscenes, "CHUNK", 700)
    read(folder)
    (folder / "v1.0-mini" / "sample.json").write_text('[{"token": "a"}, {"token": 1]', encoding="utf-8")
    with pytest.raises(InputError, match=r"sample\.json: is not a nuScenes table"):
        read(folder)


def gps_of(truth: F64, heading: float) -> F64:
    """Latitude, longitude and height of positions (N, 3) of a world that is turned by `heading` to true north."""
    east, north = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]) @ truth[:, :2].T
    lon, lat, _ = Geod(ellps="WGS84").fwd(
        np.full(len(truth), -122.4),
        np.full(len(truth), 37.77),
        np.degrees(np.arctan2(east, north)),
        np.hypot(east, north),
    )
    return np.column_stack([lat, lon, truth[:, 2] + 30])


def test_pandaset_stays_in_its_world_coordinates(tmp_path: Path) -> None:
    folder = write_pandaset(tmp_path / "001", DRIVE)
    tile, text = imported("pandaset", tmp_path, tmp_path / "out" / "tile")
    assert "8 sweeps and 10 photos in 0.3 s of 001" in text and "the world stays local" in text
    check_points(tile, DRIVE.world)
    check_photos(tile, NAMES, lambda xyz: xyz, 1e-3)
    tile, _ = imported("pandaset", folder, tmp_path / "out" / "b", "--camera", "none", "--crs", "local")
    assert not tile.views


def test_pandaset_is_georeferenced_if_gps_determines_the_heading(tmp_path: Path) -> None:
    long = Drive(sweeps=80, world=PLACE + [20.0, 0.0, 1.0] + np.zeros((1, 3)))
    truth = np.array([long.scanner(t)[:3, 3] - PLACE for t in long.times])
    gps = gps_of(truth, 0.7) + np.random.default_rng(1).normal(0, 2e-6, (80, 3)) * [1, 1, 1e5]
    gps[3, 0] += 1e-3  # an outlier of 100 m
    write_pandaset(tmp_path / "002", long, gps)
    drive = pandaset.read_sequence(tmp_path / "002", DatasetParams(camera=("none",)))
    assert drive.frame.crs == "EPSG:32610" and "georeferenced by GPS, rms 0.2" in drive.notes[0]
    to_utm = Transformer.from_crs("EPSG:4326", "EPSG:32610", always_xy=True)
    exact = gps_of(truth, 0.7)
    expected = np.column_stack([*to_utm.transform(exact[:, 1], exact[:, 0]), exact[:, 2]])
    assert np.abs(drive.frame.to_crs(drive.path.positions) - expected).max() < 0.3
    short = write_pandaset(tmp_path / "003", DRIVE, gps_of(truth, 0.7)[:8])
    assert pandaset.read_sequence(short, DatasetParams()).frame.crs == "EPSG:32610"
    noisy = gps_of(truth, 0.7)[:8] + np.random.default_rng(0).normal(0, 1e-5, (8, 3))
    drive = pandaset.read_sequence(write_pandaset(tmp_path / "004", DRIVE, noisy), DatasetParams())
    assert drive.frame.crs == "local" and "doesn't determine the heading" in drive.warnings[0]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (cut("lidar/00.pkl.gz", 300), r"00\.pkl\.gz: is damaged"),
        (remove("lidar/poses.json"), r"poses\.json: file not found"),
        (cut("lidar/timestamps.json", 30), r"timestamps\.json: Invalid JSON"),
        (cut("camera/front_camera/intrinsics.json", 9), r"intrinsics\.json: Invalid JSON"),
        (lambda f: (f / "lidar" / "timestamps.json").write_text("[1, 2]"), "has 2 entries, but file 7 exists"),
        (lambda f: (f / "lidar" / "timestamps.json").write_text(str([1.0] * 8)), "times are not ascending"),
        (lambda f: (f / "camera" / "back_camera" / "00.jpg").write_bytes(b"x"), r"00\.jpg"),
        (lambda f: (f / "lidar" / "00.pkl.gz").write_bytes(pickled_table({"x": np.zeros(3)})), "has no column y, z, i"),
    ],
)
def test_damaged_pandaset_files_are_reported(tmp_path: Path, damage: Callable[[Path], None], message: str) -> None:
    folder = write_pandaset(tmp_path / "001", DRIVE)
    damage(folder)
    with pytest.raises(InputError, match=message):
        drive, reader = pandaset.read_sequence(folder, DatasetParams()), pandaset.sweep_reader(folder)
        for time, path in drive.sweeps:
            reader(path, time)


def test_ambiguous_folder_lists_available_sequences(tmp_path: Path) -> None:
    for name in ("001", "002"):
        write_pandaset(tmp_path / name, DRIVE)
    with pytest.raises(InputError, match=r"contains 2 sequences\. Give the folder of one of them: 001, 002"):
        pandaset.find_sequence(tmp_path)
    with pytest.raises(InputError, match="contains no PandaSet sequence"):
        pandaset.find_sequence(tmp_path / "001" / "lidar")


class Harmful:
    """Its pickle creates a folder when it is loaded."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.trace),)


def test_code_in_pickles_is_not_run(tmp_path: Path) -> None:
    path, trace = tmp_path / "a.pkl.gz", tmp_path / "trace"
    path.write_bytes(gzip.compress(pickle.dumps(Harmful(trace))))
    with pytest.raises(InputError, match=r"names posix\.mkdir, which a table of numbers doesn't need"):
        read_columns(path, ("x",))
    assert not trace.exists()
    for raw in (pickle.dumps([1, 2]), b"\x80\x04r\xff\xff\xff\xffN.", b"", pickle.dumps(np.zeros(3)), b"garbage"):
        path.write_bytes(raw)
        with pytest.raises(InputError, match="is not a pickled table|does not contain a pandas DataFrame"):
            read_columns(path, ("x",))


@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_tables_pickled_by_current_pandas_are_read(tmp_path: Path, protocol: int) -> None:
    pandas = pytest.importorskip("pandas")
    values = np.random.default_rng(0).normal(size=(50, 3))
    table = pandas.DataFrame(dict(zip("xyz", values.T, strict=True)) | {"d": np.arange(50, dtype=np.int32)})
    table = table[table.x < 1]
    table.columns = table.columns.astype(object)
    table.to_pickle(tmp_path / "a.pkl", protocol=protocol)
    found = read_columns(tmp_path / "a.pkl", ("d", "x", "z"))
    assert all(np.array_equal(found[name], table[name]) for name in found) and list(found) == ["d", "x", "z"]


@pytest.mark.parametrize("kind", ["nuscenes", "pandaset"])
def test_drives_of_datasets_become_surveys(tmp_path: Path, kind: str) -> None:
    long = Drive(sweeps=60)
    if kind == "nuscenes":
        write_nuscenes(tmp_path / "data", long)
        table = '[nuscenes]\nfolder = "data"\nscene = "scene-0061"\ncamera = ["CAM_FRONT"]\npose_source = "given"\n'
    else:
        write_pandaset(tmp_path / "data", long)
        table = '[pandaset]\nfolder = "data"\npose_source = "given"\n'
    place = drive_file(tmp_path, f"{table}[tiles]\nlength = 20.0\n")
    assert Path(survey_of(place, tmp_path / "out")).is_file()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[nuscenes]\nfolder = "a"\n[sweeps]\nfolder = "a"\n', "must have either"),
        ('[pandaset]\nfolder = "a"\n[slam]\nvideo = "a.mp4"\n', "must have either"),
        ('[nuscenes]\nscene = "a"\n', r"field `nuscenes\.folder`"),
        ('[nuscenes]\nfolder = "nothing"\n', "nothing: folder not found"),
    ],
)
def test_invalid_drive_files_are_rejected(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        survey_of(drive_file(tmp_path, text), tmp_path / "out")

"""Sweeps of a synthetic hall along a known path: accurate positions and colours of its walls."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.camera.models import pixel_rays
from scan2sim.pipeline.core.errors import DataError, InputError, ScanError, SettingError
from scan2sim.pipeline.core.types import F64, Camera, Frame, PointCloud, Tile, Trajectory
from scan2sim.pipeline.importers.sweeps import (
    PhotoInput,
    PlacementParams,
    import_sweeps,
)
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.calibration import photo_extrinsics
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.rig import RigCamera, write_rig
from scan2sim.pipeline.io.sweep_files import read_sweep
from scan2sim.pipeline.io.tile import read_tile
from tests.present import present

pytestmark = pytest.mark.usefixtures("steps_in_process")

LOW, HIGH = np.array([-8.0, -6.0, 0.0]), np.array([30.0, 6.0, 5.0])  # the hall
PAINT = np.array([[250, 30, 30], [30, 250, 30], [30, 30, 250], [250, 250, 30], [30, 250, 250], [250, 30, 250]])
PERIOD, SWEEPS, COLUMNS, SPEED, TURN = 0.1, 6, 600, 9.0, 0.4
CAMERA = Camera("equirectangular", 512, 256)
T_CAMERA_SCANNER = np.eye(4)
T_CAMERA_SCANNER[:3, :3] = Rotation.from_rotvec([0.02, -0.03, 0.01]).as_matrix() @ [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
T_CAMERA_SCANNER[:3, 3] = [0.1, 0.4, -0.3]


def scanner_path(times: F64) -> Trajectory:
    """Path of the scanner: straight, with a constant rotation to the left."""
    heading = 0.3 + TURN * times
    positions = np.array([0.5, -1.0, 1.8]) + np.outer(times, [SPEED, 2.0, 0])
    return Trajectory(times, positions, Rotation.from_euler("z", heading[:, None]).as_matrix())


def intersect(origin: F64, direction: F64) -> tuple[F64, np.ndarray]:
    """(N, 3) where rays from within the hall meet a wall, and (N,) which: low x, y, z, high x, y, z."""
    with np.errstate(divide="ignore"):
        far = np.concatenate([(LOW - origin) / direction, (HIGH - origin) / direction], axis=1)
    far[~(far > 1e-9)] = np.inf
    wall = far.argmin(axis=1)
    return origin + direction * far.min(axis=1)[:, None], wall


def sweep(time: float, *, turning: bool, columns: int = COLUMNS) -> F64:
    """(N, 3) in scanner axes, measured while it turns clockwise, from back to back, or all at once."""
    angles = np.pi - (np.arange(columns) + 0.5) / columns * 2 * np.pi
    azimuth, elevation = (a.ravel() for a in np.meshgrid(angles, np.radians(np.linspace(-60, 50, 24))))
    flat = np.cos(elevation)
    ray = np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)], axis=1)
    when = time + (-azimuth / (2 * np.pi) * PERIOD if turning else np.zeros(len(ray)))
    poses = scanner_path(when)
    assert poses.rotations is not None
    hits, _ = intersect(poses.positions, np.einsum("nij,nj->ni", poses.rotations, ray))
    return np.einsum("nji,nj->ni", poses.rotations, hits - poses.positions)


def photo(T_world_cam: F64) -> np.ndarray:
    """(H, W, 3) RGB: each wall in its colour."""
    rays = pixel_rays(CAMERA).reshape(-1, 3).astype(np.float64) @ T_world_cam[:3, :3].T
    _, wall = intersect(np.tile(T_world_cam[:3, 3], (len(rays), 1)), rays)
    return PAINT[wall].reshape(CAMERA.height, CAMERA.width, 3).astype(np.uint8)


def walls(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) metres to the nearest wall's plane, and which it is."""
    off = np.abs(np.concatenate([xyz - LOW, xyz - HIGH], axis=1))
    return off.min(axis=1), off.argmin(axis=1)


def to_bin(file: Path, xyz: F64) -> None:
    np.column_stack([xyz, np.full(len(xyz), 0.5)]).astype(np.float32).tofile(file.with_suffix(".bin"))


def to_laz(file: Path, xyz: F64) -> None:
    levels = np.full(len(xyz), 32768, np.uint16)
    las.write(file.with_suffix(".laz"), PointCloud(Frame(), xyz.astype(np.float32), intensity=levels))


def to_open3d(suffix: str) -> Callable[[Path, F64], None]:
    def write(file: Path, xyz: F64) -> None:
        import open3d as o3d

        cloud = o3d.t.geometry.PointCloud(xyz.astype(np.float32))
        cloud.point["intensity"] = np.full((len(xyz), 1), 128, np.float32)
        o3d.t.io.write_point_cloud(str(file.with_suffix(suffix)), cloud)

    return write


@dataclass
class Drive:
    """Folders of sweeps and photos, files of poses of the camera and of the scanner, the true times."""

    folder: Path
    times: F64
    camera: Trajectory

    @property
    def arguments(self) -> dict[str, Any]:
        return {"sweeps": self.folder / "sweeps", "poses": self.folder / "camera.csv", "extrinsics": T_CAMERA_SCANNER}

    @property
    def photo_inputs(self) -> list[PhotoInput]:
        return [PhotoInput(self.folder / "photos", CAMERA)]


def make(
    folder: Path, *, turning: bool = False, write: Callable[[Path, F64], None] = to_bin, shift: Any = (0, 0, 0),
    sweeps: int = SWEEPS, columns: int = COLUMNS,
) -> Drive:  # fmt: skip
    times = 0.1 + PERIOD * np.arange(sweeps, dtype=float)
    for name in ("sweeps", "photos"):
        (folder / name).mkdir(parents=True)
    scanner = scanner_path(times)
    poses = scanner.poses @ np.linalg.inv(T_CAMERA_SCANNER)
    for i, time in enumerate(times):
        write(folder / "sweeps" / f"{i:06d}", sweep(float(time), turning=turning, columns=columns))
        cv2.imwrite(str(folder / "photos" / f"{i:06d}.png"), photo(poses[i])[..., ::-1])
    camera = Trajectory(times, poses[:, :3, 3] + shift, poses[:, :3, :3])
    trajectory_io.write(folder / "camera.csv", camera)
    trajectory_io.write(folder / "scanner.kitti", scanner)
    np.savetxt(folder / "extrinsics.txt", T_CAMERA_SCANNER, "%.9f")
    return Drive(folder, times, camera)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    return make(tmp_path_factory.mktemp("drive"))


def imported(**arguments: Any) -> Path:
    """Call `import_sweeps` with parameters given by name."""
    own = {name: arguments.pop(name) for name in PlacementParams.model_fields.keys() & arguments.keys()}
    return import_sweeps(**arguments, placing=PlacementParams(**own))


def cloud_of(path: Path) -> tuple[Tile, PointCloud, np.ndarray]:
    """A tile, its cloud, and the points in the CRS."""
    tile = read_tile(path)
    cloud = clouds.read(tile.clouds[0], tile.frame)
    return tile, cloud, tile.frame.to_crs(cloud.xyz)


def test_sweeps_of_a_rotating_scanner_are_deskewed(tmp_path: Path) -> None:
    drive = make(tmp_path, turning=True)
    _, cloud, xyz = cloud_of(imported(**drive.arguments, out=tmp_path / "tile", deskew="kitti"))
    assert len(xyz) == SWEEPS * 600 * 24 and walls(xyz)[0].max() < 0.003
    assert cloud.time is not None
    assert np.allclose([cloud.time.min(), cloud.time.max()], [0.05, 0.65], atol=1e-3)
    assert cloud.intensity is not None and (cloud.intensity == 32768).all()
    smeared = cloud_of(imported(**drive.arguments, out=tmp_path / "smeared"))[2]
    assert walls(smeared)[0].max() > 0.2


@pytest.mark.parametrize("write", [to_bin, to_laz, to_open3d(".pcd"), to_open3d(".ply")])
def test_sweeps_of_all_formats_are_read(tmp_path: Path, write: Callable[[Path, F64], None]) -> None:
    drive = make(tmp_path, write=write)
    _, cloud, xyz = cloud_of(imported(**drive.arguments, out=tmp_path / "tile"))
    assert len(xyz) == SWEEPS * 600 * 24 and walls(xyz)[0].max() < 0.003
    assert cloud.intensity is not None and np.abs(cloud.intensity.astype(int) - 32768).max() < 300


def test_poses_of_the_scanner_are_accepted(drive: Drive, tmp_path: Path) -> None:
    given: dict[str, Any] = {"extrinsics": T_CAMERA_SCANNER, "scanner_poses": True}
    for extra in ({}, given):
        path = imported(
            sweeps=drive.folder / "sweeps",
            poses=drive.folder / "scanner.kitti",
            out=tmp_path / "tile",
            overwrite=True,
            **extra,
        )
        tile, _, xyz = cloud_of(path)
        assert walls(xyz)[0].max() < 0.003 and tile.trajectory is not None
        assert np.allclose(tile.frame.to_crs(tile.trajectory.positions), scanner_path(drive.times).positions, atol=1e-5)


def test_points_are_coloured_by_photos_and_photos_are_posed(drive: Drive, tmp_path: Path) -> None:
    tile, cloud, xyz = cloud_of(
        imported(**drive.arguments, out=tmp_path / "tile", photos=drive.photo_inputs, link=True)
    )
    assert cloud.rgb is not None
    off = np.abs(np.concatenate([xyz - LOW, xyz - HIGH], axis=1))
    inner = np.sort(off, axis=1)[:, 1] > 0.5  # away from the edges between walls
    right = (cloud.rgb == PAINT[walls(xyz)[1]]).all(axis=1)
    assert right[inner].mean() > 0.999 and inner.mean() > 0.6
    assert len(tile.views) == SWEEPS and tile.views[2].photo.is_symlink()
    view, pose = tile.views[2], drive.camera.poses[2]
    assert np.allclose(tile.frame.to_crs(view.centre), pose[:3, 3], atol=1e-5)
    assert np.allclose(view.T_world_cam[:3, :3], pose[:3, :3], atol=1e-6) and view.time == pytest.approx(0.3)


def test_photos_are_posed_by_the_calibration_of_another_program(drive: Drive, tmp_path: Path) -> None:
    """Camera and T_lidar_camera of direct_visual_lidar_calibration, with poses of the scanner."""
    T = np.linalg.inv(T_CAMERA_SCANNER)
    pose = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
    lens = {"camera_model": "equirectangular", "intrinsics": [512, 256], "distortion_coeffs": []}
    calib = tmp_path / "calib.json"
    calib.write_text(json.dumps({"camera": lens, "results": {"T_lidar_camera": pose}}), encoding="utf-8")
    words = ["import", "sweeps", drive.folder / "sweeps", drive.folder / "scanner.kitti", "--out", tmp_path / "tile"]
    words += ["--photos", drive.folder / "photos", "--camera", calib, "--extrinsics", calib, "--scanner-poses"]
    result = CliRunner().invoke(app, [*map(str, words), "--pose-source", "given"])
    assert result.exit_code == 0, result.output
    tile, cloud, xyz = cloud_of(tmp_path / "tile")
    right = (present(cloud.rgb) == PAINT[walls(xyz)[1]]).all(axis=1)
    assert right[np.sort(np.abs(np.concatenate([xyz - LOW, xyz - HIGH], axis=1)), axis=1)[:, 1] > 0.5].mean() > 0.99
    assert np.allclose(tile.views[2].T_world_cam[:3, :3], drive.camera.poses[2, :3, :3], atol=1e-6)
    assert np.allclose(tile.frame.to_crs(tile.views[2].centre), drive.camera.positions[2], atol=1e-5)


def test_poses_of_an_imu_place_sweeps_and_the_photos_of_a_rig(drive: Drive, tmp_path: Path) -> None:
    """The extrinsics are T_imu_scanner; `rig.toml` has those of the camera."""
    T_imu_scanner = np.eye(4)
    T_imu_scanner[:3, :3], T_imu_scanner[:3, 3] = Rotation.from_rotvec([0.1, -0.2, 2.0]).as_matrix(), [0.5, -0.2, 0.9]
    poses = scanner_path(drive.times).poses @ np.linalg.inv(T_imu_scanner)
    trajectory_io.write(tmp_path / "imu.csv", Trajectory(drive.times, poses[:, :3, 3], poses[:, :3, :3]))
    np.savetxt(tmp_path / "imu.txt", T_imu_scanner, "%.9f")
    rig = tmp_path / "rig"
    rig.mkdir()
    (rig / "front").symlink_to(drive.folder / "photos")
    write_rig(rig, [RigCamera("front", CAMERA, T_CAMERA_SCANNER)])
    words = ["import", "sweeps", drive.folder / "sweeps", tmp_path / "imu.csv", "--extrinsics", tmp_path / "imu.txt"]
    words += ["--photos", rig, "--pose-source", "given", "--out", tmp_path / "tile"]
    result = CliRunner().invoke(app, [*map(str, words)])
    assert result.exit_code == 0, result.output
    tile, _, xyz = cloud_of(tmp_path / "tile")
    assert walls(xyz)[0].max() < 0.003
    assert np.allclose(tile.frame.to_crs(tile.views[2].centre), drive.camera.positions[2], atol=1e-5)


def test_mask_is_imported_and_masked_pixels_give_no_colour(drive: Drive, tmp_path: Path) -> None:
    mask = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    mask[128:] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    photo_inputs = [PhotoInput(drive.folder / "photos", CAMERA, mask=tmp_path / "mask.png")]
    tile, cloud, xyz = cloud_of(imported(**drive.arguments, out=tmp_path / "tile", photos=photo_inputs))
    assert cloud.rgb is not None and (cloud.rgb[xyz[:, 2] < 0.3] == 128).mean() > 0.8
    assert {view.mask for view in tile.views} == {tile.path.parent / "masks" / "mask.png"}


def test_unsure_sections_are_removed_and_reported(drive: Drive, tmp_path: Path) -> None:
    positions, unsure = drive.camera.positions.copy(), np.zeros(SWEEPS, bool)
    positions[2:4] += [0.7, 0.4, 0.0]
    unsure[2:4] = True
    rotations = drive.camera.rotations
    trajectory_io.write(tmp_path / "lost.csv", Trajectory(drive.times, positions, rotations, unsure))
    notes: list[str] = []
    arguments = drive.arguments | {"poses": tmp_path / "lost.csv", "photos": drive.photo_inputs, "warn": notes.append}
    tile, _, xyz = cloud_of(imported(**arguments, out=tmp_path / "tile"))
    assert len(xyz) == (SWEEPS - 2) * 600 * 24 and walls(xyz)[0].max() < 0.003 and len(tile.views) == SWEEPS - 2
    assert [text.partition(":")[0] for text in notes] == [
        f"2 of 6 {what} are excluded" for what in ("sweeps", "photos")
    ]
    notes.clear()
    tile, _, xyz = cloud_of(imported(**arguments, out=tmp_path / "all", keep_unsure=True))
    assert len(xyz) == SWEEPS * 600 * 24 and walls(xyz)[0].max() > 0.3 and not notes
    trajectory_io.write(tmp_path / "lost.csv", Trajectory(drive.times, positions, rotations, ~np.zeros(SWEEPS, bool)))
    with pytest.raises(DataError, match=r"none of 6 sweeps has a reliable pose.*--keep-unsure"):
        imported(**arguments, out=tmp_path / "none")


def test_times_are_read_from_a_file_or_from_names(drive: Drive, tmp_path: Path) -> None:
    few = tmp_path / "few"
    few.mkdir()
    source = sorted((drive.folder / "sweeps").iterdir())

    def given(names: list[str]) -> Path:
        for old in few.iterdir():
            old.unlink()
        for file, name in zip(source[1:4:2], names, strict=True):
            (few / name).symlink_to(file)
        return few

    arguments = drive.arguments | {"out": tmp_path / "tile", "overwrite": True}
    notes: list[str] = []
    (tmp_path / "times.txt").write_text("0.2\n0.4\n", encoding="utf-8")
    for names, extra in (
        (["1.bin", "3.bin"], {}),  # numbers of frames
        (["0.2.bin", "0.4.bin"], {}),
        (["1700000000200000000.bin", "1700000000400000000.bin"], {"time_offset": -1700000000.0}),
        (["a.bin", "b.bin"], {"times": tmp_path / "times.txt"}),
    ):
        _, _, xyz = cloud_of(imported(**arguments | {"sweeps": given(names), "warn": notes.append} | extra))
        assert len(xyz) == 2 * 600 * 24 and walls(xyz)[0].max() < 0.003, names
    assert not notes
    with pytest.raises(InputError, match=r"few: has 2 sweeps for 6 poses.*Give their times"):
        imported(**arguments | {"sweeps": given(["a.bin", "b.bin"])})
    with pytest.raises(
        InputError, match=r"camera.csv: has times from 0.10 to 0.60 s, the 2 sweeps from 70.20 to 70.40 s.*offset"
    ):
        imported(**arguments | {"sweeps": given(["70.2.bin", "70.4.bin"])})
    imported(**arguments | {"sweeps": given(["0.2.bin", "70.4.bin"]), "warn": notes.append})
    assert notes == ["1 of 2 sweeps are excluded: outside the trajectory's times"]


def test_sweeps_in_trajectory_gaps_are_removed(drive: Drive, tmp_path: Path) -> None:
    t = drive.camera
    late = Trajectory(np.where(t.times > 0.35, t.times + 5, t.times), t.positions, t.rotations)
    trajectory_io.write(tmp_path / "gap.csv", late)
    (tmp_path / "times.txt").write_text("0.1 0.2 0.3 3.0 5.5 5.6".replace(" ", "\n"), encoding="utf-8")
    notes: list[str] = []
    arguments = drive.arguments | {
        "poses": tmp_path / "gap.csv",
        "times": tmp_path / "times.txt",
        "warn": notes.append,
    }
    imported(**arguments, out=tmp_path / "tile")
    assert notes == ["1 of 6 sweeps are excluded: in gaps of the trajectory"]


def test_coordinates_of_a_projected_crs_keep_their_precision(tmp_path: Path) -> None:
    shift = np.array([500_000.0, 5_400_000.0, 200.0])
    drive = make(tmp_path, shift=shift)
    tile, cloud, xyz = cloud_of(imported(**drive.arguments, out=tmp_path / "tile", crs="EPSG:32633"))
    assert tile.frame.crs == "EPSG:32633" and walls(xyz - shift)[0].max() < 0.003 and np.abs(cloud.xyz).max() < 100


def test_thinning_keeps_one_point_per_voxel(drive: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = cloud_of(imported(**drive.arguments, out=tmp_path / "whole"))[2]
    thin = cloud_of(imported(**drive.arguments, out=tmp_path / "thin", voxel=0.37))[2]
    monkeypatch.setattr("scan2sim.pipeline.importers.place_sweeps.MAX_PENDING_POINTS", 20_000)  # thins repeatedly
    often = cloud_of(imported(**drive.arguments, out=tmp_path / "often", voxel=0.37))[2]
    origin = np.floor(drive.camera.positions[0])
    cells = [np.unique(np.floor((xyz - origin) / 0.37), axis=0) for xyz in (whole, thin)]
    assert 0.97 * len(cells[0]) < len(thin) < 1.03 * len(cells[0]) < 0.2 * len(whole) and len(often) == len(thin)


def test_points_outside_the_range_limits_are_removed(drive: Drive, tmp_path: Path) -> None:
    arguments = drive.arguments | {"out": tmp_path / "tile", "overwrite": True}
    with pytest.raises(DataError, match="no points within range"):
        imported(**arguments, max_range=1.5)
    xyz = cloud_of(imported(**arguments, min_range=3.0, max_range=6.0))[2]
    away = np.linalg.norm(xyz[:, None] - scanner_path(drive.times).positions, axis=2)
    assert 2.99 < away.min(axis=1).max() < 6.01


def test_inverted_extrinsics_are_detected(drive: Drive, tmp_path: Path) -> None:
    notes: list[str] = []
    wrong = drive.arguments | {"extrinsics": np.linalg.inv(T_CAMERA_SCANNER)}
    imported(**wrong, out=tmp_path / "tile", warn=notes.append)
    assert any("with `--invert-extrinsics`" in text for text in notes)
    notes.clear()
    right = imported(**wrong, invert_extrinsics=True, out=tmp_path / "right", warn=notes.append)
    expected = cloud_of(imported(**drive.arguments, out=tmp_path / "expected"))[2]
    assert not notes and np.allclose(cloud_of(right)[2], expected, atol=2e-3)


def test_poses_of_the_scanner_that_are_taken_for_the_cameras_are_detected(drive: Drive, tmp_path: Path) -> None:
    notes: list[str] = []
    scanner = drive.arguments | {"poses": drive.folder / "scanner.kitti"}
    imported(**scanner, out=tmp_path / "tile", warn=notes.append)
    assert any("look like the scanner's: with `--scanner-poses`" in text for text in notes)


def test_kitti_camera_2_is_offset_from_camera_0(drive: Drive, tmp_path: Path) -> None:
    """`Tr` is of camera 0; P2 gives camera 2 an offset of 6 cm."""
    K, offset = np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]]), np.array([0.0613, -0.001, 0.003])
    P2 = np.column_stack([K, K @ offset])
    calib = tmp_path / "calib.txt"
    matrices = {"P0": np.eye(3, 4), "P2": P2, "Tr": T_CAMERA_SCANNER[:3]}
    lines = [f"{key}: {' '.join(f'{value:.9e}' for value in matrix.ravel())}\n" for key, matrix in matrices.items()]
    calib.write_text("".join(lines), encoding="utf-8")
    own = tmp_path / "image_2"
    own.mkdir()
    for file in sorted((drive.folder / "photos").iterdir()):
        (own / file.name).symlink_to(file)
    assert photo_extrinsics(calib, drive.folder / "photos") is None
    assert photo_extrinsics(drive.folder / "extrinsics.txt", own) is None
    beside = photo_extrinsics(calib, own)
    centres = []
    for i, extrinsics in enumerate((None, beside)):
        photo_inputs = [PhotoInput(own, CAMERA, extrinsics=extrinsics)]
        tile = read_tile(imported(**drive.arguments, out=tmp_path / str(i), photos=photo_inputs, link=True))
        centres.append((tile.views[0].T_world_cam, tile.views[0].centre))
    moved = centres[0][0][:3, :3].T @ (centres[1][1] - centres[0][1])
    np.testing.assert_allclose(moved, -offset, atol=1e-6)
    calib.write_text(
        "P2: 1 2 3\nTr: " + " ".join(f"{v:.9f}" for v in T_CAMERA_SCANNER[:3].ravel()) + "\n", encoding="utf-8"
    )
    with pytest.raises(InputError, match="no valid `P2`"):
        photo_extrinsics(calib, own)


def garbage(drive: Drive, name: str) -> dict[str, Any]:
    """A drive's arguments with one of its files overwritten."""
    (drive.folder / name).write_bytes(b"nonsense!")
    return drive.arguments | {"photos": drive.photo_inputs}


@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        (lambda d: garbage(d, "sweeps/000002.bin"), InputError, r"000002\.bin: is not a sweep"),
        (
            lambda d: garbage(d, "sweeps/000009.pcd") | {"times": d.folder / "t7.txt"},
            InputError,
            r"000009\.pcd: is not",
        ),
        (lambda d: garbage(d, "photos/000002.png"), InputError, r"000002\.png: can't be read"),
        (lambda d: garbage(d, "camera.csv"), InputError, r"camera\.csv: is not a trajectory"),
        (lambda d: d.arguments | {"poses": d.folder / "flat.csv"}, InputError, r"flat\.csv: has only positions"),
        (lambda d: d.arguments | {"sweeps": d.folder / "photos"}, InputError, r"photos: contains no sweeps.*\.bin"),
        (lambda d: d.arguments | {"sweeps": d.folder / "no"}, InputError, r"no: folder not found"),
        (lambda d: d.arguments | {"times": d.folder / "t7.txt"}, InputError, r"t7\.txt: has 7 times for 6 sweeps"),
        (
            lambda d: d.arguments | {"extrinsics": None, "photos": d.photo_inputs},
            SettingError,
            "photos need the extrinsics",
        ),
        (lambda d: d.arguments | {"crs": "EPSG:4326"}, InputError, "not projected"),
        (lambda d: d.arguments | {"min_range": 60.0}, SettingError, "max_range"),
        (
            lambda d: d.arguments | {"photos": [PhotoInput(d.folder / "photos", Camera("equirectangular", 64, 32))]},
            InputError,
            r"000000\.png: is 512x256, but its calibration is for 64x32",
        ),
    ],
)
def test_invalid_input_is_reported_and_leaves_no_files(
    tmp_path: Path, change: Callable[[Drive], dict[str, Any]], kind: type[ScanError], message: str
) -> None:
    drive = make(tmp_path / "drive")
    (drive.folder / "t7.txt").write_text("\n".join(f"{0.1 + 0.08 * i:.2f}" for i in range(7)), encoding="utf-8")
    (drive.folder / "flat.csv").write_text("time,x,y,z\n0,0,0,0\n1,1,0,0\n", encoding="utf-8")
    with pytest.raises(kind, match=message):
        imported(**change(drive), out=tmp_path / "tile")
    assert [p.name for p in tmp_path.iterdir()] == ["drive"]


def test_colours_of_a_sweep_are_kept_without_photos(tmp_path: Path) -> None:
    xyz = np.random.default_rng(0).uniform(2, 5, (50, 3)).astype(np.float32)
    rgb = np.tile(np.array([10, 20, 30], np.uint8), (50, 1))
    las.write(tmp_path / "a.laz", PointCloud(Frame(), xyz, rgb))
    assert np.array_equal(present(read_sweep(tmp_path / "a.laz")[2]), rgb)
    (tmp_path / "poses.tum").write_text("0 0 0 0 0 0 0 1\n", encoding="utf-8")
    cloud = cloud_of(imported(sweeps=tmp_path / "a.laz", poses=tmp_path / "poses.tum", out=tmp_path / "tile"))[1]
    assert cloud.rgb is not None and (cloud.rgb == [10, 20, 30]).all()


def test_command_imports_sweeps_and_reports_excluded_ones(drive: Drive, tmp_path: Path) -> None:
    folder, out = drive.folder, tmp_path / "tile"
    result = CliRunner().invoke(
        app,
        f"import sweeps {folder}/sweeps {folder}/camera.csv --out {out} --extrinsics {folder}/extrinsics.txt "
        f"--photos {folder}/photos --time-offset -0.15 --max-range 20 --voxel 0.1 --name hall",
    )
    assert result.exit_code == 0, result.output
    assert "1 of 6 sweeps are excluded: outside the trajectory's times" in result.output
    assert read_tile(out).name == "hall" and len(read_tile(out).views) == SWEEPS - 1


def test_long_recordings_are_split_into_several_clouds(
    drive: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = cloud_of(imported(**drive.arguments, out=tmp_path / "whole", photos=drive.photo_inputs))[1]
    monkeypatch.setattr("scan2sim.pipeline.importers.place_sweeps.MAX_PENDING_POINTS", 20_000)
    tile = read_tile(imported(**drive.arguments, out=tmp_path / "blocks", photos=drive.photo_inputs))
    parts = [clouds.read(path, tile.frame) for path in tile.clouds]
    assert len(parts) > 2 and max(map(len, parts)) < 40_000
    joined = PointCloud.join(parts)
    assert np.array_equal(joined.xyz, whole.xyz) and np.array_equal(present(joined.time), present(whole.time))
    assert (present(joined.rgb) == present(whole.rgb)).all(axis=1).mean() > 0.95

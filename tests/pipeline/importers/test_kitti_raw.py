"""KITTI raw drives: a synthetic drive with known geometry, and a real one if available."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from pyproj import Geod, Transformer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.flows.pipelines.kitti import import_kitti_raw
from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import UNCOLOURED as GREY
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.tile import read_tile

pytestmark = pytest.mark.usefixtures("steps_in_process")

FRAMES, PERIOD, SPEED, LATE = 4, 0.1, 11.0, 0.01
YAW = 0.4  # against true east
CRS = "EPSG:32632"
WIDTH, HEIGHT = 600, 300


@dataclass
class Drive:
    folder: Path
    world: np.ndarray  # (N, 3) points, UTM
    rgb: np.ndarray  # (N, 3) colours of the points
    T_velo: np.ndarray  # (F, 4, 4) scanner to UTM at each sweep's time stamp
    pixels: np.ndarray  # (N, 2) of the first sweep's points by KITTI's own formula


def rigid(turn: Rotation, shift: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), shift
    return T


def text(*rows: tuple[str, np.ndarray]) -> str:
    return "calib_time: 09-Jan-2012 13:57:47\n" + "".join(
        f"{key}: {' '.join(f'{v:.12e}' for v in np.ravel(values))}\n" for key, values in rows
    )


def stamp(seconds: float) -> str:
    return f"2011-09-26 13:08:{24 + seconds:012.9f}"


@pytest.fixture
def drive(tmp_path: Path) -> Drive:
    return make_drive(tmp_path)


def make_drive(tmp_path: Path) -> Drive:
    """A car at 11 m/s past a wall of coloured dots, turned by `YAW`; OXTS packets come 10 ms late."""
    axes = Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    T_velo_imu = rigid(Rotation.from_rotvec([0.01, -0.02, 0.005]), [-0.81, 0.32, -0.8])
    T_cam_velo = rigid(Rotation.from_rotvec([0.01, 0.02, -0.01]) * axes, [0.0, -0.08, -0.27])
    rectify = Rotation.from_rotvec([-0.005, 0.01, 0.003])
    P = np.array([[400, 0, 300.5, 24.0], [0, 400, 150.5, 0.2], [0, 0, 1, 0.003]])

    geod, to_utm = Geod(ellps="WGS84"), Transformer.from_crs("EPSG:4326", CRS, always_xy=True)

    def place(seconds: float) -> tuple[float, float]:
        return geod.fwd(11.5, 49.0, 90 - np.degrees(YAW), SPEED * seconds)[:2]

    def utm(seconds: float) -> np.ndarray:
        return np.array([*to_utm.transform(*place(seconds)), 114.0])

    way = utm(1.0) - utm(0.0)  # grid heading along the path
    heading = Rotation.from_euler("z", np.arctan2(way[1], way[0]))

    def velo(seconds: float) -> np.ndarray:
        return rigid(heading, utm(seconds).tolist()) @ np.linalg.inv(T_velo_imu)

    times = 1.0 + PERIOD * np.arange(FRAMES)
    T_velo = np.stack([velo(t) for t in times])
    y, z = np.meshgrid(np.linspace(-5, 5, 9), np.linspace(-1.5, 2, 5))
    ahead = np.stack([np.full(y.size, 16.0), y.ravel(), z.ravel()], axis=1)
    behind = ahead[:5] * [-1, 1, 1]
    world = np.concatenate([ahead, behind]) @ T_velo[0, :3, :3].T + T_velo[0, :3, 3]
    rgb = np.random.default_rng(0).integers(0, 250, (len(world), 3))

    day = tmp_path / "2011_09_26"
    folder = day / "2011_09_26_drive_0001_sync"
    for name in ("velodyne_points", "image_02", "oxts"):
        (folder / name / "data").mkdir(parents=True)
    (day / "calib_imu_to_velo.txt").write_text(
        text(("R", T_velo_imu[:3, :3]), ("T", T_velo_imu[:3, 3])), encoding="utf-8"
    )
    (day / "calib_velo_to_cam.txt").write_text(
        text(("R", T_cam_velo[:3, :3]), ("T", T_cam_velo[:3, 3])), encoding="utf-8"
    )
    (day / "calib_cam_to_cam.txt").write_text(
        text(("R_rect_00", rectify.as_matrix()), ("S_rect_02", np.array([WIDTH, HEIGHT])), ("P_rect_02", P)),
        encoding="utf-8",
    )
    for name, shift in (("timestamps_start", -PERIOD / 2), ("timestamps", 0.0), ("timestamps_end", PERIOD / 2)):
        (folder / "velodyne_points" / f"{name}.txt").write_text(
            "\n".join(stamp(t + shift) for t in times), encoding="utf-8"
        )
    (folder / "oxts" / "timestamps.txt").write_text("\n".join(stamp(t + LATE) for t in times), encoding="utf-8")
    pixels = np.empty((0, 2))
    for i, t in enumerate(times):
        lon, lat = place(t + LATE)
        record = f"{lat:.14f} {lon:.14f} 114.0 0 0 {YAW}" + " 0" * 24
        (folder / "oxts" / "data" / f"{i:010d}.txt").write_text(record, encoding="utf-8")
        seen = np.empty_like(world)
        for k, point in enumerate(world):
            when = t
            for _ in range(10):  # a beam's time depends on its azimuth, and vice versa
                T = velo(when)
                seen[k] = (point - T[:3, 3]) @ T[:3, :3]
                when = t - PERIOD * np.arctan2(seen[k, 1], seen[k, 0]) / (2 * np.pi)
        sweep = np.column_stack([seen, np.full(len(seen), 0.5)])
        own_car = [[1.0, 0.2, -0.5, 0.1]]
        np.concatenate([sweep, own_car]).astype(np.float32).tofile(
            folder / "velodyne_points" / "data" / f"{i:010d}.bin"
        )
        still = (world - T_velo[i, :3, 3]) @ T_velo[i, :3, :3]
        local = still @ T_cam_velo[:3, :3].T + T_cam_velo[:3, 3]
        uvw = np.column_stack([local @ rectify.as_matrix().T, np.ones(len(local))]) @ P.T
        uv = uvw[:, :2] / uvw[:, 2:]
        pixels = uv if i == 0 else pixels
        image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
        for (u, v), depth, colour in zip(uv, uvw[:, 2], rgb.tolist(), strict=True):
            if depth > 0:
                cv2.circle(image, (round(u), round(v)), 4, colour[::-1], -1)
        cv2.imwrite(str(folder / "image_02" / "data" / f"{i:010d}.png"), image)
    return Drive(folder, world, rgb, T_velo, pixels)


def test_points_and_photos_are_at_their_true_positions(drive: Drive, tmp_path: Path) -> None:
    tile = read_tile(import_kitti_raw(drive.folder, tmp_path / "tile"))
    assert tile.frame.crs == CRS
    cloud = clouds.read(tile.clouds[0], tile.frame)
    xyz = tile.frame.to_crs(cloud.xyz).reshape(FRAMES, -1, 3)
    assert xyz.shape[1] == len(drive.world)  # returns from the car itself are removed
    assert np.abs(xyz - drive.world).max() < 0.005
    assert tile.trajectory is not None
    assert np.abs(tile.frame.to_crs(tile.trajectory.positions) - drive.T_velo[:, :3, 3]).max() < 0.005
    view = tile.views[0]
    uv, _ = project(view.camera, (tile.frame.to_local(drive.world) - view.centre) @ view.T_world_cam[:3, :3])
    assert np.abs(uv - drive.pixels)[:45].max() < 0.1
    assert view.time is not None and cloud.time is not None
    assert abs(np.median(cloud.time[: len(drive.world)]) - view.time) < PERIOD / 2


def test_points_get_the_colour_of_their_own_photo_and_others_are_grey(drive: Drive, tmp_path: Path) -> None:
    tile = read_tile(import_kitti_raw(drive.folder, tmp_path / "tile", frames=(0, 0)))
    cloud = clouds.read(tile.clouds[0], tile.frame)
    inside = np.all((drive.pixels > 5) & (drive.pixels < [WIDTH - 5, HEIGHT - 5]), axis=1)
    inside[45:] = False
    assert inside.sum() > 30 and cloud.rgb is not None
    assert np.array_equal(cloud.rgb[inside], drive.rgb[inside])
    assert (cloud.rgb[45:] == GREY).all()


def test_points_are_smeared_without_motion_compensation(drive: Drive, tmp_path: Path) -> None:
    tile = read_tile(import_kitti_raw(drive.folder, tmp_path / "tile", deskew=False))
    xyz = tile.frame.to_crs(clouds.read(tile.clouds[0], tile.frame).xyz).reshape(FRAMES, -1, 3)
    assert np.abs(xyz - drive.world).max() > 0.3


def test_pose_file_gives_the_same_points(drive: Drive, tmp_path: Path) -> None:
    relative = np.linalg.inv(drive.T_velo[0]) @ drive.T_velo
    np.savetxt(tmp_path / "poses.txt", relative[:, :3].reshape(FRAMES, 12))
    tile = read_tile(import_kitti_raw(drive.folder.parent, tmp_path / "tile", poses=tmp_path / "poses.txt", link=True))
    xyz = tile.frame.to_crs(clouds.read(tile.clouds[0], tile.frame).xyz).reshape(FRAMES, -1, 3)
    assert np.abs(xyz - drive.world).max() < 0.005
    assert tile.views[0].photo.is_symlink() and cv2.imread(str(tile.views[0].photo)) is not None


def test_pose_file_without_oxts_gives_a_local_tile(drive: Drive, tmp_path: Path) -> None:
    (drive.folder / "oxts").rename(tmp_path / "away")
    with pytest.raises(InputError, match=r"oxts: folder not found, and no pose file is given.*give poses"):
        import_kitti_raw(drive.folder, tmp_path / "tile")
    np.savetxt(tmp_path / "poses.txt", (np.linalg.inv(drive.T_velo[0]) @ drive.T_velo)[:, :3].reshape(FRAMES, 12))
    tile = read_tile(import_kitti_raw(drive.folder, tmp_path / "tile", poses=tmp_path / "poses.txt"))
    assert tile.frame.crs == "local"
    assert np.abs(tile.frame.to_crs(clouds.read(tile.clouds[0], tile.frame).xyz)[0] - [16, -5, -1.5]).max() < 0.005


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        ("velodyne_points/data/0000000001.bin", r"0000000001\.bin: is not a sweep.*Copy it again"),
        ("image_02/data/0000000002.png", r"0000000002\.png: can't be read.*Copy it again"),
        ("oxts/data/0000000003.txt", r"0000000003\.txt: is not an OXTS record.*or give poses"),
        ("velodyne_points/timestamps.txt", r"timestamps\.txt: line 1 is not a time stamp.*exclude that frame"),
        ("../calib_velo_to_cam.txt", r"calib_velo_to_cam\.txt: has no `R` with 9 numbers.*calibration again"),
    ],
)
def test_damaged_files_are_reported_and_leave_no_tile(drive: Drive, tmp_path: Path, harm: str, message: str) -> None:
    (drive.folder / harm).write_bytes(b"x\ny")
    with pytest.raises(InputError, match=message):
        import_kitti_raw(drive.folder, tmp_path / "tile")
    assert not (tmp_path / "tile").exists() and not list(tmp_path.glob(".tile*"))


def test_short_pose_file_missing_drive_and_existing_output_are_rejected(drive: Drive, tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"poses\.txt: has 1 poses, but sweep 3"):
        import_kitti_raw(drive.folder, tmp_path / "tile", poses=tmp_path / "poses.txt")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty: contains no KITTI raw drive.*_sync"):
        import_kitti_raw(tmp_path / "empty", tmp_path / "tile")
    (tmp_path / "tile").mkdir()
    (tmp_path / "tile" / "mine.txt").write_text("keep", encoding="utf-8")
    with pytest.raises(SettingError, match=r"tile: exists and is not empty.*--overwrite"):
        import_kitti_raw(drive.folder, tmp_path / "tile")
    assert (tmp_path / "tile" / "mine.txt").read_text(encoding="utf-8") == "keep"


def test_depth_discontinuities_project_onto_image_edges_of_a_real_drive(real_data: Path, tmp_path: Path) -> None:
    """Depth discontinuities of a sweep project onto edges of its photo; moving the camera reduces the contrast."""
    source = real_data / "kitti_raw0009_f00-24"
    poses = source / "T_velo0_velo_icp_frames_0-24.txt"
    tile = read_tile(import_kitti_raw(source, tmp_path / "tile", poses=poses, frames=(8, 12)))
    cloud = clouds.read(tile.clouds[0], tile.frame)
    assert tile.frame.crs == "EPSG:32632" and len(tile.views) == 5 and len(cloud) > 300_000
    view = tile.views[2]
    grey = cv2.GaussianBlur(cv2.imread(str(view.photo), cv2.IMREAD_GRAYSCALE), (0, 0), 1)
    edges = np.minimum(np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0)), 200)
    assert cloud.time is not None and view.time is not None
    xyz = cloud.xyz[np.abs(cloud.time - view.time) < 0.05]
    distance = np.linalg.norm(xyz - view.centre, axis=1)
    jump = np.diff(distance)  # points of a ring follow each other
    near = np.linalg.norm(np.diff(xyz, axis=0), axis=1) < 10
    end = np.zeros(len(xyz), bool)
    end[:-1] |= near & (jump > 1)
    end[1:] |= near & (jump < -1)
    end &= (distance < 30) & (distance > 4)

    def sharpness(sideways: float) -> float:
        local = (xyz[end] - view.centre) @ view.T_world_cam[:3, :3] + [sideways, 0, 0]
        uv, ok = project(view.camera, local)
        u, v = np.round(uv[ok & (local[:, 2] > 1)]).astype(int).T
        inside = (u >= 0) & (u < view.camera.width) & (v >= 0) & (v < view.camera.height)
        return float(edges[v[inside], u[inside]].mean())

    assert sharpness(0.0) > 1.15 * max(sharpness(-0.3), sharpness(0.3))


def test_pose_check_is_cached_until_the_poses_change(drive: Drive, tmp_path: Path) -> None:
    def imported() -> list[Path]:
        command = f"import kitti-raw {drive.folder.parent} --out {tmp_path}/tile --overwrite"
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 0 and "Poses as given" in result.output, result.output
        return sorted(tmp_path.glob("tile-path/steps/adjust_kitti/*/manifest.json"))

    (first,) = imported()
    written = first.stat().st_mtime_ns
    assert imported() == [first] and first.stat().st_mtime_ns == written
    oxts = next((drive.folder / "oxts" / "data").glob("*.txt"))
    oxts.write_text(oxts.read_text().replace(" ", "  ", 1))
    assert imported() != [first]

"""KITTI odometry: a synthetic sequence with known geometry, and a real one if available."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.flows.pipelines.kitti import import_kitti_odometry
from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.types import UNCOLOURED as GREY
from scan2sim.pipeline.importers.kitti_raw import raise_beams
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.tile import read_tile
from tests.present import present

pytestmark = pytest.mark.usefixtures("steps_in_process")

FRAMES, WIDTH, HEIGHT = 4, 600, 300
AXES = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])  # scanner to camera
P2 = np.array([[400, 0, 300.5, 24.0], [0, 400, 150.5, 0.2], [0, 0, 1, 0.003]])


def rigid(turn: np.ndarray, shift: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn, shift
    return T


TR = rigid(Rotation.from_rotvec([0.01, 0.02, -0.01]).as_matrix() @ AXES, [0.0, -0.08, -0.27])


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    return make_sequence(tmp_path)


def make_sequence(tmp_path: Path) -> Path:
    """A car drives a curve past a wall of dots of different colours; files in the layout of the data set."""
    folder = tmp_path / "sequences" / "31"
    for name in ("velodyne", "image_2"):
        (folder / name).mkdir(parents=True)
    (tmp_path / "poses").mkdir()
    y, z = np.meshgrid(np.linspace(-5, 5, 9), np.linspace(-1.5, 2, 5))
    wall = np.stack([np.full(y.size, 16.0), y.ravel(), z.ravel()], axis=1)  # axes of the first sweep
    np.save(tmp_path / "wall.npy", wall)
    poses, pixels = [], []
    for i in range(FRAMES):
        T_velo = rigid(Rotation.from_euler("z", 0.05 * i).as_matrix(), [1.0 * i, 0.1 * i, 0.0])
        poses.append((TR @ T_velo @ np.linalg.inv(TR))[:3].ravel())
        local = (wall - T_velo[:3, 3]) @ T_velo[:3, :3]
        own_car = [[1.0, 0.2, -0.5]]
        sweep = np.column_stack([np.concatenate([local, own_car]), np.full(len(local) + 1, 0.5)])
        sweep.astype(np.float32).tofile(folder / "velodyne" / f"{i:06d}.bin")
        uvw = np.column_stack([local @ TR[:3, :3].T + TR[:3, 3], np.ones(len(local))]) @ P2.T
        pixels.append(uvw[:, :2] / uvw[:, 2:])
        image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
        for k, (u, v) in enumerate(pixels[-1]):
            cv2.circle(image, (round(u), round(v)), 4, (k, 2 * k, 100), -1)
        cv2.imwrite(str(folder / "image_2" / f"{i:06d}.png"), image)
    np.save(tmp_path / "pixels.npy", pixels)
    np.savetxt(tmp_path / "poses" / "31.txt", poses, "%.9e")
    np.savetxt(folder / "times.txt", 0.1 * np.arange(FRAMES), "%.6e")
    rows = {"P0": P2, "P2": P2, "Tr": TR[:3]}
    (folder / "calib.txt").write_text(
        "".join(f"{key}: {' '.join(f'{v:.12e}' for v in value.ravel())}\n" for key, value in rows.items()),
        encoding="utf-8",
    )
    return folder


def test_sweeps_coincide_and_project_onto_their_pixels(sequence: Path, tmp_path: Path) -> None:
    tile = read_tile(import_kitti_odometry(sequence, tmp_path / "tile"))
    cloud = clouds.read(tile.clouds[0], tile.frame)
    wall, pixels = np.load(tmp_path / "wall.npy"), np.load(tmp_path / "pixels.npy")
    xyz = tile.frame.to_crs(cloud.xyz).reshape(FRAMES, len(wall), 3)  # the return from the car itself is removed
    assert np.abs(xyz - wall).max() < 2e-3
    assert cloud.rgb is not None and (cloud.rgb.reshape(FRAMES, -1, 3)[..., 0] == 100).all() and GREY != 100
    assert [view.time for view in tile.views] == pytest.approx([0, 0.1, 0.2, 0.3])
    for view, expected in zip(tile.views, pixels, strict=True):
        uv, _ = project(view.camera, (tile.frame.to_local(wall) - view.centre) @ view.T_world_cam[:3, :3])
        assert np.abs(uv - expected).max() < 0.01  # the files have ten digits


def test_labels_of_semantic_kitti_become_classes(sequence: Path, tmp_path: Path) -> None:
    wall = np.load(tmp_path / "wall.npy")
    ids = np.resize([40, 50, 71, 10, 81, 259, 99, 0], len(wall))
    expected = np.array([11, 6, 5, 66, 64, 66, 1, 1], np.uint8)[np.arange(len(wall)) % 8]
    (sequence / "labels").mkdir()
    for i in range(FRAMES):  # the last point is the own car; instances are in the upper half
        labels = np.append(ids, 252).astype(np.uint32) + (np.uint32(7 + i) << np.uint32(16))
        labels.tofile(sequence / "labels" / f"{i:06d}.label")
    warned: list[str] = []
    tile = read_tile(import_kitti_odometry(sequence, tmp_path / "plain", pose_source="given", warn=warned.append))
    assert not present(clouds.read(tile.clouds[0], tile.frame).classification).any()
    assert any("labels of SemanticKITTI aren't used; --labels" in one for one in warned)
    options = ["--labels", str(sequence / "labels"), "-o", str(tmp_path / "tile"), "--pose-source", "given"]
    assert CliRunner().invoke(app, ["import", "kitti-odometry", str(sequence), *options]).exit_code == 0
    tile = read_tile(tmp_path / "tile")
    cloud = clouds.read(tile.clouds[0], tile.frame)
    codes = clouds.code_table(tile.clouds[0], tile.classes)[present(cloud.classification)]
    assert (codes.reshape(FRAMES, -1) == expected).all()


def test_labels_of_other_sweeps_are_rejected(sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "labels").mkdir()
    np.zeros(7, np.uint32).tofile(tmp_path / "labels" / "000002.label")
    warned: list[str] = []
    with pytest.raises(InputError, match=r"000002\.label: has 7 labels for a sweep of 46 points"):
        import_kitti_odometry(
            sequence, tmp_path / "tile", labels=tmp_path / "labels", pose_source="given", warn=warned.append
        )
    assert any("no labels of 3 sweeps, such as 0" in one for one in warned)
    with pytest.raises(InputError, match=r"contains no numbered \.label files"):
        import_kitti_odometry(sequence, tmp_path / "tile", labels=sequence / "velodyne", pose_source="given")


def test_beam_angles_are_corrected(sequence: Path, tmp_path: Path) -> None:
    """A scanner whose beams point half a degree higher than its calibration says: 14 cm at 16 m."""
    for file in (sequence / "velodyne").iterdir():
        sweep = np.fromfile(file, np.float32).reshape(-1, 4)
        sweep[:, :3] = raise_beams(sweep[:, :3], -0.5)
        sweep.tofile(file)
    wall, found = np.load(tmp_path / "wall.npy"), {}
    for offset in ("0", "0.5"):
        options = ["--vertical-angle-offset", offset, "-o", str(tmp_path / offset), "--pose-source", "given"]
        assert CliRunner().invoke(app, ["import", "kitti-odometry", str(sequence), *options]).exit_code == 0
        tile = read_tile(tmp_path / offset)
        xyz = tile.frame.to_crs(clouds.read(tile.clouds[0], tile.frame).xyz).reshape(FRAMES, len(wall), 3)
        found[offset] = np.linalg.norm(xyz - wall, axis=2).max()
    assert found["0"] > 0.1 and found["0.5"] < 2e-3


def test_command_accepts_a_pose_file(sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "poses" / "31.txt").rename(tmp_path / "mine.txt")
    options = ["import", "kitti-odometry", str(sequence), "-o", str(tmp_path / "tile")]
    refused = CliRunner().invoke(app, options)
    assert isinstance(refused.exception, InputError) and "poses.txt" in str(refused.exception)
    done = CliRunner().invoke(app, [*options, "--poses", str(tmp_path / "mine.txt")])
    assert done.exit_code == 0 and len(read_tile(tmp_path / "tile").views) == FRAMES


@pytest.mark.parametrize(
    ("file", "body", "cause"),
    [
        ("calib.txt", "P2: 1 2 3\n", "has no `Tr` with 12 numbers"),
        ("times.txt", "0\n1\n", "has 2 times, but sweep 3"),
        ("times.txt", "0\n1\n1\n2\n", "are not ascending"),
        ("times.txt", "none\n", "is not a list of times"),
        ("poses.txt", "1 2 3\n", "is not a pose file"),
        ("velodyne/000001.bin", "12345", "is not a sweep"),
    ],
)
def test_damaged_sequence_is_rejected(sequence: Path, tmp_path: Path, file: str, body: str, cause: str) -> None:
    (sequence / file).write_text(body, encoding="utf-8")
    with pytest.raises(InputError, match=cause):
        import_kitti_odometry(sequence, tmp_path / "tile")
    assert not (tmp_path / "tile").exists()


def test_range_without_points_is_an_error(sequence: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="velodyne: has no points within range"):
        import_kitti_odometry(sequence, tmp_path / "tile", max_range=0.1)
    assert not (tmp_path / "tile").exists()


def test_times_file_that_is_a_pipe_is_rejected(sequence: Path, tmp_path: Path) -> None:
    (sequence / "times.txt").unlink()
    os.mkfifo(sequence / "times.txt")
    with pytest.raises(InputError, match="is a pipe"):
        import_kitti_odometry(sequence, tmp_path / "tile")


def test_sweeps_of_a_real_sequence_coincide(real_data: Path, tmp_path: Path) -> None:
    """Static surfaces are at the same positions in sweeps from different locations: the first and last one overlap."""
    source = real_data / "kitti_odo04_f00-24"
    tile = read_tile(import_kitti_odometry(source, tmp_path / "tile", frames=(0, 8), max_range=30.0))
    cloud = clouds.read(tile.clouds[0], tile.frame)
    assert tile.frame.crs == "local" and len(tile.views) == 9 and len(cloud) > 500_000
    assert cloud.time is not None and cloud.rgb is not None
    path = np.array([view.centre for view in tile.views])
    assert path[-1, 0] - path[0, 0] > 9 and np.ptp(path[:, 2]) < 0.5  # ahead is +x, and the road is level
    first, last = (cloud.xyz[cloud.time == t] for t in (cloud.time.min(), cloud.time.max()))
    first = first[(first[:, 2] > np.percentile(cloud.xyz[:, 2], 5) + 0.5)]  # rings on the road differ

    def gap(shift: float) -> float:
        return float(
            np.median(cKDTree(last + [shift, 0, 0]).query(first[::5], distance_upper_bound=1.0)[0].clip(max=1))
        )

    assert gap(0.0) < 0.8 * min(gap(-0.5), gap(0.5))
    coloured = (cloud.rgb != GREY).any(axis=1)
    assert coloured.mean() > 0.2

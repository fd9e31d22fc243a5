"""Output of SLAM: all trajectory files, and a COLMAP model that agrees with pycolmap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.camera.models import inside, project
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import Camera, Frame, Trajectory
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.colmap_writer import SparseMap
from scan2sim.pipeline.io.colmap_writer import write as write_colmap
from scan2sim.pipeline.io.photogrammetry.colmap import camera_of
from scan2sim.slam.trajectory.output import write

UTM = Frame("EPSG:32633", (500_000.0, 5_400_000.0, 200.0))
CAMERAS = {
    "PINHOLE": Camera("pinhole", 640, 480, 400.0, 410.0, 319.5, 239.5),
    "OPENCV": Camera("opencv", 640, 480, 400.0, 410.0, 322.0, 238.0, (-0.1, 0.02, 1e-3, -2e-3)),
    "FULL_OPENCV": Camera("opencv", 640, 480, 400.0, 410.0, 322.0, 238.0, (-0.1, 0.02, 1e-3, -2e-3, 0.01)),
    "OPENCV_FISHEYE": Camera("fisheye", 640, 640, 200.0, 201.0, 320.0, 319.0, (0.01, -0.002, 1e-4, 0.0)),
    "EQUIRECTANGULAR": Camera("equirectangular", 1024, 512),
}


def drive(camera: Camera) -> tuple[Trajectory, list[str], SparseMap]:
    """Five poses that look north, and their observations of 60 points around them."""
    random = np.random.default_rng(4)
    north = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    rotations = Rotation.from_rotvec(random.normal(0, 0.1, (5, 3))).as_matrix() @ north
    path = Trajectory(np.arange(5.0), np.column_stack([np.zeros(5), 2.0 * np.arange(5), np.full(5, 1.5)]), rotations)
    xyz = random.uniform([-15, -5, -1], [15, 40, 9], (60, 3))
    points, frames, pixels = [], [], []
    for f, pose in enumerate(path.poses):
        ahead = (xyz - pose[:3, 3]) @ pose[:3, :3]
        uv, valid = project(camera, ahead)
        valid &= (ahead[:, 2] > 0.1) | (camera.model == "equirectangular")  # limit of COLMAP's fisheye model
        seen = np.flatnonzero(valid & inside(camera, uv))
        points.append(seen)
        frames.append(np.full(len(seen), f))
        pixels.append(uv[seen])
    shuffled = random.permutation(sum(map(len, points)))
    columns = (np.concatenate(part)[shuffled] for part in (points, frames, pixels))
    point, frame, uv = columns
    rgb = random.integers(0, 255, (60, 3), dtype=np.uint8)
    names = [f"frames/{i:04d}.jpg" for i in range(5)]
    return path, names, SparseMap(xyz, point.astype(np.int32), frame.astype(np.int32), uv.astype(np.float64), rgb)


@pytest.mark.parametrize("model", CAMERAS)
def test_colmap_agrees_with_the_model(tmp_path: Path, model: str) -> None:
    camera = CAMERAS[model]
    path, names, sparse = drive(camera)
    write_colmap(tmp_path, path, camera, names, sparse)
    found = pycolmap.Reconstruction(tmp_path)
    assert (found.num_images(), found.num_points3D()) == (5, 60)
    assert found.cameras[1].model_name == model
    back = camera_of(tmp_path, found.cameras[1])
    assert (back.fx, back.cx, back.cy) == pytest.approx((camera.fx, camera.cx, camera.cy), abs=1e-9)
    errors = []
    for i, pose in enumerate(path.poses):
        image = found.images[i + 1]
        assert image.name == names[i] and np.allclose(image.projection_center(), pose[:3, 3])
        for point in image.points2D:
            assert point.has_point3D()
            errors.append(image.project_point(found.points3D[point.point3D_id].xyz) - point.xy)
    assert len(errors) == len(sparse.point) > 30 and np.abs(errors).max() < 2e-3
    lengths = np.bincount(sparse.point, minlength=60)
    stored = np.array([found.points3D[i + 1].error for i in range(60)])
    found.update_point_3d_errors()
    recomputed = np.array([found.points3D[i + 1].error for i in range(60)])
    assert np.abs(stored - recomputed)[lengths > 0].max() < 2e-3 and (stored[lengths == 0] == -1).all()
    assert [found.points3D[i + 1].track.length() for i in range(60)] == lengths.tolist()
    assert sparse.rgb is not None and (found.points3D[7].color == sparse.rgb[6]).all()


def test_model_contains_reprojection_errors_per_point(tmp_path: Path) -> None:
    camera = CAMERAS["EQUIRECTANGULAR"]
    path, names, sparse = drive(camera)
    sparse.uv[:, 0] = (sparse.uv[:, 0] + 3) % camera.width  # over the seam, too
    write_colmap(tmp_path, path, camera, names, sparse)
    found = pycolmap.Reconstruction(tmp_path)
    assert np.allclose([point.error for point in found.points3D.values()], 3, atol=1e-3)


def test_output_folder_contains_all_files(tmp_path: Path) -> None:
    path, names, sparse = drive(CAMERAS["PINHOLE"])
    files = write(tmp_path / "out", path, UTM, camera=CAMERAS["PINHOLE"], names=names, sparse=sparse)
    assert [f.relative_to(tmp_path / "out").as_posix() for f in files] == [
        "trajectory.csv", "trajectory.tum", "trajectory.kitti", "trajectory.geojson",
        "colmap/cameras.txt", "colmap/images.txt", "colmap/points3D.txt",
    ]  # fmt: skip
    assert all(f.is_file() for f in files) and len(list((tmp_path / "out").rglob("*"))) == len(files) + 1
    assert np.allclose(trajectory_io.read(files[0], UTM).positions, path.positions)
    assert "500000 5400000 200 in EPSG:32633" in files[4].read_text(encoding="utf-8")


def test_unknown_values_are_not_written(tmp_path: Path) -> None:
    path, names, _ = drive(CAMERAS["PINHOLE"])
    assert [f.name for f in write(tmp_path / "a", path)] == [f"trajectory{s}" for s in (".csv", ".tum", ".kitti")]
    bare = Trajectory(path.times, path.positions)
    assert [f.name for f in write(tmp_path / "b", bare)] == ["trajectory.csv"]
    write(tmp_path / "c", path, camera=CAMERAS["PINHOLE"], names=names)
    assert pycolmap.Reconstruction(tmp_path / "c" / "colmap").num_images() == 5


def test_inconsistent_parts_are_rejected(tmp_path: Path) -> None:
    camera = CAMERAS["PINHOLE"]
    path, names, sparse = drive(camera)
    sparse.point[0] = 60
    for wrong, message in (
        (names[:4], "4 names for 5 poses"),
        (["a"] * 5, "1 names"),
        (["a b", *names[1:]], "contains spaces"),
    ):
        with pytest.raises(DataError, match=message):
            write_colmap(tmp_path, path, camera, wrong)
    with pytest.raises(DataError, match=r"don't exist"):
        write_colmap(tmp_path, path, camera, names, sparse)
    with pytest.raises(DataError, match=r"no rotations"):
        write_colmap(tmp_path, Trajectory(path.times, path.positions), camera, names)
    assert not list(tmp_path.iterdir())

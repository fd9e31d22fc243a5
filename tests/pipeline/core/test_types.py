"""Data types: lossless saving and loading, coordinates with a precision of millimetres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.types import Camera, Frame, Mesh, PointCloud, Trajectory, View
from scan2sim.pipeline.io import views
from scan2sim.pipeline.tiling.borders.clip import Clipped

FRAME = Frame("EPSG:2154", (770500.0, 6277550.0, 20.0))


def test_frame_round_trip_in_feet() -> None:
    frame = Frame("local", (100.0, 200.0, 3.0), 0.3048)
    feet = np.array([[636001.76, 848935.20, 406.26]])
    assert np.abs(frame.to_crs(frame.to_local(feet)) - feet).max() < 1e-8
    assert np.allclose(frame.to_local([[0, 0, 0]]), [[-100, -200, -3]])


def test_save_and_load_round_trip(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    cloud = PointCloud(
        FRAME, random.random((5, 3), np.float32), time=random.random(5), classification=np.arange(5, dtype=np.uint8)
    )
    cloud.save(tmp_path / "c.npz")
    back = PointCloud.load(tmp_path / "c.npz")
    assert back.frame == FRAME and back.rgb is None
    assert back.time is not None and cloud.time is not None and (back.time == cloud.time).all()
    path = Trajectory(np.arange(3.0), random.random((3, 3)))
    path.save(tmp_path / "t.npz")
    assert np.allclose(Trajectory.load(tmp_path / "t.npz").at(np.array([0.5])), path.positions[:2].mean(axis=0))


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64])
def test_numpy_scalars_are_saved_and_loaded(tmp_path: Path, kind: type) -> None:
    x, y, z = np.array([770500, 6277550, 20]).astype(kind)
    frame = Frame("EPSG:2154", (x, y, z), kind(1))
    assert frame == FRAME
    points, faces = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32)
    PointCloud(frame, points).save(tmp_path / "cloud.npz")
    Mesh(frame, points, faces).save(tmp_path / "mesh.npz")
    Clipped(Mesh(frame, points, faces), {"next": np.ones(3, bool)}).save(tmp_path / "clipped.npz", tmp_path / "on.npz")
    assert PointCloud.load(tmp_path / "cloud.npz").frame == FRAME
    assert Mesh.load(tmp_path / "mesh.npz").frame == FRAME
    assert Clipped.load(tmp_path / "clipped.npz", tmp_path / "on.npz").mesh.frame == FRAME
    Trajectory(np.arange(2).astype(kind), points[:2].astype(kind)).save(tmp_path / "path.npz")
    assert Trajectory.load(tmp_path / "path.npz").positions.tolist() == [[0, 0, 0]] * 2
    camera = Camera("opencv", kind(8), kind(6), kind(9), kind(9), kind(4), kind(3), (kind(0), kind(0)))
    view = View("a", camera, np.eye(4).astype(kind), tmp_path / "a.png", time=kind(5))
    views.save(tmp_path / "views.json", [view])
    assert views.load(tmp_path / "views.json")[0].camera == camera


def test_join_fills_missing_attributes() -> None:
    a = PointCloud(FRAME, np.zeros((2, 3), np.float32), rgb=np.zeros((2, 3), np.uint8), time=np.zeros(2))
    b = PointCloud(FRAME, np.ones((3, 3), np.float32), classification=np.full(3, 6, np.uint8))
    both = PointCloud.join([a, b])
    assert both.rgb is not None and both.rgb[2:].tolist() == [[128] * 3] * 3
    assert both.classification is not None and both.classification.tolist() == [1, 1, 6, 6, 6]
    assert both.time is None


def test_keep_drops_unused_vertices_and_selects_all_attributes() -> None:
    vertices = np.arange(18, dtype=np.float32).reshape(6, 3) ** 1.5
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    mesh = Mesh(FRAME, vertices, faces, uv=np.zeros((2, 3, 2), np.float32), page=np.array([0, 1], np.int16))
    half = mesh.keep(np.array([False, True]))
    assert half.faces.tolist() == [[0, 1, 2]] and (half.vertices == vertices[3:]).all()
    assert half.page is not None and half.page.tolist() == [1]


def test_scaled_camera_keeps_pixel_centres_aligned() -> None:
    camera = Camera("pinhole", 100, 80, 50.0, 50.0, 49.5, 39.5).scaled(0.5)
    assert (camera.width, camera.height, camera.cx, camera.cy) == (50, 40, 24.5, 19.5)

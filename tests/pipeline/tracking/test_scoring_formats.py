"""Formats of KITTI and nuScenes for scoring tracks."""

import json
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.types import Camera, Frame, View
from scan2sim.pipeline.tracking.scoring_formats import write_kitti, write_nuscenes
from scan2sim.pipeline.tracking.tracks import Track

AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Camera axes (columns) of a camera that looks along x."""


def car(x: float, y: float, yaw: float) -> Track:
    times = np.array([0.0, 0.1])
    poses = np.array([[x, y, 0.0, yaw], [x + 1, y, 0.0, yaw]])
    return Track(5, "car", (4.0, 1.8, 1.5), times, poses, np.full((2, 2), 0.1), True, None)


def view(time: float) -> View:
    T = np.eye(4)
    T[:3, :3], T[2, 3] = AHEAD, 1.65
    return View(f"{time}", Camera("pinhole", 1242, 375, 720, 720, 610, 173), T, Path("p.png"), time=time)


def test_kitti_labels_are_boxes_in_the_axes_of_the_camera(tmp_path: Path) -> None:
    write_kitti(tmp_path / "k.txt", [car(20, 2, 0.0)], [view(0.1), view(0.0)])
    first, second = ([*line.split()] for line in (tmp_path / "k.txt").read_text().splitlines())
    assert first[:3] == ["0", "5", "Car"] and second[0] == "1"
    height, width, length, x, y, z, rotation = (float(word) for word in first[10:17])
    assert (height, width, length) == (1.5, 1.8, 4.0)
    assert (x, y, z) == pytest.approx((-2, 1.65, 20))
    assert rotation == pytest.approx(-np.pi / 2, abs=1e-4)  # KITTI: along z
    assert float(second[15]) == pytest.approx(21)
    left, top, right, bottom = (float(word) for word in first[6:10])
    assert left < 610 - 720 * 2 / 20 < right and top < bottom
    assert right == pytest.approx(610 - 720 * 1.1 / 22, abs=1)


def test_kitti_labels_omit_objects_behind_the_camera_or_absent(tmp_path: Path) -> None:
    write_kitti(tmp_path / "k.txt", [car(-20, 2, 0.0), car(20, 2, 0.0)], [view(3.0)])
    assert (tmp_path / "k.txt").read_text() == ""


def test_nuscenes_results_are_in_the_crs(tmp_path: Path) -> None:
    write_nuscenes(tmp_path / "n.json", [car(20, 2, np.pi / 2)], Frame("EPSG:32632", (1000.0, 2000.0, 100.0)))
    results = json.loads((tmp_path / "n.json").read_text())["results"]
    box = results["0.000000"][0]
    assert box["translation"] == pytest.approx([1020, 2002, 100.75])
    assert box["size"] == [1.8, 4.0, 1.5]
    assert box["rotation"] == pytest.approx([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    assert box["tracking_name"] == "car" and np.hypot(*box["velocity"]) == pytest.approx(10)

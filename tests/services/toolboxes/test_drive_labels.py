"""Labels from a drive's lidar: parked and moving vehicles in photos, what hides them, and what is ignored."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, F64, Camera, Frame, PointCloud, View
from scan2sim.pipeline.io.images import image
from scan2sim.services.toolboxes.detector import dataset, drive_labels
from scan2sim.services.toolboxes.detector.drive_labels import Box, Drive

CAMERA = Camera("pinhole", 640, 320, 320.0, 320.0, 319.5, 159.5)
FORWARD = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation of a camera that looks along +y, 1.5 m above the ground."""
TIME = 100.0
CAR_AT = np.array([0.0, 12.0])
NAMES = ("car", "van", "truck")


def view(tmp_path: Path) -> View:
    """A photo at the origin."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = FORWARD, (0, 0, 1.5)
    image.write(tmp_path / "a.png", np.zeros((320, 640, 3), np.uint8))
    return View("a", CAMERA, T, tmp_path / "a.png", time=TIME)


def corners(x: float, y: float, size: tuple[float, float, float] = (1.8, 4.2, 1.5)) -> F64:
    """Corners of a box on the ground."""
    half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * np.array(size[:2]) / 2
    floor = np.column_stack([half + [x, y], np.zeros(4)])
    return np.concatenate([floor, floor + [0, 0, size[2]]])


def surface(low: tuple[float, float, float], high: tuple[float, float, float], spacing: float = 0.1) -> F32:
    """Points on a grid between two corners."""
    axes = [np.arange(a, b + 1e-6, spacing) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)


def cloud(*parts: tuple[F32, str, float]) -> PointCloud:
    """Points, their class and time; scanned for two seconds if the time is 0."""
    xyz = np.concatenate([part for part, _, _ in parts])
    codes = np.concatenate([np.full(len(part), CODE[name], np.uint8) for part, name, _ in parts])
    spread = np.linspace(TIME - 1, TIME + 1, 997)
    times = [np.full(len(part), time) if time else np.resize(spread, len(part)) for part, _, time in parts]
    return PointCloud(Frame(), xyz, classification=codes, time=np.concatenate(times))


GROUND = (surface((-10, 1, 0), (10, 60, 0), 0.25), "terrain", 0.0)
NO_POINTS = PointCloud(Frame(), np.zeros((0, 3), np.float32), time=np.zeros(0))


def objects(
    tmp_path: Path, static: PointCloud, parked: list[Box], moving: PointCloud = NO_POINTS
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Objects of the photo that are learned, and those that are ignored."""
    ((_, found, _),) = drive_labels.labelled_photos(Drive("d", [view(tmp_path)], static, moving, parked, None))
    learned = [one for one in found if one["visible"] > dataset.MIN_VISIBLE_SHARE]
    return learned, [one for one in found if one["visible"] <= dataset.MIN_VISIBLE_SHARE]


def test_parked_car_is_labelled_where_the_camera_sees_it(tmp_path: Path) -> None:
    car = Box("car", corners(*CAR_AT))
    learned, _ = objects(tmp_path, cloud(GROUND), [car])
    near = 12 - 2.1
    left = 319.5 - 320 * 0.9 / (near + drive_labels.CORNER_CUT_M)
    bottom, top = 159.5 + 320 * (1.5 - drive_labels.SILL_M) / near, 159.5
    (one,) = learned
    assert one["class"] == "car" and one["visible"] == 1
    np.testing.assert_allclose(one["box"], [left, top, 639 - left, bottom], atol=1.5)


def test_car_behind_a_wall_is_ignored(tmp_path: Path) -> None:
    wall = surface((-3, 6, 0), (3, 6, 2.5))
    learned, ignored = objects(tmp_path, cloud(GROUND, (wall, "building", 0.0)), [Box("car", corners(*CAR_AT))])
    assert not learned
    assert any(one["box"][2] - one["box"][0] > 50 and one["box"][3] - one["box"][1] > 30 for one in ignored)


def test_distant_region_is_ignored_unless_something_is_before_it(tmp_path: Path) -> None:
    _, ignored = objects(tmp_path, cloud(GROUND), [])
    middle = [one for one in ignored if one["box"][0] < 320 < one["box"][2] and one["box"][1] < 162 < one["box"][3] + 8]
    assert middle
    wall = surface((-10, 20, 0), (10, 20, 6))
    _, hidden = objects(tmp_path, cloud(GROUND, (wall, "building", 0.0)), [])
    assert not [one for one in hidden if one["box"][0] < 320 < one["box"][2]]


def test_moving_car_is_labelled_where_it_was_at_the_time_of_the_photo(tmp_path: Path) -> None:
    def at(y: float, time: float) -> tuple[F32, str, float]:
        rear = surface((-0.9, y, 0.3), (0.9, y, 1.5))
        return np.concatenate([rear, surface((0.9, y, 0.3), (0.9, y + 3.8, 1.5))]), "vehicle", time

    learned, _ = objects(tmp_path, cloud(GROUND), [], cloud(at(10, TIME), at(14, TIME + 0.4)))
    (one,) = learned
    assert one["class"] == "car"
    assert one["box"][3] == pytest.approx(159.5 + 320 * (1.5 - drive_labels.SILL_M) / 10, abs=2)


def test_moving_vehicle_that_was_not_removed_is_ignored(tmp_path: Path) -> None:
    rear = (surface((-0.9, 10, 0.3), (0.9, 10, 1.6)), "vehicle", TIME)
    side = (surface((0.9, 10, 0.3), (0.9, 13.8, 1.6)), "vehicle", TIME)
    learned, ignored = objects(tmp_path, cloud(GROUND, rear, side), [])
    assert not learned
    assert any(one["box"][2] - one["box"][0] > 50 and one["box"][3] - one["box"][1] > 30 for one in ignored)


def test_rows_and_people_are_ignored_and_moved_instances_left_out(tmp_path: Path) -> None:
    def feature(kind: str, moved: bool) -> dict[str, Any]:
        ring = corners(*CAR_AT)[:4, :2].tolist()
        properties = {"kind": kind, "moved": moved, "ground_z": 0.0, "height_m": 1.5}
        return {"geometry": {"coordinates": [[*ring, ring[0]]]}, "properties": properties}

    features = [feature("car", True), feature("row", False), feature("person", False), feature("van", False)]
    (tmp_path / "instances.geojson").write_text(json.dumps({"features": features}), encoding="utf-8")
    boxes = drive_labels.parked_boxes(tmp_path / "instances.geojson", cloud(GROUND))
    assert [box.label for box in boxes] == [None, None, "van"]
    np.testing.assert_allclose(boxes[0].corners, corners(*CAR_AT))


def test_written_labels_are_a_dataset_for_the_training(tmp_path: Path) -> None:
    drive = Drive("d", [view(tmp_path)], cloud(GROUND), NO_POINTS, [Box("van", corners(*CAR_AT))], None)
    counts = drive_labels.write([drive], NAMES, tmp_path / "labels")
    assert counts == {"images": 1, "boxes": 1}
    (one,), names = dataset.read(tmp_path / "labels")
    assert names == list(NAMES) and one.image.is_file()
    assert one.classes[one.visible > 0].tolist() == [1]

"""Trails of moving people and vehicles are found in a map; static objects are not."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F32, F64, Bools, Frame, PointCloud
from scan2sim.pipeline.robot_maps.ghosts import find_ghosts
from scan2sim.pipeline.steps.ghosts import GhostsParams, ghosts

RNG = np.random.default_rng(5)


def _box(low: tuple[float, float, float], high: tuple[float, float, float], per_m3: float) -> F64:
    size = np.subtract(high, low)
    return RNG.uniform(low, high, (int(per_m3 * np.prod(size)), 3))


FLOOR = np.column_stack([np.mgrid[0:20:0.1, 0:12:0.1].reshape(2, -1).T, np.zeros(200 * 120)])
WALL = _box((0, 11.8, 0), (20, 12, 2.9), 500)
FENCE = _box((2, 9, 0), (18, 9.05, 1.6), 2000)  # the floor is seen on both sides
SHELF = _box((15, 2, 0), (19, 2.8, 1.8), 300)  # the floor beneath is hidden
PERSON = np.concatenate([_box((1 + 0.9 * i, 4, 0.1), (1.45 + 0.9 * i, 4.45, 1.75), 400) for i in range(12)])
VEHICLE = np.concatenate([_box((1 + i, 6, 0.2), (2 + i, 7.7, 1.5), 60) for i in range(15)])


def _scene(*clusters: F64) -> tuple[F32, Bools, Bools]:
    """Points, and masks of floor and wall points."""
    floor = FLOOR[~((FLOOR[:, 0] > 15) & (FLOOR[:, 0] < 19) & (FLOOR[:, 1] > 2) & (FLOOR[:, 1] < 2.8))]
    xyz = np.concatenate([floor, WALL, *clusters]).astype(np.float32)
    index = np.arange(len(xyz))
    return xyz, index < len(floor), (index >= len(floor)) & (index < len(floor) + len(WALL))


def test_trails_are_found_and_standing_clusters_are_not() -> None:
    xyz, floor, wall = _scene(FENCE, SHELF, PERSON, VEHICLE)
    found = find_ghosts(xyz, floor, wall, np.zeros(len(xyz), bool), 0.1)
    assert [ghost.kind for ghost in found] == ["vehicle", "person"]
    vehicle, person = found
    assert vehicle.length == pytest.approx(15, abs=1) and vehicle.width == pytest.approx(1.7, abs=0.4)
    assert person.length == pytest.approx(10.3, abs=1) and person.height == pytest.approx(1.7, abs=0.1)
    assert np.abs(person.path[:, 1] - 4.2).max() < 0.4 and np.abs(person.path[:, 2]).max() < 0.05
    first = len(xyz) - len(PERSON) - len(VEHICLE)
    true = np.arange(first, first + len(PERSON))
    assert np.isin(true, person.points).mean() > 0.95 and np.isin(person.points, true).mean() > 0.95


def test_parked_vehicle_is_not_a_ghost() -> None:
    xyz, floor, wall = _scene(_box((3, 6, 0.2), (7.5, 7.7, 1.5), 60))  # driven away later: the floor was seen
    assert find_ghosts(xyz, floor, wall, np.zeros(len(xyz), bool), 0.1) == []


def test_storeys_are_searched_separately() -> None:
    xyz, floor, wall = _scene(PERSON)
    upper = xyz + np.array([0, 0, 3.2], np.float32)
    both, double = np.concatenate([xyz, upper]), np.concatenate
    ceiling = np.zeros(len(both), bool)
    found = find_ghosts(both, double([floor, floor]), double([wall, wall]), ceiling, 0.1)
    assert sorted(round(float(ghost.path[:, 2].mean()), 1) for ghost in found) == [0.0, 3.2]


@pytest.mark.parametrize("count", [0, 1, 500])
def test_maps_without_floor_or_points_have_none(count: int) -> None:
    xyz = RNG.uniform(0, 5, (count, 3)).astype(np.float32)
    none = np.zeros(count, bool)
    assert find_ghosts(xyz, none, none, none, 0.1) == []
    assert find_ghosts(xyz, ~none, none, none, 0.1) == []


def test_step_lists_all_ghosts_and_removes_the_selected_ones(tmp_path: Path) -> None:
    xyz, floor, wall = _scene(PERSON, VEHICLE)
    code = np.full(len(xyz), CODE["furniture"], np.uint8)
    code[floor], code[wall] = CODE["floor"], CODE["wall"]
    PointCloud(Frame(), xyz, classification=code).save(tmp_path / "in.npz")
    inputs = {"cloud": tmp_path / "in.npz"}
    done = ghosts(inputs, GhostsParams(), tmp_path, silent)
    assert len(PointCloud.load(done.files["cloud"])) == len(xyz)
    assert done.metrics == {"ghosts": 2, "removed_points": 0} and "--set ghosts.remove=all" in done.warnings[0]
    done = ghosts(inputs, GhostsParams(remove="2"), tmp_path, silent)
    kept = PointCloud.load(done.files["cloud"])
    assert len(xyz) - len(kept) == done.metrics["removed_points"] > 0.95 * len(PERSON)
    assert done.warnings[0].startswith("1 long cluster may be") and done.warnings[0].endswith("=all or 1,2")
    listed = json.loads(done.files["geojson"].read_text(encoding="utf-8"))["features"]
    assert [one["properties"]["removed"] for one in listed] == [False, True]
    assert not ghosts(inputs, GhostsParams(remove="all"), tmp_path, silent).warnings


def test_single_number_is_a_selection() -> None:
    params = GhostsParams.of("ghosts", {"remove": 1})
    assert [params.is_removed(number) for number in (1, 2)] == [True, False]


def test_wrong_selection_is_an_error() -> None:
    with pytest.raises(SettingError, match="must be none, all, or numbers"):
        GhostsParams.of("ghosts", {"remove": "first"})

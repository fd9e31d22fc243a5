"""Classes of a simulated robot's map of a building, also without floor or ceiling, and with people."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from scan2sim.data_samples.building import Style, Surface, build
from scan2sim.data_samples.robot_map import Lidar, Mapping, record
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, U8, Bools
from scan2sim.segmentation.indoor import classify_indoor

KINDS: dict[str, tuple[Surface, ...]] = {
    "floor": (Surface.FLOOR,),
    "wall": (Surface.WALL, Surface.PILLAR, Surface.WINDOW),
    "ceiling": (Surface.CEILING,),
    "furniture": (Surface.FURNITURE,),
}


@cache
def scanned(storeys: int = 1) -> tuple[F32, U8]:
    """Points of a map on a grid of 10 cm, level, and their true surfaces."""
    building = build(1, Style(rooms=2, storeys=storeys, stairs=storeys == 2))
    found = record(building, Lidar(azimuth_step=0.8), Mapping(voxel=0.1, keyframe=1.0, first_pose=False), 1)
    return found.xyz.astype(np.float32), found.surface


def iou(found: U8, surface: U8, kind: str) -> float:
    true, said = np.isin(surface, KINDS[kind]), found == CODE[kind]
    return float((true & said).sum() / (true | said).sum())


def test_classes_agree_with_the_truth() -> None:
    xyz, surface = scanned()
    found = classify_indoor(xyz, 0.08)
    scores = {kind: iou(found.classification, surface, kind) for kind in KINDS}
    assert np.mean(list(scores.values())) > 0.78, scores
    assert len(found.storeys) == 1


@pytest.mark.parametrize("missing", ["floor", "ceiling"])
def test_classification_works_without_floor_or_ceiling(missing: str) -> None:
    xyz, surface = scanned()
    keep: Bools = ~np.isin(surface, KINDS[missing])
    found = classify_indoor(xyz[keep], 0.08)
    assert (found.classification == CODE[missing]).mean() < 0.03
    assert iou(found.classification, surface[keep], "wall") > 0.75


def test_storeys_and_stairs_are_separated() -> None:
    xyz, surface = scanned(2)
    found = classify_indoor(xyz, 0.08)
    assert len(found.storeys) == 2
    assert all(storey.floor and storey.ceilings for storey in found.storeys)
    stairs = found.classification == CODE["stairs"]
    assert stairs[surface == Surface.STAIRS].mean() > 0.4
    assert stairs[surface != Surface.STAIRS].mean() < 0.02


def test_trail_of_a_person_is_neither_wall_nor_furniture() -> None:
    building = build(12, Style(rooms=3))
    found = record(building, Lidar(), Mapping(first_pose=False, people=2), 12)
    classes = classify_indoor(found.xyz.astype(np.float32), 0.045).classification
    person = classes == CODE["person"]
    trail = found.surface == Surface.PERSON
    assert trail.sum() > 2000
    assert person[trail].mean() > 0.4
    assert (classes[trail] == CODE["wall"]).mean() < 0.2
    assert person[~trail].mean() < 0.01


@pytest.mark.parametrize("count", [0, 1, 3, 50])
def test_hardly_any_points_are_furniture(count: int) -> None:
    xyz = np.random.default_rng(0).uniform(0, 3, (count, 3)).astype(np.float32)
    assert len(classify_indoor(xyz, 0.1).classification) == count

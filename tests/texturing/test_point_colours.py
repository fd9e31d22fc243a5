"""Colours of points for texels that no photo saw."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, Frame, PointCloud
from scan2sim.texturing.inpainting.point_colours import point_colours
from tests.present import present

FLOOR_RGB, WALL_RGB = (140, 120, 90), (235, 235, 230)


def grid(*axes: np.ndarray) -> F32:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)


@pytest.mark.parametrize(("source", "clean"), [("intensity", True), ("colours", False)])
def test_floor_of_a_map_coloured_by_intensity_has_no_shades_of_the_walls(
    tmp_path: Path, source: str, clean: bool
) -> None:
    step = np.arange(0, 2, 0.05)
    floor = grid(step[2:], step, np.zeros(1))  # none within 10 cm of the wall: shadows of a sensor
    wall = grid(np.zeros(1), step, step)
    for name, xyz, rgb, code in (("terrain", floor, FLOOR_RGB, "terrain"), ("building", wall, WALL_RGB, "building")):
        colours, classes = np.tile(np.array(rgb, np.uint8), (len(xyz), 1)), np.full(len(xyz), CODE[code], np.uint8)
        PointCloud(Frame(), xyz, colours, classification=classes).save(tmp_path / f"{name}.npz")
    (tmp_path / "source.json").write_text(json.dumps({"source": source}), encoding="utf-8")
    inputs = {f"cloud.{name}": tmp_path / f"{name}.npz" for name in ("terrain", "building")}
    found, measured = point_colours(inputs | {"colour_source": tmp_path / "source.json"}, None, "terrain")
    at_the_wall = np.array([[0.02, y, 0.0] for y in step], np.float32)
    shown, _ = present(found).at(at_the_wall)
    assert measured and (np.abs(shown - FLOOR_RGB).max() < 2) == clean

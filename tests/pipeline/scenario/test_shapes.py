"""Shapes of road users: closed, within their box, wheels on the ground."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
import trimesh

from scan2sim.pipeline.scenario.scenario import Actor
from scan2sim.pipeline.scenario.shapes import axles, parts
from scan2sim.pipeline.tracking.tracks import Category
from tests.fakes import traffic

SIZES = {
    "car": (4.3, 1.8, 1.5), "ego": (4.3, 1.8, 1.6), "van": (5.3, 2.0, 2.3), "truck": (8.0, 2.5, 3.4),
    "bus": (12.0, 2.5, 3.1), "motorcycle": (2.1, 0.8, 1.7), "cyclist": (1.8, 0.6, 1.75),
    "pedestrian": (0.8, 0.55, 1.75),
}  # fmt: skip


@pytest.mark.parametrize("category", get_args(Category))
def test_shape_fills_its_box_and_stands_on_the_ground(category: str) -> None:
    size = SIZES[category]
    track = traffic.drive(1, category, size, (0.0, 1.0), 0.0, 0.0, 1.0)  # type: ignore[arg-type]
    found = parts(Actor("one", track).track)
    vertices = np.concatenate([part.vertices for part in found])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    assert low[2] == pytest.approx(0.0, abs=1e-6)
    assert np.all(low >= np.array([-size[0] / 2, -size[1] / 2, 0.0]) - 1e-6)
    assert np.all(high <= np.array([size[0] / 2, size[1] / 2, size[2]]) + 1e-6)
    assert np.all(high - low > 0.9 * np.array(size))
    for part in found:
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        assert mesh.is_watertight and mesh.volume > 0, part.name


def test_wheels_are_at_the_axles() -> None:
    track = traffic.drive(1, "car", SIZES["car"], (0.0, 1.0), 0.0, 0.0, 1.0)
    found = axles("car", track.size)
    assert found is not None and 2.3 < found.front - found.rear < 2.9 and 0.55 < found.wheel_diameter < 0.7
    places = {round(float(part.vertices[:, 0].mean()), 3) for part in parts(track) if part.name == "tyre"}
    assert places == {round(found.rear, 3), round(found.front, 3)}

"""Boxes of modelled solids: the same volume at any heading; scanned surfaces are not split."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F64, Frame, Mesh
from scan2sim.pipeline.geometry.fitted_boxes import Box, mesh_of
from scan2sim.pipeline.geometry.rectilinear_solids import is_rectilinear, split_boxes

# a wall of 4 x 0.1 x 2.5 m with a door from 1 to 2 m, 2 m high: quadrilaterals that do not share vertices
U, Z = (0.0, 1.0, 2.0, 4.0), (0.0, 2.0, 2.5)
SOLID = np.array([[True, True], [False, True], [True, True]])


def wall_with_door(heading: float) -> Mesh:
    quads: list[list[tuple[float, float, float]]] = []
    padded = np.pad(SOLID, 1)
    for i, j in np.argwhere(SOLID):
        (a, b), (c, e) = U[i : i + 2], Z[j : j + 2]
        quads.append([(a, 0.1, c), (a, 0.1, e), (b, 0.1, e), (b, 0.1, c)])
        quads.append([(a, 0, c), (b, 0, c), (b, 0, e), (a, 0, e)])
        if not padded[i, j + 1]:
            quads.append([(a, 0, c), (a, 0, e), (a, 0.1, e), (a, 0.1, c)])
        if not padded[i + 2, j + 1]:
            quads.append([(b, 0, c), (b, 0.1, c), (b, 0.1, e), (b, 0, e)])
        if not padded[i + 1, j]:
            quads.append([(a, 0, c), (a, 0.1, c), (b, 0.1, c), (b, 0, c)])
        if not padded[i + 1, j + 2]:
            quads.append([(a, 0, e), (b, 0, e), (b, 0.1, e), (a, 0.1, e)])
    xyz = np.array(quads).reshape(-1, 3)
    faces = (4 * np.arange(len(quads))[:, None] + [0, 1, 2, 0, 2, 3]).reshape(-1, 3)
    return Mesh(Frame(), turned(xyz, heading).astype(np.float32), faces.astype(np.int32))


def turned(xyz: F64, heading: float) -> F64:
    c, s = np.cos(heading), np.sin(heading)
    return np.asarray(xyz @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T)


def within(boxes: list[Box], points: F64) -> F64:
    """(N,) number of boxes that contain each point."""
    count = np.zeros(len(points))
    for box in boxes:
        own = turned(points, -box.heading)
        count += ((own > box.low) & (own < box.high)).all(axis=1)
    return count


@pytest.mark.parametrize("heading", [0.0, 0.4, 1.9])
def test_boxes_of_a_wall_with_a_door_have_its_exact_volume(heading: float) -> None:
    boxes, rest = split_boxes(wall_with_door(heading))
    assert not len(rest) and len(boxes) <= 3
    own = np.random.default_rng(0).uniform((-0.2, -0.2, -0.2), (4.2, 0.3, 2.7), (20_000, 3))
    solid = ((own > (0, 0, 0)) & (own < (4, 0.1, 2.5))).all(axis=1) & ~(
        (np.abs(own[:, 0] - 1.5) < 0.5) & (own[:, 2] < 2)
    )
    near = np.abs(own[:, :, None] - np.array([[0, 1, 2, 4], [0, 0.1, 0, 0.1], [0, 2, 2.5, 0]])).min(axis=(1, 2)) < 0.002
    assert (within(boxes, turned(own, heading)) == solid)[~near].all()


def test_furniture_of_different_heading_is_split_into_separate_boxes() -> None:
    made = [
        Box(0.3, np.array([0.0, 0, 0]), np.array([1.0, 0.6, 0.7])),
        Box(1.0, np.array([3.0, 0, 0]), np.array([4.0, 1, 1])),
    ]
    vertices, faces = mesh_of(made)
    boxes, rest = split_boxes(Mesh(Frame(), vertices, faces))
    assert not len(rest) and len(boxes) == 2
    volumes = sorted(float(np.prod(box.high - box.low)) for box in boxes)
    assert volumes == pytest.approx([0.42, 1.0], abs=1e-4)


def test_open_and_slanted_surfaces_are_not_boxes() -> None:
    vertices, faces = mesh_of([Box(0.0, np.zeros(3), np.ones(3))])
    lid_off = Mesh(Frame(), vertices, faces[np.abs(faces // 4).min(axis=1) == 0])
    assert is_rectilinear(lid_off) and split_boxes(lid_off)[0] == []
    slanted = Mesh(Frame(), vertices + 0.2 * vertices[:, [2]] * np.array([1, 0, 0], np.float32), faces)
    assert not is_rectilinear(slanted) and split_boxes(slanted)[0] == []
    assert len(split_boxes(slanted)[1]) == len(slanted)

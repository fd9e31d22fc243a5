"""Faces whose back is open: walls scanned from one side, not bodies that are closed behind."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.geometry.open_backs import THICKNESS_M, open_backs


def mesh(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(Frame(), shape.vertices.astype(np.float32), shape.faces.astype(np.int32))


def box(x: float, y: float, z: float) -> Mesh:
    return mesh(trimesh.creation.box((x, y, z)))


def wall(y: float, towards: int) -> Mesh:
    """A square wall in the plane y, whose front is towards +y or -y."""
    corners = np.array([(0, y, 0), (4, y, 0), (4, y, 3), (0, y, 3)], np.float32)
    faces = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
    return Mesh(Frame(), corners, faces if towards < 0 else faces[:, ::-1].copy())


def test_a_single_wall_is_open_whatever_stands_behind_it() -> None:
    alone = wall(0.0, -1)
    assert open_backs(alone, [alone]).all()
    assert open_backs(alone, [alone, wall(1.0, -1)]).all()  # the front of the next wall
    assert open_backs(alone, [alone, wall(THICKNESS_M + 1, 1)]).all()  # the far side of a courtyard
    assert not open_backs(alone, [alone, wall(0.3, 1)]).any()  # the other side of the wall


def test_closed_bodies_and_level_surfaces_have_no_open_back() -> None:
    for body in (box(0.3, 3, 2), box(2, 3, 3), mesh(trimesh.creation.icosphere(2, 1.5))):
        assert not open_backs(body, [body]).any()
    above = box(4, 4, 4)
    roof = above.keep(above.face_normal[:, 2] > 0.9)
    assert len(roof) and not open_backs(roof, [roof]).any()


def test_half_a_trunk_is_open() -> None:
    trunk = mesh(trimesh.creation.cylinder(0.2, 3.0))
    half = trunk.keep((trunk.corners.mean(axis=1)[:, 0] > 0) & (np.abs(trunk.face_normal[:, 2]) < 0.5))
    assert open_backs(half, [half]).all()


@pytest.mark.parametrize("count", [0, 1])
def test_degenerate_faces_have_no_back(count: int) -> None:
    flat = Mesh(Frame(), np.zeros((3, 3), np.float32), np.zeros((count, 3), np.int32))
    assert open_backs(flat, [flat]).tolist() == [False] * count

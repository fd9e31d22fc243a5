"""Poles and trunks as cylinders, which physics engines support as primitives."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.geometry import primitives
from scan2sim.pipeline.geometry.cylinders import split_cylinders

POLE = primitives.tube([(1, 2, -0.2), (1.1, 2, 1), (1.4, 2.2, 3.8)], [0.05, 0.05, 0.05], 8)
TRUNK = primitives.tube([(5, 5, 0), (5.2, 5, 2)], [0.2, 0.18], 12)
ARM = primitives.tube([(0, 0, 5), (0, 0.5, 5.6), (0, 2, 5.7)], [0.05, 0.05, 0.05], 8)
PLATE = primitives.plate([(0, 0, 2), (1, 0, 2), (1, 0, 3), (0, 0, 3)], (0, 0.02, 0))


def mesh(parts: list[tuple[primitives.Triangles, str]]) -> Mesh:
    vertices, faces = primitives.join([part for part, _ in parts])
    codes = np.concatenate([np.full(len(part[1]), CODE[name], np.uint8) for part, name in parts])
    return Mesh(Frame(), vertices.astype(np.float32), faces, classification=codes)


def test_leaning_trunk_becomes_a_cylinder_along_its_tube() -> None:
    (one,), rest = split_cylinders(mesh([(TRUNK, "high_vegetation")]))
    assert len(rest) == 0 and one.code == CODE["high_vegetation"]
    assert one.centre == pytest.approx((5.1, 5, 1), abs=0.01) and one.radius == pytest.approx(0.19, abs=0.005)
    assert one.length == pytest.approx(np.hypot(2, 0.2), abs=0.05)
    assert one.axis == pytest.approx(np.array([0.2, 0, 2]) / np.hypot(2, 0.2), abs=0.01)


def test_angles_rotate_the_z_axis_onto_the_cylinder_axis() -> None:
    (one,), _ = split_cylinders(mesh([(TRUNK, "high_vegetation")]))
    roll, pitch, yaw = one.angles
    turned = np.array([np.sin(pitch) * np.cos(yaw), np.sin(pitch) * np.sin(yaw), np.cos(pitch)])
    assert roll == 0 and turned == pytest.approx(one.axis)


def test_bent_and_flat_shapes_and_walls_remain_meshes() -> None:
    parts = [(POLE, "pole"), (ARM, "pole"), (PLATE, "road_sign"), (TRUNK, "building")]
    found, rest = split_cylinders(mesh(parts))
    assert len(found) <= 1 and len(rest) >= sum(len(part[1]) for part, _ in parts[1:])
    straight = primitives.tube([(1, 2, 0), (1, 2, 3)], [0.05, 0.05], 8)
    found, rest = split_cylinders(mesh([(straight, "pole"), (PLATE, "road_sign")]))
    assert [one.code for one in found] == [CODE["pole"]] and len(rest) == len(PLATE[1])


def test_without_classes_no_cylinders_are_detected() -> None:
    vertices, faces = TRUNK
    plain = Mesh(Frame(), vertices.astype(np.float32), faces)
    assert split_cylinders(plain) == ([], plain)

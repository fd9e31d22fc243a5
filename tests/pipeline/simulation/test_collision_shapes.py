"""Collision shapes by class."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.geometry import primitives
from scan2sim.pipeline.geometry.cylinders import Cylinder
from scan2sim.pipeline.simulation.collision_shapes import solids
from scan2sim.pipeline.steps.decimate import with_furniture
from tests.fakes import synthetic


def test_each_class_has_its_mesh_and_friction_and_trunks_are_cylinders() -> None:
    ground = replace(synthetic.ground(10), uv=None, page=None)
    codes = np.where(ground.corners[:, 0, 0] < 0, CODE["road"], CODE["terrain"]).astype(np.uint8)
    vertices, faces = primitives.tube([(2, 2, 0), (2, 2, 3)], [0.2, 0.2], 12)
    trunk = Mesh(
        ground.frame,
        vertices.astype(np.float32),
        faces,
        classification=np.full(len(faces), CODE["high_vegetation"], np.uint8),
    )
    whole = replace(
        with_furniture(ground, trunk), classification=np.concatenate([codes, np.full(len(faces), 5, np.uint8)])
    )
    found = {one.name: one for one in solids(whole, 0.45)}
    assert set(found) == {"road", "terrain", "trunk_1"}
    assert found["road"].friction == 0.45 and found["terrain"].friction == 0.34
    assert isinstance(found["trunk_1"].shape, Cylinder)
    shapes = [one.shape for one in found.values() if isinstance(one.shape, Mesh)]
    assert sum(map(len, shapes)) == len(ground)


def test_mesh_without_classes_is_paved_ground() -> None:
    (one,) = solids(replace(synthetic.ground(4), uv=None, page=None), 0.8)
    assert one.name == "ground" and one.friction == 0.8
    assert solids(synthetic.ground(4).keep(np.zeros(32, bool)), 0.8) == []

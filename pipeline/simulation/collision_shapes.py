"""Solids: a tile's collision mesh as what simulators take: a mesh a class, cylinders, each with its friction."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scan2sim.pipeline.core.classes import CODE, group_of, name_of
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.geometry.cylinders import Cylinder, told_apart
from scan2sim.pipeline.terrain.friction import coefficient


@dataclass(frozen=True)
class Solid:
    """What bodies collide with, of one class.

    Attributes:
        name: unique in its tile: its class's, "road", and of cylinders with a number, "pole_1".
        code: LAS class code.
        friction: Coulomb friction coefficient.
        shape: local metres, z up.
    """

    name: str
    code: int
    friction: float
    shape: Mesh | Cylinder


def solids(mesh: Mesh, paved: float) -> list[Solid]:
    """A collision mesh's ground, walls, poles and trunks; one without classes is all paved ground.

    Args:
        mesh: as the step `collision` makes it.
        paved: friction of roads (`pipeline.terrain.friction`).
    """
    if mesh.classification is None or not len(mesh):
        return [Solid("ground", CODE["terrain"], paved, mesh)] if len(mesh) else []
    cylinders, rest = told_apart(mesh)
    assert rest.classification is not None
    ground = {code for code in np.unique(rest.classification).tolist() if group_of()[code] == 0}
    found = [
        Solid(name_of(code), code, coefficient(code, ground, paved), replace(part, classification=None))
        for code in np.unique(rest.classification).tolist()
        for part in [rest.keep(rest.classification == code)]
    ]
    for i, cylinder in enumerate(cylinders, start=1):
        name = "trunk" if cylinder.code == CODE["high_vegetation"] else name_of(cylinder.code)
        found.append(Solid(f"{name}_{i}", cylinder.code, coefficient(cylinder.code, ground, paved), cylinder))
    return found

"""Collision shapes of a tile for simulators: a mesh per class, and cylinders, each with its friction."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scan2sim.pipeline.core.classes import CODE, group_of, name_of
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.geometry.cylinders import Cylinder, split_cylinders
from scan2sim.pipeline.simulation.friction import coefficient


@dataclass(frozen=True)
class Solid:
    """A collision shape of one class.

    Attributes:
        name: unique in its tile: name of the class ("road"), with a number for cylinders ("pole_1").
        code: LAS class code.
        friction: Coulomb friction coefficient.
        shape: mesh or cylinder, local metres, z up.
    """

    name: str
    code: int
    friction: float
    shape: Mesh | Cylinder


def solids(mesh: Mesh, paved: float) -> list[Solid]:
    """Split a collision mesh into shapes by class; a mesh without classes is one shape of paved ground.

    Args:
        mesh: result of the step `collision`.
        paved: friction coefficient of roads (`pipeline.simulation.friction`).
    """
    if mesh.classification is None or not len(mesh):
        return [Solid("ground", CODE["terrain"], paved, mesh)] if len(mesh) else []
    cylinders, rest = split_cylinders(mesh)
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

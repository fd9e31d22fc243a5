"""Random meshes of road users, by object class."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from scan2sim.data_samples import figures, objects, roadside
from scan2sim.data_samples.paints import RGB
from scan2sim.data_samples.shapes import Part, smooth_normals
from scan2sim.data_samples.traffic import coach
from scan2sim.data_samples.variety import colour, grey
from scan2sim.pipeline.core.types import F64

Rng = np.random.Generator

CLASSES = ("car", "van", "bus", "truck", "train", "person", "cyclist")
"""Object classes; meshes of trains are in `trains`."""
ROOF_PROFILES = {  # positions along a car in metres, and the least height of its roof there
    "saloon": ([0.0], [0.0]),
    "hatchback": ([-2.2, -2.1, -1.8, -1.2, -1.0], [0.9, 1.05, 1.30, 1.44, 0.0]),
    "estate": ([-2.2, -2.12, -2.0, -1.2, -1.0], [0.95, 1.25, 1.40, 1.46, 0.0]),
    "pickup": ([-2.2, -0.9, -0.7], [1.0, 1.05, 0.0]),
}


def random_road_user(label: str, rng: Rng) -> Part:
    """Random car, van, bus, truck, person or cyclist, x forwards, the origin on the ground below it."""
    return _MAKERS[label](rng)


def _painted(rng: Rng) -> RGB:
    """Random colour of a vehicle, preferably white, grey or black."""
    return colour(rng, 0.45) if rng.random() < 0.45 else grey(rng, 0.012, 0.9)


def _car(rng: Rng) -> Part:
    mesh = objects.car(_painted(rng))
    xyz = mesh.vertices.astype(np.float64)
    xyz[:, 2] = _raised(xyz, *ROOF_PROFILES[str(rng.choice(list(ROOF_PROFILES), p=[0.35, 0.35, 0.25, 0.05]))])
    scale = rng.uniform([0.82, 0.92, 0.95], [1.1, 1.06, 1.12]) * (1.0, 1.0, rng.choice([1.0, 1.2], p=[0.7, 0.3]))
    xyz *= scale
    return replace(mesh, vertices=xyz.astype(np.float32), normals=smooth_normals(xyz, mesh.faces).astype(np.float32))


def _raised(xyz: F64, at: list[float], least: list[float], belt: float = 0.75) -> F64:
    """(V,) heights of a car's vertices (V, 3) after raising its roof to a profile.

    Args:
        xyz: vertices.
        at, least: positions along the car, and least height of the roof there.
        belt: height below which vertices stay unchanged.
    """
    stations, index = np.unique(np.round(xyz[:, 0], 3), return_inverse=True)
    top = np.zeros(len(stations))
    np.maximum.at(top, index, xyz[:, 2])
    target = np.maximum(top, np.interp(stations, at, least))
    stretch = ((target - belt) / np.maximum(top - belt, 0.03))[index]
    return np.asarray(np.where(xyz[:, 2] > belt, belt + (xyz[:, 2] - belt) * stretch, xyz[:, 2]), np.float64)


def _van(rng: Rng) -> Part:
    return coach(rng.uniform(4.6, 6.2), rng.uniform(1.85, 2.1), rng.uniform(1.95, 2.7), _painted(rng), rng)


def _bus(rng: Rng) -> Part:
    tall = rng.random() < 0.2
    return coach(rng.uniform(9.5, 13.5), 2.5, 4.2 if tall else rng.uniform(2.9, 3.3), colour(rng, 0.5), rng)


def _truck(rng: Rng) -> Part:
    length, height = rng.uniform(6, 12), rng.uniform(2.6, 3.8)
    return roadside.lorry(length, height, (_painted(rng), _painted(rng)), int(rng.integers(1 << 20)))


def _person(rng: Rng) -> Part:
    return figures.person(int(rng.integers(1 << 20)))


def _cyclist(rng: Rng) -> Part:
    return figures.cyclist(int(rng.integers(1 << 20)))


_MAKERS: dict[str, Callable[[Rng], Part]] = {
    "car": _car, "van": _van, "bus": _bus, "truck": _truck, "person": _person, "cyclist": _cyclist,
}  # fmt: skip

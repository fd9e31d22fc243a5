"""Cylinders: what physics takes for poles and trunks, which meshes show as tubes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F64, Mesh

STANDING = (CODE["pole"], CODE["high_vegetation"])
"""Classes of street furniture that are tubes; signs are plates."""
LEAST, SHARE = 0.05, 0.3
"""Metres, or the share of its radius if that is more, by which a tube may leave its cylinder."""


@dataclass(frozen=True)
class Cylinder:
    """A closed, straight, round body.

    Attributes:
        centre: (x, y, z) of its middle, local metres.
        axis: unit vector along it, upwards.
        radius, length: metres.
        code: LAS class code.
    """

    centre: tuple[float, float, float]
    axis: tuple[float, float, float]
    radius: float
    length: float
    code: int

    @property
    def angles(self) -> tuple[float, float, float]:
        """Roll, pitch and yaw (SDF, URDF: fixed axes x, y, z) in radians that turn the z axis onto its own."""
        x, y, z = self.axis
        return 0.0, float(np.arctan2(np.hypot(x, y), z)), float(np.arctan2(y, x))


def told_apart(mesh: Mesh) -> tuple[list[Cylinder], Mesh]:
    """The parts of a mesh with classes that are poles and trunks, as cylinders, and the rest of it.

    A tube that bends, or tapers much, stays in the rest.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if mesh.classification is None or not len(mesh):
        return [], mesh
    n, links = len(mesh.vertices), mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    _, piece = connected_components(coo_matrix((np.ones(len(links), bool), links.T), shape=(n, n)), directed=False)
    of_face = piece[mesh.faces[:, 0]]
    rest = np.ones(len(mesh), bool)
    found = []
    for one in np.unique(of_face[np.isin(mesh.classification, STANDING)]):
        own = of_face == one
        cylinder = fit(mesh.corners[own].astype(np.float64), int(mesh.classification[own][0]))
        if cylinder is not None:
            found.append(cylinder)
            rest &= ~own
    return found, mesh.keep(rest)


def fit(corners: F64, code: int) -> Cylinder | None:
    """The cylinder of a closed tube's volume, from its triangles (F, 3, 3); None where that is not its shape."""
    places = np.unique(corners.reshape(-1, 3), axis=0)
    middle = places.mean(axis=0)
    axis = np.linalg.svd(places - middle, full_matrices=False)[2][0]
    axis *= np.sign(axis[2]) or 1.0
    along = (places - middle) @ axis
    length = float(np.ptp(along))
    a, b, c = np.moveaxis(corners - middle, 1, 0)
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6
    if volume <= 0 or length <= 0:
        return None
    radius = float(np.sqrt(volume / (np.pi * length)))
    off = np.linalg.norm(places - middle - along[:, None] * axis, axis=1)
    if np.abs(off - radius).max() > max(LEAST, SHARE * radius) or length < 2 * radius:
        return None
    x, y, z = (middle + (along.min() + along.max()) / 2 * axis).tolist()
    return Cylinder((x, y, z), tuple(axis.tolist()), radius, length, code)

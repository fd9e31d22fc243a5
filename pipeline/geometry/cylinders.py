"""Cylinders: fits collision cylinders to the tubes of poles and trunks in a mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F64, Mesh

TUBE_CLASSES = (CODE["pole"], CODE["high_vegetation"])
"""Classes of street furniture that are tubes (poles, trunks); signs are flat."""
TOLERANCE_M, TOLERANCE_RADII = 0.05, 0.3
"""Largest deviation of a tube from its cylinder: the larger of an absolute and a relative (to the radius) limit."""


@dataclass(frozen=True)
class Cylinder:
    """A solid circular cylinder.

    Attributes:
        centre: (x, y, z) of its centre, local metres.
        axis: unit vector along its axis, upwards.
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
        """Roll, pitch and yaw (SDF, URDF: fixed axes x, y, z) in radians that rotate the z axis onto `axis`."""
        x, y, z = self.axis
        return 0.0, float(np.arctan2(np.hypot(x, y), z)), float(np.arctan2(y, x))


def split_cylinders(mesh: Mesh) -> tuple[list[Cylinder], Mesh]:
    """Split a mesh with classes into cylinders, fitted to its poles and trunks, and the remaining faces.

    A tube that is bent or strongly tapered remains a mesh.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if mesh.classification is None or not len(mesh):
        return [], mesh
    n, links = len(mesh.vertices), mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    _, piece = connected_components(coo_matrix((np.ones(len(links), bool), links.T), shape=(n, n)), directed=False)
    piece_of_face = piece[mesh.faces[:, 0]]
    rest = np.ones(len(mesh), bool)
    found = []
    for one in np.unique(piece_of_face[np.isin(mesh.classification, TUBE_CLASSES)]):
        own = piece_of_face == one
        cylinder = fit(mesh.corners[own].astype(np.float64), int(mesh.classification[own][0]))
        if cylinder is not None:
            found.append(cylinder)
            rest &= ~own
    return found, mesh.keep(rest)


def fit(corners: F64, code: int) -> Cylinder | None:
    """Cylinder with the volume of a closed tube, from its triangles (F, 3, 3); None if the tube is not a cylinder."""
    points = np.unique(corners.reshape(-1, 3), axis=0)
    mean = points.mean(axis=0)
    axis = np.linalg.svd(points - mean, full_matrices=False)[2][0]
    axis *= np.sign(axis[2]) or 1.0
    along = (points - mean) @ axis
    length = float(np.ptp(along))
    a, b, c = np.moveaxis(corners - mean, 1, 0)
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6
    if volume <= 0 or length <= 0:
        return None
    radius = float(np.sqrt(volume / (np.pi * length)))
    radial_distance = np.linalg.norm(points - mean - along[:, None] * axis, axis=1)
    if np.abs(radial_distance - radius).max() > max(TOLERANCE_M, TOLERANCE_RADII * radius) or length < 2 * radius:
        return None
    x, y, z = (mean + (along.min() + along.max()) / 2 * axis).tolist()
    return Cylinder((x, y, z), tuple(axis.tolist()), radius, length, code)

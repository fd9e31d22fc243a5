"""Rectilinear solids as boxes: slabs of walls with openings and furniture, upright and at any heading, exactly.

A solid is cut at the planes of all its faces; cells inside it are merged into boxes.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F64, I64, Bools, Mesh
from scan2sim.pipeline.geometry.fitted_boxes import Box

WELD_M = 0.001
"""Vertices and planes that are nearer are the same."""
MIN_COSINE = 0.9999
"""Cosine of the angle between a face's normal and an axis up to which the face is perpendicular to it."""
MAX_CELLS_TIMES_FACES = 20_000_000
MAX_WINDING_ERROR = 0.1
"""Deviation of winding numbers from whole ones above which a surface is not closed."""


def is_rectilinear(mesh: Mesh) -> bool:
    """Whether every face is level or upright: modelled slabs and boxes, which no scanned surface is."""
    return bool(len(mesh)) and bool(_upright_or_level(_normals(mesh.corners.astype(np.float64))).all())


def split_boxes(mesh: Mesh) -> tuple[list[Box], Mesh]:
    """Split a mesh into boxes, which are its closed pieces of upright and level faces, and the remaining faces."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(mesh):
        return [], mesh
    _, vertex = np.unique(np.rint(mesh.vertices / WELD_M).astype(np.int64), axis=0, return_inverse=True)
    links = vertex.ravel()[mesh.faces[:, [0, 1, 1, 2]]].reshape(-1, 2)
    n = len(mesh.vertices)
    _, piece = connected_components(coo_matrix((np.ones(len(links), bool), links.T), shape=(n, n)), directed=False)
    piece = piece[links[::2, 0]]
    corners = mesh.corners.astype(np.float64)
    suitable = np.bincount(piece, ~_upright_or_level(_normals(corners)), minlength=n) == 0
    order = np.argsort(piece, kind="stable")
    rest = np.ones(len(mesh), bool)
    found: list[Box] = []
    for own in np.split(order, np.flatnonzero(np.diff(piece[order])) + 1):
        boxes = _boxes(corners[own]) if suitable[piece[own[0]]] else []
        found += boxes
        rest[own] = not boxes
    return found, mesh.keep(rest)


def _normals(corners: F64) -> F64:
    """Normals (F, 3) of triangles (F, 3, 3), as long as twice their areas."""
    return np.asarray(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def _upright_or_level(normal: F64) -> Bools:
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    z = np.abs(normal[:, 2]) / length
    return np.asarray((z > MIN_COSINE) | (z < np.sqrt(1 - MIN_COSINE**2)) | (length < WELD_M**2))


def _boxes(corners: F64) -> list[Box]:
    """Boxes of one piece (F, 3, 3); empty if its faces have more than two headings, or if it is not closed."""
    normal = _normals(corners)
    widest = normal[np.linalg.norm(normal[:, :2], axis=1).argmax()]
    heading = float(np.arctan2(widest[1], widest[0]))
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, -s], [s, c]])
    own, normal = (np.concatenate([part[..., :2] @ turn, part[..., 2:]], axis=-1) for part in (corners, normal))
    length = np.linalg.norm(normal, axis=1)
    if (np.abs(normal).max(axis=1) < MIN_COSINE * length)[length > WELD_M**2].any():
        return []
    cuts = [_distinct(own[..., axis].ravel()) for axis in range(3)]
    middle = [(cut[1:] + cut[:-1]) / 2 for cut in cuts]
    shape = tuple(map(len, middle))
    if not 0 < np.prod(shape) * len(own) <= MAX_CELLS_TIMES_FACES:
        return []
    centres = np.stack(np.meshgrid(*middle, indexing="ij"), axis=-1).reshape(-1, 3)
    winding = np.abs(_winding_numbers(own, centres))
    if np.abs(winding - np.rint(winding)).max() > MAX_WINDING_ERROR:
        return []
    found = []
    for low, high in _merged((winding > 0.5).reshape(shape)):
        corner = [np.array([cuts[axis][at[axis]] for axis in range(3)]) for at in (low, high)]
        found.append(Box(heading, *corner))
    return found


def _distinct(values: F64) -> F64:
    """Sorted values without those that follow another one closely."""
    values = np.sort(values)
    return np.asarray(values[np.diff(values, prepend=-np.inf) > WELD_M])


def _winding_numbers(corners: F64, points: F64) -> F64:
    """Winding numbers (N,) of triangles (F, 3, 3) around points (N, 3) (van Oosterom and Strackee 1983)."""
    total = np.zeros(len(points))
    for triangle in corners:
        a, b, c = (corner - points for corner in triangle)
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        volume = np.einsum("ij,ij->i", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a)))
        total += 2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
    return np.asarray(total / (4 * np.pi))


def _merged(solid: Bools) -> list[tuple[I64, I64]]:
    """First cells and cells after the last ones, (3,) each, of blocks that cover the solid cells exactly."""
    left, found = solid.copy(), []
    while left.any():
        low = np.array(np.unravel_index(int(left.argmax()), left.shape))
        high = low + 1
        for axis in (2, 1, 0):
            while high[axis] < left.shape[axis]:
                low_side, high_side = low.copy(), high.copy()
                low_side[axis], high_side[axis] = high[axis], high[axis] + 1
                if not left[tuple(map(slice, low_side, high_side))].all():
                    break
                high[axis] += 1
        left[tuple(map(slice, low, high))] = False
        found.append((low, high))
    return found

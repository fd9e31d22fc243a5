"""Texture of the mesh that a tile was made from, baked onto the simplified surface. Import late: it loads numba.

A texel takes the colour of the nearest point on the source, averaged over the texel's area in the source's image. Where
the nearest point is on the other side of a thin wall, the nearest point along the normal on the same side is taken.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.core.types import F32, I32, I64, Bools
from scan2sim.pipeline.io.source_mesh import SourceMesh, Texels
from scan2sim.texturing.inpainting.hole_filling import texel_points
from scan2sim.texturing.texel_map import frame
from scan2sim.texturing.texture_page import SEEN, Page

CHUNK = 1_000_000
"""Texels that are looked up at a time, to bound memory."""
SAME_SIDE_MIN_COS = -0.2
"""Cosine between the normals below which the nearest point is on the other side of a thin wall."""
OTHER_SIDE_MAX_M = 0.3
"""Distance along the normal up to which the same side is looked for."""


class _Places(NamedTuple):
    """Points on the source: face (N,), and barycentric weights (N,) of its second and third corner."""

    face: I32
    second: F32
    third: F32


class SourceTexture:
    """Paints pages with the colours of a source mesh.

    Args:
        source: in the local coordinates of the pages' faces.
    """

    def __init__(self, source: SourceMesh) -> None:
        import open3d as o3d

        self._source = source
        self._coloured = source.coloured
        self._normal = source.mesh.face_normal
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            np.ascontiguousarray(source.mesh.vertices), np.ascontiguousarray(source.mesh.faces.astype(np.uint32))
        )

    def paint(self, page: Page) -> None:
        """Colour the texels without a colour, in place, except where the source has none."""
        rows, columns = np.nonzero((page.owner >= 0) & (page.seen == 0))
        if not len(rows):
            return
        per_x, per_y, normal = _frames(page.flat, page.corners)
        owner = page.owner[rows, columns]
        parts = []
        for start in range(0, len(rows), CHUNK):
            part = slice(start, start + CHUNK)
            points = texel_points(page.owner, page.flat, page.corners, rows[part], columns[part])
            parts.append(self._nearest(points, normal[owner[part]]))
        found = _Places(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        good = self._coloured[found.face]
        texels = Texels(owner[good], per_x, per_y)
        colours = self._source.colours(found.face[good], found.second[good], found.third[good], texels)
        page.rgb[rows[good], columns[good]] = colours
        page.seen[rows[good], columns[good]] = SEEN

    def _nearest(self, points: F32, normal: F32) -> _Places:
        """Points on the source nearest to `points` (N, 3) on faces with normals (N, 3)."""
        import open3d as o3d

        hit = self._scene.compute_closest_points(o3d.core.Tensor.from_numpy(points))
        face = hit["primitive_ids"].numpy().astype(np.int32)
        weights = hit["primitive_uvs"].numpy().copy()
        behind = np.flatnonzero(np.einsum("ij,ij->i", self._normal[face], normal) < SAME_SIDE_MIN_COS)
        if len(behind):
            best = np.full(len(behind), np.inf, np.float32)
            for sign in (1, -1):
                start = points[behind]
                rays = np.concatenate([start, sign * normal[behind]], axis=1).astype(np.float32)
                cast = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
                distance, other = cast["t_hit"].numpy(), cast["primitive_ids"].numpy()
                hits = np.isfinite(distance) & (distance < np.minimum(best, OTHER_SIDE_MAX_M))
                hits[hits] = self._same_side(other[hits], normal[behind[hits]])
                best[hits] = distance[hits]
                face[behind[hits]] = other[hits]
                weights[behind[hits]] = cast["primitive_uvs"].numpy()[hits]
        return _Places(face, weights[:, 0].copy(), weights[:, 1].copy())

    def _same_side(self, face: I64, normal: F32) -> Bools:
        return np.asarray(np.einsum("ij,ij->i", self._normal[face], normal) >= SAME_SIDE_MIN_COS)


@njit(cache=True, parallel=True)
def _frames(flat: F32, corners: F32) -> tuple[F32, F32, F32]:
    """Metres per texel in x and y, and unit normal, (F, 3) each, of every face; zero if it is degenerate."""
    per_x, per_y = np.zeros((len(flat), 3), np.float32), np.zeros((len(flat), 3), np.float32)
    normal = np.zeros((len(flat), 3), np.float32)
    for f in prange(len(flat)):
        _, x, y, _ = frame(flat, corners, f)
        n = np.cross(
            (corners[f, 1] - corners[f, 0]).astype(np.float64), (corners[f, 2] - corners[f, 0]).astype(np.float64)
        )
        length = max(np.sqrt((n * n).sum()), 1e-20)
        for k in range(3):
            per_x[f, k], per_y[f, k], normal[f, k] = x[k], y[k], n[k] / length
    return per_x, per_y, normal

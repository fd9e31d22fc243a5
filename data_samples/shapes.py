"""Triangle meshes of simple shapes: quads, boxes, tubes, bumpy blobs, walls with openings, leaves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from scan2sim.data_samples.paints import Material, Paint
from scan2sim.pipeline.core.types import F32, F64, I32, U8

Field = Callable[[F64], F64]


@dataclass(frozen=True)
class Part:
    """Triangle mesh with materials.

    Attributes:
        vertices: (V, 3) float32 metres.
        normals: (V, 3) float32 unit shading normals.
        uv: (V, 2) float32 texture coordinates, as defined by the material.
        sky: (V,) float32 sky openness in [0, 1]; NaN where it must still be traced.
        faces: (F, 3) int32, counter-clockwise seen from outside.
        material, classification: (F,) uint8.
        colour: (F, 3) float32 linear RGB.
        seed: (F,) int32 seed of the material's pattern.
        size: (F, 2) float32 extent of the uv of openings, metres.
    """

    vertices: F32
    normals: F32
    uv: F32
    sky: F32
    faces: I32
    material: U8
    classification: U8
    colour: F32
    seed: I32
    size: F32

    def moved(self, heading: float | F64, position: npt.ArrayLike) -> Part:
        """Mesh rotated by `heading` (radians, about z), then translated by `position`."""
        c, s = np.cos(heading), np.sin(heading)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return replace(
            self,
            vertices=(self.vertices @ turn.T + np.asarray(position)).astype(np.float32),
            normals=(self.normals @ turn.T).astype(np.float32),
        )


class Opening(NamedTuple):
    """A window or door in a wall: its rectangle in the wall's plane, metres, and its paint."""

    x0: float
    z0: float
    x1: float
    z1: float
    paint: Paint


def part(
    vertices: npt.ArrayLike,
    faces: npt.ArrayLike,
    uv: npt.ArrayLike,
    paint: Paint,
    *,
    normals: npt.ArrayLike | None = None,
    size: tuple[float, float] = (1.0, 1.0),
    sky: npt.ArrayLike | None = None,
    seeds: npt.ArrayLike | None = None,
) -> Part:
    """Mesh with a single paint; normals are averaged over the faces around a vertex unless given."""
    xyz, tri = np.asarray(vertices, np.float64), np.asarray(faces, np.int32).reshape(-1, 3)
    n = len(tri)
    return Part(
        vertices=xyz.astype(np.float32),
        normals=np.asarray(smooth_normals(xyz, tri) if normals is None else normals, np.float32),
        uv=np.asarray(uv, np.float32),
        sky=np.full(len(xyz), np.nan, np.float32) if sky is None else np.asarray(sky, np.float32),
        faces=tri,
        material=np.full(n, paint.material, np.uint8),
        classification=np.full(n, paint.classification, np.uint8),
        colour=np.tile(np.array(paint.colour, np.float32), (n, 1)),
        seed=np.full(n, paint.seed, np.int32) if seeds is None else np.asarray(seeds, np.int32),
        size=np.tile(np.array(size, np.float32), (n, 1)),
    )


def join(parts: Sequence[Part]) -> Part:
    """Concatenation of several meshes."""
    starts = np.cumsum([0] + [len(p.vertices) for p in parts])
    columns = {
        name: np.concatenate([getattr(p, name) for p in parts])
        for name in ("vertices", "normals", "uv", "sky", "material", "classification", "colour", "seed", "size")
    }
    return Part(faces=np.concatenate([p.faces + np.int32(s) for p, s in zip(parts, starts, strict=False)]), **columns)


def smooth_normals(vertices: F64, faces: I32) -> F64:
    """(V, 3) unit normals, area-weighted over the faces around each vertex."""
    c = vertices[faces]
    cross = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
    total = np.stack([np.bincount(faces.ravel(), np.repeat(cross[:, k], 3), len(vertices)) for k in range(3)], axis=1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def quads(corners: npt.ArrayLike, uv: npt.ArrayLike, paint: Paint, size: tuple[float, float] = (1.0, 1.0)) -> Part:
    """Separate flat quads: corners (Q, 4, 3) counter-clockwise, uv (Q, 4, 2)."""
    xyz = np.asarray(corners, np.float64).reshape(-1, 3)
    faces = (4 * np.arange(len(xyz) // 4)[:, None] + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3)
    return part(xyz, faces, np.asarray(uv).reshape(-1, 2), paint, size=size)


def box(low: npt.ArrayLike, high: npt.ArrayLike, paint: Paint, *, bottom: bool = False) -> Part:
    """An axis-parallel box, uv in metres along each side; without its lower face unless `bottom`."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low, float), np.asarray(high, float)
    sides = [
        ([(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)], (0, 2)),
        ([(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)], (1, 2)),
        ([(x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1)], (0, 2)),
        ([(x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1)], (1, 2)),
        ([(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)], (0, 1)),
    ]
    if bottom:
        sides.append(([(x0, y1, z0), (x1, y1, z0), (x1, y0, z0), (x0, y0, z0)], (0, 1)))
    corners = np.array([side for side, _ in sides])
    uv = np.stack([c[:, list(axes)] for c, (_, axes) in zip(corners, sides, strict=True)])
    return quads(corners, uv, paint)


def tube(path: npt.ArrayLike, radii: npt.ArrayLike, paint: Paint, sides: int = 10) -> Part:
    """A round tube along `path` (P, 3) with radii (P,), closed at its end."""
    path, radii = np.asarray(path, float), np.asarray(radii, float)
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    helper = np.where(np.abs(along[:, 2:]) > 0.9, [[1.0, 0, 0]], [[0, 0, 1.0]])
    a = np.cross(helper, along)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(along, a)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.cos(angle)[None, :, None] * a[:, None] + np.sin(angle)[None, :, None] * b[:, None]
    xyz = path[:, None] + radii[:, None, None] * ring
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    uv = np.stack(np.broadcast_arrays(angle[None] * radii.max(), length[:, None]), axis=-1)
    body = part(
        xyz.reshape(-1, 3), _lattice(len(path), sides + 1), uv.reshape(-1, 2), paint, normals=ring.reshape(-1, 3)
    )
    fan = np.concatenate([xyz[-1, :-1], path[-1:]])
    tip = np.stack([np.arange(sides), np.roll(np.arange(sides), -1), np.full(sides, sides)], axis=1)
    return join([body, part(fan, tip, fan[:, :2], paint)])


def _lattice(rows: int, columns: int) -> I32:
    """Faces of a grid of vertices (rows, columns), counter-clockwise for columns x rows = outside."""
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3).astype(np.int32)


def sheet(xyz: F64, uv: F64, paint: Paint) -> Part:
    """A smooth surface from a grid of vertices (rows, columns, 3)."""
    rows, columns = xyz.shape[:2]
    return part(xyz.reshape(-1, 3), _lattice(rows, columns), uv.reshape(-1, 2), paint)


def waves(rng: np.random.Generator, wavelength: float, count: int = 14, dimensions: int = 3) -> Field:
    """Smooth random field of about [-1, 1], a sum of plane waves no shorter than 0.6 of `wavelength`."""
    direction = rng.normal(size=(count, dimensions))
    direction *= (2 * np.pi / wavelength / rng.uniform(0.6, 1.8, count) / np.linalg.norm(direction, axis=1))[:, None]
    phase = rng.uniform(0, 2 * np.pi, count)

    def field(points: F64) -> F64:
        return np.sin(points @ direction.T + phase).sum(axis=-1) / np.sqrt(count / 2) / 2

    return field


def blob(
    centre: npt.ArrayLike, radii: npt.ArrayLike, rng: np.random.Generator, paint: Paint, *, bump: float = 0.12,
    wavelength: float = 0.7, rounds: int = 3, shade: tuple[float, float] | None = None,
) -> Part:  # fmt: skip
    """A bumpy ellipsoid; `shade`: sky openness at its bottom and top; None: to be traced."""
    unit, faces = _sphere(rounds)
    radii = np.broadcast_to(np.asarray(radii, float), 3)
    xyz = unit * radii
    xyz = xyz * (1 + bump * waves(rng, wavelength)(xyz))[:, None]
    uv = np.stack([np.arctan2(unit[:, 1], unit[:, 0]) * radii[0], unit[:, 2] * radii[2]], axis=1)
    sky = None if shade is None else shade[0] + (shade[1] - shade[0]) * (unit[:, 2] + 1) / 2
    return part(xyz + np.asarray(centre, float), faces, uv, paint, sky=sky)


def _sphere(rounds: int) -> tuple[F64, I32]:
    """Vertices and faces of an icosahedron on the unit sphere, subdivided `rounds` times."""
    g = (1 + 5**0.5) / 2
    xyz = np.array(
        [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g), (0, -1, -g), (0, 1, -g),
         (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)], float,
    )  # fmt: skip
    faces = np.array(
        [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6),
         (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10),
         (8, 6, 7), (9, 8, 1)], np.int32,
    )  # fmt: skip
    for _ in range(rounds):
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        middle = (len(xyz) + inverse.reshape(-1, 3)).astype(np.int32)
        xyz = np.concatenate([xyz, xyz[unique].mean(axis=1)])
        a, b, c = faces.T
        p, q, r = middle.T
        faces = np.stack([a, p, r, b, q, p, c, r, q, p, q, r], axis=1).reshape(-1, 3)
    return xyz / np.linalg.norm(xyz, axis=1, keepdims=True), faces


def leaves(points: F64, outward: F64, sky: F64, rng: np.random.Generator, paint: Paint, length: float = 0.16) -> Part:
    """Rhombic leaves at `points` (N, 3), facing approximately `outward` (N, 3), which also determines their shading."""
    n = len(points)
    if n == 0:
        return part(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2)), paint, normals=np.zeros((0, 3)))
    facing = outward + 0.75 * rng.normal(size=(n, 3))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    along = np.cross(facing, rng.normal(size=(n, 3)))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(facing, along)
    long = length * rng.uniform(0.7, 1.25, (n, 1))
    corners = np.stack([-long * along / 2, -0.28 * long * across, long * along / 2, 0.28 * long * across], axis=1)
    corners += points[:, None]
    uv = np.stack([corners[..., 0] + corners[..., 1], corners[..., 2]], axis=-1)
    faces = (4 * np.arange(n)[:, None] + np.array([0, 2, 1, 0, 3, 2])).reshape(-1, 3)
    shading = outward + 0.35 * facing
    shading /= np.linalg.norm(shading, axis=1, keepdims=True)
    return part(
        corners.reshape(-1, 3), faces, uv.reshape(-1, 2), paint,
        normals=np.repeat(shading, 4, axis=0), sky=np.repeat(sky, 4),
        seeds=np.repeat(paint.seed + rng.integers(0, 1 << 20, n), 2),
    )  # fmt: skip


def wall(
    width: float, height: float, openings: Sequence[Opening], paint: Paint, *, foot: float = 0.0, recess: float = 0.14,
    plinth: tuple[float, Paint] | None = None,
) -> Part:  # fmt: skip
    """A wall in the plane y = 0, facing -y, with recessed openings.

    Args:
        width: extent along x from 0, metres.
        height: upper end; the wall starts at z = -foot.
        openings: windows and doors.
        paint: paint of the wall.
        foot: depth below z = 0, metres.
        recess: depth of the openings, metres.
        plinth: height below which the wall has another paint, and this paint.
    """
    rows = {-foot, height, *(o.z0 for o in openings), *(o.z1 for o in openings)}
    if plinth:
        rows.add(plinth[0])
    x, z = np.unique([0.0, width, *(o.x0 for o in openings), *(o.x1 for o in openings)]), np.array(sorted(rows))
    xm, zm = np.meshgrid((x[1:] + x[:-1]) / 2, (z[1:] + z[:-1]) / 2)
    solid = np.ones(xm.shape, bool)
    for o in openings:
        solid &= ~((xm > o.x0) & (xm < o.x1) & (zm > o.z0) & (zm < o.z1))
    low = np.zeros_like(solid) if plinth is None else zm < plinth[0]
    parts = []
    for mask, own in ((solid & ~low, paint), (solid & low, plinth[1] if plinth else paint)):
        j, i = np.nonzero(mask)
        if len(i):
            flat = np.stack([x[[i, i + 1, i + 1, i]], z[[j, j, j + 1, j + 1]]], axis=-1).transpose(1, 0, 2)
            parts.append(quads(np.insert(flat, 1, 0.0, axis=2), flat, own))
    for o in openings:
        a, b, c, d, r = o.x0, o.x1, o.z0, o.z1, recess
        reveal = [
            [(a, 0, c), (a, 0, d), (a, r, d), (a, r, c)], [(b, 0, d), (b, 0, c), (b, r, c), (b, r, d)],
            [(a, 0, d), (b, 0, d), (b, r, d), (a, r, d)], [(b, 0, c), (a, 0, c), (a, r, c), (b, r, c)],
        ]  # fmt: skip
        uv = [[(p[0] + p[1], p[2] + p[1]) for p in quad] for quad in reveal]
        parts.append(quads(np.array(reveal)[:, ::-1], np.array(uv)[:, ::-1], paint._replace(material=Material.PLAIN)))
        pane = [[(a, r, c), (b, r, c), (b, r, d), (a, r, d)]]
        w, h = b - a, d - c
        parts.append(quads(pane, [[(0, 0), (w, 0), (w, h), (0, h)]], o.paint, size=(w, h)))
    return join(parts)

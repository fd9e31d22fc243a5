"""Borders: where tiles that were made apart meet, with the same vertices at the same height.

`clip` cuts a mesh to its tile's cell, `join` fits its border to that of the tile whose name sorts first, `gap`
measures what lies between two finished meshes. The vertices on borders are multiples of `GRID` in world metres:
float32 holds them exactly in any tile's local coordinates (origins are whole metres, tiles below 2 km), so that
"the same place" means the same bits.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.cells import Cell
from scan2sim.pipeline.types import F64, Frame, Mesh

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

GRID = 2.0**-12
"""Metres: places on borders are multiples of it, in world coordinates."""
ON = 1e-4
"""Metres from a border within which a vertex counts as lying on it."""
SNAP = 0.02
"""Metres that a vertex may slide along its edge to the border, where a cut would leave a sliver."""
SHORT = 0.002
"""Metres: edges along a border that are no longer become one vertex."""
LEAST = 0.1
"""Share of a face's area that sliding must leave, seen in the direction of its normal."""
FACING = 0.1
"""Metres that a normal's turn by 60 degrees counts for where the counterpart of a vertex is looked for."""
AGAINST = 4.0
"""What a metre along the other's border costs in the wrong direction."""
DETOUR, MORE = 3.0, 0.5
"""What an edge may cost that is made to follow the other's border: so many times its length, and as much more."""
ROUNDS = 30
"""Tries at turning back the faces that moving the border has turned over."""
COUNTERPART = 0.3
"""Metres within which two borders are parts of one, for the measure."""
STEP = 0.01
"""Metres between the places at which a gap is measured."""


@dataclass(frozen=True)
class Clipped:
    """A mesh cut to its cell.

    Attributes:
        mesh: nothing of it reaches beyond a border.
        on: neighbour's name to (V,): the vertex lies on the border with it; one in a corner lies on several.
    """

    mesh: Mesh
    on: Mapping[str, Bools]

    def save(self, mesh: Path, on: Path) -> None:
        """Write as two .npz."""
        self.mesh.save(mesh)
        with open(on, "wb") as file:
            np.savez(file, names=np.array(list(self.on), str), on=_stack(self.on, len(self.mesh.vertices)))

    @classmethod
    def load(cls, mesh: Path, on: Path) -> Clipped:
        """Read what `save` wrote."""
        with np.load(on) as data:
            return cls(Mesh.load(mesh), dict(zip(data["names"].tolist(), data["on"].T, strict=True)))


def on_grid(xyz: F64) -> F64:
    """World places (N, 3) rounded to multiples of `GRID`."""
    return np.rint(xyz / GRID) * GRID


def world(mesh: Mesh) -> F64:
    """(V, 3) vertices in world metres."""
    return mesh.vertices.astype(np.float64) + np.asarray(mesh.frame.origin)


def _mesh(frame: Frame, xyz: F64, faces: npt.NDArray[Any]) -> Mesh:
    """From world metres."""
    return Mesh(frame, (xyz - np.asarray(frame.origin)).astype(np.float32), faces.astype(np.int32))


def _stack(on: Mapping[str, Bools], n: int) -> Bools:
    """(n, names)."""
    return np.stack(list(on.values()), axis=1) if on else np.zeros((n, 0), bool)


def _cross(corners: F64) -> F64:
    """(F, 3) normals of corners (F, 3, 3), as long as twice the area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _edges(faces: npt.NDArray[Any]) -> Ints:
    """(3 F, 2) directed edges: those from every face's first corner, then those from its second, then its third."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)


def _welded(faces: Ints, pairs: Ints, n: int) -> tuple[Ints, Bools, Ints]:
    """Make vertices one that `pairs` (P, 2) say are; of `n` in all.

    Returns:
        The faces that are left (K, 3), which they are (F,), and (n,) what each vertex has become: the lowest of all
        that hang together. Faces go that have lost an edge, and those that have come to lie on each other.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(pairs):
        return faces, np.ones(len(faces), bool), np.arange(n)
    _, piece = connected_components(coo_matrix((np.ones(len(pairs), bool), pairs.T), shape=(n, n)), directed=False)
    _, first = np.unique(piece, return_index=True)
    weld = first[piece]
    touched = np.isin(weld, weld[pairs])[faces].any(axis=1)
    faces = weld[faces]
    left = np.all(faces != np.roll(faces, 1, axis=1), axis=1)
    here = np.flatnonzero(touched & left)
    _, index, count = np.unique(np.sort(faces[here], axis=1), axis=0, return_inverse=True, return_counts=True)
    left[here[count[index.ravel()] > 1]] = False
    return faces[left], left, weld


# --- clip ---


def clip(mesh: Mesh, cell: Cell) -> Clipped:
    """Cut a mesh to its tile's cell, border after border; `density` and the like are dropped.

    Edges that cross a border are cut there, once for all their faces. Where the cut would come close to a vertex,
    the vertex slides along the edge onto the border instead, so that no slivers arise. Faces that lie in a border
    altogether go.
    """
    xyz, faces = world(mesh), mesh.faces.astype(np.int64)
    names = sorted(cell.neighbours)
    on = np.zeros((len(xyz), len(names)), bool)
    for k, name in enumerate(names):
        distance = cell.beyond(name, xyz[:, :2])
        if (distance > -ON).any():
            xyz, faces, on = _cut(xyz, faces, on, distance, k)
    border = on.sum(axis=1) > 0
    xyz[border] = on_grid(xyz[border])
    for short in (0.0, SHORT):  # first those that have come to lie in one place, be it a corner
        edges = _edges(faces[border[faces].sum(axis=1) > 1])
        length = np.linalg.norm(xyz[edges[:, 0]] - xyz[edges[:, 1]], axis=1)
        same = (on[edges[:, 0]] == on[edges[:, 1]]).all(axis=1) & border[edges[:, 0]]
        faces, _, weld = _welded(faces, edges[(length <= short) & (same if short else True)], len(xyz))
        gone = np.flatnonzero(weld != np.arange(len(xyz)))
        np.logical_or.at(on, weld[gone], on[gone])
    used, faces = np.unique(faces, return_inverse=True)
    xyz, faces, on = xyz[used], faces.reshape(-1, 3), on[used]
    return Clipped(_mesh(mesh.frame, xyz, faces), {name: on[:, k] for k, name in enumerate(names)})


def _cut(xyz: F64, faces: Ints, on: Bools, distance: F64, k: int) -> tuple[F64, Ints, Bools]:
    """Cut at border `k`, which vertices lie `distance` (V,) beyond."""
    side = np.sign(np.where(np.abs(distance) <= ON, 0, distance)).astype(np.int8)
    xyz, side = _slid(xyz, faces, on, distance, side)
    on = on.copy()
    on[:, k] = side == 0
    faces = faces[(side[faces] < 0).any(axis=1)]  # not those in the border or beyond it
    crosses = (side[faces] > 0).any(axis=1)
    a, b, cut = _crossings(faces[crosses], side)
    places = xyz[a] + (distance[a] / (distance[a] - distance[b]))[:, None] * (xyz[b] - xyz[a])
    flags = on[a] & on[b]
    flags[:, k] = True
    cut[cut >= 0] += len(xyz)
    xyz, on = np.concatenate([xyz, places]), np.concatenate([on, flags])
    # round each cut face: its corners on this side, and the cuts of its edges, in order
    kept = np.where(side[faces[crosses]] <= 0, faces[crosses], -1)
    ring = np.stack([kept, cut], axis=2).reshape(-1, 6)
    ring = np.take_along_axis(ring, np.argsort(ring < 0, axis=1, kind="stable"), axis=1)[:, :4]
    return xyz, np.concatenate([faces[~crosses], _fans(xyz, ring)]), on


def _crossings(faces: Ints, side: npt.NDArray[np.int8]) -> tuple[Ints, Ints, Ints]:
    """Edges that cross: both ends, and (F, 3) each face's (first corner to second, ...) index into them, or -1."""
    edges = np.sort(_edges(faces), axis=1)
    across = side[edges[:, 0]] * side[edges[:, 1]] < 0
    ends, inverse = np.unique(edges[across], axis=0, return_inverse=True)
    index = np.full(len(edges), -1)
    index[across] = inverse.ravel()
    return ends[:, 0], ends[:, 1], index.reshape(3, -1).T


def _fans(xyz: F64, ring: Ints) -> Ints:
    """Triangles of polygons (F, 4), the fourth corner -1 where there are but three; quads by their shorter diagonal."""
    quad = ring[ring[:, 3] >= 0]
    corners = xyz[quad]
    first, second = (np.linalg.norm(corners[:, i] - corners[:, i + 2], axis=1) for i in (0, 1))
    other = first > second
    quad[other] = np.roll(quad[other], -1, axis=1)
    return np.concatenate([ring[ring[:, 3] < 0, :3], quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])


def _slid(
    xyz: F64, faces: Ints, on: Bools, distance: F64, side: npt.NDArray[np.int8]
) -> tuple[F64, npt.NDArray[np.int8]]:
    """Vertices close to a border slid onto it along one of their edges that cross it; new places and sides.

    A vertex that lies on borders already slides along edges in those alone. None slides that would turn a face
    over, shrink it to nothing or lay it into the border.
    """
    at = faces[(side[faces] < 0).any(axis=1)]
    a, b, _ = _crossings(at[(side[at] > 0).any(axis=1)], side)
    share = distance[a] / (distance[a] - distance[b])
    places = xyz[a] + share[:, None] * (xyz[b] - xyz[a])
    way = np.concatenate([share, 1 - share]) * np.tile(np.linalg.norm(xyz[b] - xyz[a], axis=1), 2)
    vertex, other, place = np.concatenate([a, b]), np.concatenate([b, a]), np.concatenate([places, places])
    may = (way <= SNAP) & (np.concatenate([share, 1 - share]) <= 0.5) & (on[vertex] <= on[other]).all(axis=1)
    vertex, place, way = vertex[may], place[may], way[may]
    order = np.lexsort((way, vertex))  # each along its shortest way
    vertex, first = np.unique(vertex[order], return_index=True)
    place = place[order][first]

    moves = np.zeros(len(xyz), bool)
    moves[vertex] = True
    at = at[moves[at].any(axis=1)]
    before = _cross(xyz[at])
    while len(vertex):
        slid, sides = xyz.copy(), side.copy()
        slid[vertex], sides[vertex] = place, 0
        matters = (sides[at] < 0).any(axis=1) | (sides[at] == 0).all(axis=1)
        kept = np.einsum("ij,ij->i", _cross(slid[at]), before) > LEAST * np.einsum("ij,ij->i", before, before)
        bad = np.zeros(len(xyz), bool)
        bad[at[matters & (~kept | (sides[at] == 0).all(axis=1))]] = True
        if not bad[vertex].any():
            return slid, sides
        vertex, place = vertex[~bad[vertex]], place[~bad[vertex]]
    return xyz, side


# --- join ---


class Curve(NamedTuple):
    """The edge that a mesh has on one of its borders.

    Attributes:
        edges: (E, 2) directed as in their faces; into the mesh's vertices.
        face: (E,) the face of each.
    """

    edges: Ints
    face: Ints


def curve(faces: npt.NDArray[Any], on: Bools) -> Curve:
    """The edges of one face alone whose both ends lie `on` (V,) a border."""
    near = np.flatnonzero(on[faces].sum(axis=1) > 1)
    edges, face = _edges(faces[near]), np.tile(near, 3)
    along = on[edges].all(axis=1)
    edges, face = edges[along], face[along]
    _, index, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    alone = count[index.ravel()] == 1
    return Curve(edges[alone], face[alone])


def chains(edges: Ints, ends: Iterable[int] = ()) -> list[list[int]]:
    """Edges in a row, as lists of vertices; closed ones name their first vertex again at the end.

    Args:
        edges: (E, 2) directed.
        ends: vertices where chains end even if they could go on.
    """
    after: dict[int, list[int]] = defaultdict(list)
    incoming: dict[int, int] = defaultdict(int)
    for a, b in edges.tolist():
        after[a].append(b)
        incoming[b] += 1
    stops = {v for v in {*after, *incoming} if len(after.get(v, ())) != 1 or incoming.get(v, 0) != 1} | set(ends)
    found = []
    for start in [*sorted(stops), *sorted(set(after) - stops)]:  # what is left after the open ones are loops
        while after.get(start):
            chain = [start, after[start].pop()]
            while chain[-1] not in stops and after.get(chain[-1]):
                chain.append(after[chain[-1]].pop())
            found.append(chain)
    return found


@dataclass(frozen=True)
class Joined:
    """A mesh that meets its neighbours.

    Attributes:
        mesh: the result.
        facts: for every neighbour that was given and owns its border: see `join`.
        turned: faces that the move has turned by more than a right angle, for good.
    """

    mesh: Mesh
    facts: dict[str, dict[str, float]]
    turned: int


class Follow(NamedTuple):
    """How a border is to follow a neighbour's.

    Attributes:
        vertices: (M,) that move.
        places: (M, 3) where to, world metres.
        welds: (W, 2) vertices that become one.
        inserts: (face, a, b, places (N, 3)): new vertices on the edge a-b of a face, in order.
        facts: see `join`.
    """

    vertices: Ints
    places: F64
    welds: Ints
    inserts: list[tuple[int, int, int, F64]]
    facts: dict[str, float]


def join(name: str, clips: Mapping[str, Clipped], tolerance: float, reach: float) -> Joined:
    """Fit the border of tile `name` to those of its neighbours that own theirs: whose names sort before it.

    Every vertex on a border is moved to its counterpart there, and edges follow the owner's, vertex for vertex.
    In a corner all tiles go to where the first of them (by name) that has a vertex there has it. The surface behind
    the border goes with it, ever less up to `reach`: a ramp, no step.

    Args:
        name: of the tile.
        clips: of the tile and of those neighbours that there are, by name.
        tolerance: metres that a vertex may be moved.
        reach: metres from the border at which the surface stays as it was.

    Returns:
        With facts for each neighbour: vertices `matched` and `unmatched`, `mean_m` and `max_m` that matched ones
        moved, and the `edges` that were `followed` of the neighbour's `edges`.
    """
    own = clips[name]
    start, places = world(own.mesh), _cornered(name, clips, tolerance)
    owners = [other for other in sorted(own.on) if other < name and other in clips]
    follows = {
        other: _follow(name, own, places, other, clips[other], _cornered(other, clips, tolerance), tolerance)
        for other in owners
    }
    for follow in follows.values():
        places[follow.vertices] = follow.places
    free = ~_stack(own.on, len(start)).any(axis=1)
    moved = np.flatnonzero((places != start).any(axis=1))
    places[free] += _ramp(start[free], start[moved], (places - start)[moved], reach)

    faces, parent, added = _split(own.mesh.faces, [i for f in follows.values() for i in f.inserts], len(start))
    xyz, free = np.concatenate([places, added]), np.concatenate([free, np.zeros(len(added), bool)])
    welds = np.concatenate([np.empty((0, 2), np.int64), *(f.welds for f in follows.values())])
    faces, left, _ = _welded(faces, welds, len(xyz))
    before = _cross(start[own.mesh.faces[parent[left]]])
    xyz, turned = _turned_back(xyz, faces, before, free)
    mesh = _mesh(own.mesh.frame, xyz, faces).keep(np.ones(len(faces), bool))
    return Joined(mesh, {other: follow.facts for other, follow in follows.items()}, turned)


def _cornered(name: str, clips: Mapping[str, Clipped], tolerance: float) -> F64:
    """(V, 3) world places of a clip's vertices, those in corners where the first tile has them."""
    from scipy.spatial import cKDTree

    clip = clips[name]
    xyz, names = world(clip.mesh), list(clip.on)
    on = _stack(clip.on, len(xyz))
    corner = np.flatnonzero(on.sum(axis=1) > 1)
    for flags in np.unique(on[corner], axis=0):
        left = corner[(on[corner] == flags).all(axis=1)]
        tiles = {name, *(names[k] for k in np.flatnonzero(flags))}
        for tile in sorted(tiles):
            if tile == name:  # the others go to where this one has it
                break
            if tile not in clips or not tiles - {tile} <= set(clips[tile].on):
                continue
            theirs = np.logical_and.reduce([clips[tile].on[other] for other in tiles - {tile}])
            places = world(clips[tile].mesh)[theirs]
            if len(places) and len(left):
                distance, nearest = cKDTree(places).query(xyz[left])
                close = distance <= tolerance
                xyz[left[close]] = places[nearest[close]]
                left = left[~close]
    return xyz


def _follow(name: str, own: Clipped, settled: F64, other: str, theirs: Clipped, there: F64, tolerance: float) -> Follow:
    """How the tile `name` is to follow the border of the tile `other`.

    Args:
        name, own: the tile.
        settled: (V, 3) world places of its vertices, where those in corners have theirs already.
        other, theirs, there: the same of the other tile.
        tolerance: metres that a vertex may be moved.
    """
    mine, yours = curve(own.mesh.faces, own.on[other]), curve(theirs.mesh.faces, theirs.on[name])
    vertices, graph = np.unique(mine.edges), _Graph(yours.edges, there)
    partner, distance = _partners(own.mesh, vertices, theirs.mesh, np.unique(yours.edges), there, tolerance)
    corner = vertices[np.sum([on[vertices] for on in own.on.values()], axis=0) > 1]
    vertex_at = {tuple(there[v].tolist()): v for v in np.unique(yours.edges).tolist()}
    for v, place in zip(corner.tolist(), settled[corner].tolist(), strict=True):
        partner.pop(v, None)
        if tuple(place) in vertex_at:
            partner[v] = vertex_at[tuple(place)]
    face_of = {(a, b): f for (a, b), f in zip(mine.edges.tolist(), mine.face.tolist(), strict=True)}
    target: dict[int, int] = {}
    welds, inserts, followed = [], [], 0
    single, count = np.unique(mine.edges, return_counts=True)
    ends = set(single[count == 1].tolist()) - set(corner.tolist())
    for chain in chains(mine.edges, corner.tolist()):
        for found in _runs(chain, partner, distance, graph):
            run, walk, at = _to_the_end(found, ends, graph, tolerance)
            target.update((vertex, walk[i]) for vertex, i in zip(run, at, strict=True))
            followed += len(walk) - 1
            for (a, i), (b, j) in pairwise(zip(run, at, strict=True)):
                if i == j:
                    welds.append((a, b))
                elif j > i + 1:
                    inserts.append((face_of[a, b], a, b, there[walk[i + 1 : j]]))
    moved, to = np.array(list(target), np.int64), there[np.array(list(target.values()), np.int64)]
    shift = np.linalg.norm(to - world(own.mesh)[moved], axis=1)
    facts = {
        "matched": len(moved),
        "unmatched": len(vertices) - len(moved),
        "mean_m": round(float(shift.mean()), 4) if len(shift) else 0.0,
        "max_m": round(float(shift.max()), 4) if len(shift) else 0.0,
        "edges": len(yours.edges),
        "followed": followed,
    }
    return Follow(moved, to, np.array(welds, np.int64).reshape(-1, 2), inserts, facts)


def _partners(
    mesh: Mesh, vertices: Ints, other: Mesh, others: Ints, there: F64, tolerance: float
) -> tuple[dict[int, int], dict[int, float]]:
    """The nearest of a neighbour's vertices for each, and how far it is; none where that is beyond `tolerance`.

    Nearest in place and normal: of a thin wall's two sides, the right one.
    """
    from scipy.spatial import cKDTree

    if not len(others) or not len(vertices):
        return {}, {}
    xyz = world(mesh)[vertices]
    tree = cKDTree(np.column_stack([there[others], FACING * _normals(other, others)]))
    _, nearest = tree.query(np.column_stack([xyz, FACING * _normals(mesh, vertices)]))
    distance = np.linalg.norm(there[others[nearest]] - xyz, axis=1)
    close = distance <= tolerance
    v = vertices[close].tolist()
    return (
        dict(zip(v, others[nearest[close]].tolist(), strict=True)),
        dict(zip(v, distance[close].tolist(), strict=True)),
    )


class Run(NamedTuple):
    """A part of a chain that follows the neighbour's curve.

    Attributes:
        vertices: the own ones.
        walk: the neighbour's, in a row.
        at: each own one's place in the walk: never back.
    """

    vertices: list[int]
    walk: list[int]
    at: list[int]


def _runs(chain: list[int], partner: dict[int, int], distance: dict[int, float], graph: _Graph) -> Iterable[Run]:
    """Parts of a chain that follow an edge or more of the neighbour's curve.

    Partners may lie back and forth; the walk goes on only: what it would take back is left out of it, and the
    vertices that led there stay where it turned.
    """
    if chain[0] == chain[-1] and distance:  # a loop begins where it is surest
        first = min(range(len(chain) - 1), key=lambda i: distance.get(chain[i], np.inf))
        chain = [*chain[first:-1], *chain[: first + 1]]
    run = Run([], [], [])
    for vertex in [*chain, -1]:
        to = partner.get(vertex)
        way = graph.way(run.walk[-1], to) if run.walk and to is not None else None
        if way is None:
            if len(run.walk) > 1:
                yield run._replace(at=np.minimum.accumulate(run.at[::-1])[::-1].tolist())
            run = Run([], [] if to is None else [to], [])
        for step in way or ():
            if run.walk[-2:-1] == [step]:
                run.walk.pop()
            else:
                run.walk.append(step)
        if to is not None:
            run.vertices.append(vertex)
            run.at.append(len(run.walk) - 1)


def _to_the_end(run: Run, ends: set[int], graph: _Graph, limit: float) -> Run:
    """A run, its walk continued to the ends of the neighbour's curve where it begins or stops at one of `ends`."""
    vertices, walk, at = run
    if vertices[-1] in ends:
        walk = [*walk, *graph.tail(walk[-1], walk[-2], limit)]
        at = [*at[:-1], len(walk) - 1]
    if vertices[0] in ends:
        before = graph.tail(walk[0], walk[1], limit)[::-1]
        walk = [*before, *walk]
        at = [0, *(i + len(before) for i in at[1:])]
    return Run(vertices, walk, at)


class _Graph:
    """A neighbour's border curve to walk along.

    Args:
        edges: (E, 2) into `xyz`, directed as in the neighbour's faces: the own ones run against them.
        xyz: (V, 3) metres.
    """

    def __init__(self, edges: Ints, xyz: F64) -> None:
        self.xyz = xyz
        self.next: dict[int, dict[int, float]] = defaultdict(dict)
        length = np.linalg.norm(xyz[edges[:, 0]] - xyz[edges[:, 1]], axis=1)
        for (a, b), far in zip(edges.tolist(), length.tolist(), strict=True):
            self.next[b][a] = far
            self.next[a].setdefault(b, AGAINST * far)

    def way(self, a: int, b: int) -> list[int] | None:
        """Vertices of the cheapest way from a to b, without a; None where it is dear or there is none."""
        limit = DETOUR * float(np.linalg.norm(self.xyz[a] - self.xyz[b])) + MORE
        queue: list[tuple[float, list[int]]] = [(0.0, [a])]
        seen = set()
        while queue:
            price, way = heappop(queue)
            if way[-1] == b:
                return way[1:]
            if way[-1] in seen:
                continue
            seen.add(way[-1])
            for vertex, more in self.next[way[-1]].items():
                if vertex not in seen and price + more <= limit:
                    heappush(queue, (price + more, [*way, vertex]))
        return None

    def tail(self, last: int, before: int, limit: float) -> list[int]:
        """Vertices from `last` to where the curve ends, coming from `before`; none where that is far."""
        way, length = [last], 0.0
        while len(self.next[way[-1]]) == 2:
            (step,) = self.next[way[-1]].keys() - {before}
            length += float(np.linalg.norm(self.xyz[step] - self.xyz[way[-1]]))
            if length > limit or step == last:
                return []
            before = way[-1]
            way.append(step)
        return way[1:] if len(self.next[way[-1]]) == 1 else []


def _normals(mesh: Mesh, vertices: Ints) -> F64:
    """(N, 3) unit normals of some of a mesh's vertices."""
    chosen = np.zeros(len(mesh.vertices), bool)
    chosen[vertices] = True
    faces = mesh.faces[chosen[mesh.faces].any(axis=1)]
    normal = np.zeros((len(chosen), 3))
    np.add.at(normal, faces, _cross(mesh.vertices[faces].astype(np.float64))[:, None])
    normal = normal[vertices]
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)


def _ramp(xyz: F64, moved: F64, shift: F64, reach: float) -> F64:
    """(N, 3) by which the places `xyz` (N, 3) behind a border go with its vertices `moved` (M, 3): less and less."""
    from scipy.spatial import cKDTree

    out = np.zeros_like(xyz)
    if not len(moved):
        return out
    tree = cKDTree(moved)
    nearest, _ = tree.query(xyz, distance_upper_bound=reach)
    near = np.flatnonzero(np.isfinite(nearest))
    k = min(8, len(moved))  # the mean of a few: single ones also move along the border, from vertex to vertex
    _, index = tree.query(xyz[near], k=k)
    share = 1 - nearest[near] / reach
    out[near] = shift[index.reshape(len(near), k)].mean(axis=1) * (share**2 * (3 - 2 * share))[:, None]
    return out


def _split(faces: npt.NDArray[Any], inserts: list[tuple[int, int, int, F64]], n: int) -> tuple[Ints, Ints, F64]:
    """Faces with vertices inserted into their edges, as fans; the face each comes from; the new vertices' places.

    Args:
        faces: (F, 3).
        inserts: see `Follow`.
        n: vertices so far; the new ones are numbered on.
    """
    parts: dict[int, list[tuple[int, ...]]] = {}
    for face, a, b, places in inserts:
        row = [a, *range(n, n + len(places)), b]
        n += len(places)
        fan = []
        for part in parts.get(face, [tuple(faces[face].tolist())]):
            at = next((i for i in range(3) if (part[i], part[(i + 1) % 3]) == (a, b)), None)
            fan += [part] if at is None else [(p, q, part[(at + 2) % 3]) for p, q in pairwise(row)]
        parts[face] = fan
    whole = np.setdiff1d(np.arange(len(faces)), list(parts))
    parent = np.array([face for face, fan in parts.items() for _ in fan], np.int64)
    split = np.array([part for fan in parts.values() for part in fan], np.int64).reshape(-1, 3)
    added = np.concatenate([np.empty((0, 3)), *(places for *_, places in inserts)])
    return np.concatenate([faces[whole].astype(np.int64), split]), np.concatenate([whole, parent]), added


def _turned_back(xyz: F64, faces: Ints, before: F64, free: Bools) -> tuple[F64, int]:
    """Turn back faces that don't look as `before` (F, 3): their free vertices go to the middle of their neighbours.

    Returns:
        Places (V, 3), and how many faces stayed turned.
    """

    def turned(near: Ints) -> Ints:
        return near[np.einsum("ij,ij->i", _cross(xyz[faces[near]]), before[near]) < 0]

    xyz = xyz.copy()
    near = np.arange(len(faces))
    for _ in range(ROUNDS):
        bad = turned(near)
        at = np.zeros(len(xyz), bool)
        at[faces[bad]] = True
        at &= free
        if not at.any():
            break
        around = np.flatnonzero(at[faces].any(axis=1))
        near = np.union1d(bad, around)
        edges = _edges(faces[around])
        total, count = np.zeros_like(xyz), np.zeros(len(xyz))
        np.add.at(total, edges[:, 0], xyz[edges[:, 1]])
        np.add.at(count, edges[:, 0], 1)
        xyz[at] = total[at] / count[at, None]
    return xyz, len(turned(np.arange(len(faces))))


# --- gap ---


@dataclass(frozen=True)
class Gap:
    """What lies between two meshes at their border.

    Attributes:
        length_m: of the border, the mean of both meshes'.
        one_sided_m: of both, length without any counterpart within 0.3 m, or beyond the end of the other's border.
        shared: share of both meshes' border edges that both have, vertex for vertex and bit for bit.
        max_m, p99_m, mean_m: distance to the other's border, of what has a counterpart.
        crack_m2: area between the two, of what has a counterpart.
        overlap_m: how far one of them reaches beyond the border at most.
    """

    length_m: float
    one_sided_m: float
    shared: float
    max_m: float
    p99_m: float
    mean_m: float
    crack_m2: float
    overlap_m: float


def gap(a: Mesh, b: Mesh, cell: Cell, neighbour: str) -> Gap:
    """Walk the border between the mesh `a` of a cell and `b` of its neighbour, every centimetre of both.

    Edges of one face alone whose both ends lie within a millimetre of the border count.
    """
    sides = []
    overlap = 0.0
    for mesh, sign in ((a, 1), (b, -1)):
        xyz = world(mesh)
        distance = sign * cell.beyond(neighbour, xyz[:, :2])
        overlap = max(overlap, float(distance.max(initial=0.0)))
        sides.append(xyz[curve(mesh.faces, np.abs(distance) < 1e-3).edges])
    known = [{frozenset((tuple(p), tuple(q))) for p, q in side.tolist()} for side in sides]
    lengths = [float(np.linalg.norm(side[:, 0] - side[:, 1], axis=1).sum()) for side in sides]
    distance, length = np.concatenate(
        [_apart(sides[0], sides[1], known[1]), _apart(sides[1], sides[0], known[0])], axis=1
    )
    met = distance <= COUNTERPART
    edges = len(sides[0]) + len(sides[1])
    return Gap(
        length_m=sum(lengths) / 2,
        one_sided_m=float(length[~met].sum()),
        shared=2 * len(known[0] & known[1]) / edges if edges else 1.0,
        max_m=float(distance[met].max(initial=0.0)),
        p99_m=float(np.percentile(distance[met], 99)) if met.any() else 0.0,
        mean_m=float(np.average(distance[met], weights=length[met])) if met.any() else 0.0,
        crack_m2=float((distance * length)[met].sum() / 2),
        overlap_m=overlap,
    )


def _apart(side: F64, other: F64, known: set[frozenset[Any]]) -> F64:
    """(2, N) of places every centimetre along edges `side` (E, 2, 3): distance to edges `other`, length stood for.

    Edges among the `known` ones of the other are at no distance at all. Where the other's border ends, what goes on
    has no counterpart: its distance is infinite.
    """
    from scipy.spatial import cKDTree

    same = np.array([frozenset((tuple(p), tuple(q))) in known for p, q in side.tolist()], bool)
    places, length, edge = _along(side)
    distance = np.zeros(len(places))
    apart = np.flatnonzero(~same[edge])
    if not len(other):
        distance[:] = np.inf
    elif len(apart):
        there, _, there_edge = _along(other)
        k = min(8, len(there))
        _, nearest = cKDTree(there).query(places[apart], k=k)
        p, q = np.moveaxis(other[there_edge[nearest.reshape(-1, k)]], 2, 0)  # (N, k, 3) ends of the nearest edges
        way = q - p
        square = np.maximum(np.einsum("ijk,ijk->ij", way, way), 1e-30)
        along = np.clip(np.einsum("ijk,ijk->ij", places[apart, None] - p, way) / square, 0, 1)
        away = np.linalg.norm(places[apart, None] - p - along[..., None] * way, axis=2)
        best = np.arange(len(apart)), away.argmin(axis=1)
        _, node, degree = np.unique(other.reshape(-1, 3), axis=0, return_inverse=True, return_counts=True)
        ends = (degree == 1)[node.reshape(-1, 2)[there_edge[nearest.reshape(-1, k)]]][best]  # (N, 2) of that edge
        past = (ends[:, 0] & (along[best] == 0)) | (ends[:, 1] & (along[best] == 1))
        distance[apart] = np.where(past, np.inf, away[best])
    return np.stack([distance, length])


def _along(edges: F64) -> tuple[F64, F64, Ints]:
    """Places every centimetre along edges (E, 2, 3), the length that each stands for, and its edge."""
    length = np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1)
    count = np.maximum(1, np.rint(length / STEP)).astype(np.int64)
    edge = np.repeat(np.arange(len(edges)), count)
    order = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    share = ((order + 0.5) / count[edge])[:, None]
    return edges[edge, 0] * (1 - share) + edges[edge, 1] * share, (length / count)[edge], edge

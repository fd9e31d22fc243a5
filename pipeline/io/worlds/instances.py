"""Instances of a world: which faces belong to which building, tree, pole, sign or vehicle, and boxes of vehicles.

Street furniture and trees are those of `furniture.geojson`, parked vehicles those of `instances.geojson`; other faces
are grouped by what touches (`TOUCHING`). Ground, low vegetation, and floors, walls and ceilings of rooms have none.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, F64, I32, I64, U8, Bools, Mesh
from scan2sim.pipeline.dynamic_objects.instance_boxes import is_parked
from scan2sim.pipeline.io.worlds.scene import SceneTile, Vector

FURNITURE_FILE, VEHICLES_FILE = "furniture.geojson", "instances.geojson"
TILE_IDS = 1 << 16
"""Ids of the tile with index k are k * TILE_IDS + 1 and so on: those of a world with one tile begin at 1."""
TOUCHING: dict[str, tuple[int, ...]] = {
    "building": (CODE["building"], CODE["tower"]),
    "wall_or_fence": (CODE["wall_or_fence"],),
    "vegetation": (CODE["mid_vegetation"], CODE["high_vegetation"]),
    "furniture": (CODE["pole"], CODE["road_sign"], CODE["furniture"]),
    "vehicle": (CODE["vehicle"],),
}
"""Kinds of instances, and the classes whose faces touch each other in one of them."""
CODE_OF_KIND = {"pole": CODE["pole"], "lamp": CODE["pole"], "sign": CODE["road_sign"], "tree": CODE["high_vegetation"]}
"""Classes of the kinds in `furniture.geojson`; a trunk belongs to a tree."""
CELL_M = 1.0
"""Surfaces with vertices in the same cell of this size, seen from above, or in adjacent ones touch each other."""
FOOT_M = 1.0
"""Largest horizontal distance of a surface from the foot of the pole or tree that it belongs to."""
BOX_MARGIN_M, BOX_GROUND_M = 0.2, 0.1
"""Margin of a vehicle's box to its sides and above, and height above the ground from which on points belong to it."""


@dataclass(frozen=True)
class Instance:
    """An object of a world.

    Attributes:
        id: its value in instance images, from 1.
        kind: "building", "wall_or_fence", "vegetation", "tree", "pole", "lamp", "sign", "furniture", "vehicle", or the
            kind of vehicle that `instances.geojson` names.
        code: LAS code of its class.
        tile: name of its tile.
        position_m: its foot, or the lowest point below the middle of its bounding box, world metres.
    """

    id: int
    kind: str
    code: int
    tile: str
    position_m: Vector

    def to_json(self) -> dict[str, Any]:
        """For a JSON file."""
        return asdict(self)


@dataclass(frozen=True)
class Box:
    """A vehicle's box: world metres.

    Attributes:
        id: of the instance.
        centre: (2,) horizontally.
        axes: (2, 2) unit vectors along its sides.
        half: (2,) half its length along each.
        low, high: heights of the ground and of its top.
    """

    id: int
    centre: F64
    axes: F64
    half: F64
    low: float
    high: float

    def contains(self, points: F64) -> Bools:
        """(N,) bool, whether points (N, 3) are inside, or within the margin."""
        own = np.abs((points[:, :2] - self.centre) @ self.axes.T) <= self.half + BOX_MARGIN_M
        height = points[:, 2]
        above = (height >= self.low + BOX_GROUND_M) & (height <= self.high + BOX_MARGIN_M)
        return np.asarray(own.all(axis=1) & above, bool)


@dataclass(frozen=True)
class TileInstances:
    """Instances of a tile.

    Attributes:
        table: all of them, in the order of their ids.
        faces: by surface group, (F,) id of each face, 0: none.
        boxes: of parked vehicles.
    """

    table: tuple[Instance, ...]
    faces: Mapping[str, I32]
    boxes: tuple[Box, ...]


def instances_of(tile: SceneTile, index: int, meshes: Mapping[str, tuple[Mesh, U8]]) -> TileInstances:
    """Find the instances of a tile; the same input gives the same ids.

    Args:
        tile: the tile.
        index: its index in the scene.
        meshes: by surface group, its mesh in world metres and the LAS code of each face.

    Raises:
        InputError: a list of the tile can't be read.
    """
    table = _Table(tile, index * TILE_IDS)
    feet = [_listed(table, row) for row in _rows(tile, FURNITURE_FILE)]
    boxes = [_box(table, row) for row in _rows(tile, VEHICLES_FILE) if is_parked(row["properties"])]
    standing = [foot for foot in feet if foot.code != CODE["high_vegetation"]]
    trees = [foot for foot in feet if foot.code == CODE["high_vegetation"]]
    faces = {group: np.zeros(len(mesh), np.int32) for group, (mesh, _) in meshes.items()}
    for group, (mesh, codes) in meshes.items():
        for kind, members in TOUCHING.items():
            own = np.flatnonzero(np.isin(codes, members))
            if kind == "furniture":
                faces[group][own] = _by_foot(mesh, own, standing, divided=False)
            if kind == "vegetation":
                faces[group][own] = _by_foot(mesh, own, trees, divided=True)
            if kind == "vehicle":
                faces[group][own] = box_ids(mesh.corners[own].mean(axis=1), boxes)
            own = own[faces[group][own] == 0]
            for part in _parts(_touching(mesh, own)):
                corners = mesh.corners[own[part]].reshape(-1, 3)
                code = int(np.bincount(codes[own[part]]).argmax())
                faces[group][own[part]] = table.add(kind, code, _middle(corners)).id
    return TileInstances(tuple(table.rows), faces, tuple(boxes))


def box_ids(points: npt.ArrayLike, boxes: Sequence[Box]) -> I32:
    """Ids (N,) of the boxes that contain points (N, 3), world metres, 0: none."""
    xyz = np.asarray(points, np.float64)
    found = np.zeros(len(xyz), np.int32)
    for box in boxes:
        found[box.contains(xyz)] = box.id
    return found


class _Table:
    """Instances of a tile that have got an id."""

    def __init__(self, tile: SceneTile, before: int) -> None:
        self.tile, self._before = tile, before
        self.rows: list[Instance] = []

    def add(self, kind: str, code: int, position: F64) -> Instance:
        x, y, z = np.round(position, 3).tolist()
        self.rows.append(Instance(self._before + len(self.rows) + 1, kind, code, self.tile.name, (x, y, z)))
        return self.rows[-1]

    def to_world(self, crs: Any) -> F64:
        """CRS coordinates (..., 3) to world metres."""
        return self.tile.frame.to_local(crs) + np.asarray(self.tile.offset)


def _rows(tile: SceneTile, file: str) -> list[dict[str, Any]]:
    """Features of a tile's list; empty without the list."""
    path = tile.folder / file
    if not path.is_file():
        return []
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["features"]
        for row in rows:  # everything that is read later on
            np.asarray(row["geometry"]["coordinates"], np.float64), str(row["properties"]["kind"])
        return list(rows)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _damaged(path, error) from None


def _damaged(path: Path, error: Exception) -> InputError:
    return InputError(path, f"isn't the list of a world ({type(error).__name__}: {error})", "Run the world again")


def _listed(table: _Table, row: Mapping[str, Any]) -> Instance:
    """Instance of an object in `furniture.geojson`."""
    kind = str(row["properties"]["kind"]).replace("trunk", "tree")
    return table.add(kind, CODE_OF_KIND.get(kind, CODE["pole"]), table.to_world(row["geometry"]["coordinates"]))


def _box(table: _Table, row: Mapping[str, Any]) -> Box:
    """Box of a vehicle in `instances.geojson`, which gets an id."""
    path = table.tile.folder / VEHICLES_FILE
    try:
        properties, ring = row["properties"], np.asarray(row["geometry"]["coordinates"][0][:4], np.float64)
        corners = table.to_world(np.column_stack([ring, np.full(4, properties["ground_z"])]))
        sides = np.stack([corners[1] - corners[0], corners[2] - corners[1]])[:, :2]
        length = np.linalg.norm(sides, axis=1)
        centre, low = corners.mean(axis=0), float(corners[0, 2])
        one = table.add(properties["kind"], CODE["vehicle"], centre)
        top = low + float(properties["height_m"])
        return Box(one.id, centre[:2], sides / np.maximum(length, 1e-6)[:, None], length / 2, low, top)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise _damaged(path, error) from None


def _by_foot(mesh: Mesh, own: I64, feet: list[Instance], *, divided: bool) -> I32:
    """Ids (K,) of faces `own` (K,): that of the foot on which their connected surface stands, 0: on none.

    `divided`: of a surface on several feet, each face belongs to the nearest one, like crowns that grow together; or
    else the whole surface to the foot that it is nearest to, like the arm of a lamp above another pole.
    """
    from scipy.spatial import cKDTree

    found = np.zeros(len(own), np.int32)
    if not feet or not len(own):
        return found
    xy = np.array([foot.position_m[:2] for foot in feet])
    ids = np.array([foot.id for foot in feet], np.int32)
    for part in _parts(_connected(mesh, own)):
        corners = mesh.corners[own[part]][..., :2]
        distance, _ = cKDTree(corners.reshape(-1, 2)).query(xy, distance_upper_bound=FOOT_M)
        near = np.flatnonzero(np.isfinite(distance))
        if len(near) and not divided:
            near = near[[distance[near].argmin()]]
        if len(near):
            _, nearest = cKDTree(xy[near]).query(corners.mean(axis=1))
            found[part] = ids[near[nearest]]
    return found


def _connected(mesh: Mesh, own: I64) -> I64:
    """Group (K,) of the faces `own` (K,): those that share vertices have the same."""
    return _grouped(mesh.faces[own], len(mesh.vertices), np.zeros((0, 2), np.int64))


def _touching(mesh: Mesh, own: I64) -> I64:
    """Group (K,) of the faces `own` (K,): those that share vertices, or have some in adjacent cells, have the same."""
    used = np.unique(mesh.faces[own])
    cells, cell = np.unique(_cells(mesh.vertices[used]), axis=0, return_inverse=True)
    first = len(mesh.vertices)
    links = [np.column_stack([used, first + cell.reshape(-1)])]
    number = {tuple(one): k for k, one in enumerate(cells.tolist())}
    for across, down in ((1, 0), (0, 1), (1, 1), (1, -1)):
        pairs = [(k, number.get((x + across, y + down), -1)) for (x, y), k in number.items()]
        links.append(first + np.array([pair for pair in pairs if pair[1] >= 0], np.int64).reshape(-1, 2))
    return _grouped(mesh.faces[own], first + len(cells), np.concatenate(links))


def _cells(vertices: F32) -> I64:
    """Cells (N, 2) of vertices (N, 3), seen from above."""
    return np.floor(vertices[:, :2].astype(np.float64) / CELL_M).astype(np.int64)


def _grouped(faces: I32, nodes: int, links: I64) -> I64:
    """Connected group (K,) of faces (K, 3) in a graph of their edges and further links (L, 2) between nodes."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = np.concatenate([faces[:, :2], faces[:, 1:], links]).astype(np.int64)
    graph = coo_matrix((np.ones(len(pairs), bool), pairs.T), shape=(nodes, nodes))
    _, group = connected_components(graph, directed=False)
    return np.asarray(group[faces[:, 0]], np.int64)


def _parts(group: I64) -> list[I64]:
    """Indices of the members of each group (K,), in the order of their first members."""
    _, first, label = np.unique(group, return_index=True, return_inverse=True)
    order = np.argsort(label.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(label.reshape(-1), minlength=len(first)))[:-1]
    parts = np.split(order, ends) if len(group) else []
    return [parts[k] for k in np.argsort(first)]


def _middle(corners: F32) -> F64:
    """The lowest point below the middle of the bounding box of corners (N, 3)."""
    low, high = corners.min(axis=0).astype(np.float64), corners.max(axis=0)
    return np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])

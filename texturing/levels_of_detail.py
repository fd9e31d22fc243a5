"""Hierarchical levels of detail (HLOD) of a scene: coarser versions of each tile, then of groups of tiles.

Each level has a quarter of the triangles and texels of the finer levels that it replaces, so its texels are twice as
wide. First each tile is simplified as many times as wanted, then up to four neighbours are merged into one level, until
one level represents the whole scene. Levels that may be shown side by side share vertices: open edges between vertices
that another tile has, too, are kept until that tile is part of the same level.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F32, F64, I64, Mesh
from scan2sim.pipeline.geometry.boundary_curve import curve
from scan2sim.pipeline.io.file_checks import link_or_copy
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds import textured_mesh
from scan2sim.pipeline.io.worlds.scene import Level, Scene, SceneTile, statistics
from scan2sim.texturing.simplify_textured import WELD_DISTANCE_M, Share, simplify_group

if TYPE_CHECKING:
    from scan2sim.pipeline.io.worlds.textured_mesh import Textured

LEVEL_SHARE = Share(0.25, 0.25)
"""Share of the triangles and texels that a level keeps of the finer levels."""


class SharedBorder(NamedTuple):
    """Border between two tiles.

    Attributes:
        group: surface group that both tiles have there.
        tile, other: names of the tiles.
        points: (K, 3) vertices of open edges that both tiles have, metres from the scene's origin.
    """

    group: str
    tile: str
    other: str
    points: F64


def with_levels(scene: Scene, levels: int, folder: Path, report: Report) -> Scene:
    """Scene with coarser levels of detail.

    Args:
        scene: scene whose tiles are the finest level.
        levels: number of levels of each tile, including the tile itself.
        folder: folder for the coarser levels.
        report: progress callback.
    """
    if levels < 2:
        return scene
    builder = _LevelBuilder(scene, folder, report)
    coarse = [Level(tile, texel=_texel_m(tile.textured().values())) for tile in scene.tiles]
    for _ in range(1, levels):
        coarse = [builder.coarser([level]) for level in coarse]
    return replace(scene, coarse=builder.merge(coarse))


class _LevelBuilder:
    """Builds the coarser levels of a scene."""

    def __init__(self, scene: Scene, folder: Path, report: Report) -> None:
        self._folder, self._report = folder, report
        self._borders = shared_borders(scene)
        self._built = 0
        self._tiles = len(scene.tiles)

    def merge(self, levels: Sequence[Level]) -> Level:
        """Root of a tree of coarser levels over `levels`, with up to four children each."""
        if len(levels) == 1:
            return levels[0]
        return self.coarser([self.merge(part) for half in _halves(levels) for part in _halves(half)])

    def coarser(self, finer: Sequence[Level]) -> Level:
        """Coarser level that replaces all of `finer`."""
        first = finer[0].tile
        height = 1 + max(level.height for level in finer)
        level_folder = self._folder / f"level{height}" / first.name
        below = {tile.name for level in finer for tile in level.source_tiles()}
        self._built += 1
        self._report(1 - 1 / (1 + self._built / self._tiles), f"level {height} of {first.name}")
        shapes, errors = {}, []
        for group in sorted({group for level in finer for group in level.tile.groups}):
            source = first.folder / group
            if len(finer) > 1:
                source = level_folder / "joined" / group
                _join([level.tile for level in finer], group, source)
            shape = textured_mesh.read(source)
            assert shape is not None
            borders = self._outer_borders(below, group) - np.asarray(first.offset)
            simplify_group(group, shape, source, LEVEL_SHARE, borders, level_folder / group)
            small = textured_mesh.read(level_folder / group)
            assert small is not None
            shapes[group] = small
            errors.append(_geometric_error(shape.mesh, small.mesh))
        tile = replace(first, groups={group: statistics(shape) for group, shape in shapes.items()}, folder=level_folder)
        error = max(level.error for level in finer) + max(errors)
        return Level(tile, height, error, _texel_m(shapes.values()), tuple(finer))

    def _outer_borders(self, below: set[str], group: str) -> F64:
        """(K, 3) border vertices between the tiles named `below` and other tiles, metres from the scene's origin."""
        points = [b.points for b in self._borders if b.group == group and b.tile in below and b.other not in below]
        return np.concatenate([np.zeros((0, 3)), *points])


def _halves(levels: Sequence[Level]) -> list[Sequence[Level]]:
    """Levels split spatially into two halves; a single level stays as it is."""
    if len(levels) == 1:
        return [levels]
    middle = np.array([np.add(t.offset, (np.add(t.low, t.high)) / 2) for t in (level.tile for level in levels)])
    order = np.argsort(middle[:, np.ptp(middle, axis=0).argmax()], kind="stable")
    half = (len(levels) + 1) // 2
    return [[levels[i] for i in order[:half]], [levels[i] for i in order[half:]]]


def shared_borders(scene: Scene) -> list[SharedBorder]:
    """Borders between the tiles of a scene, each from both sides."""
    from scipy.spatial import cKDTree

    found = []
    for group in SURFACES:
        vertices = {tile.name: _open_vertices(tile, group) for tile in scene.tiles if group in tile.groups}
        boxes = {
            name: (points.min(axis=0) - WELD_DISTANCE_M, points.max(axis=0) + WELD_DISTANCE_M)
            for name, points in vertices.items()
            if len(points)
        }
        for name, (low, high) in boxes.items():
            for other, (bottom, top) in boxes.items():
                if name == other or (low > top).any() or (high < bottom).any():
                    continue
                tree = cKDTree(vertices[other])
                shared = np.isfinite(tree.query(vertices[name], distance_upper_bound=WELD_DISTANCE_M)[0])
                if shared.any():
                    found.append(SharedBorder(group, name, other, vertices[name][shared]))
    return found


def _open_vertices(tile: SceneTile, group: str) -> F64:
    """(V, 3) vertices of open edges, metres from the scene's origin."""
    mesh = Mesh.load(tile.folder / group / "mesh.npz")
    opened = np.unique(curve(mesh.faces, np.ones(len(mesh.vertices), bool)).edges)
    return mesh.vertices[opened].astype(np.float64) + tile.offset


def _join(tiles: Sequence[SceneTile], group: str, out: Path) -> None:
    """Write a group of several tiles as one textured mesh, local to the first tile, welded along their borders."""
    out.mkdir(parents=True)
    vertices, faces, uv, page, codes = np.zeros((0, 3)), [], [], [], []
    reflectance: F32 | None = np.zeros(0, np.float32)
    pages = 0
    for tile in tiles:
        shape = textured_mesh.read(tile.folder / group) if group in tile.groups else None
        if shape is None:
            continue
        mesh = shape.mesh
        assert mesh.uv is not None and mesh.page is not None
        vertices, index = _welded(
            vertices, mesh.vertices.astype(np.float64) + np.subtract(tile.offset, tiles[0].offset)
        )
        if reflectance is not None and shape.reflectance is not None:
            reflectance = np.resize(reflectance, len(vertices))
            reflectance[index] = shape.reflectance
        else:
            reflectance = None
        faces.append(index[mesh.faces])
        uv.append(mesh.uv)
        page.append(mesh.page + pages)
        codes.append(np.zeros(len(mesh), np.uint8) if mesh.classification is None else mesh.classification)
        for i, image_file in enumerate(shape.pages):
            link_or_copy(image_file, out / f"page_{pages + i}.png")
        for i, mask in enumerate(shape.seen):
            link_or_copy(mask, out / f"page_{pages + i}_seen.png")
        pages += len(shape.pages)
    Mesh(
        tiles[0].frame,
        vertices.astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        uv=np.concatenate(uv),
        page=np.concatenate(page).astype(np.int16),
        classification=np.concatenate(codes),
    ).save(out / "mesh.npz")
    if reflectance is not None:
        textured_mesh.save_reflectance(out, reflectance)


def _welded(vertices: F64, more: F64) -> tuple[F64, I64]:
    """`vertices` extended by the new ones of `more` (N, 3), and the index (N,) of each of `more` among them."""
    from scipy.spatial import cKDTree

    if not len(vertices):
        return more, np.arange(len(more))
    distance, same = cKDTree(vertices).query(more, distance_upper_bound=WELD_DISTANCE_M)
    new = ~np.isfinite(distance)
    return np.concatenate([vertices, more[new]]), np.where(new, len(vertices) + np.cumsum(new) - 1, same)


def _geometric_error(fine: Mesh, coarse: Mesh) -> float:
    """95th percentile of the distance in metres from points on a mesh to a coarser mesh."""
    from scan2sim.pipeline.geometry.surface_distance import deviation

    return deviation(fine, coarse, 0)["p95"]


def _texel_m(shapes: Iterable[Textured]) -> float:
    """Texel size in metres: root of the mean area of a texel."""
    area = texels = 0.0
    for shape in shapes:
        assert shape.mesh.uv is not None and shape.mesh.page is not None
        size = np.array([np.prod(image.size_of(page)) for page in shape.pages], np.float64)
        (a, b), (c, d) = np.moveaxis(shape.mesh.uv[:, 1:] - shape.mesh.uv[:, :1], (1, 2), (0, 1)).astype(np.float64)
        texels += float((np.abs(a * d - b * c) / 2 * size[shape.mesh.page]).sum())
        area += float(shape.mesh.face_area.sum(dtype=np.float64))
    return float(np.sqrt(area / texels))

"""Levels of detail of a scene: each tile in coarser ones, and above the tiles such that stand for several.

Each has a quarter of the triangles and texels of what it stands for, so its texels are twice as wide: first the tile
itself, as often as is asked for, then up to four neighbours as one, until one stands for all. Where two levels may be
shown side by side they share their vertices: open edges between vertices that another tile has, too, stay as they are,
until that tile is part of the same level.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F64, I64, Mesh
from scan2sim.pipeline.io.file_checks import pass_on
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds import textured_mesh
from scan2sim.pipeline.io.worlds.scene import Level, Scene, SceneTile, figures
from scan2sim.pipeline.tiling.borders.boundary_curve import curve
from scan2sim.texturing.simplify_textured import SAME, Share, shrink

if TYPE_CHECKING:
    from scan2sim.pipeline.io.worlds.textured_mesh import Textured

SHARE = Share(0.25, 0.25)
"""Of the triangles and texels of what a level stands for."""


class Meeting(NamedTuple):
    """Where two tiles meet.

    Attributes:
        group: the surface that both have there.
        tile, other: their names.
        places: (K, 3) vertices of open edges that both have, metres from the scene's origin.
    """

    group: str
    tile: str
    other: str
    places: F64


def detailed(scene: Scene, levels: int, folder: Path, report: Report) -> Scene:
    """A scene with coarser levels.

    Args:
        scene: its tiles are the finest level.
        levels: of each tile, itself counted.
        folder: where coarser ones are kept.
        report: progress.
    """
    if levels < 2:
        return scene
    making = _Making(scene, folder, report)
    coarse = [Level(tile, texel=_texel(tile.textured().values())) for tile in scene.tiles]
    for _ in range(1, levels):
        coarse = [making.above([level]) for level in coarse]
    return replace(scene, coarse=making.one_for(coarse))


class _Making:
    """Of all levels of a scene."""

    def __init__(self, scene: Scene, folder: Path, report: Report) -> None:
        self._folder, self._report = folder, report
        self._meetings = meetings(scene)
        self._made = 0
        self._all = len(scene.tiles)

    def one_for(self, levels: Sequence[Level]) -> Level:
        """One level for all of these, and whatever is between."""
        if len(levels) == 1:
            return levels[0]
        return self.above([self.one_for(part) for half in _halves(levels) for part in _halves(half)])

    def above(self, finer: Sequence[Level]) -> Level:
        """The level above some, which stands for all of them."""
        first = finer[0].tile
        height = 1 + max(level.height for level in finer)
        place = self._folder / f"level{height}" / first.name
        below = {tile.name for level in finer for tile in level.stands_for()}
        self._made += 1
        self._report(1 - 1 / (1 + self._made / self._all), f"level {height} of {first.name}")
        shapes, errors = {}, []
        for group in sorted({group for level in finer for group in level.tile.groups}):
            source = first.folder / group
            if len(finer) > 1:
                source = place / "joined" / group
                _join([level.tile for level in finer], group, source)
            shape = textured_mesh.read(source)
            assert shape is not None
            borders = self._borders(below, group) - np.asarray(first.offset)
            shrink(group, shape, source, SHARE, borders, place / group)
            small = textured_mesh.read(place / group)
            assert small is not None
            shapes[group] = small
            errors.append(_apart(shape.mesh, small.mesh))
        tile = replace(first, groups={group: figures(shape) for group, shape in shapes.items()}, folder=place)
        error = max(level.error for level in finer) + max(errors)
        return Level(tile, height, error, _texel(shapes.values()), tuple(finer))

    def _borders(self, below: set[str], group: str) -> F64:
        """(K, 3) where tiles of these names meet others, metres from the scene's origin."""
        ends = [m.places for m in self._meetings if m.group == group and m.tile in below and m.other not in below]
        return np.concatenate([np.zeros((0, 3)), *ends])


def _halves(levels: Sequence[Level]) -> list[Sequence[Level]]:
    """Halves of what lies together; itself where there is one."""
    if len(levels) == 1:
        return [levels]
    middle = np.array([np.add(t.offset, (np.add(t.low, t.high)) / 2) for t in (level.tile for level in levels)])
    order = np.argsort(middle[:, np.ptp(middle, axis=0).argmax()], kind="stable")
    half = (len(levels) + 1) // 2
    return [[levels[i] for i in order[:half]], [levels[i] for i in order[half:]]]


def meetings(scene: Scene) -> list[Meeting]:
    """Where tiles of a scene meet, each from both sides."""
    from scipy.spatial import cKDTree

    found = []
    for group in SURFACES:
        ends = {tile.name: _ends(tile, group) for tile in scene.tiles if group in tile.groups}
        boxes = {name: (ends.min(axis=0) - SAME, ends.max(axis=0) + SAME) for name, ends in ends.items() if len(ends)}
        for name, (low, high) in boxes.items():
            for other, (bottom, top) in boxes.items():
                if name == other or (low > top).any() or (high < bottom).any():
                    continue
                shared = np.isfinite(cKDTree(ends[other]).query(ends[name], distance_upper_bound=SAME)[0])
                if shared.any():
                    found.append(Meeting(group, name, other, ends[name][shared]))
    return found


def _ends(tile: SceneTile, group: str) -> F64:
    """(V, 3) vertices of open edges, metres from the scene's origin."""
    mesh = Mesh.load(tile.folder / group / "mesh.npz")
    opened = np.unique(curve(mesh.faces, np.ones(len(mesh.vertices), bool)).edges)
    return mesh.vertices[opened].astype(np.float64) + tile.offset


def _join(tiles: Sequence[SceneTile], group: str, out: Path) -> None:
    """Write a group of several tiles as one textured mesh, local to the first, welded where they meet."""
    out.mkdir(parents=True)
    vertices, faces, uv, page, codes = np.zeros((0, 3)), [], [], [], []
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
        faces.append(index[mesh.faces])
        uv.append(mesh.uv)
        page.append(mesh.page + pages)
        codes.append(np.zeros(len(mesh), np.uint8) if mesh.classification is None else mesh.classification)
        for i, picture in enumerate(shape.pages):
            pass_on(picture, out / f"page_{pages + i}.png")
        for i, mask in enumerate(shape.seen):
            pass_on(mask, out / f"page_{pages + i}_seen.png")
        pages += len(shape.pages)
    Mesh(
        tiles[0].frame,
        vertices.astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        uv=np.concatenate(uv),
        page=np.concatenate(page).astype(np.int16),
        classification=np.concatenate(codes),
    ).save(out / "mesh.npz")


def _welded(vertices: F64, more: F64) -> tuple[F64, I64]:
    """Vertices and those of `more` (N, 3) that aren't among them yet, and where each of these is then (N,)."""
    from scipy.spatial import cKDTree

    if not len(vertices):
        return more, np.arange(len(more))
    distance, same = cKDTree(vertices).query(more, distance_upper_bound=SAME)
    new = ~np.isfinite(distance)
    return np.concatenate([vertices, more[new]]), np.where(new, len(vertices) + np.cumsum(new) - 1, same)


def _apart(fine: Mesh, coarse: Mesh) -> float:
    """Metres from places on a mesh to a coarser one: 95 % of them are nearer."""
    from scan2sim.pipeline.steps.collision import deviation

    return deviation(fine, coarse, 0)["p95"]


def _texel(shapes: Iterable[Textured]) -> float:
    """Metres that a texel spans, the root of the mean area."""
    area = texels = 0.0
    for shape in shapes:
        assert shape.mesh.uv is not None and shape.mesh.page is not None
        size = np.array([np.prod(image.size_of(page)) for page in shape.pages], np.float64)
        (a, b), (c, d) = np.moveaxis(shape.mesh.uv[:, 1:] - shape.mesh.uv[:, :1], (1, 2), (0, 1)).astype(np.float64)
        texels += float((np.abs(a * d - b * c) / 2 * size[shape.mesh.page]).sum())
        area += float(shape.mesh.face_area.sum(dtype=np.float64))
    return float(np.sqrt(area / texels))

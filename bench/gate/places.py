"""What the gate knows of a world beside its export: its road, the cloud's surface, ways to drive, photos."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F64, Bools, PointCloud, View
from scan2sim.pipeline.geometry.height_map import Raster, grown
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.pipeline.simulation.spawn import courses
from scan2sim.pipeline.tiling.voronoi_cell import Cell

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

COUNT = 20
"""Places on the road."""
ROOM = 2.5
"""Metres around a place on which there is ground, and nothing that stands."""
KERB = 0.5
"""Metres to ground of other classes: at a kerb there is no one height."""
LOW, HIGH = 0.25, 3.0
"""Metres above the ground in which things stand in a car's way."""
AROUND = 0.3
"""Metres around a place whose points tell the surface's height there."""
ON = 0.15
"""Metres from a border on which a place lies."""
CELL = 0.25


@dataclass(frozen=True)
class Places:
    """Of a world; coordinates are the world's, metres.

    Attributes:
        road: (N, 3) on the road, far from each other: things are dropped there.
        borders: (M, 3) on borders of tiles, likewise.
        ground: (K, 3) points of the ground, as scanned.
        paved: (K,) which of them are of a road; all, where no road is told from other ground.
        ways: (W, 3) each, along roads, the longest first.
        views: photos, posed in the world.
    """

    road: F64
    borders: F64
    ground: F64
    paved: Bools
    ways: tuple[F64, ...] = ()
    views: tuple[View, ...] = ()

    def heights(self, xy: F64) -> F64:
        """(N,) heights of the cloud's surface at places (N, 2): of a plane through the points around; NaN without."""
        out = np.full(len(xy), np.nan)
        for i, near in enumerate(self._near(xy)):
            if len(near) >= 10:
                part = self.ground[near]
                part = part[np.abs(part[:, 2] - np.median(part[:, 2])) < 0.1]
                away = part[:, :2] - xy[i]
                if np.linalg.norm(away.mean(axis=0)) < AROUND / 3:  # else all points lie to one side
                    out[i] = np.linalg.lstsq(np.column_stack([away, np.ones(len(part))]), part[:, 2], rcond=None)[0][2]
        return out

    def on_road(self, xy: F64) -> Bools:
        """(N,) whether most points around places (N, 2) are of a road."""
        return np.array([len(near) > 0 and self.paved[near].mean() > 0.5 for near in self._near(xy)])

    def _near(self, xy: F64) -> Sequence[list[int]]:
        """Indices of the ground's points around each of the places (N, 2)."""
        return self._tree.query_ball_point(xy, AROUND)

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.ground[:, :2])


def find(scene: Scene, run: Path, tiles: Sequence[Path]) -> Places:
    """Places in a world, by the points that its run classified.

    Args:
        scene: the world.
        run: its folder of kept results.
        tiles: folders of its tiles, in the scene's order.
    """
    many = len(scene.tiles) > 1
    ground, codes, above, cells = [], [], [], {}
    for kept, folder in zip(scene.tiles, tiles, strict=True):
        cell = read_tile(folder).cell
        steps = run / "steps" / kept.name if many else run / "steps"
        for part in ("terrain", "building", "vegetation", "rest"):
            cloud = PointCloud.load(max((steps / "split").glob(f"*/{part}.npz"), key=lambda p: p.stat().st_mtime))
            own = np.ones(len(cloud), bool) if cell is None else _inside(cloud, cell)
            xyz = cloud.xyz[own].astype(np.float64) + kept.offset
            if part == "terrain":
                ground.append(xyz)
                codes.append(np.asarray(cloud.classification)[own])
            else:
                above.append(xyz)
        if cell is not None:
            cells[kept.name] = cell
    points, code, standing = np.concatenate(ground), np.concatenate(codes), np.concatenate(above)
    road = code == CODE["road"] if (code == CODE["road"]).any() else np.ones(len(code), bool)
    raster, free = _free(points, standing, points[~road])
    on_road = road & free[raster.at(points)]
    borders = [_on_border(points[on_road], scene, *pair) for pair in _pairs(cells)]
    return Places(
        _spread(points[on_road], COUNT),
        np.concatenate([np.zeros((0, 3)), *borders]),
        points,
        road,
        tuple(way.places for way in courses(scene)),
        tuple(_views(scene, tiles)),
    )


def _views(scene: Scene, tiles: Sequence[Path]) -> Iterator[View]:
    """The photos of all tiles, each once, posed in the world."""
    known = set()
    for tile in map(read_tile, tiles):
        shift = np.asarray(tile.frame.origin) - np.asarray(scene.origin)
        for view in tile.views:
            if view.photo.name not in known:
                known.add(view.photo.name)
                pose = np.array(view.T_world_cam, np.float64)
                pose[:3, 3] += shift
                yield replace(view, T_world_cam=pose)


def _inside(cloud: PointCloud, cell: Cell) -> Bools:
    return np.asarray(cell.outside(cloud.xyz[:, :2] + np.asarray(cloud.frame.origin[:2])) <= 0)


def _free(ground: F64, standing: F64, kerb: F64) -> tuple[Raster, Bools]:
    """Where there is ground all around, nothing stands, and no kerb is near."""
    raster = Raster.over(CELL, [ground, standing])
    height = -raster.highest(np.column_stack([ground[:, :2], -ground[:, 2]]).astype(np.float32))
    over = standing[:, 2] - height[raster.at(standing)]
    hindered = raster.covered(standing[(over > LOW) & (over < HIGH)]) | grown(np.isnan(height), 0)
    return raster, ~grown(hindered, ROOM / CELL) & ~grown(raster.covered(kerb), KERB / CELL)


def _spread(points: F64, count: int) -> F64:
    """Some of the points, each far from those before it."""
    if not len(points):
        return np.zeros((0, 3))
    points = points[:: max(1, len(points) // 20_000)]
    chosen = [int(np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1)))]
    away = np.full(len(points), np.inf)
    for _ in range(count - 1):
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(away)))
    return np.asarray(points[chosen])


def _pairs(cells: dict[str, Cell]) -> list[tuple[Cell, str]]:
    return [(cell, other) for name, cell in cells.items() for other in cell.neighbours if name < other in cells]


def _on_border(points: F64, scene: Scene, cell: Cell, other: str) -> F64:
    """Three places where the road crosses a border."""
    xy = points[:, :2] + np.asarray(scene.origin[:2])
    return _spread(points[(np.abs(cell.beyond(other, xy)) < ON) & (cell.outside(xy) < ON)], 3)

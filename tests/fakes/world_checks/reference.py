"""Reference data of a world, independent of its export: road points, the cloud's surface, routes, photos."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import yaml
from PIL import Image

from scan2sim.pipeline.camera.renderer import Body, Renderer
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F64, U8, Bools, Camera, Mesh, PointCloud, View
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.pipeline.geometry.height_map import Raster, dilate
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.pipeline.io.worlds.spawn import courses, free_space_pose

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

ROAD_POINT_COUNT = 20
"""Number of points chosen on the road."""
CLEARANCE_M = 2.5
"""Radius around a chosen point with ground and without obstacles: room for a car."""
ROOM_CLEARANCE_M = 0.5
"""The same in rooms, where no cars are dropped."""
WAY_STEP_M = 0.25
"""Distance between the positions of a way through free space."""
KERB_DISTANCE_M = 0.5
"""Minimum distance to ground of other classes: at a kerb the height isn't unique."""
OBSTACLE_MIN_M, OBSTACLE_MAX_M = 0.25, 3.0
"""Heights above the ground at which objects block a car."""
SURFACE_RADIUS_M = 0.3
"""Radius of the points that determine the surface's height at a position."""
EYE_HEIGHT_M = 0.8
"""Height of the rendering's camera above the spawn pose."""
RENDERED_PX = 960, 540
FREE_GREY = 250
"""Least grey level of free cells in an occupancy map."""
BORDER_DISTANCE_M = 0.15
"""Maximum distance from a border of a point on it."""
CELL_M = 0.25


class Photo(NamedTuple):
    """A photo without lens distortion.

    Attributes:
        rgb: (H, W, 3).
        camera: pinhole camera.
        pose: (4, 4) camera to world; x right, y down, z forward.
    """

    rgb: U8
    camera: Camera
    pose: F64


@dataclass(frozen=True)
class Visible:
    """A visible surface.

    Attributes:
        label: name of its class.
        mesh: world coordinates.
        reflective: whether its reflectance for lidar is known.
    """

    label: str
    mesh: Mesh
    reflective: bool


@dataclass(frozen=True)
class WorldReference:
    """Reference data of a world; world coordinates in metres.

    Attributes:
        road: (N, 3) points on the road, far from each other, where objects are dropped.
        borders: (M, 3) points on tile borders, likewise.
        ground: (K, 3) scanned ground points.
        paved: (K,) which of them belong to a road; all, if there is no road class.
        ways: routes (W, 3) along roads, the longest first; in rooms, straight ahead from the spawn pose.
        rooms: whether the world is a robot's map of rooms.
        rendered: rendering from the robot's spawn pose, of worlds made without photos.
        views: photos with poses in the world.
        surfaces: the visible surfaces.
    """

    road: F64
    borders: F64
    ground: F64
    paved: Bools
    ways: tuple[F64, ...] = ()
    views: tuple[View, ...] = ()
    rooms: bool = False
    rendered: Photo | None = None
    surfaces: tuple[Visible, ...] = ()

    def heights(self, xy: F64) -> F64:
        """(N,) heights of the cloud's surface at positions (N, 2), from a plane fit; NaN without points."""
        out = np.full(len(xy), np.nan)
        for i, near in enumerate(self._near(xy)):
            if len(near) >= 10:
                part = self.ground[near]
                part = part[np.abs(part[:, 2] - np.median(part[:, 2])) < 0.1]
                away = part[:, :2] - xy[i]
                if np.linalg.norm(away.mean(axis=0)) < SURFACE_RADIUS_M / 3:  # otherwise all points lie to one side
                    out[i] = np.linalg.lstsq(np.column_stack([away, np.ones(len(part))]), part[:, 2], rcond=None)[0][2]
        return out

    def on_road(self, xy: F64) -> Bools:
        """(N,) whether most points around positions (N, 2) belong to a road."""
        return np.array([len(near) > 0 and self.paved[near].mean() > 0.5 for near in self._near(xy)])

    def at_kerb(self, xy: F64) -> Bools:
        """(N,) whether points around positions (N, 2) belong to both road and other ground: the height isn't unique."""
        shares = [self.paved[near].mean() if len(near) else 1.0 for near in self._near(xy)]
        return np.array([0 < share < 1 for share in shares])

    def _near(self, xy: F64) -> Sequence[list[int]]:
        """Indices of the ground points around each of the positions (N, 2)."""
        return self._tree.query_ball_point(xy, SURFACE_RADIUS_M)

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.ground[:, :2])


def find(scene: Scene, run: Path, tiles: Sequence[Path]) -> WorldReference:
    """Reference data from the points that a run classified.

    Args:
        scene: the world.
        run: folder of the run's cached results.
        tiles: folders of its tiles, in the scene's order.
    """
    many = len(scene.tiles) > 1
    first = read_tile(tiles[0]).robot_map
    rooms = first is not None and first.scene == "indoor"
    ground, codes, above, cells = [], [], [], {}
    for kept, folder in zip(scene.tiles, tiles, strict=True):
        cell = read_tile(folder).cell
        steps = run / "steps" / kept.name if many else run / "steps"
        for part in ("terrain", "building", "vegetation", "rest", *(("furniture",) if rooms else ())):
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
    raster, free = _free(points, standing, points[~road], ROOM_CLEARANCE_M if rooms else CLEARANCE_M)
    on_road = road & free[raster.at(points)]
    borders = [_on_border(points[on_road], scene, *pair) for pair in _pairs(cells)]
    return WorldReference(
        _spread(points[on_road], ROAD_POINT_COUNT),
        np.concatenate([np.zeros((0, 3)), *borders]),
        points,
        road,
        (_way_ahead(scene),) if rooms else tuple(way.places for way in courses(scene)),
        tuple(_views(scene, tiles)),
        rooms,
        _rendered(scene) if rooms else None,
        tuple(visible(scene)),
    )


def visible(scene: Scene) -> Iterator[Visible]:
    """The visible surfaces of all tiles."""
    for tile in scene.tiles:
        for surface in tile.surfaces():
            mesh = surface.shape.mesh
            vertices = mesh.vertices + np.asarray(tile.offset, np.float32)
            yield Visible(surface.label, replace(mesh, vertices=vertices), surface.shape.reflectance is not None)


def _rendered(scene: Scene) -> Photo:
    """Rendering of the textured surfaces from the spawn pose, at a robot's height."""
    start = free_space_pose(scene)
    assert start is not None
    bodies = []
    for tile in scene.tiles:
        for shape in tile.textured().values():
            vertices = shape.mesh.vertices + np.asarray(tile.offset, np.float32)
            bodies.append(Body(replace(shape.mesh, vertices=vertices), shape.pages))
    c, s = np.cos(start.angles[2]), np.sin(start.angles[2])
    pose = np.eye(4)
    pose[:3, :3] = [[s, 0, c], [-c, 0, s], [0, -1, 0]]
    pose[:3, 3] = np.add(start.position, [0, 0, EYE_HEIGHT_M])
    width, height = RENDERED_PX
    camera = Camera("pinhole", width, height, width / 2, width / 2, width / 2 - 0.5, height / 2 - 0.5)
    return Photo(Renderer(bodies).view(camera, pose, samples=2).rgb, camera, pose)


def _way_ahead(scene: Scene) -> F64:
    """(W, 3) positions straight ahead from the spawn pose, as far as the occupancy map is free."""
    start = free_space_pose(scene)
    assert start is not None
    (folder,) = (tile.folder for tile in scene.tiles)
    about = yaml.safe_load((folder / "map.yaml").read_text(encoding="utf-8"))
    cells = np.asarray(Image.open(folder / about["image"]))[::-1]
    heading = np.array([np.cos(start.angles[2]), np.sin(start.angles[2])])
    way = start.position[:2] + np.arange(0, 100, WAY_STEP_M)[:, None] * heading
    column, row = np.floor((way - about["origin"][:2]) / about["resolution"]).astype(int).T
    inside = (row >= 0) & (row < cells.shape[0]) & (column >= 0) & (column < cells.shape[1])
    free = inside & (cells[np.where(inside, row, 0), np.where(inside, column, 0)] >= FREE_GREY)
    count = int(np.argmin(np.append(free, False)))
    return np.column_stack([way[:count], np.full(count, start.position[2])])


def _views(scene: Scene, tiles: Sequence[Path]) -> Iterator[View]:
    """The photos of all tiles without duplicates, with poses in the world."""
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


def _free(ground: F64, standing: F64, kerb: F64, clearance: float) -> tuple[Raster, Bools]:
    """Cells with ground all around, without obstacles and away from kerbs."""
    raster = Raster.over(CELL_M, [ground, standing])
    height = -raster.highest(np.column_stack([ground[:, :2], -ground[:, 2]]).astype(np.float32))
    over = standing[:, 2] - height[raster.at(standing)]
    hindered = raster.covered(standing[(over > OBSTACLE_MIN_M) & (over < OBSTACLE_MAX_M)]) | dilate(np.isnan(height), 0)
    return raster, ~dilate(hindered, clearance / CELL_M) & ~dilate(raster.covered(kerb), KERB_DISTANCE_M / CELL_M)


def _spread(points: F64, count: int) -> F64:
    """Points chosen by farthest point sampling."""
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
    """Three points where the road crosses a border."""
    xy = points[:, :2] + np.asarray(scene.origin[:2])
    return _spread(
        points[(np.abs(cell.beyond(other, xy)) < BORDER_DISTANCE_M) & (cell.outside(xy) < BORDER_DISTANCE_M)], 3
    )

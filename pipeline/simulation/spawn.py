"""Where in a scene a robot starts: on a road, facing along it; else on the path of whoever recorded it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.classes import group_of
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F64, Trajectory
from scan2sim.pipeline.io.worlds.scene import PATH, Scene
from scan2sim.pipeline.roads import driven
from scan2sim.pipeline.roads.course import Course, course
from scan2sim.pipeline.roads.scene_roads import drawn
from scan2sim.pipeline.simulation.robot import Start

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene

LENGTH, WIDTH, HEIGHT = 0.9, 0.7, 0.4
"""Metres of ground that a robot stands on, and above it where nothing else may be near."""
CLEAR = 0.8
"""Metres to what isn't ground."""
LEVEL = 0.1
"""Metres by which the ground may leave a plane below it."""
OVER = 2.0
"""Metres above a road's surface from where ground is looked for: below bridges and crowns."""
DROP = 0.02
"""Metres that it falls at the start."""


def courses(scene: Scene) -> list[Course]:
    """Ways to drive, world metres: along roads, else along the path of whoever recorded each tile; longest first."""
    found = [course(road) for road in drawn(scene)] or list(_paths(scene))
    return sorted(found, key=lambda one: -len(one.places))


def find(scene: Scene) -> Start:
    """The beginning of the longest stretch that a robot can drive over, facing along it.

    Raises:
        DataError: no road and no path is known, or none lies free on ground.
    """
    ways = courses(scene)
    if not ways:
        raise DataError(
            "robot",
            f"nothing says where in {scene.name} one drives: neither a road nor the recording vehicle's path is known",
            "Give the tile a trajectory or posed photos from the ground, or export without the robot",
        )
    ground, others = bodies(scene)
    best: tuple[int, Start | None] = (0, None)
    for way in ways:
        stands = _stands(way, ground, others)
        free = np.array([stand is not None for stand in stands])
        edges = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]]).astype(int)))
        for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            if last - first > best[0]:
                best = last - first, stands[first]
    if best[1] is None:
        raise DataError(
            "robot",
            f"{scene.name} has no free ground along its {ways[0].by}s",
            "Look at its collision mesh, or export without the robot",
        )
    return best[1]


def _paths(scene: Scene) -> list[Course]:
    """Ways that were driven, by tile; places are where the recording device was."""
    from scipy.spatial import cKDTree

    found = []
    for tile in scene.tiles:
        if (tile.folder / PATH).is_file():
            places = Trajectory.load(tile.folder / PATH).positions + np.asarray(tile.offset)
            for way in driven.ways(places, np.ones(len(places), bool)):
                _, nearest = cKDTree(places[:, :2]).query(way)
                found.append(Course(np.column_stack([way, places[nearest, 2]]), "path"))
    return found


def bodies(scene: Scene) -> tuple[RaycastingScene, RaycastingScene]:
    """The ground of all tiles, and all else that bodies collide with, world metres."""
    import open3d as o3d

    ground, others = o3d.t.geometry.RaycastingScene(), o3d.t.geometry.RaycastingScene()
    for tile in scene.tiles:
        solid = tile.solid()
        codes = solid.classification
        below = np.ones(len(solid), bool) if codes is None else group_of()[codes] == 0
        for part, to in ((solid.keep(below), ground), (solid.keep(~below), others)):
            vertices = (part.vertices + np.asarray(tile.offset)).astype(np.float32)
            to.add_triangles(vertices, part.faces.astype(np.uint32))
    return ground, others


def _stands(way: Course, ground: RaycastingScene, others: RaycastingScene) -> list[Start | None]:
    """Where a robot can stand along a course; None where it can't."""
    over = way.places[:, 2] + (0.0 if way.by == "path" else OVER)
    x, y = np.meshgrid(np.linspace(-LENGTH, LENGTH, 7) / 2, np.linspace(-WIDTH, WIDTH, 5) / 2)
    found = []
    for place, heading, top in zip(way.places, way.headings, over, strict=True):
        ahead = np.array([np.cos(heading), np.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        under = place[:2] + x.reshape(-1, 1) * ahead + y.reshape(-1, 1) * left
        height = heights(ground, under, float(top))
        stand = _stand(np.column_stack([x.ravel(), y.ravel(), height]), place, float(heading), way.by)
        found.append(stand if stand is not None and _clear(others, stand) else None)
    return found


def heights(ground: RaycastingScene, xy: F64, top: float) -> F64:
    """(N,) heights of the ground at places (N, 2), below `top`; NaN without any."""
    rays = np.zeros((len(xy), 6), np.float32)
    rays[:, :2], rays[:, 2], rays[:, 5] = xy, top, -1.0
    far = ground.cast_rays(rays)["t_hit"].numpy()
    return np.where(np.isfinite(far), top - far, np.nan)


def _stand(below: F64, place: F64, heading: float, by: str) -> Start | None:
    """On the plane through the ground (N, 3) below it (metres ahead, to the left, height); None where it is none."""
    if not np.isfinite(below).all():
        return None
    plane = np.column_stack([below[:, :2], np.ones(len(below))])
    (ahead, left, height), *_ = np.linalg.lstsq(plane, below[:, 2], rcond=None)
    if np.abs(plane @ (ahead, left, height) - below[:, 2]).max() > LEVEL:
        return None
    position = float(place[0]), float(place[1]), float(height) + DROP
    return Start(position, (float(np.arctan(left)), -float(np.arctan(ahead)), heading), by)


def _clear(others: RaycastingScene, stand: Start) -> bool:
    """Whether nothing but ground is near."""
    middle = np.array([[*stand.position[:2], stand.position[2] + HEIGHT]], np.float32)
    return bool(others.compute_distance(middle).numpy()[0] > CLEAR)

"""Spawn pose of the robot in a scene: in the free space of its map, on a road, or on the recording vehicle's path."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.classes import group_of
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F64, Trajectory
from scan2sim.pipeline.io.worlds.scene import PATH_FILE, Scene
from scan2sim.pipeline.io.worlds.scene_roads import roads_of
from scan2sim.pipeline.roads import driven
from scan2sim.pipeline.roads.course import Course, course
from scan2sim.pipeline.simulation.robot import Start

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene

FOOTPRINT_LENGTH_M, FOOTPRINT_WIDTH_M, BODY_HEIGHT_M = 0.9, 0.7, 0.4
"""Footprint of a robot, and height at which the distance to obstacles is measured."""
MIN_OBSTACLE_DISTANCE_M = 0.8
MAX_UNEVENNESS_M = 0.1
"""Largest distance of the ground from a plane below the footprint."""
SEARCH_HEIGHT_M = 2.0
"""Height above a road's surface from which the ground is searched downwards: below bridges and crowns."""
DROP_HEIGHT_M = 0.02
"""Initial height above the ground."""
MAX_TILES = 8
"""Number of tiles around the origin in which a pose is searched."""
SEARCH_RADIUS_M, GROUND_STEP_M = 20.0, 1.0
"""Half the side of the square in which free ground is searched, and the spacing of the places there."""


def courses(scene: Scene) -> list[Course]:
    """Courses to drive in world metres, longest first: along roads, or else along the recording vehicle's paths."""
    found = [course(road) for road in roads_of(scene)] or list(_paths(scene))
    return sorted(found, key=lambda one: -len(one.places))


def find_spawn_pose(scene: Scene) -> Start:
    """Pose in the free space of a robot's map, or start of the longest section of a course that a robot can drive over.

    Raises:
        DataError: no road and no path is known, or no free ground was found along them.
    """
    if (start := free_space_pose(scene)) is not None:
        return start
    ways = courses(scene)
    if not ways:
        raise DataError(
            "robot",
            f"no spawn pose in {scene.name}: neither a road nor the recording vehicle's path is known",
            "Give the tile a trajectory or posed photos from the ground, or export without the robot",
        )
    ground, others = bodies(scene)
    best: tuple[int, Start | None] = (0, None)
    for way in ways:
        poses = _poses_along(way, ground, others)
        free = np.array([pose is not None for pose in poses])
        edges = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]]).astype(int)))
        for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            if last - first > best[0]:
                best = last - first, poses[first]
    if best[1] is None:
        raise DataError(
            "robot",
            f"{scene.name} has no free ground along its {ways[0].by}s",
            "Check the collision mesh, or export without the robot",
        )
    return best[1]


def default_pose(scene: Scene) -> Start | None:
    """Pose for any robot, as `find_spawn_pose`, in the tile nearest to the world's origin that has one.

    Where no road and no path is known it is the free ground nearest to the origin; None: there is none.
    """
    nearest = sorted(scene.tiles, key=lambda tile: float(np.linalg.norm(tile.offset[:2])))[:MAX_TILES]
    alone = [replace(scene, tiles=(tile,)) for tile in nearest]
    for one in alone:
        with suppress(DataError):
            return find_spawn_pose(one)
    return next((pose for one in alone if (pose := _ground_pose(one)) is not None), None)


def _ground_pose(scene: Scene) -> Start | None:
    """The free ground nearest to the origin of a scene with one tile, heading along the x axis."""
    (tile,) = scene.tiles
    steps = np.arange(-SEARCH_RADIUS_M, SEARCH_RADIUS_M + GROUND_STEP_M / 2, GROUND_STEP_M)
    places = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    top = tile.high[2] + tile.offset[2]
    ground, others = bodies(scene)
    for place in places[np.argsort(np.linalg.norm(places, axis=1), kind="stable")]:
        way = Course(np.array([[*place, top], [place[0] + 1, place[1], top]]), "ground")
        if (pose := _poses_along(way, ground, others)[0]) is not None:
            return pose
    return None


def free_space_pose(scene: Scene) -> Start | None:
    """Pose that the step `navigation` found, in world coordinates; None without it."""
    about = scene.tiles[0].navigation() if len(scene.tiles) == 1 else None
    if about is None:
        return None
    (x, y, z), (roll, pitch, yaw) = about["spawn"]["position_m"], about["spawn"]["angles_rad"]
    return Start((x, y, z), (roll, pitch, yaw), "floor")


def _paths(scene: Scene) -> list[Course]:
    """Driven paths of each tile, as courses at the positions of the recording device."""
    from scipy.spatial import cKDTree

    found = []
    for tile in scene.tiles:
        if (tile.folder / PATH_FILE).is_file():
            places = Trajectory.load(tile.folder / PATH_FILE).positions + np.asarray(tile.offset)
            for way in driven.ways(places, np.ones(len(places), bool)):
                _, nearest = cKDTree(places[:, :2]).query(way)
                found.append(Course(np.column_stack([way, places[nearest, 2]]), "path"))
    return found


def bodies(scene: Scene) -> tuple[RaycastingScene, RaycastingScene]:
    """Collision meshes of all tiles, world metres: the ground, and everything else."""
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


def _poses_along(way: Course, ground: RaycastingScene, others: RaycastingScene) -> list[Start | None]:
    """Pose of a robot at each position of a course; None where it can't stand."""
    over = way.places[:, 2] + (0.0 if way.by == "path" else SEARCH_HEIGHT_M)
    x, y = np.meshgrid(
        np.linspace(-FOOTPRINT_LENGTH_M, FOOTPRINT_LENGTH_M, 7) / 2,
        np.linspace(-FOOTPRINT_WIDTH_M, FOOTPRINT_WIDTH_M, 5) / 2,
    )
    found = []
    for position, heading, top in zip(way.places, way.headings, over, strict=True):
        ahead = np.array([np.cos(heading), np.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        under = position[:2] + x.reshape(-1, 1) * ahead + y.reshape(-1, 1) * left
        height = heights(ground, under, float(top))
        pose = _pose_on_ground(np.column_stack([x.ravel(), y.ravel(), height]), position, float(heading), way.by)
        found.append(pose if pose is not None and _is_free(others, pose) else None)
    return found


def heights(ground: RaycastingScene, xy: F64, top: float) -> F64:
    """Heights (N,) of the ground at points (N, 2), searched downwards from `top`; NaN where there is none."""
    rays = np.zeros((len(xy), 6), np.float32)
    rays[:, :2], rays[:, 2], rays[:, 5] = xy, top, -1.0
    depth = ground.cast_rays(rays)["t_hit"].numpy()
    return np.where(np.isfinite(depth), top - depth, np.nan)


def _pose_on_ground(below: F64, position: F64, heading: float, by: str) -> Start | None:
    """Pose on the plane fitted to the ground (N, 3) (metres ahead, left, height); None if the ground is not planar."""
    if not np.isfinite(below).all():
        return None
    plane = np.column_stack([below[:, :2], np.ones(len(below))])
    (ahead, left, height), *_ = np.linalg.lstsq(plane, below[:, 2], rcond=None)
    if np.abs(plane @ (ahead, left, height) - below[:, 2]).max() > MAX_UNEVENNESS_M:
        return None
    origin = float(position[0]), float(position[1]), float(height) + DROP_HEIGHT_M
    return Start(origin, (float(np.arctan(left)), -float(np.arctan(ahead)), heading), by)


def _is_free(others: RaycastingScene, pose: Start) -> bool:
    """Whether there is no obstacle near."""
    middle = np.array([[*pose.position[:2], pose.position[2] + BODY_HEIGHT_M]], np.float32)
    return bool(others.compute_distance(middle).numpy()[0] > MIN_OBSTACLE_DISTANCE_M)

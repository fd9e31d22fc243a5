"""Robots dropped in a world's free space in MuJoCo: whether they come to rest on the floor; and free space itself.

A robot is a box with friction. A ball would roll down a slope of one degree, which says nothing about a floor.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.maps.chain import World
from bench.maps.command import Missing, scan2sim
from bench.maps.inputs import BenchMap
from scan2sim.data_samples.building import FreeSpace, Surface
from scan2sim.pipeline.core.classes import group_of
from scan2sim.pipeline.core.types import F64, Bools, Frame, Mesh

ROBOTS = 200
ROBOT_SIZE_M = (0.3, 0.3, 0.2)
ROBOT_FRICTION = 0.9
DROP_HEIGHT_M = 0.3
"""Height of the robot's underside above the floor before it falls."""
MAX_FLOOR_DISTANCE_M = 0.1
MAX_SPEED_M_S = 0.05
"""Speed of a robot at rest."""
SETTLE_S = 4.0
HEADROOM_M = 1.5
"""Height above a storey's floor below which its floor is sought, if there are several."""
FLOOR_RADIUS_M, FLOOR_POINTS = 0.3, 10
"""Radius around a position, and number of points in it from which they can show the floor's height, ..."""
FLOOR_PERCENTILE, FLOOR_THICKNESS_M, FLOOR_SHARE = 5.0, 0.2, 0.8
"""... the median of those up to the thickness above this percentile, if they have this share: others show no floor."""
GRID_M = 0.05
"""Distance between positions at which free space is compared."""


class Drop(NamedTuple):
    """Robots that were dropped.

    Attributes:
        at_rest: (N,) whether a robot rests within `MAX_FLOOR_DISTANCE_M` of the floor.
        room: (N,) whether its box was clear of all cells that aren't free; others may start inside an obstacle.
    """

    at_rest: Bools
    room: Bools


def drop(one: BenchMap, world: World, folder: Path) -> Drop:
    """Drop robots at random positions of the free space of all storeys.

    Raises:
        Missing: the world has no occupancy map or no free cell, the export failed, or MuJoCo isn't installed.
    """
    try:
        import mujoco
    except ImportError:
        raise Missing("mujoco isn't installed (pip install mujoco)") from None
    xy, storey, clearance = free_positions(world.maps(), ROBOTS)
    half = np.array(ROBOT_SIZE_M) / 2
    start = np.column_stack([xy, floor_heights(one, world, xy, storey) + DROP_HEIGHT_M + half[2]])
    shutil.rmtree(folder, ignore_errors=True)
    scan2sim(folder.with_suffix(".log"), "export", world.run, "--to", "mujoco", "--out", folder)
    spec = mujoco.MjSpec.from_file(str(next(folder.glob("*.xml"))))
    for i, position in enumerate(start):
        robot = spec.worldbody.add_body(name=f"robot{i}", pos=position)
        robot.add_freejoint()
        robot.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=half, mass=10, friction=[ROBOT_FRICTION, 0.005, 0.0001], contype=1,
            conaffinity=0,  # robots don't collide with each other
        )  # fmt: skip
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=round(SETTLE_S / model.opt.timestep))
    end = np.array([data.body(f"robot{i}").xpos for i in range(len(start))])
    speed = np.array([np.linalg.norm(data.body(f"robot{i}").cvel[3:]) for i in range(len(start))])
    gap = end[:, 2] - half[2] - floor_heights(one, world, end[:, :2], storey)
    return Drop((np.abs(gap) < MAX_FLOOR_DISTANCE_M) & (speed < MAX_SPEED_M_S), clearance > np.hypot(*half[:2]))


def floor_errors(one: BenchMap, world: World) -> F64:
    """Distances (N,) of the world's floor from the map's lowest points around positions of free space, metres.

    Positions where the robot saw no floor are left out: there is nothing to compare.
    """
    from scipy.spatial import cKDTree

    xy, storey, _ = free_positions(world.maps(), ROBOTS)
    floor = world_floor(world, xy, storey)
    points = world.place(one.xyz)
    tree, errors = cKDTree(points[:, :2]), []
    for position, height in zip(xy, floor, strict=True):
        near = points[tree.query_ball_point(position, FLOOR_RADIUS_M), 2]
        near = near[np.abs(near - height) < HEADROOM_M]
        if len(near) >= FLOOR_POINTS:
            low = np.percentile(near, FLOOR_PERCENTILE, method="lower")
            on_floor = near[(near >= low) & (near <= low + FLOOR_THICKNESS_M)]
            if len(on_floor) > FLOOR_SHARE * len(near):
                errors.append(abs(height - np.median(on_floor)))
    return np.array(errors)


def free_positions(maps: list[FreeSpace], count: int, seed: int = 0) -> tuple[F64, F64, F64]:
    """Random positions in free cells of all storeys' maps.

    Returns:
        (count, 2) positions, (count,) heights of these storeys' floors, and (count,) their smallest possible distances
        from cells that aren't free.
    """
    cells = [np.argwhere(free.free)[:, ::-1] for free in maps]
    if not sum(map(len, cells)):
        raise Missing("the world's occupancy maps have no free cell")
    corner = np.concatenate([free.origin + own * free.cell for free, own in zip(maps, cells, strict=True)])
    size, floor = (np.repeat([getattr(f, k) for f in maps], list(map(len, cells))) for k in ("cell", "floor"))
    rng = np.random.default_rng(seed)
    chosen = rng.integers(len(corner), size=count)
    clearance = np.concatenate([_clearance(free)[free.free] for free in maps])[chosen]
    return corner[chosen] + rng.random((count, 2)) * size[chosen, None], floor[chosen], clearance


def _clearance(free: FreeSpace) -> F64:
    """(Y, X) distance that any position in a cell has at least from cells that aren't free, metres."""
    from scipy.ndimage import distance_transform_edt

    centres = distance_transform_edt(np.pad(free.free, 1))[1:-1, 1:-1]
    return np.asarray((centres - 2**0.5) * free.cell)


def floor_heights(one: BenchMap, world: World, xy: F64, storey: F64) -> F64:
    """(N,) heights of the floor at world positions (N, 2) in storeys whose floors are at about the heights (N,).

    Known for simulated maps, as planes: the world's level is measured by part `up`. For others that of the world:
    `floor_errors` compares it with the map.
    """
    if one.truth is None or one.building is None:
        return world_floor(world, xy, storey)
    floors = np.column_stack([np.zeros((len(one.building.floors), 2)), one.building.floors])
    T = one.truth.T_map_world
    points = world.place(floors @ T[:3, :3].T + T[:3, 3])
    up = world.T_world_map[:3, :3] @ one.up
    own = points[np.abs(points[:, 2] - storey[:, None]).argmin(axis=1)]
    return np.asarray(own[:, 2] - (xy - own[:, :2]) @ up[:2] / up[2])


def world_floor(world: World, xy: F64, storey: F64) -> F64:
    """(N,) heights of the world's ground at positions (N, 2); infinite where there is none."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    for tile in world.scene.tiles:
        solid = tile.solid()
        assert solid.classification is not None
        ground = solid.keep(group_of()[solid.classification] == 0)
        placed = Mesh(Frame(), ground.vertices + np.asarray(tile.offset, np.float32), ground.faces)
        scene.add_triangles(
            o3d.core.Tensor.from_numpy(placed.vertices), o3d.core.Tensor.from_numpy(placed.faces.astype(np.uint32))
        )
    top = storey + HEADROOM_M if len(np.unique(storey)) > 1 else np.full(len(xy), 1000.0)
    rays = np.zeros((len(xy), 6), np.float32)
    rays[:, :2], rays[:, 2], rays[:, 5] = xy, top, -1
    return np.asarray(top - scene.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy(), np.float64)


def free_agreement(one: BenchMap, world: World) -> float:
    """Intersection over union of the world's free space and the true one, within the part that the robot saw.

    The true one is what the robot for which the map is made reaches: other true free space may be in the map, or not.
    """
    assert one.building is not None and one.truth is not None
    found, band = world.maps()[0], (world.scene.tiles[0].navigation() or {})["band_m"]
    truth = one.building.free_space(0, low=band["low"], high=band["high"])
    reached = truth.swept(one.building.routes[0][0][:2], band["radius"])
    points = one.truth.world
    seen = points[(one.truth.surface == Surface.FLOOR) & (points[:, 2] < one.building.floors[0] + 0.5)]
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    grid = np.stack(np.meshgrid(*(np.arange(a, b, GRID_M) for a, b in zip(low, high, strict=True))), axis=-1)
    xy = grid.reshape(-1, 2)
    there = np.column_stack([xy, np.zeros(len(xy))])
    T = one.truth.T_map_world
    placed = world.place(there @ T[:3, :3].T + T[:3, 3])
    a, b = reached.at(xy), found.at(placed[:, :2])
    return float((a & b).sum() / max((a | b & ~truth.at(xy)).sum(), 1))

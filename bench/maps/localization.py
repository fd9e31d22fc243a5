"""A lidar simulated in a world and localized in the user's own map, by point-to-plane ICP (Chen and Medioni 1991).

Points of a noisy map scatter around its walls, and point-to-point registration (kiss-icp) is drawn to the nearest ones:
3 to 5 cm off even in a perfect world. Planes fitted to neighbourhoods average the scatter: .5 to .8 cm.
"""

from __future__ import annotations

import numpy as np

from bench.maps.chain import World
from bench.maps.inputs import BenchMap
from scan2sim.data_samples.robot_map import beam_directions
from scan2sim.pipeline.core.types import F64
from scan2sim.slam.geometry import exp_so3

SWEEPS = 60
"""Number of sweeps along the robot's path."""
SWEEP_VOXEL_M = 0.1
NORMAL_RADIUS_M, NORMAL_NEIGHBOURS_MAX = 0.3, 60
"""Neighbourhood of a point of the map that its plane is fitted to."""
MAX_DISTANCES_M = (1.0, 0.5, 0.25)
"""Maximum distance of correspondences, in stages."""
KERNEL_M = 0.1
"""Scale of Tukey's robust kernel in the last stage; it grows with the distance in the others."""
ITERATIONS = 40
START_ERROR_M, START_ERROR_DEG = 0.2, 4.0
"""Standard deviation of the initial guess per axis."""
MIN_RETURNS = 100


def localization_errors(one: BenchMap, world: World, seed: int = 0) -> F64:
    """(S,) position errors in metres of sweeps taken in the world from true poses between the map's own."""
    import open3d as o3d

    assert one.truth is not None and one.lidar is not None
    icp = o3d.pipelines.registration
    target = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(one.xyz))
    target.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(NORMAL_RADIUS_M, NORMAL_NEIGHBOURS_MAX))
    criteria = icp.ICPConvergenceCriteria(max_iteration=ITERATIONS)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(world.mesh.vertices, world.mesh.faces.astype(np.uint32))
    rng = np.random.default_rng(seed)
    beams = beam_directions(one.lidar).reshape(-1, 3)
    path = one.truth.trajectory
    moments = path.times[0] + (np.arange(SWEEPS) + 0.5) / SWEEPS * (path.times[-1] - path.times[0])
    errors = []
    for T_map_sensor in path.pose_at(moments):
        T = world.T_world_map @ T_map_sensor
        rays = np.concatenate([np.broadcast_to(T[:3, 3], beams.shape), beams @ T[:3, :3].T], axis=1)
        far = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy().astype(np.float64)
        hit = (far > one.lidar.range_min) & (far < one.lidar.range_max)
        if hit.sum() < MIN_RETURNS:
            errors.append(np.inf)
            continue
        sweep = beams[hit] * (far[hit] + rng.normal(0, one.lidar.noise, int(hit.sum())))[:, None]
        source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(sweep)).voxel_down_sample(SWEEP_VOXEL_M)
        guess = T_map_sensor.copy()
        guess[:3, 3] += rng.normal(0, START_ERROR_M, 3)
        guess[:3, :3] = guess[:3, :3] @ exp_so3(np.radians(rng.normal(0, START_ERROR_DEG, 3)))
        found = guess
        for limit in MAX_DISTANCES_M:
            kernel = icp.TukeyLoss(KERNEL_M * limit / MAX_DISTANCES_M[-1])
            plane = icp.TransformationEstimationPointToPlane(kernel)
            found = icp.registration_icp(source, target, limit, found, plane, criteria).transformation
        errors.append(float(np.linalg.norm(found[:3, 3] - T_map_sensor[:3, 3])))
    return np.array(errors)

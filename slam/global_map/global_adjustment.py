"""Global bundle adjustment of all keyframes and points after odometry, by pycolmap (Ceres).

Schoenberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016; pycolmap supports equirectangular cameras. The
adjusted path is kept only if held-out features (`cross_validation.py`) fit it better than odometry's path.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.types import F64, Trajectory
from scan2sim.pipeline.geometry.similarity import umeyama
from scan2sim.pipeline.io.colmap_writer import SparseMap
from scan2sim.pipeline.io.colmap_writer import write as write_colmap
from scan2sim.slam.factor_graph import Graph
from scan2sim.slam.geometry import angles
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.global_map.sparse_model import SparsePoints, sparse_points, update_map
from scan2sim.slam.mapping.cross_validation import compare_paths, points_by_fixed_cameras

LOSS_SCALE = 3.0
"""Scale of the Cauchy loss, as a multiple of the median error: keeps most of the information of Gaussian errors."""
OUTLIER_GATES = 2.0
"""Multiple of the odometry's inlier gate beyond which observations are excluded."""
SEAM_MARGIN_PX = 20.0
"""Distance from a 360 frame's seam within which observations are excluded."""
POLE_SINE_MAX = 0.9
"""Sine of the elevation in a 360 frame beyond which observations are excluded."""


@dataclass(frozen=True)
class Adjusted:
    """Result of the bundle adjustment.

    Attributes:
        known: odometry's points and observations.
        poses: (C, 4, 4) of the keyframes, camera to world.
        xyz: (P, 3) points.
        before, after: mean reprojection error of all observations, pixels.
    """

    known: SparsePoints
    poses: F64
    xyz: F64
    before: float
    after: float


def adjust(checkpoint: MapCheckpoint) -> dict[str, Any]:
    """Bundle-adjust a map that was built with `keep`, in place; returns metrics.

    The map stays unchanged if the held-out features don't fit the adjusted path better.

    Raises:
        UnavailableError: pycolmap isn't installed.
    """
    new = bundle_adjust(checkpoint)
    comparison = compare_paths(checkpoint.map, np.stack([k.T_world_cam for k in checkpoint.map.keyframes]), new.poses)
    if comparison.second_is_better:
        update_map(checkpoint, new.known, new.poses, new.xyz)
    return {
        "adjustment_kept": comparison.second_is_better,
        "held_out_features": comparison.held_out, "held_out_gain": round(comparison.gain, 4),
        "adjusted_keyframes": len(new.poses), "adjusted_points": len(new.xyz),
        "reprojection_before_px": round(new.before, 4), "reprojection_after_px": round(new.after, 4),
    }  # fmt: skip


def bundle_adjust(checkpoint: MapCheckpoint) -> Adjusted:
    """Keyframes and points with the least reprojection error, of a map that was built with `keep`.

    Position, orientation and scale of the whole map stay those of odometry, or GPS.

    Raises:
        UnavailableError: pycolmap isn't installed.
    """
    require("--adjust", "pycolmap")
    import pycolmap

    keyframes = checkpoint.map.keyframes
    poses = np.stack([k.T_world_cam for k in keyframes])
    known = sparse_points(checkpoint)
    camera = checkpoint.map.camera
    all_fixed = np.ones(len(poses), bool)
    graph = Graph(poses, known.xyz, known.point, known.keyframe, known.bearing, all_fixed, checkpoint.map.sigma)
    xyz = points_by_fixed_cameras(graph)  # keyframes have moved since some points left the window
    known = replace(known, xyz=np.where(np.isfinite(xyz), xyz, known.xyz))
    uv, use = project(camera, known.bearing)
    error = angles(poses[known.keyframe], known.xyz[known.point], known.bearing)
    use &= error < OUTLIER_GATES * checkpoint.map.gate
    if camera.model == "equirectangular":
        # pycolmap's residuals are in pixels, which jump at the seam and stretch at the poles
        use &= np.abs(uv[:, 0] - camera.width / 2) < camera.width / 2 - SEAM_MARGIN_PX
        use &= np.abs(known.bearing[:, 1]) < POLE_SINE_MAX
    counts = np.bincount(known.point[use], minlength=len(known.xyz))
    use &= counts[known.point] > 1
    if not use.any():
        return Adjusted(known, poses, known.xyz, 0.0, 0.0)
    path = Trajectory(np.arange(len(poses), dtype=np.float64), poses[:, :3, 3], poses[:, :3, :3])
    sparse = SparseMap(known.xyz, known.point[use], known.keyframe[use], uv[use].astype(np.float64))
    with tempfile.TemporaryDirectory(prefix="scan2sim-adjust-") as folder:
        write_colmap(Path(folder), path, camera, [f"{i:06d}" for i in range(len(poses))], sparse)
        model = pycolmap.Reconstruction(folder)
    before = model.compute_mean_reprojection_error()
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_SCALE * float(np.median(error[use])) / checkpoint.map.pixel
    options.ceres.solver_options.max_num_iterations = 50
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
    moved = poses.copy()
    for i in model.reg_image_ids():
        world_to_cam = model.images[i].cam_from_world()
        R = world_to_cam.rotation.matrix()
        moved[i - 1, :3, :3], moved[i - 1, :3, 3] = R.T, -R.T @ world_to_cam.translation
    onto = umeyama(moved[:, :3, 3], poses[:, :3, 3], scaled=True)
    placed = np.tile(np.eye(4), (len(poses), 1, 1))
    placed[:, :3, :3], placed[:, :3, 3] = onto.rotation @ moved[:, :3, :3], onto.apply(moved[:, :3, 3])
    xyz = known.xyz.copy()
    for i, point in model.points3D.items():
        xyz[i - 1] = point.xyz
    return Adjusted(known, placed, onto.apply(xyz), float(before), float(model.compute_mean_reprojection_error()))

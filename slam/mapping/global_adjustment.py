"""Global adjustment: all keyframes and points at once, by pycolmap (Ceres), after odometry; reported apart from it.

Schoenberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016; pycolmap knows equirectangular cameras. Features
that neither odometry nor the adjustment has used (`cross_validation.py`) tell which of both paths is kept.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.types import F64, Trajectory
from scan2sim.pipeline.geometry.similarity import umeyama
from scan2sim.pipeline.io.colmap_writer import SparseMap
from scan2sim.pipeline.io.colmap_writer import write as write_colmap
from scan2sim.slam.geometry import angles
from scan2sim.slam.mapping.cross_validation import judge, laid
from scan2sim.slam.mapping.factor_graph import Graph
from scan2sim.slam.mapping.map_file import Mapped
from scan2sim.slam.mapping.sparse_model import Kept, kept, move

LOSS = 3.0
"""Times the median error, beyond which Cauchy's loss counts observations ever less: that loses little of what Gaussian
errors tell."""
WRONG = 2.0
"""Observations off by more than so many times the odometry's gate are left out."""
EDGE, POLE = 20.0, 0.9
"""Pixels from a 360 frame's seam, and sine of the elevation, beyond which observations are left out."""


@dataclass(frozen=True)
class Adjusted:
    """Where keyframes and points fit best.

    Attributes:
        known: what odometry knew of the points.
        poses: (C, 4, 4) of the keyframes, camera to world.
        xyz: (P, 3) the points.
        before, after: pixels, mean error of all observations.
    """

    known: Kept
    poses: F64
    xyz: F64
    before: float
    after: float


def adjust(mapped: Mapped) -> dict[str, Any]:
    """Move the keyframes of an odometry that was told to `keep` to where all observations fit best; figures.

    Where witnesses fit the adjusted path no better, all stays where it was.

    Raises:
        UnavailableError: pycolmap isn't installed.
    """
    new = adjusted(mapped)
    said = judge(mapped.map, np.stack([k.T_world_cam for k in mapped.map.keyframes]), new.poses)
    if said.better:
        move(mapped, new.known, new.poses, new.xyz)
    return {
        "adjustment_kept": said.better, "witnesses": said.witnesses, "witnesses_gain": round(said.gain, 4),
        "adjusted_keyframes": len(new.poses), "adjusted_points": len(new.xyz),
        "reprojection_before_px": round(new.before, 4), "reprojection_after_px": round(new.after, 4),
    }  # fmt: skip


def adjusted(mapped: Mapped) -> Adjusted:
    """The keyframes of an odometry that was told to `keep`, where all observations fit best.

    The whole keeps its place, orientation and scale: those are the odometry's, or GPS's.

    Raises:
        UnavailableError: pycolmap isn't installed.
    """
    need("--adjust", "pycolmap")
    import pycolmap

    keyframes = mapped.map.keyframes
    poses = np.stack([k.T_world_cam for k in keyframes])
    known = kept(mapped)
    camera = mapped.map.camera
    still = np.ones(len(poses), bool)
    graph = Graph(poses, known.xyz, known.point, known.keyframe, known.bearing, still, mapped.map.sigma)
    xyz = laid(graph)  # cameras have moved since some points left the window
    known = replace(known, xyz=np.where(np.isfinite(xyz), xyz, known.xyz))
    uv, inside = project(camera, known.bearing)
    error = angles(poses[known.keyframe], known.xyz[known.point], known.bearing)
    inside &= error < WRONG * mapped.map.gate
    if (
        camera.model == "equirectangular"
    ):  # pycolmap measures in pixels, which jump at the seam and stretch at the poles
        inside &= (np.abs(uv[:, 0] - camera.width / 2) < camera.width / 2 - EDGE) & (np.abs(known.bearing[:, 1]) < POLE)
    seen = np.bincount(known.point[inside], minlength=len(known.xyz))
    inside &= seen[known.point] > 1
    if not inside.any():
        return Adjusted(known, poses, known.xyz, 0.0, 0.0)
    path = Trajectory(np.arange(len(poses), dtype=np.float64), poses[:, :3, 3], poses[:, :3, :3])
    sparse = SparseMap(known.xyz, known.point[inside], known.keyframe[inside], uv[inside].astype(np.float64))
    with tempfile.TemporaryDirectory(prefix="scan2sim-adjust-") as folder:
        write_colmap(Path(folder), path, camera, [f"{i:06d}" for i in range(len(poses))], sparse)
        model = pycolmap.Reconstruction(folder)
    before = model.compute_mean_reprojection_error()
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS * float(np.median(error[inside])) / mapped.map.pixel
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

"""Writer of COLMAP text models; `pipeline.io.photogrammetry.colmap` reads them.

It does not use pycolmap: it needs no package, keeps the order of names and ids, and records the CRS of the
coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import F64, I32, U8, Camera, Frame, Trajectory
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.trajectory import atomic_write


@dataclass(frozen=True)
class SparseMap:
    """Sparse 3D points and their observations in the frames (tracks).

    Attributes:
        xyz: (M, 3) local metres.
        point, frame: (K,) point and frame of each observation, indices into `xyz` and the trajectory.
        uv: (K, 2) pixel of each observation; the centre of the top left pixel is (0, 0).
        rgb: (M, 3) colours, or None.
    """

    xyz: F64
    point: I32
    frame: I32
    uv: F64
    rgb: U8 | None = None


def write(
    folder: Path,
    trajectory: Trajectory,
    camera: Camera,
    names: Sequence[str],
    sparse: SparseMap | None = None,
    frame: Frame | None = None,
) -> list[Path]:
    """Write a COLMAP text model in local metres (a comment in `cameras.txt` names the frame); returns its three files.

    COLMAP's poses are world to camera, the centre of its top left pixel is (0.5, 0.5), its ids count from 1.

    Raises:
        DataError: the trajectory has no rotations, or names, poses and observations are inconsistent.
        SpaceError: the disk is full or not writable.
    """
    from scipy.spatial.transform import Rotation

    if trajectory.rotations is None:
        raise DataError(folder, "the trajectory has no rotations", "Write it without a COLMAP model")
    if len(names) != len(trajectory) or len(set(names)) != len(names):
        raise DataError(folder, f"{len(set(names))} names for {len(trajectory)} poses", "Give each pose a unique name")
    if any(len(name.split()) != 1 for name in names):
        raise DataError(
            folder, "a frame name is empty or contains spaces, which COLMAP's text format can't store", "Rename it"
        )
    if sparse is None:
        empty = np.zeros(0, np.int32)
        sparse = SparseMap(np.zeros((0, 3)), empty, empty, np.zeros((0, 2)))
    if len(sparse.point) and not (
        0 <= sparse.point.min() <= sparse.point.max() < len(sparse.xyz)
        and 0 <= sparse.frame.min() <= sparse.frame.max() < len(names)
    ):
        raise DataError(folder, "observations refer to points or frames that don't exist", "Number both from 0")

    order = np.argsort(sparse.frame, kind="stable")
    frames, points = sparse.frame[order], sparse.point[order]
    uv = sparse.uv[order] + 0.5
    bounds = np.searchsorted(frames, np.arange(len(names) + 1))
    index_in_image = np.arange(len(frames)) - bounds[frames]

    world_to_cam = trajectory.rotations.transpose(0, 2, 1)
    translations = -np.einsum("tij,tj->ti", world_to_cam, trajectory.positions)
    quaternions = Rotation.from_matrix(world_to_cam).as_quat(canonical=True, scalar_first=True)
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then X Y POINT3D_ID ...\n"]
    for i, (name, q, t) in enumerate(zip(names, quaternions.tolist(), translations.tolist(), strict=True)):
        in_image = slice(bounds[i], bounds[i + 1])
        pose = " ".join(f"{value:.12g}" for value in (*q, *t))
        observed = zip(uv[in_image].tolist(), points[in_image].tolist(), strict=True)
        seen = (f"{u:.4f} {v:.4f} {p + 1}" for (u, v), p in observed)
        images.append(f"{i + 1} {pose} 1 {name}\n{' '.join(seen)}\n")

    errors = _reprojection_errors(trajectory, camera, sparse)
    rgb = np.full((len(sparse.xyz), 3), 128, np.uint8) if sparse.rgb is None else sparse.rgb
    by_point = np.argsort(points, kind="stable")
    ends = np.searchsorted(points[by_point], np.arange(len(sparse.xyz) + 1))
    cloud = ["# POINT3D_ID X Y Z R G B ERROR, then IMAGE_ID POINT2D_IDX ...\n"]
    for i, (xyz, colour, error) in enumerate(zip(sparse.xyz.tolist(), rgb.tolist(), errors.tolist(), strict=True)):
        track = by_point[ends[i] : ends[i + 1]]
        seen = (f"{f + 1} {k}" for f, k in zip(frames[track].tolist(), index_in_image[track].tolist(), strict=True))
        position = " ".join(f"{value:.9g}" for value in xyz)
        cloud.append(f"{i + 1} {position} {' '.join(map(str, colour))} {error:.4f} {' '.join(seen)}\n")

    file_checks.make_folder(folder)
    texts = {
        "cameras.txt": _cameras_txt(camera, frame or Frame()),
        "images.txt": "".join(images),
        "points3D.txt": "".join(cloud),
    }
    for file, text in texts.items():
        with atomic_write(folder / file) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return [folder / file for file in texts]


def colmap_camera(camera: Camera) -> tuple[str, tuple[float, ...]]:
    """Model of a camera by COLMAP's name, and its parameters in COLMAP's order.

    Raises:
        KeyError: COLMAP has no counterpart (orthographic).
    """
    k = (*camera.distortion, *[0.0] * 8)
    at_most_four = len(camera.distortion) <= 4
    focal = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)
    return {
        "pinhole": ("PINHOLE", focal),
        "opencv": ("OPENCV", (*focal, *k[:4])) if at_most_four else ("FULL_OPENCV", (*focal, *k[:8])),
        "fisheye": ("OPENCV_FISHEYE", (*focal, *k[:4])),
        "equirectangular": ("EQUIRECTANGULAR", (float(camera.width), float(camera.height))),
    }[camera.model]


def _cameras_txt(camera: Camera, frame: Frame) -> str:
    """Content of `cameras.txt` with its one camera."""
    model, params = colmap_camera(camera)
    crs = " ".join(frame.crs.split())  # WKT may have several lines
    origin = " ".join(f"{value:.12g}" for value in frame.to_crs([0, 0, 0]))
    numbers = " ".join(f"{value:.12g}" for value in params)
    return (
        f"# coordinates: metres from {origin} in {crs}\n"
        f"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS\n1 {model} {camera.width} {camera.height} {numbers}\n"
    )


def _reprojection_errors(trajectory: Trajectory, camera: Camera, sparse: SparseMap) -> F64:
    """Mean reprojection error (M,) of each point in pixels; -1, COLMAP's "unknown", for points never observed."""
    from scan2sim.pipeline.camera.models import project

    assert trajectory.rotations is not None
    offset = sparse.xyz[sparse.point] - trajectory.positions[sparse.frame]
    uv, valid = project(camera, np.einsum("nij,ni->nj", trajectory.rotations[sparse.frame], offset))
    residual = uv - sparse.uv
    if camera.model == "equirectangular":  # wrap around at the left and right border
        residual[:, 0] -= camera.width * np.round(residual[:, 0] / camera.width)
    pixels = np.where(valid, np.linalg.norm(residual, axis=1), 0.0)
    counts = np.bincount(sparse.point[valid], minlength=len(sparse.xyz))
    sums = np.bincount(sparse.point, pixels, len(sparse.xyz))
    return np.where(counts > 0, sums / np.maximum(counts, 1), -1.0)

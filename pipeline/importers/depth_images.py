"""Fusion of posed depth images into a cloud, as phones with a depth sensor record them beside their photos.

A depth image gives millimetres along the optical axis (of panoramas: from the centre) for every pixel, 0 where unknown;
it may be smaller than its photo, and covers the same field of view. Pixels at depth discontinuities are left out:
sensors interpolate between foreground and background there. On a plane, inverse depth is linear in the image, so
the test is its second difference. Points are averaged in voxels of the size of a pixel at the median depth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, U8, Bools, Camera, Frame, PointCloud
from scan2sim.pipeline.io.images.image import read_levels, read_rgb
from scan2sim.pipeline.io.photogrammetry import Model, Photos, Shot

UNIT_M = 0.001
MAX_SECOND_DIFFERENCE = 0.02
"""Second difference of inverse depth between neighbouring pixels, relative to it, above which a pixel is left out."""
MAX_PIXELS = 400_000
"""Pixels of a depth image up to which all are used; of larger ones every second, third, ... in both directions."""
MERGED_POINTS = 4_000_000
"""Points that are collected before they are averaged in voxels."""
SPACING_IMAGES = 20  # depth images that determine the voxel size


def fuse(found: Model, photos: Photos, warn: Callable[[str], None], report: Report = silent) -> tuple[F64, U8]:
    """Points (N, 3) in model coordinates, and their colours (N, 3), of all shots that have a depth image.

    Args:
        found: the model; depths are in thousandths of its unit.
        photos: finds the photos, which colour the points.
        warn: receives depth images that are left out.
        report: receives progress.
    """
    from scan2sim.pipeline.geometry.voxel_grid import sample

    shots = [shot for shot in found.shots if shot.depth is not None]
    origin = np.round(found.centres.mean(axis=0)).tolist()
    frame = Frame(origin=(origin[0], origin[1], origin[2]))
    voxel = _spacing(found, shots)
    merged, parts = PointCloud(frame, np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8)), list[PointCloud]()
    for i, shot in enumerate(shots):
        report(i / len(shots), f"depth {shot.file}")
        try:
            xyz, rgb = _points(shot, found.cameras[shot.camera], photos.find(shot.file))
        except InputError as error:
            warn(f"{error.where}: {error.cause}: left out")
            continue
        part = PointCloud(frame, frame.to_local(xyz).astype(np.float32), rgb)
        parts.append(sample(part, voxel))
        if i + 1 == len(shots) or sum(map(len, parts)) > MERGED_POINTS:
            merged, parts = sample(PointCloud.join([merged, *parts]), voxel), []
    if parts:
        merged = sample(PointCloud.join([merged, *parts]), voxel)
    return frame.to_crs(merged.xyz), merged.rgb if merged.rgb is not None else np.empty((0, 3), np.uint8)


def _spacing(found: Model, shots: Sequence[Shot]) -> float:
    """Median over depth images of the width of a used pixel at their median depth, model units."""
    from scan2sim.pipeline.camera.models import pixel_angle

    widths = []
    for shot in shots[:: math.ceil(len(shots) / SPACING_IMAGES)]:
        try:
            depth, step = _depth(shot)
        except InputError:
            continue
        if (depth > 0).any():
            camera = found.cameras[shot.camera]
            pixel = pixel_angle(camera) * camera.width / depth.shape[1] * step
            widths.append(float(np.median(depth[depth > 0])) * pixel)
    return float(np.median(widths)) if widths else 1.0


def _depth(shot: Shot) -> tuple[F64, int]:
    """A depth image (H, W), model units, 0 where unknown; and the step between its pixels that are used."""
    import cv2

    assert shot.depth is not None
    depth = cv2.imread(str(shot.depth), cv2.IMREAD_UNCHANGED)
    if depth is None or depth.ndim != 2 or depth.dtype not in (np.uint16, np.int32, np.float32):
        raise InputError(shot.depth, "is not a depth image of one channel and 16 or 32 bits", "Export it again")
    metres = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float64) * UNIT_M
    metres[discontinuities(metres)] = 0
    return metres, math.ceil(math.sqrt(depth.size / MAX_PIXELS))


def discontinuities(depth: F64) -> Bools:
    """(H, W) whether the inverse of a depth image (H, W), 0 where unknown, bends by more than a smooth surface."""
    inverse = np.divide(1.0, depth, out=np.full(depth.shape, np.nan), where=depth > 0)
    bend = np.zeros(depth.shape)
    bend[:, 1:-1] = np.abs(np.nan_to_num(inverse[:, :-2] - 2 * inverse[:, 1:-1] + inverse[:, 2:]))
    bend[1:-1] = np.maximum(bend[1:-1], np.abs(np.nan_to_num(inverse[:-2] - 2 * inverse[1:-1] + inverse[2:])))
    return np.asarray(bend > MAX_SECOND_DIFFERENCE * np.nan_to_num(inverse))


def _points(shot: Shot, camera: Camera, photo: Path) -> tuple[F64, U8]:
    """Points (N, 3) of a depth image in model coordinates, and their colours in the photo."""
    import cv2

    from scan2sim.pipeline.camera.models import unproject

    depth, step = _depth(shot)
    used = np.zeros(depth.shape, bool)
    used[::step, ::step] = depth[::step, ::step] > 0
    if shot.mask is not None:
        used &= cv2.resize(read_levels(shot.mask), depth.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    rows, columns = np.nonzero(used)
    scale = np.array([camera.width / depth.shape[1], camera.height / depth.shape[0]])
    rays = unproject(camera, (np.column_stack([columns, rows]) + 0.5) * scale - 0.5)
    along_axis = 1.0 if camera.model == "equirectangular" else rays[:, 2]
    local = rays * (depth[rows, columns] / along_axis)[:, None]
    rgb = cv2.resize(read_rgb(photo), depth.shape[::-1], interpolation=cv2.INTER_AREA)[rows, columns]
    good = np.isfinite(local).all(axis=1)
    return local[good] @ shot.pose[:3, :3].T + shot.pose[:3, 3], rgb[good]

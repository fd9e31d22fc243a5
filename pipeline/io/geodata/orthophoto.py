"""Orthophotos: a GeoTIFF, or an image with a world file, as a view of an orthographic camera that looks straight down.

A world file has the six coefficients of the affine transform from pixels to CRS coordinates, one per line; the centre
of the top left pixel is its origin. GeoTIFF has the same in its tags (OGC 19-008r4).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera, Frame, View
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.images.decoders.opencv import opened
from scan2sim.pipeline.io.tile_folder import add_file

SCALE_TAG, TIEPOINT_TAG, TRANSFORM_TAG, KEYS_TAG = 33550, 33922, 34264, 34735
RASTER_TYPE_KEY, PROJECTED_CRS_KEY = 1025, 3072  # GeoTIFF keys
PIXEL_IS_POINT, USER_DEFINED = 2, 32767  # their values
CAMERA_HEIGHT_M = 10.0  # above the highest point of the tile
MAX_SKEW = 1e-4  # cosine of the angle between the sides of a pixel


def read_view(path: Path, frame: Frame, highest: float) -> View:
    """The view of an orthophoto.

    Args:
        path: JPEG, PNG or TIFF, with a world file beside it, or a GeoTIFF.
        frame: frame of the tile; the orthophoto is in its CRS and units.
        highest: height of the tile's highest point, metres above the CRS's zero.

    Raises:
        InputError: unreadable, not georeferenced, in another CRS, or its pixels are skewed or mirrored.
    """
    size, tags = _header(path)
    world = world_file(path)
    to_crs = _from_world_file(world) if world else _from_tags(path, tags, frame)
    right, down, first = to_crs[:2, 0] * frame.unit, to_crs[:2, 1] * frame.unit, to_crs[:2, 2]
    across, along = float(np.linalg.norm(right)), float(np.linalg.norm(down))
    if not np.isfinite(to_crs).all() or min(across, along) <= 0 or not 1e-4 < across < 1e3 > along:
        raise InputError(world or path, "has an invalid pixel size", "Export its georeference again")
    right, down = right / across, down / along
    if abs(right @ down) > MAX_SKEW or right[0] * down[1] - right[1] * down[0] > 0:
        raise InputError(world or path, "has skewed or mirrored pixels", "Rectify it first (gdalwarp)")
    pose = np.eye(4)
    pose[:2, 0], pose[:2, 1], pose[2, 2] = right, down, -1.0
    height = highest - frame.origin[2] + CAMERA_HEIGHT_M
    pose[:3, 3] = (*frame.to_local([*first, 0.0])[:2], height)
    camera = Camera("orthographic", *size, 1 / across, 1 / along, 0.0, 0.0)
    return View(path.stem, camera, pose, path)


def world_file(path: Path) -> Path | None:
    """The world file beside an image: `.wld`, or derived from its suffix (`.jgw`, `.jpgw`), in any case."""
    suffix = path.suffix[1:].lower()
    known = {"wld", f"{suffix}w", f"{suffix[0]}{suffix[-1]}w" if suffix else "wld"}
    beside = sorted(path.parent.glob("*"))
    names = (f"{path.stem}.", f"{path.name}.")
    return next(
        (file for file in beside if file.name.startswith(names) and file.suffix[1:].lower() in known and file != path),
        None,
    )


def copy_to_tile(path: Path, folder: Path, link: bool = False) -> str:
    """Copy or link an orthophoto and its world file into a tile's folder; returns its name there."""
    world = world_file(path)
    if world is not None:
        add_file(world, folder, world.name, link)
    return add_file(path, folder, path.name, link)


def _header(path: Path) -> tuple[tuple[int, int], dict[int, Any]]:
    """Width and height, and the tags of a TIFF."""
    size = image.size_of(path, parts=True)
    with opened(path) as picture:
        return size, dict(getattr(picture, "tag_v2", {}))


def _from_world_file(path: Path) -> F64:
    """Affine transform (2, 3) from pixel (column, row, 1) to CRS coordinates."""
    try:
        text = file_checks.check(path).read_text(encoding="utf-8-sig")[:10_000]
        a, d, b, e, c, f = (float(word) for word in re.split(r"\s+", text.strip().replace(",", ".")))
    except (OSError, ValueError) as error:
        raise InputError(path, f"is not a world file of six numbers ({error})", "Export it again") from None
    return np.array([(a, b, c), (d, e, f)])


def _from_tags(path: Path, tags: dict[int, Any], frame: Frame) -> F64:
    """Affine transform (2, 3) from pixel (column, row, 1) to CRS coordinates, from GeoTIFF tags."""
    keys = np.asarray(tags.get(KEYS_TAG, ()), np.int64)
    table = {int(row[0]): int(row[3]) for row in keys[4 : len(keys) // 4 * 4].reshape(-1, 4) if row[1] == 0}
    code = table.get(PROJECTED_CRS_KEY, 0)
    if code not in (0, USER_DEFINED) and frame.crs != crs_io.LOCAL and not crs_io.same(f"EPSG:{code}", frame.crs):
        remedy = "Reproject it to the clouds' CRS first (gdalwarp -t_srs)"
        raise InputError(path, f"is in EPSG:{code}, but the clouds are in {crs_io.name(frame.crs)}", remedy)
    try:
        if TRANSFORM_TAG in tags:
            matrix = np.asarray(tags[TRANSFORM_TAG], np.float64).reshape(4, 4)[:2, [0, 1, 3]]
        else:
            (sx, sy), tie = tags[SCALE_TAG][:2], tags[TIEPOINT_TAG]
            matrix = np.array([(sx, 0.0, tie[3] - sx * tie[0]), (0.0, -sy, tie[4] + sy * tie[1])])
    except (KeyError, ValueError, IndexError, TypeError):
        raise InputError(
            path, "is not georeferenced", "Give a GeoTIFF, or put a world file beside it (.wld, .jgw, .tfw)"
        ) from None
    if table.get(RASTER_TYPE_KEY) != PIXEL_IS_POINT:  # coordinates refer to the corners of pixels
        matrix[:, 2] += 0.5 * (matrix[:, 0] + matrix[:, 1])
    return matrix

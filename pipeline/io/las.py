"""LAS, LAZ and COPC, through laspy."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import InputError
from pipeline.types import F64, Frame, PointCloud

CHUNK = 2_000_000


def _open(path: Path) -> Any:
    import laspy
    from laspy.errors import LaspyException

    try:
        return laspy.open(path)
    except FileNotFoundError:
        raise InputError(path, "is missing", "Put it there, or mend the name") from None
    except (LaspyException, ValueError, struct.error, OSError) as error:
        raise InputError(path, f"is no readable LAS file ({error})", "Copy or export it again") from None


def read_header(path: Path) -> tuple[int, F64, F64, str | None]:
    """Number of points, low and high corner (CRS units), CRS as WKT or None."""
    with _open(path) as reader:
        header = reader.header
        if header.point_count == 0:
            raise InputError(path, "holds no points", "Leave it out of the tile")
        return header.point_count, np.array(header.mins), np.array(header.maxs), _crs(path, header)


def read(path: Path, frame: Frame) -> PointCloud:
    """Read all points into local coordinates, chunk by chunk; colours of 16 bits become 8."""
    with _open(path) as reader:
        n = reader.header.point_count
        names = set(reader.header.point_format.dimension_names)
        xyz = np.empty((n, 3), np.float32)
        label = np.empty(n, np.uint8)
        intensity = np.empty(n, np.uint16)
        time = np.empty(n, np.float64) if "gps_time" in names else None
        rgb = np.empty((n, 3), np.uint16) if "red" in names else None
        at = 0
        try:
            for part in reader.chunk_iterator(CHUNK):
                here = slice(at, at + len(part))
                xyz[here] = frame.to_local(np.column_stack([part.x, part.y, part.z]))
                label[here] = part.classification
                intensity[here] = part.intensity
                if time is not None:
                    time[here] = part.gps_time
                if rgb is not None:
                    rgb[here] = np.column_stack([part.red, part.green, part.blue])
                at += len(part)
        except Exception as error:  # the decompressors raise their own kinds, a panic among them
            raise _truncated(path, at, n, str(error)) from None
        if at < n:
            raise _truncated(path, at, n, "end of file")
    return PointCloud(frame, xyz, _eight_bits(rgb), label=label, time=time, intensity=intensity)


def write(path: Path, cloud: PointCloud, scale: float = 0.001) -> None:
    """Write a LAS 1.4 file (LAZ by suffix), CRS and class names included; coordinates back in the CRS."""
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    has_rgb = cloud.rgb is not None
    header = laspy.LasHeader(point_format=7 if has_rgb else 6, version="1.4")
    header.scales = np.full(3, scale / cloud.frame.unit)
    header.offsets = np.floor(cloud.frame.to_crs(np.zeros(3)))
    if cloud.frame.crs != "local":
        from pyproj import CRS

        header.vlrs.append(WktCoordinateSystemVlr(CRS.from_user_input(cloud.frame.crs).to_wkt("WKT1_GDAL")))
        header.global_encoding.wkt = True
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.frame.to_crs(cloud.xyz).T
    if cloud.label is not None:
        las.classification = cloud.label
    if cloud.time is not None:
        las.gps_time = cloud.time
    if cloud.intensity is not None:
        las.intensity = cloud.intensity
    if cloud.rgb is not None:
        las.red, las.green, las.blue = (cloud.rgb.astype(np.uint16) * 257).T
    las.write(str(path))


def _eight_bits(rgb: Any) -> Any:
    if rgb is None or not rgb.any():  # a format with colour fields that were never filled
        return None
    return (rgb >> 8).astype(np.uint8) if rgb.max() > 255 else rgb.astype(np.uint8)


def _crs(path: Path, header: Any) -> str | None:
    from pyproj.exceptions import CRSError

    try:
        crs = header.parse_crs()
    except (CRSError, NotImplementedError) as error:
        raise InputError(
            path, f"its CRS can't be read ({error})", "Set `crs` in its header, or write it again"
        ) from None
    return crs.to_wkt() if crs is not None else None


def _truncated(path: Path, at: int, n: int, cause: str) -> InputError:
    return InputError(path, f"is truncated or damaged: {at:,} of {n:,} points can be read ({cause})", "Copy it again")

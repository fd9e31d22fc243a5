"""Sweeps of Livox `CustomMsg` messages (livox_ros_driver 1 and 2), read from their bytes: their points are structs."""

from __future__ import annotations

import struct

import numpy as np

from scan2sim.pipeline.importers.bag.point_cloud2 import InvalidCloud, RawSweep

TYPES = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg", "livox_interfaces/msg/CustomMsg")
POINT_BYTES = 19
"""offset_time uint32 (nanoseconds after `timebase`), x, y, z float32, reflectivity, tag, line uint8."""
CDR_POINT_BYTES = 20
"""In ROS 2, points are aligned to four bytes."""


def decode(raw: bytes, ros2: bool) -> RawSweep:
    """The points of a message; times are relative, in nanoseconds.

    Layout: header, timebase uint64, point_num uint32, lidar_id uint8, rsvd uint8[3], points CustomPoint[].

    Raises:
        InvalidCloud: the bytes don't fit the definition.
    """
    order = ">" if ros2 and raw[1:2] == b"\0" else "<"
    try:
        (length,) = struct.unpack_from(f"{order}I", raw, 12)
        at = 16 + length
        if ros2:
            at = 4 + -(-(at - 4) // 8) * 8  # timebase is aligned to 8 bytes, counted from the end of the 4-byte prefix
        (count,) = struct.unpack_from(f"{order}I", raw, at + 16)
    except struct.error:
        raise InvalidCloud(f"is too short ({len(raw)} bytes)") from None
    size = CDR_POINT_BYTES if ros2 else POINT_BYTES
    start = at + 20
    if start + count * size - (size - POINT_BYTES) > len(raw):
        raise InvalidCloud(f"has {len(raw)} bytes for {count} points")
    row = np.dtype(
        {
            "names": ["t", "x", "y", "z", "reflectivity"],
            "formats": [f"{order}u4", f"{order}f4", f"{order}f4", f"{order}f4", "u1"],
            "offsets": [0, 4, 8, 12, 16],
            "itemsize": size,
        }
    )
    data = raw[start : start + count * size]
    rows = np.frombuffer(data.ljust(count * size, b"\0"), row)
    xyz = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float32)
    keep = np.isfinite(xyz).all(axis=1) & (xyz != 0).any(axis=1)
    return RawSweep(xyz[keep], rows["reflectivity"][keep], None, rows["t"][keep])

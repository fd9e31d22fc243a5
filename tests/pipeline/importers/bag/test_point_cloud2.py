"""PointCloud2 messages in the layouts of scanner drivers, and invalid ones."""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.pipeline.importers.bag import livox
from scan2sim.pipeline.importers.bag.point_cloud2 import InvalidCloud, decode, intensity_scale, time_unit

STAMP_NS = 1_700_000_000_123_456_789
KINDS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
XYZ = np.array([[1.5, -2.0, 0.25], [np.nan, 1, 1], [0, 0, 0], [30.0, 4.0, -1.0], [-7.0, 0.0, 0.0]])
OFFSETS = np.array([0.0, 0.02, 0.04, 0.06, 0.1])


def cloud(
    xyz: str = "<f4", time: tuple[str, str] | None = None, values: Any = OFFSETS, pad: int = 0, **more: Any
) -> Any:
    """A message; `time`: name and type of the field with the times."""
    kinds = [(name, xyz) for name in "xyz"] + [("intensity", f"{xyz[0]}f4")]
    if time is not None:
        kinds.append((time[0], time[1]))
    offsets = [int(o) + 4 for o in np.cumsum([0, *(np.dtype(k).itemsize for _, k in kinds[:-1])])]
    size = offsets[-1] + np.dtype(kinds[-1][1]).itemsize + 3  # unaligned, and padded on both sides
    names, formats = zip(*kinds, strict=True)
    row = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})
    rows = np.zeros(len(XYZ), row)
    for k, axis in enumerate("xyz"):
        rows[axis] = XYZ[:, k]
    rows["intensity"] = np.arange(len(XYZ)) / 10
    if time is not None:
        rows[time[0]] = values
    data = rows.tobytes()
    fields = [
        SimpleNamespace(name=name, offset=at, datatype=KINDS[np.dtype(kind).str[1:]], count=1)
        for (name, kind), at in zip(kinds, offsets, strict=True)
    ]
    message = SimpleNamespace(
        fields=fields, point_step=size, row_step=size * len(XYZ) + pad, height=1, width=len(XYZ),
        is_bigendian=xyz[0] == ">", data=np.frombuffer(data, np.uint8),
    )  # fmt: skip
    return SimpleNamespace(**(vars(message) | more))


@pytest.mark.parametrize("xyz", ["<f4", ">f4", "<f8", ">f8"])
def test_any_byte_order_and_type_is_read_without_points_without_return(xyz: str) -> None:
    sweep = decode(cloud(xyz))
    assert sweep.xyz.dtype == np.float32 and np.array_equal(sweep.xyz, XYZ[[0, 3, 4]].astype(np.float32))
    assert sweep.intensity is not None and np.allclose(sweep.intensity, [0, 0.3, 0.4]) and sweep.time is None


SPELLINGS: dict[str, tuple[tuple[str, str], npt.NDArray[Any]]] = {
    "velodyne": (("time", "<f4"), OFFSETS - 0.1),
    "ouster": (("t", "<u4"), OFFSETS * 1e9),
    "hesai": (("timestamp", "<f8"), STAMP_NS * 1e-9 + OFFSETS),
    "livox relative": (("offset_time", "<u4"), OFFSETS * 1e9),
    "livox absolute": (("timestamp", "<f8"), STAMP_NS + OFFSETS * 1e9),
    "microseconds": (("time_offset", "<u4"), OFFSETS * 1e6),
    "float microseconds": (("t", "<f4"), OFFSETS * 1e6),
    "blickfeld": (("point_time_offset", "<u4"), OFFSETS * 1e9),
    "aeva": (("time_offset_ns", "<i4"), OFFSETS * 1e9),
    "float seconds": (("Relative_Time_Sec", "<f4"), OFFSETS),
}


@pytest.mark.parametrize("name", SPELLINGS)
def test_unit_of_point_times_is_recognized(name: str) -> None:
    spelling, values = SPELLINGS[name]
    sweep = decode(cloud(time=spelling, values=values))
    assert sweep.time is not None
    unit = time_unit(sweep.time, STAMP_NS)
    assert unit is not None and not unit.other_clock
    expected = OFFSETS[[0, 3, 4]] - (0.1 if name == "velodyne" else 0)
    assert np.allclose(unit.offsets(sweep.time, STAMP_NS), expected, atol=1e-6)


def test_absolute_integer_nanoseconds_keep_their_precision() -> None:
    time = (STAMP_NS + OFFSETS * 1e9).astype(np.int64).astype(np.uint64)
    time[0] = STAMP_NS + 37
    unit = time_unit(time, STAMP_NS)
    assert unit is not None and unit.absolute and unit.offsets(time, STAMP_NS)[0] == pytest.approx(37e-9, abs=2e-9)


@pytest.mark.parametrize(
    ("names", "unit"),
    [(("timestamp_s", "timestamp_us"), 1000), (("timeSecond", "timeNanosecond"), 1), (("stamp_sec", "stamp_nsec"), 1)],
)
def test_seconds_and_their_rest_in_two_fields_are_one_time(names: tuple[str, str], unit: int) -> None:
    nanoseconds = np.array([0, 20, 40, 60, 100]) * 10**6 + 950 * 10**6  # across the end of a second
    second = STAMP_NS // 10**9
    rows = np.zeros(len(XYZ), [*((axis, "<f4") for axis in "xyz"), (names[0], "<u4"), (names[1], "<u4")])
    for k, axis in enumerate("xyz"):
        rows[axis] = XYZ[:, k]
    rows[names[0]] = second + nanoseconds // 10**9
    rows[names[1]] = nanoseconds % 10**9 // unit
    fields = [
        SimpleNamespace(name=name, offset=4 * k, datatype=KINDS["f4" if k < 3 else "u4"], count=1)
        for k, name in enumerate(("x", "y", "z", *names))
    ]
    data, size = np.frombuffer(rows.tobytes(), np.uint8), rows.dtype.itemsize
    sweep = decode(cloud(fields=fields, point_step=size, row_step=size * len(rows), data=data))
    stamp = second * 10**9 + 950 * 10**6
    assert sweep.time is not None
    found = time_unit(sweep.time, stamp)
    assert found is not None and found.absolute
    assert np.allclose(found.offsets(sweep.time, stamp), OFFSETS[[0, 3, 4]], atol=1e-6)


def test_whole_seconds_alone_are_no_times_of_points() -> None:
    assert decode(cloud(time=("stamp_sec", "<u4"), values=1_700_000_000)).time is None


def test_times_of_another_clock_start_at_the_first_point_and_constant_ones_are_ignored() -> None:
    unit = time_unit(5000.0 + OFFSETS, STAMP_NS)
    assert unit is not None and unit.other_clock
    assert np.allclose(unit.offsets(5000.0 + OFFSETS, STAMP_NS), OFFSETS)
    assert time_unit(np.zeros(5), STAMP_NS) is None


def test_padded_rows_and_packed_colours_are_read() -> None:
    packed = np.array([0x00FF8001, 0x00010203], np.uint32)
    rows = np.zeros((2, 1), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<f4")])
    rows["x"], rows["rgb"] = 1.0, packed.view(np.float32)[:, None]
    data = b"".join(row.tobytes() + b"\xff" * 5 for row in rows)[:-5]  # the last row without padding
    fields = [SimpleNamespace(name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate(("x", "y", "z", "rgb"))]
    message = SimpleNamespace(
        fields=fields, point_step=16, row_step=21, height=2, width=1, is_bigendian=False, data=data
    )
    sweep = decode(message)
    assert sweep.rgb is not None and sweep.rgb.tolist() == [[255, 128, 1], [1, 2, 3]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"data": np.zeros(50, np.uint8)}, "has 50 bytes for 5 x 1 points"),
        ({"fields": []}, "has no fields x, y and z"),
        ({"point_step": 3}, "fields that don't fit"),
        ({"fields": [SimpleNamespace(name="x", offset=0, datatype=77, count=1)]}, "unknown data type 77"),
    ],
)
def test_inconsistent_clouds_are_rejected(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidCloud, match=message):
        decode(cloud(**change))


def test_intensities_are_scaled_by_their_type() -> None:
    assert (
        intensity_scale(np.array([3], np.uint8)) == 1 / 255 and intensity_scale(np.array([3], np.uint16)) == 1 / 65535
    )
    assert [round(1 / intensity_scale(np.array([v], np.float32))) for v in (0.7, 90.0, 3000.0)] == [1, 255, 65535]


@pytest.mark.parametrize(("ros2", "frame"), [(True, "a"), (True, "livox_frame"), (False, "livox")])
def test_livox_messages_are_decoded(ros2: bool, frame: str) -> None:
    name = frame.encode() + (b"\0" if ros2 else b"")
    raw = (b"\0\1\0\0" if ros2 else b"\0\0\0\0") + struct.pack("<iII", 5, 6, len(name)) + name
    raw += b"\0" * (-(len(raw) - 4) % 8 if ros2 else 0)
    raw += struct.pack("<QIB3BI", 9, 2, 0, 0, 0, 0, 2)
    points = [struct.pack("<IfffBBB", 1000 * k, 1.0 + k, 2.0, 3.0, 10 * k, 0, 0) for k in range(2)]
    raw += points[0] + (b"\0" if ros2 else b"") + points[1]
    sweep = livox.decode(raw, ros2)
    assert sweep.xyz.tolist() == [[1, 2, 3], [2, 2, 3]] and sweep.time is not None and sweep.time.tolist() == [0, 1000]
    assert sweep.intensity is not None and sweep.intensity.tolist() == [0, 10]
    with pytest.raises(InvalidCloud, match="bytes for 2 points"):
        livox.decode(raw[:-8], ros2)
    with pytest.raises(InvalidCloud, match="too short"):
        livox.decode(raw[:14], ros2)

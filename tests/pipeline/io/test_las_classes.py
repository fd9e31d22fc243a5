"""A copy of a LAS file with new classes keeps all other data."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from laspy.vlrs.known import ExtraBytesStruct
from pyproj import CRS

from scan2sim.pipeline.core.classes import CLASSES
from scan2sim.pipeline.core.errors import DataError, InputError, SpaceError, UnavailableError
from scan2sim.pipeline.core.types import U8, Frame
from scan2sim.pipeline.io import las_classes
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.las_classes import write_classified

N = 1000
FRAME = Frame("EPSG:25832", (500_000.0, 5_400_000.0, 100.0))


def made(path: Path, point_format: int, crs: str | None = "EPSG:25832", extra: str = "echo_width") -> Path:
    """A file whose every dimension is filled, with one extra one of scaled integers, a foreign record and a CRS."""
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format > 3 else "1.2")
    header.scales, header.offsets = np.array([0.01, 0.001, 0.002]), np.array([500_000.0, 5_400_000.0, 7.0])
    header.add_extra_dim(
        laspy.ExtraBytesParams(extra, "int32", "ns", offsets=np.array([0.3]), scales=np.array([0.001]))
    )
    header.vlrs.append(laspy.VLR("nobody", 77, "of someone else", b"\x01\x02\xff"))
    header.global_encoding.gps_time_type = 1
    header.file_source_id, header.system_identifier = 4711, "a scanner"
    if crs is not None:
        header.add_crs(CRS(crs))
    cloud, rng = laspy.LasData(header), np.random.default_rng(point_format)
    cloud.points = laspy.ScaleAwarePointRecord.zeros(N, header=header)
    for dim in header.point_format.dimensions:
        if dim.name in ("X", "Y", "Z", extra):
            values = rng.integers(-90_000, 90_000, N)
            cloud.points.array[dim.name] = values
        elif dim.kind is laspy.point.dims.DimensionKind.FloatingPoint:
            cloud[dim.name] = rng.uniform(0, 100, N).astype(np.float32)
        else:
            low, high = (-90, 91) if dim.name == "scan_angle_rank" else (int(dim.min), min(int(dim.max), 2**31) + 1)
            cloud[dim.name] = rng.integers(low, high, N)
    if point_format > 8:  # lazrs can't do more
        cloud.scanner_channel = np.full(N, 2)
    cloud.write(path)
    return path


def result_columns(n: int = N) -> tuple[U8, U8, U8]:
    rng = np.random.default_rng(8)
    code = rng.choice([c.code for c in CLASSES], n).astype(np.uint8)
    return code, rng.integers(0, 256, n).astype(np.uint8), rng.integers(1, 4, n).astype(np.uint8)


def check(source: Path, out: Path, columns: tuple[U8, U8, U8]) -> Any:
    """Compare all common dimensions, and the classes with the given ones; returns the copy."""
    old, new = laspy.read(source), laspy.read(out)
    assert str(new.header.version) == "1.4" and new.header.are_points_compressed
    assert new.header.point_format.id == {0: 6, 1: 6, 2: 7, 3: 7, 4: 9, 5: 10}.get(
        old.header.point_format.id, old.header.point_format.id
    )
    places = new.header.scales * np.column_stack([old.X, old.Y, old.Z]) + new.header.offsets
    assert np.allclose([places.min(axis=0), places.max(axis=0)], [new.header.mins, new.header.maxs], 0, 1e-6)
    returns = np.bincount(np.array(old.return_number), minlength=16)[1:]
    assert np.array_equal(new.header.number_of_points_by_return, returns)
    for name in ("scales", "offsets"):
        assert np.array_equal(getattr(old.header, name), getattr(new.header, name)), name
    for name in ("file_source_id", "system_identifier", "uuid"):
        assert getattr(old.header, name) == getattr(new.header, name), name
    assert old.header.global_encoding.gps_time_type == new.header.global_encoding.gps_time_type
    there = set(new.point_format.dimension_names)
    for name in set(old.point_format.dimension_names) - {
        "classification",
        "scan_angle_rank",
        *las_classes.EXTRA_DIMENSIONS,
    }:
        assert name in there, name
        assert np.array_equal(np.array(old[name]), np.array(new[name])), name
    if "scan_angle_rank" in old.point_format.dimension_names:
        assert np.abs(np.array(new.scan_angle) * 0.006 - old.scan_angle_rank).max() <= 0.003 + 1e-9
        assert np.array_equal(np.array(new.overlap) == 1, np.array(old.classification) == 12)
    for name, values in zip(("classification", "confidence", "class_source"), columns, strict=True):
        assert np.array_equal(np.array(new[name]), values), name
    extra = list(new.point_format.extra_dimension_names)
    assert len(extra) == len(set(extra)) and extra[-2:] == ["confidence", "class_source"]
    return new


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("point_format", range(11))
def test_all_data_except_classes_is_kept(tmp_path: Path, point_format: int, suffix: str) -> None:
    source, out = made(tmp_path / f"a{suffix}", point_format), tmp_path / "b.laz"
    columns = result_columns()
    write_classified(source, out, *columns)
    new = check(source, out, columns)
    assert {64, 69} <= set(np.unique(np.array(new.classification)).tolist())
    assert new.header.parse_crs() == CRS("EPSG:25832") or new.header.parse_crs().to_epsg() == 25832
    assert new.header.global_encoding.wkt
    assert {v.record_id for v in new.vlrs if v.user_id == "LASF_Projection"} == {2112}
    assert [v.record_data for v in new.vlrs if v.user_id == "nobody"] == [b"\x01\x02\xff"]
    assert [d.description for d in new.point_format.extra_dimensions] == ["ns", *las_classes.EXTRA_DIMENSIONS.values()]
    if point_format in (0, 2):
        assert not np.array(new.gps_time).any()
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([source.name, "b.laz"])


def test_class_names_are_in_one_lookup_record(tmp_path: Path) -> None:
    write_classified(made(tmp_path / "a.las", 3), tmp_path / "b.laz", *result_columns())
    write_classified(tmp_path / "b.laz", tmp_path / "c.laz", *result_columns())  # one lookup, not two
    (lookup,) = laspy.read(tmp_path / "c.laz").vlrs.get("ClassificationLookupVlr")
    assert len(lookup.lookups) == 256
    assert (lookup[64], lookup[69], lookup[90]) == ("roadsign", "sidewalk", "")  # laspy reads letters and digits only
    content = (tmp_path / "c.laz").read_bytes()
    assert all(struct.pack("<B15s", c.code, c.name.encode()) in content for c in CLASSES)


@pytest.mark.parametrize("point_format", [1, 7])
def test_classified_file_is_read_as_the_same_cloud(tmp_path: Path, point_format: int) -> None:
    source, columns = made(tmp_path / "a.laz", point_format), result_columns()
    write_classified(source, tmp_path / "b.laz", *columns)
    old, new = las.read(source, FRAME), las.read(tmp_path / "b.laz", FRAME)
    assert (
        np.array_equal(old.xyz, new.xyz)
        and new.classification is not None
        and np.array_equal(new.classification, columns[0][las.used_and_classes(source)[0]])
    )
    for name in ("time", "intensity", "rgb"):
        assert np.array_equal(getattr(old, name), getattr(new, name)), name
    assert las.read_header(source)[0] == las.read_header(tmp_path / "b.laz")[0]


def test_file_is_classified_in_chunks_and_in_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, columns = made(tmp_path / "a.laz", 3), result_columns()
    before = tmp_path / "before.laz"
    before.write_bytes(source.read_bytes())
    monkeypatch.setattr(las_classes, "CHUNK_POINTS", 300)
    write_classified(source, source, *columns)
    check(before, source, columns)
    write_classified(source, source, *result_columns())
    check(before, source, columns)


def test_file_without_crs_stays_without(tmp_path: Path) -> None:
    source = made(tmp_path / "a.las", 1, crs=None)
    write_classified(source, tmp_path / "b.laz", *result_columns())
    assert check(source, tmp_path / "b.laz", result_columns()).header.parse_crs() is None


def test_geotiff_keys_become_wkt_with_their_heights(tmp_path: Path) -> None:
    def geotiff(*more: tuple[int, int]) -> Path:
        keys = [(1024, 1), (2048, 4258), *more]
        data = struct.pack("<4H", 1, 1, 0, len(keys)) + b"".join(struct.pack("<4H", k, 0, 1, v) for k, v in keys)
        cloud = laspy.read(made(tmp_path / "a.las", 1, crs=None))
        cloud.header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", data))
        cloud.write(tmp_path / "a.las")
        write_classified(tmp_path / "a.las", tmp_path / "b.laz", *result_columns())
        return tmp_path / "b.laz"

    crs = laspy.open(geotiff((3072, 25832), (4096, 7837))).header.parse_crs()
    assert [c.to_epsg() for c in crs.sub_crs_list] == [25832, 7837]
    assert laspy.open(geotiff((3072, 25832), (4096, 5030))).header.parse_crs().to_epsg() == 25832
    header = laspy.open(geotiff((3072, 32767))).header  # a projection that only the keys describe
    assert [v.record_id for v in header.vlrs if v.user_id == "LASF_Projection"] == [34735]
    assert not header.global_encoding.wkt


def test_earlier_results_are_replaced_and_clashing_names_are_changed(tmp_path: Path) -> None:
    for extra in ("confidence", "gps_time"):
        source = made(tmp_path / f"{extra}.las", 2, extra=extra)
        write_classified(source, tmp_path / "b.laz", *result_columns())
        new, old = laspy.read(tmp_path / "b.laz"), laspy.read(source)
        names = list(new.point_format.extra_dimension_names)
        assert names[-2:] == ["confidence", "class_source"] and len(names) == (3 if extra == "gps_time" else 2)
        assert np.array_equal(np.array(new.confidence), result_columns()[1])
        if extra == "gps_time":
            assert np.array_equal(np.array(new[names[0]]), np.array(old["gps_time"]))


def test_undescribed_and_overlooked_extra_bytes_are_kept(tmp_path: Path) -> None:
    """laspy overlooks the second of two records, and bytes that no record describes."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    for name in ("first", "confidence", "third"):
        header.add_extra_dim(laspy.ExtraBytesParams(name, "uint8"))
    cloud = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(N, header=header))
    for name in ("first", "confidence", "third"):
        cloud.points.array[name] = np.random.default_rng(len(name)).integers(0, 256, N)
    (record,) = cloud.header.vlrs.extract("ExtraBytesVlr")
    first, second, _ = (bytes(s) for s in record.extra_bytes_structs)
    with (tmp_path / "a.las").open("wb") as file:
        cloud.header.vlrs.extend(laspy.VLR("LASF_Spec", 4, "", data) for data in (first, second))
        writer = laspy.LasWriter(file, cloud.header, closefd=False)
        writer.write_points(cloud.points)
        writer.close()
    write_classified(tmp_path / "a.las", tmp_path / "b.laz", *result_columns())
    new = laspy.read(tmp_path / "b.laz")
    assert list(new.point_format.extra_dimension_names) == ["first", "ExtraBytes", "confidence", "class_source"]
    assert np.array_equal(new["first"], cloud.points.array["first"])
    assert np.array_equal(new["ExtraBytes"], cloud.points.array["third"])
    assert np.array_equal(new["confidence"], result_columns()[1])


def test_extra_bytes_descriptions_are_kept(tmp_path: Path) -> None:
    """No-data values and ranges of the descriptions too, which laspy drops or recomputes."""
    source = made(tmp_path / "a.las", 6)
    with laspy.open(source) as reader:
        (one,) = reader.header.vlrs.get("ExtraBytesVlr")[0].extra_bytes_structs
    said = ExtraBytesStruct.from_buffer_copy(bytes(one))
    said.no_data = np.array([-1])
    np.frombuffer(said._min, np.int64)[0] = -12345
    source.write_bytes(source.read_bytes().replace(bytes(one), bytes(said)))
    write_classified(source, tmp_path / "b.laz", *result_columns())
    assert bytes(said) in (tmp_path / "b.laz").read_bytes()


def test_waveforms_are_copied(tmp_path: Path) -> None:
    source = made(tmp_path / "a.las", 4)
    cloud = laspy.read(source)
    cloud.header.global_encoding.waveform_data_packets_internal = True
    cloud.evlrs = laspy.vlrs.vlrlist.VLRList(
        [laspy.VLR("nobody", 5, "", b"abc"), laspy.VLR("LASF_Spec", 65535, "waveforms", b"wave" * 99)]
    )
    cloud.write(source)
    write_classified(source, tmp_path / "b.laz", *result_columns())
    new = check(source, tmp_path / "b.laz", result_columns())
    assert sorted((v.user_id, v.record_data) for v in new.evlrs) == [("LASF_Spec", b"wave" * 99), ("nobody", b"abc")]
    start = new.header.start_of_waveform_data_packet_record
    assert (tmp_path / "b.laz").read_bytes()[start + 60 :].startswith(b"wave")


def test_waveforms_of_several_channels_are_rejected(tmp_path: Path) -> None:
    cloud = laspy.read(made(tmp_path / "a.las", 9))
    cloud.scanner_channel[-1] = 1
    cloud.write(tmp_path / "a.las")
    with pytest.raises(UnavailableError, match=r"a\.las: has waveforms of several scanner channels.*Split it"):
        write_classified(tmp_path / "a.las", tmp_path / "b.laz", *result_columns())
    assert [p.name for p in tmp_path.iterdir()] == ["a.las"]


def test_full_disk_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lazrs import LazrsError

    def full(*_: object) -> None:
        raise LazrsError("IoError: Failed to call write")

    source = made(tmp_path / "a.las", 3)
    monkeypatch.setattr(laspy.LasWriter, "write_points", full)
    with pytest.raises(SpaceError, match=r"b\.laz: can't be written"):
        write_classified(source, tmp_path / "b.laz", *result_columns())
    assert [p.name for p in tmp_path.iterdir()] == ["a.las"]


def test_copc_becomes_laz(tmp_path: Path) -> None:
    """A COPC file of one node; the octree is not valid for the copy, and is removed."""
    cloud = laspy.read(made(tmp_path / "a.las", 7))
    cloud.header.vlrs.insert(0, laspy.VLR("copc", 1, "", bytes(160)))
    cloud.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("copc", 1000, "", bytes(32)), laspy.VLR("nobody", 5, "", b"a")])
    source = tmp_path / "a.copc.laz"
    cloud.write(source)
    content = bytearray(source.read_bytes())
    (points,), (evlr,) = struct.unpack_from("<I", content, 96), struct.unpack_from("<Q", content, 235)
    (table,) = struct.unpack_from("<q", content, points)
    struct.pack_into("<5d2Q2d", content, 375 + 54, 500_000, 5_400_000, 7, 2000, 10, evlr + 60, 32, 0, 100)
    struct.pack_into("<4iQ2i", content, evlr + 60, 0, 0, 0, 0, points + 8, table - points - 8, N)
    source.write_bytes(content)
    with laspy.CopcReader.open(source) as reader:
        assert len(reader.query()) == N
    write_classified(source, tmp_path / "b.laz", *result_columns())
    new = check(source, tmp_path / "b.laz", result_columns())
    assert [v.user_id for v in new.evlrs] == ["nobody"] and not new.vlrs.get_by_id("copc")


@pytest.mark.parametrize(
    "name", ["ign_77055_627760.laz", "ign_77050_627760.laz", "ign_870000_6618000_rgb_50x100.laz", "sample_c.las"]
)
def test_real_files_keep_their_data_and_crs(real_data: Path, tmp_path: Path, name: str) -> None:
    source = real_data / "las" / name
    with laspy.open(source) as reader:
        n, crs = reader.header.point_count, reader.header.parse_crs()
    write_classified(source, tmp_path / "b.laz", *result_columns(n))
    new = check(source, tmp_path / "b.laz", result_columns(n)).header.parse_crs()
    assert (crs is None and new is None) or new == crs or new.to_epsg() == crs.to_epsg() is not None


def test_failures_leave_an_earlier_copy_untouched(tmp_path: Path) -> None:
    source, out = made(tmp_path / "a.laz", 3), tmp_path / "b.laz"
    out.write_bytes(b"earlier")
    code, confidence, class_source = result_columns()
    with pytest.raises(DataError, match=r"a\.laz: has 1,000 points, but confidence is uint8 of shape \(999,\)"):
        write_classified(source, out, code, confidence[:-1], class_source)
    for damaged in (source.read_bytes()[:-9000], source.read_bytes()[:100], b""):
        (tmp_path / "cut.laz").write_bytes(damaged)
        with pytest.raises(InputError, match=r"cut\.laz: is "):
            write_classified(tmp_path / "cut.laz", out, code, confidence, class_source)
    las_file = made(tmp_path / "cut.las", 3)
    las_file.write_bytes(las_file.read_bytes()[:-2000])
    with pytest.raises(InputError, match=r"cut\.las: is truncated"):
        write_classified(las_file, out, code, confidence, class_source)
    with pytest.raises(InputError, match="file not found"):
        write_classified(tmp_path / "none.laz", out, code, confidence, class_source)
    assert out.read_bytes() == b"earlier"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.laz", "b.laz", "cut.las", "cut.laz"]

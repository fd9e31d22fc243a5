"""Requirements on all cloud formats: files as other programs write them are read losslessly."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.core.errors import InputError, ScanError, UnavailableError
from scan2sim.pipeline.core.types import Frame, PointCloud
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile, write_tile
from tests.pipeline.io.test_clouds import FRAME, made, write_ply
from tests.present import present

N = 1000


def write_las(path: Path, cloud: PointCloud) -> None:
    las.write(path, cloud)


def write_copc(path: Path, cloud: PointCloud, levels: int = 2) -> None:
    """An octree: each point in the node of its position on one of `levels`, the first points on the coarsest."""
    copclib = pytest.importorskip("copclib", reason="COPC files are written by copclib")
    from pyproj import CRS

    xyz = cloud.frame.to_crs(cloud.xyz)
    low, high = np.floor(xyz.min(axis=0)), np.ceil(xyz.max(axis=0))
    config = copclib.CopcConfigWriter(7, [0.001] * 3, low.tolist(), CRS(cloud.frame.crs).to_wkt("WKT1_GDAL"))
    header = config.las_header
    header.min, header.max = copclib.Vector3(*low), copclib.Vector3(*high)
    span = float((high - low).max())
    depth = np.minimum(np.arange(len(cloud)) * levels // len(cloud), levels - 1)
    cell = np.minimum(np.floor((xyz - low) / span * 2.0 ** depth[:, None]), 2.0 ** depth[:, None] - 1).astype(int)
    keys, node = np.unique(np.column_stack([depth, cell]), axis=0, return_inverse=True)
    writer = copclib.FileWriter(str(path), config)
    rgb, time = present(cloud.rgb), present(cloud.time)
    classification, intensity = present(cloud.classification), present(cloud.intensity)
    for k, key in enumerate(keys.tolist()):
        points = copclib.Points(header)
        for i in np.flatnonzero(node.ravel() == k):
            point = points.CreatePoint()
            point.x, point.y, point.z = xyz[i]
            point.red, point.green, point.blue = (int(v) * 257 for v in rgb[i])
            point.classification, point.intensity = int(classification[i]), int(intensity[i])
            point.gps_time = time[i]
            points.AddPoint(point)
        writer.AddNode(copclib.VoxelKey(*key), points)
    writer.Close()


def write_e57(path: Path, cloud: PointCloud) -> None:
    """Two scans in different axes; single precision, as pye57 writes."""
    pye57 = pytest.importorskip("pye57", reason="E57 files are written by pye57")
    from scipy.spatial.transform import Rotation

    file = pye57.E57(str(path), mode="w")
    for some, angle in ((slice(0, 400), 0.3), (slice(400, None), -1.2)):
        part, turn = cloud.take(some), Rotation.from_rotvec([0.1, angle, 0.2])
        at = np.array(cloud.frame.origin) + [3.0, 2.0, 1.0]
        own = turn.inv().apply(part.frame.to_crs(part.xyz) - at)
        x, y, z, w = turn.as_quat()
        data = {f"cartesian{axis}": own[:, i] for i, axis in enumerate("XYZ")}
        data |= {f"color{name}": present(part.rgb)[:, i] for i, name in enumerate(("Red", "Green", "Blue"))}
        data["intensity"] = present(part.intensity) / 65535.0
        limits = type("Limits", (), {"intensityMinimum": 0.0, "intensityMaximum": 1.0})()
        for axis, low, high in zip("xyz", own.min(axis=0), own.max(axis=0), strict=True):
            setattr(limits, f"{axis}Minimum", low)
            setattr(limits, f"{axis}Maximum", high)
        file.write_scan_raw(data, rotation=np.array([w, x, y, z]), translation=at, scan_header=limits)
    file.close()


def write_ptx(path: Path, cloud: PointCloud) -> None:
    """Two scans in different axes, with beams without a return."""
    from scipy.spatial.transform import Rotation

    rows: list[str] = []
    for some, angle in ((slice(0, 400), 0.3), (slice(400, None), -1.2)):
        part, turn = cloud.take(some), Rotation.from_rotvec([0.1, angle, 0.2])
        at = np.array(cloud.frame.origin) + [3.0, 2.0, 1.0]
        own = turn.inv().apply(part.frame.to_crs(part.xyz) - at)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[3, :3] = turn.as_matrix().T, at  # of row vectors
        rows += [str(len(part) // 2 + 1), "2", " ".join(map(repr, at.tolist())), "1 0 0", "0 1 0", "0 0 1"]
        rows += [" ".join(map(repr, row)) for row in matrix.tolist()]
        levels = present(part.intensity) / 65535
        for place, level, rgb in zip(own, levels, present(part.rgb), strict=True):
            rows.append(" ".join([*(f"{v:.5f}" for v in place), f"{level:.7f}", *map(str, rgb)]))
        rows += 2 * ["0 0 0 0.5 0 0 0"]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def pcd(data: str, double: bool = True) -> Callable[[Path, PointCloud], None]:
    def write(path: Path, cloud: PointCloud) -> None:
        places = [(axis, "<f8" if double else "<f4") for axis in "xyz"]
        row = np.dtype([*places, ("rgb", "<u4"), ("_", "V3"), ("label", "u1"), ("intensity", "<u2")])
        rows = np.zeros(len(cloud), row)
        for i, axis in enumerate("xyz"):
            rows[axis] = cloud.frame.to_crs(cloud.xyz)[:, i] if double else cloud.xyz[:, i]
        red, green, blue = present(cloud.rgb).astype(np.uint32).T
        rows["rgb"] = red << 16 | green << 8 | blue
        rows["label"], rows["intensity"] = cloud.classification, cloud.intensity
        write_pcd(path, rows, data)

    return write


def write_pcd(path: Path, rows: np.ndarray, data: str, count: int | None = None) -> None:
    kinds = {"f": "F", "u": "U", "i": "I", "V": "U"}
    names = present(rows.dtype.names)
    types = [rows.dtype[name] for name in names]
    n = len(rows) if count is None else count
    head = "\n".join(
        [
            "# .PCD v0.7 - Point Cloud Data file format",
            "VERSION 0.7",
            f"FIELDS {' '.join(names)}",
            f"SIZE {' '.join('1' if t.kind == 'V' else str(t.itemsize) for t in types)}",
            f"TYPE {' '.join(kinds[t.kind] for t in types)}",
            f"COUNT {' '.join(str(t.itemsize) if t.kind == 'V' else '1' for t in types)}",
            f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {data}\n",
        ]
    )
    if data == "ascii":
        cells = {name: rows[name].tolist() for name in names}
        cells |= {name: ["0 0 0"] * len(rows) for name in names if name == "_"}
        lines = [" ".join(str(cells[name][i]) for name in names) for i in range(len(rows))]
        path.write_text(head + "\n".join(lines) + "\n", encoding="utf-8")
    elif data == "binary":
        path.write_bytes(head.encode() + rows.tobytes())
    else:
        plain = b"".join(rows[name].tobytes() for name in names)
        packed = lzf(plain)
        path.write_bytes(head.encode() + struct.pack("<II", len(packed), len(plain)) + packed)


def lzf(plain: bytes) -> bytes:
    """Lehmann's LZF, greedy: back references of three bytes and more, found by a table of triples."""
    out, literal, i = bytearray(), bytearray(), 0
    seen: dict[bytes, int] = {}

    def flush() -> None:
        for at in range(0, len(literal), 32):
            some = literal[at : at + 32]
            out.append(len(some) - 1)
            out.extend(some)
        literal.clear()

    while i < len(plain):
        triple = plain[i : i + 3]
        back = i - seen.get(triple, i)
        seen[triple] = i
        if len(triple) == 3 and 0 < back <= 8192:
            length = 3
            while length < 264 and i + length < len(plain) and plain[i + length] == plain[i - back + length]:
                length += 1
            flush()
            short = length - 2
            out.append(min(short, 7) << 5 | (back - 1) >> 8)
            if short >= 7:
                out.append(short - 7)
            out.append((back - 1) & 255)
            i += length
        else:
            literal.append(plain[i])
            i += 1
    flush()
    return bytes(out)


def text(delimiter: str, heading: str | None, wide: bool = False) -> Callable[[Path, PointCloud], None]:
    def write(path: Path, cloud: PointCloud) -> None:
        rows = [heading] if heading else []
        colours = present(cloud.rgb).astype(int) * (257 if wide else 1)
        for place, rgb, intensity, classification in zip(
            cloud.frame.to_crs(cloud.xyz), colours, present(cloud.intensity), present(cloud.classification), strict=True
        ):
            rows.append(
                delimiter.join([*(f"{v:.4f}" for v in place), *map(str, rgb), str(intensity), str(classification)])
            )
        path.write_text("\n".join(rows) + "\n", encoding="utf-8")

    return write


def ept(kind: str) -> Callable[[Path, PointCloud], None]:
    """An octree of a root and two nodes, the second of which is in a hierarchy file of its own."""

    def write(path: Path, cloud: PointCloud) -> None:
        from pyproj import CRS

        places = {"type": "signed", "size": 4, "scale": 0.001}
        schema: list[dict[str, Any]] = [
            *({"name": axis, "offset": float(o), **places} for axis, o in zip("XYZ", FRAME.origin, strict=True)),
            *({"name": name, "type": "unsigned", "size": 2} for name in ("Intensity", "Red", "Green", "Blue")),
            {"name": "Classification", "type": "unsigned", "size": 1},
            {"name": "GpsTime", "type": "float", "size": 8},
        ]
        for folder in ("ept-data", "ept-hierarchy"):
            (path.parent / folder).mkdir(parents=True)
        nodes = {"0-0-0-0": slice(0, 300), "1-0-0-0": slice(300, 700), "1-1-0-1": slice(700, None)}
        for key, some in nodes.items():
            part = cloud.take(some)
            file = path.parent / "ept-data" / key
            if kind == "laszip":
                las.write(file.with_suffix(".laz"), part)
                continue
            sizes = {"signed": "i", "unsigned": "u", "float": "f"}
            rows = np.zeros(len(part), [(d["name"], f"<{sizes[d['type']]}{d['size']}") for d in schema])
            for i, axis in enumerate("XYZ"):
                rows[axis] = np.rint(part.xyz[:, i].astype(float) / 0.001)
            for i, name in enumerate(("Red", "Green", "Blue")):
                rows[name] = present(part.rgb)[:, i].astype(np.uint16) * 257
            rows["Intensity"], rows["Classification"], rows["GpsTime"] = part.intensity, part.classification, part.time
            if kind == "binary":
                file.with_suffix(".bin").write_bytes(rows.tobytes())
            else:
                zstandard = pytest.importorskip("zstandard", reason="zstd tiles are written by zstandard")
                file.with_suffix(".zst").write_bytes(zstandard.ZstdCompressor().compress(rows.tobytes()))
        first, second = {"0-0-0-0": 300, "1-0-0-0": 400, "1-1-0-1": -1}, {"1-1-0-1": len(cloud) - 700}
        (path.parent / "ept-hierarchy" / "0-0-0-0.json").write_text(json.dumps(first), encoding="utf-8")
        (path.parent / "ept-hierarchy" / "1-1-0-1.json").write_text(json.dumps(second), encoding="utf-8")
        srs = {"authority": "EPSG", "horizontal": "32632", "wkt": CRS(FRAME.crs).to_wkt()}
        info = {"version": "1.1.0", "dataType": kind, "hierarchyType": "json", "points": len(cloud), "span": 128}
        path.write_text(json.dumps(info | {"schema": schema, "srs": srs}), encoding="utf-8")

    return write


@dataclass(frozen=True)
class Format:
    """A file, its writer, and what the format stores: precision in metres, attributes, CRS, order of points."""

    file: str
    write: Callable[[Path, PointCloud], None]
    precision: float = 6e-4
    keeps: tuple[str, ...] = ("rgb", "classification", "time", "intensity")
    crs: bool = False
    ordered: bool = True


MOST = ("rgb", "classification", "intensity")
FORMATS = {
    "las": Format("c.las", write_las, crs=True),
    "laz": Format("c.laz", write_las, crs=True),
    "copc": Format("c.copc.laz", write_copc, crs=True, ordered=False),
    "ply": Format(
        "c.ply", lambda p, c: write_ply(p, c, "binary_little_endian", "class"), 1e-5, ("rgb", "classification")
    ),
    "e57": Format("c.e57", write_e57, 2e-5, ("rgb", "intensity")),
    "ptx": Format("c.ptx", write_ptx, 1e-4, ("rgb", "intensity")),
    "pcd ascii": Format("c.pcd", pcd("ascii"), 1e-5, MOST),
    "pcd binary": Format("c.pcd", pcd("binary"), 1e-5, MOST),
    "pcd binary_compressed": Format("c.PCD", pcd("binary_compressed"), 1e-5, MOST),
    "xyz": Format("c.xyz", text(" ", None), 1e-4, MOST),
    "txt": Format("c.txt", text("\t", "//X\tY\tZ\tR\tG\tB\tIntensity\tClassification"), 1e-4, MOST),
    "csv": Format("c.csv", text(",", "x,y,z,red,green,blue,intensity,class"), 1e-4, MOST),
    "csv of 16 bits": Format("c.csv", text(";", '"X";"Y";"Z";"r";"g";"b";"i";"label"', wide=True), 1e-4, MOST),
    "ept laszip": Format("town/ept.json", ept("laszip"), crs=True),
    "ept binary": Format("town/ept.json", ept("binary"), crs=True),
    "ept zstandard": Format("town/ept.json", ept("zstandard"), crs=True),
}  # fmt: skip


@pytest.fixture(params=FORMATS)
def written(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Format, Path, PointCloud]:
    form, cloud = FORMATS[request.param], made(N)
    form.write(tmp_path / form.file, cloud)
    return form, tmp_path / form.file, cloud


def same(form: Format, read: PointCloud, cloud: PointCloud, precision: float) -> None:
    """Compare clouds: points in the order of writing, except in an octree, where times identify them."""
    assert len(read) == len(cloud)
    if not form.ordered:
        read, cloud = read.take(np.argsort(present(read.time))), cloud.take(np.argsort(present(cloud.time)))
    error = read.frame.to_crs(read.xyz) - cloud.frame.to_crs(cloud.xyz)
    assert np.abs(error).max() < precision
    for name in ("rgb", "classification", "time", "intensity"):
        values = getattr(read, name)
        if name in form.keeps:
            assert np.array_equal(values, getattr(cloud, name)), name
        else:
            assert values is None or not values.any(), f"{name} was not in the file"


def test_cloud_round_trip(written: tuple[Format, Path, PointCloud]) -> None:
    form, path, cloud = written
    header = clouds.read_header(path)
    assert header.count == N and (header.crs is not None) == form.crs
    assert not form.crs or "UTM zone 32N" in present(header.crs)
    places = cloud.frame.to_crs(cloud.xyz)
    assert np.abs(header.low - places.min(axis=0)).max() < 2e-3
    assert np.abs(header.high - places.max(axis=0)).max() < 2e-3
    same(form, clouds.read(path, FRAME), cloud, form.precision)


def test_cloud_is_read_in_chunks(written: tuple[Format, Path, PointCloud]) -> None:
    """As when a survey is cut: each chunk in a nearby frame, with the same scaling of colours and intensities."""
    form, path, cloud = written
    parts = list(clouds.chunks(path, Frame(FRAME.crs), 128))
    assert len(parts) > 5 or form.file.endswith(".ply")
    moved = [replace(p, frame=FRAME, xyz=FRAME.to_local(p.frame.to_crs(p.xyz)).astype(np.float32)) for p in parts]
    same(form, PointCloud.join(moved), cloud, form.precision)
    assert all(np.abs(part.xyz).max() < 200 for part in parts)


def test_cloud_is_inspected_and_imported(written: tuple[Format, Path, PointCloud]) -> None:
    form, path, cloud = written
    shown = CliRunner().invoke(app, ["inspect", str(path)])
    assert shown.exit_code == 0 and "1,000" in shown.output
    out = path.parent / "tile"
    crs = [] if form.crs else ["--crs", FRAME.crs]
    done = CliRunner().invoke(app, ["import", "clouds", str(path), "--out", str(out), *crs])
    assert done.exit_code == 0, done.output
    tile = read_tile(out)
    assert tile.frame.crs == FRAME.crs and tile.clouds[0].suffix in (".las", ".laz", ".ply")
    same(form, clouds.read(tile.clouds[0], tile.frame), cloud, form.precision + 6e-4)


def test_tile_refers_to_a_cloud(written: tuple[Format, Path, PointCloud]) -> None:
    form, path, cloud = written
    write_tile(path.parent, name="t", crs=FRAME.crs, clouds=[path.name], cameras={})
    if path.name == "ept.json":
        with pytest.raises(InputError, match="import clouds"):
            read_tile(path.parent)
    else:
        tile = read_tile(path.parent)
        same(form, clouds.read(tile.clouds[0], tile.frame), cloud, form.precision)


def test_truncated_file_is_rejected(written: tuple[Format, Path, PointCloud]) -> None:
    """Truncated anywhere: an error with a remedy, or all points."""
    _, start, _ = written
    path = sorted((start.parent / "ept-data").iterdir())[1] if start.name == "ept.json" else start
    whole = path.read_bytes()
    for share in (0.02, 0.1, 0.5, 0.9, 0.999):
        path.write_bytes(whole[: int(len(whole) * share)])
        try:
            read = clouds.read(start, FRAME)
        except ScanError as error:
            assert error.remedy
        else:  # text has no length; the hierarchy of COPC follows all points
            assert len(read) == N or path.suffix in (".xyz", ".txt", ".csv")


def test_missing_reader_is_reported_with_its_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("scan2sim.pipeline.core.optional_deps.importlib.util.find_spec", lambda name: None)
    (tmp_path / "c.e57").write_bytes(b"ASTM-E57")
    with pytest.raises(UnavailableError, match=r"c\.e57: needs pye57.*pip install 'scan2sim\[e57\]'"):
        clouds.read_header(tmp_path / "c.e57")


# --- single formats


@pytest.mark.parametrize("data", ["binary", "binary_compressed", "ascii"])
@pytest.mark.parametrize("count", [10**15, 2000, -1, 0])
def test_pcd_with_a_wrong_header_is_rejected(tmp_path: Path, data: str, count: int) -> None:
    rows = np.ones(1000, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    write_pcd(tmp_path / "c.pcd", rows, data, count)
    with pytest.raises(InputError, match=r"c\.pcd: is "):
        clouds.read(tmp_path / "c.pcd", Frame())


def crc32c(data: bytes) -> int:
    """Castagnoli checksum of E57 pages."""
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    crc = 0xFFFFFFFF
    for byte in data:
        crc = table[(crc ^ byte) & 255] ^ crc >> 8
    return crc ^ 0xFFFFFFFF


def e57_changed(data: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """An E57 file with other content (of the same length) and valid checksums, one after every 1,020 bytes."""
    plain = change(b"".join(data[at : at + 1020] for at in range(0, len(data), 1024)))
    pages = [plain[at : at + 1020] for at in range(0, len(plain), 1020)]
    return b"".join(page + struct.pack(">I", crc32c(page)) for page in pages)


@pytest.mark.parametrize("count", [b"401", b"999"])
def test_e57_with_a_wrong_count_is_rejected(tmp_path: Path, count: bytes) -> None:
    path = tmp_path / "c.e57"
    write_e57(path, made(N))
    lie = b'recordCount="%s"' % count
    path.write_bytes(e57_changed(path.read_bytes(), lambda plain: plain.replace(b'recordCount="400"', lie)))
    with pytest.raises(InputError, match=f"400 of {count.decode()} points of a scan can be read"):
        clouds.read(tmp_path / "c.e57", FRAME)


def test_beams_without_return_are_not_counted(tmp_path: Path) -> None:
    rows = np.ones(1000, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    rows["y"][:900] = np.nan
    write_pcd(tmp_path / "c.pcd", rows, "binary_compressed")
    assert clouds.read_header(tmp_path / "c.pcd").count == len(clouds.read(tmp_path / "c.pcd", Frame())) == 100


@pytest.mark.parametrize("compressed", [False, True])
def test_pcd_files_of_open3d_are_read(tmp_path: Path, compressed: bool) -> None:
    o3d = pytest.importorskip("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.random.default_rng(0).uniform(-9, 9, (500, 3))))
    cloud.colors = o3d.utility.Vector3dVector(np.random.default_rng(1).integers(0, 256, (500, 3)) / 255)
    assert o3d.io.write_point_cloud(str(tmp_path / "c.pcd"), cloud, compressed=compressed)
    read = clouds.read(tmp_path / "c.pcd", Frame())
    assert np.abs(read.xyz - np.asarray(cloud.points)).max() < 1e-5
    assert np.array_equal(present(read.rgb), np.rint(np.asarray(cloud.colors) * 255))


@pytest.mark.parametrize(
    ("lines", "note"),
    [
        ("1 2 3\n4 5 6", "3 columns interpreted as x y z"),
        ("# a remark\n1,2,3,0.5\n4,5,6,0.25", "4 columns interpreted as x y z intensity"),
        ("1;2;3;0.5;6\n4;5;6;0.25;2", "5 columns interpreted as x y z intensity class"),
        ("z,y,x,range\n3,2,1,9\n6,5,4,9", "z y x; not read: range"),
        ("1,0;2,0;3,0;\n4,0;5,0;6,0;", "3 columns interpreted as x y z"),
        ("\ufeffX Y Z Scalar_Intensity\n1 2 3 7\n4 5 6 8", "x y z intensity"),
    ],
)
def test_columns_are_detected_and_assumptions_reported(tmp_path: Path, lines: str, note: str) -> None:
    (tmp_path / "c.txt").write_text(lines, encoding="utf-8")
    assert note in clouds.read_header(tmp_path / "c.txt").notes[0]
    assert clouds.read(tmp_path / "c.txt", Frame()).xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    warned: list[str] = []
    import_las([tmp_path / "c.txt"], tmp_path / "tile", crs="local", warn=warned.append)
    assert note in warned[0] and all("decimal commas" in other for other in warned[1:])


@pytest.mark.parametrize(
    ("lines", "cause"),
    [
        ("", "is empty"),
        ("# no points\n", "contains no points"),
        ("1 2\n", "2 columns and no header line"),
        ("1 2 3 4 5 6 7 8 9 10\n", "10 columns and no header line"),
        ("x y z\n", "is not a cloud: its first line is 'x y z'"),
        ("1 2 3\n4 5\n", "is not a cloud with 3 columns"),
        ("1 2 3\n4 five 6\n", "is not a cloud with 3 columns"),
        ("x,y,height,z\n1,2,3,4\n", "has two columns z"),
        ("nan nan nan\n", "no points with finite coordinates"),
        ("hello\nworld\n", "is not a cloud"),
    ],
)
def test_text_that_is_not_a_cloud_is_rejected(tmp_path: Path, lines: str, cause: str) -> None:
    (tmp_path / "c.xyz").write_text(lines, encoding="utf-8")
    with pytest.raises(InputError, match=cause):
        clouds.read(tmp_path / "c.xyz", Frame())


def test_too_long_line_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scan2sim.pipeline.io.number_text.BLOCK_BYTES", 1 << 10)
    (tmp_path / "c.xyz").write_text("1 2 " + "3" * 5000, encoding="utf-8")
    with pytest.raises(InputError, match="line of more than|is not a cloud"):
        clouds.read(tmp_path / "c.xyz", Frame())


BINARY = """{"dataType": "binary", "schema": [{"name": "X", "type": "signed", "size": %s, "scale": %s},
    {"name": "Y", "type": "signed", "size": 4}, {"name": "Z", "type": "signed", "size": 4}]}"""


@pytest.mark.parametrize(
    ("file", "body", "cause"),
    [
        ("ept-hierarchy/0-0-0-0.json", '{"0-0-0-0": -1}', "refers to 0-0-0-0 a second time"),
        ("ept-hierarchy/0-0-0-0.json", '{"../../x": 5}', "is not an octree node"),
        ("ept-hierarchy/0-0-0-0.json", '{"0-0-0-0": 1000000000000}', "has .* bytes"),
        ("ept-hierarchy/0-0-0-0.json", '{"3-0-0-0": 5}', "file not found"),
        ("ept-hierarchy/0-0-0-0.json", "[" * 100_000, "is not readable JSON"),
        ("ept.json", "{}", "has the unknown dataType"),
        ("ept.json", '{"dataType": "binary", "schema": [{"name": "X"}]}', "its schema has no valid dimensions"),
        ("ept.json", BINARY % ("4", "NaN"), "its schema has no valid dimensions"),
        ("ept.json", BINARY % ("4", "1" + 400 * "0"), "its schema has no valid dimensions"),
        ("ept.json", BINARY % ("1e400", "1"), "its schema has no valid dimensions"),
    ],
)
def test_damaged_ept_is_rejected(tmp_path: Path, file: str, body: str, cause: str) -> None:
    ept("binary")(tmp_path / "ept.json", made(N))
    (tmp_path / file).write_text(body, encoding="utf-8")
    with pytest.raises(InputError, match=cause):
        clouds.read(tmp_path / "ept.json", FRAME)


def test_the_old_name_of_the_command_still_works(tmp_path: Path) -> None:
    write_las(tmp_path / "c.laz", made(10))
    assert CliRunner().invoke(app, ["import", "las", str(tmp_path / "c.laz"), "-o", str(tmp_path / "t")]).exit_code == 0


def test_real_tile_is_read_losslessly_from_copc(real_data: Path, tmp_path: Path) -> None:
    """An airborne tile as an octree of three levels, by the writer of copclib; points are complete and unchanged."""
    pytest.importorskip("copclib", reason="COPC files are written by copclib")
    laspy = pytest.importorskip("laspy")
    source = sorted((real_data / "las").glob("ign_7705*.laz"))[0]
    some = laspy.read(source).points[:20_000]
    whole = clouds.read(source, Frame("EPSG:2154")).take(slice(0, 20_000))
    assert len(some) == len(whole)
    x, y, z = np.floor([some.x.min(), some.y.min(), some.z.min()]).tolist()
    frame = Frame("EPSG:2154", (x, y, z))
    cloud = PointCloud(
        frame,
        frame.to_local(np.column_stack([some.x, some.y, some.z])).astype(np.float32),
        np.zeros((len(some), 3), np.uint8),
        classification=np.array(some.classification),
        time=np.array(some.gps_time),
        intensity=np.array(some.intensity),
    )
    write_copc(tmp_path / "c.copc.laz", cloud, levels=3)
    with laspy.CopcReader.open(tmp_path / "c.copc.laz") as reader:  # valid for the octree reader of laspy
        assert len(reader.query()) == len(cloud) and reader.header.point_count == len(cloud)
    read = clouds.read(tmp_path / "c.copc.laz", frame)
    assert np.abs(np.sort(read.xyz, axis=0) - np.sort(cloud.xyz, axis=0)).max() < 1e-3
    assert np.array_equal(np.bincount(present(read.classification)), np.bincount(present(cloud.classification)))
    assert np.array_equal(np.sort(present(read.time)), np.sort(present(cloud.time)))
    tile = read_tile(import_las([tmp_path / "c.copc.laz"], tmp_path / "tile"))
    assert tile.frame.crs == "EPSG:2154" and len(clouds.read(tile.clouds[0], tile.frame)) == len(cloud)

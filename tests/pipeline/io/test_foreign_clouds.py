"""Clouds as other programs write them: read right, with a note on what was assumed, or refused with the true reason."""

from __future__ import annotations

import re
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from pyproj import Transformer

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import UNCOLOURED, Frame, PointCloud
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.io import clouds, sweep_files
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.geodata import geokeys
from scan2sim.pipeline.io.geodata.area_of_use import misfit
from scan2sim.pipeline.io.label_sets import parse_classes
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.ingest import IngestParams, TileFrame, ingest
from tests.pipeline.io.test_cloud_formats import ept, write_pcd
from tests.pipeline.io.test_clouds import FRAME, made, write_ply
from tests.present import present

N = 3000


def flagged(path: Path, count: int = 300, overlap: int = 0, point_format: int = 7) -> np.ndarray:
    """A cloud with withheld points 100 m below the others; returns which are withheld."""
    header = laspy.LasHeader(version="1.4" if point_format > 5 else "1.2", point_format=point_format)
    header.scales, header.offsets = np.full(3, 0.001), np.array([458_800.0, 5_428_600.0, 0.0])
    data = laspy.LasData(header)
    rng = np.random.default_rng(1)
    withheld = np.zeros(N, bool)
    withheld[rng.choice(N, count, replace=False)] = True
    xyz = rng.uniform(0, 50, (N, 3)) + header.offsets
    xyz[withheld, 2] -= 100
    data.x, data.y, data.z = xyz.T
    data.withheld = withheld
    if overlap:
        data.overlap = np.arange(N) < overlap
    data.write(path)
    return withheld


def ingested(folder: Path, names: list[Path], frame: Frame) -> tuple[Any, list[str]]:
    """Cloud and warnings of step `ingest`."""
    context = TileFrame(crs=frame.crs, origin=frame.origin, unit=frame.unit)
    inputs = {f"cloud.{i}": path for i, path in enumerate(names)}
    folder.mkdir()
    done = ingest(inputs, IngestParams(context=context), folder, lambda *_: None)
    return PointCloud.load(folder / "cloud.npz"), list(done.warnings)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("point_format", [3, 7])
def test_withheld_points_are_not_used_and_counted(tmp_path: Path, suffix: str, point_format: int) -> None:
    path = tmp_path / f"c{suffix}"
    withheld = flagged(path, point_format=point_format)
    frame = Frame(origin=FRAME.origin)
    cloud = clouds.read(path, frame)
    assert len(cloud) == N - 300 and frame.to_crs(cloud.xyz)[:, 2].min() >= -0.01
    assert sum(map(len, clouds.chunks(path, frame, 100))) == N - 300
    assert clouds.flag_notes(path) == ("300 withheld points are not used",)
    whole, warnings = ingested(tmp_path / "out", [path], frame)
    assert len(whole) == N - 300 and warnings == [f"{path.name}: 300 withheld points are not used"]
    used, codes = las.used_and_classes(path)
    assert np.array_equal(used, ~withheld) and len(codes) == N


def test_a_file_of_withheld_points_only_is_refused_by_the_import(tmp_path: Path) -> None:
    flagged(tmp_path / "c.laz", count=N)
    with pytest.raises(InputError, match="all of its .* points have the withheld flag"):
        import_las([tmp_path / "c.laz"], tmp_path / "tile", crs="EPSG:32632")
    assert not (tmp_path / "tile").exists()


def test_an_import_names_flags(tmp_path: Path) -> None:
    flagged(tmp_path / "c.laz", overlap=50)
    notes: list[str] = []
    import_las([tmp_path / "c.laz"], tmp_path / "tile", crs="EPSG:32632", warn=notes.append)
    assert any("300 withheld points are not used" in note for note in notes)
    assert any("overlap flag" in note and "they are used" in note for note in notes)


def test_a_file_of_withheld_points_only_is_refused(tmp_path: Path) -> None:
    flagged(tmp_path / "c.laz", count=N)
    for use in (lambda: clouds.read(tmp_path / "c.laz", FRAME), lambda: list(clouds.chunks(tmp_path / "c.laz", FRAME))):
        with pytest.raises(InputError, match="all of its 3,000 points have the withheld flag"):
            use()


def test_times_that_are_not_numbers_are_none(tmp_path: Path) -> None:
    flagged(tmp_path / "c.las", 0)
    data = laspy.read(tmp_path / "c.las")
    data.gps_time = np.full(N, np.nan)
    data.write(tmp_path / "c.las")
    (tmp_path / "c.csv").write_text("x,y,z,time\n" + "1,2,3,nan\n4,5,6,nan\n", encoding="ascii")
    for name in ("c.las", "c.csv"):
        assert clouds.read(tmp_path / name, FRAME).time is None


def test_node_of_an_ept_with_too_many_points_is_named(tmp_path: Path) -> None:
    ept("laszip")(tmp_path / "ept.json", made(N))
    node = tmp_path / "ept-data" / "0-0-0-0.laz"
    points = laspy.read(node)
    points.points = points.points[np.arange(len(points)).repeat(2)]
    points.write(node)
    with pytest.raises(InputError, match=r"0-0-0-0\.laz: .*it has [\d,]+ points, the hierarchy says"):
        clouds.read_header(tmp_path / "ept.json")


def test_withheld_points_of_an_ept_are_not_used(tmp_path: Path) -> None:
    ept("laszip")(tmp_path / "ept.json", made(N))
    for file in (tmp_path / "ept-data").iterdir():
        node = laspy.read(file)
        node.withheld = np.arange(len(node)) % 4 == 0
        node.write(file)
    header = clouds.read_header(tmp_path / "ept.json")
    assert header.count == len(clouds.read(tmp_path / "ept.json", FRAME)) < 0.76 * N
    assert any("withheld points are not used" in note for note in header.notes)


def write_scans(path: Path, scans: list[dict[str, np.ndarray]], limits: list[dict[str, float]] | None = None) -> None:
    """An E57 of scans of 1000 points in a plane, each with the given fields."""
    pye57 = pytest.importorskip("pye57", reason="E57 files are written by pye57")
    file = pye57.E57(str(path), mode="w")
    for i, fields in enumerate(scans):
        xyz = np.random.default_rng(i).uniform(0, 10, (1000, 3))
        header = None
        if limits is not None:
            bounds = {f"{axis}{end}": 10.0 * (end == "Maximum") for axis in "xyz" for end in ("Minimum", "Maximum")}
            header = type("Limits", (), {**bounds, **limits[i]})()
        data = {f"cartesian{axis}": xyz[:, k] for k, axis in enumerate("XYZ")} | fields
        options: dict[str, Any] = {} if header is None else {"scan_header": header}
        file.write_scan_raw(data, rotation=np.array([1.0, 0, 0, 0]), translation=np.zeros(3), **options)
    file.close()


def colour_fields(value: tuple[int, int, int]) -> dict[str, np.ndarray]:
    return {f"color{n}": np.full(1000, v, np.uint8) for n, v in zip(("Red", "Green", "Blue"), value, strict=True)}


@pytest.mark.parametrize("grey_first", [True, False])
def test_an_e57_has_the_attributes_of_all_scans(tmp_path: Path, grey_first: bool) -> None:
    grey = {"intensity": np.linspace(0, 1, 1000).astype(np.float32)}
    scans = [grey, colour_fields((180, 90, 60))]
    write_scans(tmp_path / "c.e57", scans if grey_first else scans[::-1])
    header = clouds.read_header(tmp_path / "c.e57")
    assert any("1,000 of 2,000 points have no colour" in note for note in header.notes)
    import_las([tmp_path / "c.e57"], tmp_path / "tile", crs="EPSG:32632")
    tile = read_tile(tmp_path / "tile")
    for cloud in (clouds.read(tmp_path / "c.e57", Frame()), clouds.read(tile.clouds[0], tile.frame)):
        order = slice(None, None, -1 if grey_first else 1)
        rgb = present(cloud.rgb).reshape(2, 1000, 3)[order]
        intensity = present(cloud.intensity).reshape(2, 1000)[order]
        assert (rgb[0] == (180, 90, 60)).all() and (rgb[1] == UNCOLOURED).all()
        assert intensity[0].max() == 0 and intensity[1].max() == 65535


def test_intensities_are_scaled_by_scan(tmp_path: Path) -> None:
    levels = np.linspace(0, 1, 1000).astype(np.float32)
    ranges = [{"intensityMinimum": 0.0, "intensityMaximum": top} for top in (1.0, 1000.0)]
    write_scans(tmp_path / "c.e57", [{"intensity": levels}, {"intensity": levels * 1000}], ranges)
    intensity = present(clouds.read(tmp_path / "c.e57", Frame()).intensity).reshape(2, 1000)
    assert np.abs(intensity[0].astype(int) - intensity[1]).max() <= 1 and intensity.max() == 65535


def test_limits_of_an_e57_may_be_scaled_integers(tmp_path: Path) -> None:
    """FARO SCENE writes those of intensities so."""
    pye57 = pytest.importorskip("pye57", reason="E57 files are written by pye57")
    libe57, file = pye57.libe57, pye57.E57(str(tmp_path / "c.e57"), mode="w")
    levels = np.linspace(0, 500, 1000)
    values = {name: levels.copy() for name in ("cartesianX", "cartesianY", "cartesianZ", "intensity")}
    owner, buffers = file.image_file, libe57.VectorSourceDestBuffer()
    scan, limits, point = (libe57.StructureNode(owner) for _ in range(3))
    for name, column in values.items():
        point.set(name, libe57.FloatNode(owner, 0.0))
        buffers.append(libe57.SourceDestBuffer(owner, name, column, 1000, True, True))
    for end, raw in (("Minimum", 0), ("Maximum", 10_000)):
        limits.set(f"intensity{end}", libe57.ScaledIntegerNode(owner, raw, 0, 10_000, 0.1, 0.0))
    points = libe57.CompressedVectorNode(owner, point, libe57.VectorNode(owner, True))
    for name, node in (("guid", libe57.StringNode(owner, "{scan}")), ("intensityLimits", limits), ("points", points)):
        scan.set(name, node)
    file.data3d.append(scan)
    writer = points.writer(buffers)
    writer.write(1000)
    writer.close()
    file.close()
    intensity = present(clouds.read(tmp_path / "c.e57", Frame()).intensity)
    assert np.abs(intensity - 65535 / 1000 * levels).max() <= 1


def test_a_tile_has_the_attributes_of_all_clouds(tmp_path: Path) -> None:
    cloud = made(N)
    las.write(tmp_path / "a.laz", cloud)
    las.write(tmp_path / "b.laz", replace(cloud, rgb=None))
    write_ply(tmp_path / "c.ply", replace(cloud, intensity=None), "binary_little_endian", "class")
    whole, warnings = ingested(tmp_path / "out", [tmp_path / n for n in ("a.laz", "b.laz", "c.ply")], FRAME)
    rgb = whole.rgb.reshape(3, N, 3)
    assert np.array_equal(rgb[0], present(cloud.rgb)) and (rgb[1] == UNCOLOURED).all()
    assert np.array_equal(whole.intensity[:N], present(cloud.intensity)) and not whole.intensity[2 * N :].any()
    assert any("b.laz: no colours" in w for w in warnings)
    assert any("c.ply: no intensities" in w for w in warnings)
    assert any("c.ply: no times" in w for w in warnings)


def box(path: Path, edge: float) -> Path:
    """A room of 10 x 8 x 3 m as a mesh whose edges are at most `edge` metres."""
    import trimesh

    trimesh.creation.box((10, 8, 3)).subdivide_to_size(edge).export(path)
    return path


def test_a_mesh_whose_vertices_cover_its_surface_is_read_with_a_note(tmp_path: Path) -> None:
    header = clouds.read_header(box(tmp_path / "c.ply", 0.3))
    assert any("is a mesh" in note and "import map" in note for note in header.notes)


def test_a_mesh_of_large_triangles_is_no_cloud(tmp_path: Path) -> None:
    import trimesh

    fine, walls = trimesh.creation.icosphere(4), trimesh.creation.box((10, 8, 3))
    trimesh.util.concatenate([fine, walls]).export(tmp_path / "c.ply")
    with pytest.raises(InputError, match=r"is a mesh of 5,132 faces, not a point cloud.*map .*c\.ply --out TILE"):
        clouds.read_header(tmp_path / "c.ply")
    with pytest.raises(InputError, match=r"is a mesh of 12 faces, not a point cloud"):
        clouds.read_header(box(tmp_path / "c.ply", 20.0))
    with pytest.raises(InputError, match=r"is a mesh, not a point cloud.*import map .*c\.obj --out TILE"):
        clouds.read_header(box(tmp_path / "c.obj", 1.0))
    with pytest.raises(InputError, match="not found"):
        clouds.read_header(tmp_path / "gone.obj")


def test_a_ply_of_faces_only_says_so(tmp_path: Path) -> None:
    head = (
        "ply\nformat ascii 1.0\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n3 0 1 2\n3 1 2 3\n"
    )
    (tmp_path / "c.ply").write_text(head, encoding="utf-8")
    with pytest.raises(InputError, match="it has 2 faces, but no vertices"):
        clouds.read_header(tmp_path / "c.ply")


@pytest.mark.parametrize("names", ["x y z f_dc_0 f_dc_1 f_dc_2 opacity", "packed_position packed_color"])
def test_gaussian_splats_are_no_cloud(tmp_path: Path, names: str) -> None:
    columns = "".join(f"property float {name}\n" for name in names.split())
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 2000\n{columns}end_header\n"
    (tmp_path / "c.ply").write_bytes(head.encode() + bytes(4 * 2000 * len(names.split())))
    with pytest.raises(InputError, match="contains Gaussian splats"):
        clouds.read_header(tmp_path / "c.ply")


@pytest.mark.parametrize("suffix", [".las", ".laz", ".ply", ".pcd", ".e57", ".xyz", ".csv"])
@pytest.mark.parametrize(
    ("content", "cause"),
    [
        (b"", r"is empty \(0 bytes\)"),
        (b"\n<!DOCTYPE HTML><html><title>404 Not Found</title></html>", "is a web page"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12\n", "is a Git LFS pointer.*git lfs pull"),
        (b"<?xml version='1.0'?><Error><Code>AccessDenied</Code></Error>", "is an XML document"),
        (b"PK\x03\x04....", "is a ZIP archive"),
        (bytes(5000), "contains only zeros"),
    ],
)
def test_what_is_no_cloud_is_named(tmp_path: Path, suffix: str, content: bytes, cause: str) -> None:
    (tmp_path / f"c{suffix}").write_bytes(content)
    with pytest.raises(InputError, match=cause):
        clouds.read_header(tmp_path / f"c{suffix}")


def test_a_wrong_suffix_is_named(tmp_path: Path) -> None:
    las.write(tmp_path / "c.las", made(N))
    (tmp_path / "c.las").rename(tmp_path / "c.ply")
    with pytest.raises(InputError, match=r"is a LAS file by its content.*Rename it to c\.las"):
        clouds.read_header(tmp_path / "c.ply")


def test_links_that_lead_nowhere_and_missing_permissions_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, target in (("loop.laz", "loop.laz"), ("gone.laz", "/nowhere/gone.laz")):
        (tmp_path / name).symlink_to(target)
        with pytest.raises(InputError, match=f"is a link that leads nowhere .to {target}"):
            clouds.read_header(tmp_path / name)
    las.write(tmp_path / "c.las", made(N))
    monkeypatch.setattr("os.access", lambda *_: False)  # tests may run as root, who may read everything
    with pytest.raises(InputError, match="can't be read: no permission. Change its permissions"):
        clouds.read_header(tmp_path / "c.las")


PLACE = np.array([389_000.0, 5_820_000.0, 35.0])
"""A street in Berlin, EPSG:32633."""
TACOMA = np.array([1_160_000.0, 700_000.0, 300.0])
"""US survey feet in EPSG:2927, metres after scaling in EPSG:32149 (Washington South)."""


def georeferenced(path: Path, middle: np.ndarray, keys: dict[int, int] | None = None, wkt: bytes | None = None) -> Path:
    """A LAS of 2000 points around a position, with GeoTIFF keys or the content of a WKT record."""
    header = laspy.LasHeader(version="1.4" if wkt is not None else "1.2", point_format=6 if wkt is not None else 3)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(middle)
    entries = sorted((keys or {}).items())
    if entries:
        directory = struct.pack("<4H", 1, 1, 0, len(entries))
        directory += b"".join(struct.pack("<4H", key, 0, 1, value) for key, value in entries)
        header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", directory))
    if wkt is not None:
        header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", wkt))
    data = laspy.LasData(header)
    data.x, data.y, data.z = (np.random.default_rng(2).uniform(-20, 20, (2000, 3)) + middle).T
    data.write(path)
    return path


def imported(tmp_path: Path, cloud: Path, **options: Any) -> tuple[Frame, np.ndarray, list[str]]:
    """Frame of the imported tile, middle of its points in the CRS, and warnings."""
    notes: list[str] = []
    import_las([cloud], tmp_path / "tile", warn=notes.append, **options)
    tile = read_tile(tmp_path / "tile")
    points = clouds.read(tile.clouds[0], tile.frame).xyz
    return tile.frame, tile.frame.to_crs(points.mean(axis=0)), notes


def test_units_in_geotiff_keys_override_those_of_the_code(tmp_path: Path) -> None:
    cloud = georeferenced(tmp_path / "c.las", TACOMA, {1024: 1, 3072: 32149, 3076: 9003, 4099: 9003})
    frame, middle, notes = imported(tmp_path, cloud)
    assert frame.unit == pytest.approx(1200 / 3937) and not notes
    latitude, longitude, _ = present(crs_io.to_wgs84(frame))
    expected = Transformer.from_crs(2927, 4326, always_xy=True).transform(*TACOMA[:2])
    assert (longitude, latitude) == pytest.approx(expected, abs=0.01)
    assert np.abs(middle - TACOMA).max() < 3


def test_heights_in_another_unit_are_refused_with_the_reason(tmp_path: Path) -> None:
    cloud = georeferenced(tmp_path / "c.las", PLACE, {1024: 1, 3072: 32633, 4099: 9003})
    with pytest.raises(InputError, match=r"heights in units of 0\.3048\d* m, but horizontal units of 1 m"):
        imported(tmp_path, cloud)


def test_a_projection_given_by_parameters_is_read(tmp_path: Path) -> None:
    pytest.importorskip("rasterio", reason="GDAL reads projections without a code")
    doubles = (-120.5, 45.333333333333336, 47.333333333333336, 45.833333333333336, 500_000.0 * 3937 / 1200, 0.0)
    numbers = {1024: 1, 2048: 4269, 3072: 32767, 3074: 32767, 3075: 8, 3076: 9003}
    entries = [(key, 0, 1, value) for key, value in numbers.items()]
    entries += [(key, 34736, 1, i) for key, i in ((3084, 0), (3085, 1), (3078, 3), (3079, 2), (3086, 4), (3087, 5))]
    directory = struct.pack("<4H", 1, 1, 0, len(entries)) + b"".join(struct.pack("<4H", *e) for e in sorted(entries))
    crs = present(geokeys.crs_of_records(directory, struct.pack("<6d", *doubles)))
    place = Transformer.from_crs(crs, 4326, always_xy=True).transform(*TACOMA[:2])
    assert place == pytest.approx(Transformer.from_crs(2927, 4326, always_xy=True).transform(*TACOMA[:2]), abs=1e-4)


@pytest.mark.parametrize("wkt", [b"''\0", b'PROJCS["unfinished', b"see the readme", b"\xff\xfe\0"])
def test_a_crs_that_cannot_be_read_counts_as_none(tmp_path: Path, wkt: bytes) -> None:
    cloud = georeferenced(tmp_path / "c.las", PLACE, wkt=wkt)
    with pytest.raises(InputError, match=r"(has no CRS|its CRS can't be read).*--crs EPSG:32633"):
        imported(tmp_path, cloud)
    frame, middle, _ = imported(tmp_path, cloud, crs="EPSG:32633")
    assert frame.crs == "EPSG:32633" and np.abs(middle - PLACE).max() < 2


def test_given_crs_and_units_win_over_the_header_with_a_warning(tmp_path: Path) -> None:
    degrees = georeferenced(tmp_path / "c.las", PLACE, {1024: 2, 2048: 4326})
    with pytest.raises(InputError, match=r"EPSG:4326 has degrees, but its coordinates.*are lengths.*--crs"):
        imported(tmp_path, degrees)
    frame, _, notes = imported(tmp_path, degrees, crs="EPSG:32633")
    assert frame.crs == "EPSG:32633" and any("its header says EPSG:4326; EPSG:32633 is used" in n for n in notes)
    feet = georeferenced(tmp_path / "f.las", TACOMA, {1024: 1, 3072: 32149})
    with pytest.raises(InputError, match=r"outside of the area of use.*another unit.*--units us-ft"):
        imported(tmp_path, feet)
    frame, middle, notes = imported(tmp_path / "b", feet, units="us-ft")
    assert frame.unit == pytest.approx(1200 / 3937) and any("read in us-ft, as given" in n for n in notes)
    assert np.abs(middle - TACOMA).max() < 3


def test_northing_before_easting_is_refused_or_converted(tmp_path: Path) -> None:
    cloud = georeferenced(tmp_path / "c.las", PLACE[[1, 0, 2]], {1024: 1, 3072: 32633})
    with pytest.raises(InputError, match="northing comes before easting.*--axes neh"):
        imported(tmp_path, cloud)
    _, middle, notes = imported(tmp_path, cloud, axes="neh")
    assert np.abs(middle - PLACE).max() < 2 and not notes
    _, _, notes = imported(tmp_path / "b", cloud, crs="local")
    assert any("northing before easting, which mirrors the world" in note for note in notes)
    with pytest.raises(SettingError, match="no order of axes"):
        imported(tmp_path / "c", cloud, axes="xyz")


@pytest.mark.parametrize(
    ("crs", "middle", "reading"),
    [
        ("EPSG:32633", PLACE, None),
        ("EPSG:25832", [800_000, 5_820_000, 0], None),  # Berlin in the zone of western Germany, as is usual
        ("EPSG:2154", [870_000, 6_618_000, 0], None),
        ("EPSG:2056", [2_600_000, 1_200_000, 0], None),
        ("EPSG:2927", TACOMA, None),
        ("EPSG:3857", [1_490_000, 6_890_000, 0], None),
        ("EPSG:28355", [320_000, 5_812_000, 0], None),
        ("EPSG:32633", [33_389_000, 5_820_000, 0], "begin with the zone number 33"),
        ("EPSG:32633", [12.0, -40.0, 0], "seem to be local.*--crs local"),
        ("EPSG:32632", [1_900_000, 5_820_000, 0], "Check the CRS"),
        ("EPSG:2927", TACOMA * 0.3048, "--units m"),
    ],
)
def test_coordinates_are_held_against_the_area_of_use(crs: str, middle: Any, reading: str | None) -> None:
    low, high = np.asarray(middle, float) - 20, np.asarray(middle, float) + 20
    found = misfit(crs, low, high)
    assert (found is None) if reading is None else re.search(reading, str(found))


def table(order: str, seed: int = 4) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Rows with columns x y z r g b i (intensity of PTS) j (intensity of 0..255) n (number) N (normal) c (class)."""
    rng = np.random.default_rng(seed)
    n = 500
    xyz = PLACE + rng.uniform(-20, 20, (n, 3))
    grey = rng.integers(20, 230, n)
    rgb = np.clip(grey[:, None] + rng.integers(-15, 15, (n, 3)), 0, 255)
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    columns = dict(zip("xyz", xyz.T, strict=True)) | dict(zip("rgb", rgb.T, strict=True))
    columns |= {"i": rng.integers(-2048, 2047, n), "j": rng.integers(0, 256, n), "n": np.arange(1, n + 1)}
    columns["c"] = rng.choice([2, 6, 11], n)
    texts = {key: [f"{v:.3f}" if key in "xyz" else str(v) for v in values] for key, values in columns.items()}
    texts["N"] = [" ".join(f"{v:.5f}" for v in row) for row in normal]
    return [" ".join(cells) for cells in zip(*(texts[key] for key in order), strict=True)], xyz, rgb


@pytest.mark.parametrize(
    "order",
    ["xyzrgb", "xyzrgbi", "xyzirgb", "xyzrgbj", "xyzjrgb", "nxyz", "nxyzrgb", "nxyzirgb", "xyzN", "xyzrgbN", "xyzNrgb",
     "xyzirgbN", "xyzrgbjc", "xyzjrgbc"],
)  # fmt: skip
@pytest.mark.parametrize("count_line", [True, False])
def test_columns_without_names_are_found_by_their_values(tmp_path: Path, order: str, count_line: bool) -> None:
    lines, xyz, rgb = table(order)
    (tmp_path / "c.pts").write_text("\n".join([*([str(len(lines))] if count_line else []), *lines]), encoding="utf-8")
    cloud = clouds.read(tmp_path / "c.pts", Frame(origin=tuple(PLACE)))
    assert np.abs(cloud.xyz + PLACE - xyz).max() < 2e-3
    assert (cloud.rgb is None) == ("r" not in order)
    if cloud.rgb is not None:
        assert np.array_equal(cloud.rgb, rgb)


def test_values_that_fit_no_order_are_refused(tmp_path: Path) -> None:
    (tmp_path / "c.txt").write_text("1 2 3 -0.5 70000 9\n4 5 6 1 2 3\n", encoding="utf-8")
    with pytest.raises(InputError, match="6 columns and no header line, and their values fit no known order.*Name the"):
        clouds.read_header(tmp_path / "c.txt")


HEADINGS = ["x;y;z;r;g;b", "Rechtswert;Hochwert;Höhe;Rot;Grün;Blau", "E;N;H;R;G;B", "X [m];Y [m];Z [m];Red;Green;Blue",
            "Est;Nord;Hauteur;Rouge;Vert;Bleu", "ESTE;NORTE;ALTURA;ROJO;VERDE;AZUL"]  # fmt: skip


@pytest.mark.parametrize("heading", HEADINGS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("commas", [True, False])
def test_text_of_other_languages_and_encodings(tmp_path: Path, heading: str, encoding: str, commas: bool) -> None:
    lines, xyz, rgb = table("xyzrgb")
    rows = [line.replace(" ", ";").replace(".", "," if commas else ".") for line in lines]
    (tmp_path / "c.csv").write_bytes("\r\n".join([heading, *rows, ""]).encode(encoding))
    cloud = clouds.read(tmp_path / "c.csv", Frame(origin=tuple(PLACE)))
    assert np.abs(cloud.xyz + PLACE - xyz).max() < 2e-3 and np.array_equal(present(cloud.rgb), rgb)


def test_decimal_commas_between_blanks(tmp_path: Path) -> None:
    (tmp_path / "c.xyz").write_text("389000,5 5820000,25 35,125\n389001,5 5820000,25 35,125\n", encoding="utf-8")
    assert clouds.read_header(tmp_path / "c.xyz").low.tolist() == [389000.5, 5820000.25, 35.125]
    (tmp_path / "c.xyz").write_text("1, 2, 3\n4, 5, 6\n", encoding="utf-8")
    assert clouds.read_header(tmp_path / "c.xyz").high.tolist() == [4, 5, 6]


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_pcd_with_padding_without_bytes_capitals_and_zeros(tmp_path: Path, data: str) -> None:
    rows = np.ones(1024, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
    rows["y"] = np.arange(1024)
    for name in ("x", "y", "z"):
        rows[name][::4] = 0
    write_pcd(tmp_path / "c.pcd", rows, data)
    text = (tmp_path / "c.pcd").read_bytes()
    for old, new in (
        (b"FIELDS x y z intensity", b"FIELDS X Y _ Z intensity _"), (b"SIZE 4 4 4 4", b"SIZE 4 4 1 4 4 2"),
        (b"TYPE F F F F", b"TYPE F F U F F U"), (b"COUNT 1 1 1 1", b"COUNT 1 1 0 1 1 0"),
        (b"WIDTH 1024\nHEIGHT 1", b"WIDTH 256\nHEIGHT 4"),
    ):  # fmt: skip
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "c.pcd").write_bytes(text)
    cloud = clouds.read(tmp_path / "c.pcd", Frame())
    assert len(cloud) == 768 and set(cloud.xyz[:, 0]) == {1} and cloud.xyz[-1, 1] == 1023


def test_pcd_with_data_that_lzf_could_not_compress(tmp_path: Path) -> None:
    xyz = np.random.default_rng(0).uniform(-9, 9, (300, 3)).astype("<f4")
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 300\nHEIGHT 1\nPOINTS 300\n"
    body = xyz.T.tobytes()
    whole = head.encode() + b"DATA binary_compressed\n" + struct.pack("<II", len(body), len(body)) + body
    (tmp_path / "c.pcd").write_bytes(whole)
    assert np.array_equal(clouds.read(tmp_path / "c.pcd", Frame()).xyz, xyz)


@pytest.mark.parametrize(
    ("columns", "top", "layout"),
    [
        (("xyz", "i"), 1, None),
        (("xyz", "i"), 255, None),
        (("xyz", "i", "ring"), 255, "nuScenes"),
        (("xyz", "i", "time", "ring"), 255, "x y z intensity time ring"),
    ],
)
def test_bin_sweeps_are_read_by_their_values(tmp_path: Path, columns: tuple[str, ...], top: int, layout: Any) -> None:
    rng, n = np.random.default_rng(0), 1200  # points whose bytes are divisible by every layout
    parts = {"xyz": rng.uniform(-40, 40, (n, 3)), "i": rng.integers(0, top + 1, n), "ring": np.arange(n) % 32}
    parts["i"][0] = top
    parts["time"] = np.linspace(0, 0.1, n)
    rows = np.column_stack([parts[name] for name in columns]).astype(np.float32)
    rows.tofile(tmp_path / "c.bin")
    sweep = sweep_files.read_sweep(tmp_path / "c.bin")
    assert np.array_equal(sweep.xyz, rows[:, :3])
    assert np.abs(sweep.intensity - np.rint(rows[:, 3] / top * 65535)).max() <= 1
    note = sweep_files.reading(tmp_path / "c.bin")
    assert (note is None) if layout is None else layout in present(note)


def test_a_bin_of_other_values_is_refused(tmp_path: Path) -> None:
    np.random.default_rng(0).normal(size=1200).astype(np.float32).tofile(tmp_path / "c.bin")
    with pytest.raises(InputError, match="is not a sweep: its values are not those of"):
        sweep_files.read_sweep(tmp_path / "c.bin")


def labelled(path: Path, fields: str, label: str, labels: np.ndarray) -> Path:
    """A PLY with coordinates, further float fields, and labels."""
    names = ["x", "y", "z", *fields.split(), label]
    rows = np.random.default_rng(0).uniform(0, 50, (len(labels), len(names))).astype("<f4")
    rows[:, -1] = labels
    head = "".join(f"property float {name}\n" for name in names)
    text = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{head}end_header\n"
    path.write_bytes(text.encode() + rows.tobytes())
    return path


@pytest.mark.parametrize(
    ("fields", "label", "name", "expected"),
    [
        ("scalar_Intensity scalar_GPSTime scalar_ScanAngleRank", "scalar_Label", "Toronto-3D",
         {0: "unclassified", 1: "road", 4: "building", 6: "pole", 7: "vehicle"}),
        ("x_origin y_origin z_origin reflectance", "class", "Paris-Lille-3D",
         {0: "unclassified", 1: "terrain", 2: "building", 8: "vehicle", 9: "high_vegetation"}),
        ("red green blue instance visible confidence", "semantic", "KITTI-360",
         {0: "unclassified", 5: "unclassified", 7: "road", 8: "sidewalk", 11: "building", 17: "pole", 20: "road_sign",
          21: "high_vegetation", 22: "terrain", 26: "vehicle", 35: "wall_or_fence", -1: "unclassified"}),
    ],
)  # fmt: skip
def test_labels_of_data_sets_are_mapped(
    tmp_path: Path, fields: str, label: str, name: str, expected: dict[int, str]
) -> None:
    labels = np.resize(list(expected), N)
    path = labelled(tmp_path / "c.ply", fields, label, labels)
    assert any(name in note for note in clouds.read_header(path).notes)
    whole, _ = ingested(tmp_path / "out", [path], Frame())
    assert whole.classification.tolist() == [CODE[expected[label]] for label in labels.tolist()]


def test_labels_that_are_no_las_codes_are_unclassified_and_counted(tmp_path: Path) -> None:
    path = labelled(tmp_path / "c.ply", "a", "label", np.resize([2, 6, -1, 300], N))
    notes = clouds.read_header(path).notes
    assert any("field `label` is read as LAS classes" in note for note in notes)
    assert any("1,500 points have classes that are no LAS codes" in note for note in notes)
    assert present(clouds.read(path, Frame()).classification)[:4].tolist() == [2, 6, 1, 1]


def test_labels_of_a_pcd_are_noted(tmp_path: Path) -> None:
    """PCL's labels are often those of segments."""
    head = "FIELDS x y z label\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n"
    (tmp_path / "c.pcd").write_text(head + "0 0 0 1\n1 1 1 2\n", encoding="ascii")
    assert any("field `label` is read as LAS classes" in note for note in clouds.read_header(tmp_path / "c.pcd").notes)


def test_points_of_a_ply_may_end_with_their_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    """A mesh without faces, or whose faces are in the next block: no warning of numpy appears."""
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    points = "0 0 0\n1 1 1\n"
    (tmp_path / "c.ply").write_text(f"{head}element note 1\nproperty int n\nend_header\n{points}7\n", encoding="ascii")
    monkeypatch.setattr("scan2sim.pipeline.io.number_text.BLOCK_BYTES", len(points))
    assert clouds.read_header(tmp_path / "c.ply").count == 2
    assert not recwarn.list


def test_labels_of_a_named_data_set_are_mapped(tmp_path: Path) -> None:
    """SemanticKITTI's 10 is a car, not LAS's rail; 11 a bicycle, not a road; codes that it doesn't have, no class."""
    labels = np.resize([40, 48, 50, 70, 72, 80, 81, 10, 11, 18, 30, 99, 252], N)
    path = labelled(tmp_path / "c.ply", "a", "label", labels)
    _, warnings = ingested(tmp_path / "plain", [path], Frame())
    assert any(
        "They seem to be labels of SemanticKITTI: import with --classes SemanticKITTI" in one for one in warnings
    )
    table = clouds.code_table(path, parse_classes("semantickitti"))
    expected = [
        "road", "sidewalk", "building", "high_vegetation", "terrain", "pole", "road_sign", "vehicle", "vehicle",
        "vehicle", "person", "unclassified", "vehicle", "unclassified",
    ]  # fmt: skip
    assert table[[*labels[:13], 2]].tolist() == [CODE[name] for name in expected]
    assert parse_classes("65=noise") == {65: CODE["low_noise"]} and parse_classes("") == {}
    with pytest.raises(SettingError, match="'KITTI' is no known data set.*KITTI-360, SemanticKITTI"):
        parse_classes("KITTI")
    dales = clouds.code_table(path, parse_classes("DALES"))[[1, 2, 8, 11]]
    assert dales.tolist() == [CODE[name] for name in ("terrain", "high_vegetation", "building", "unclassified")]


def test_codes_of_a_survey_are_not_taken_for_a_data_set(tmp_path: Path) -> None:
    path = labelled(tmp_path / "c.ply", "a", "label", np.resize([2, 5, 6, 70, 71], N))
    _, warnings = ingested(tmp_path / "plain", [path], Frame())
    assert any("survey's own" in one for one in warnings) and not any("SemanticKITTI" in one for one in warnings)

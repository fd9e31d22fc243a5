"""Clouds as other programs write them: read right, with a note on what was assumed, or refused with the true reason."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import UNCOLOURED, Frame, PointCloud
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.ingest import IngestParams, TileFrame, ingest
from tests.pipeline.io.test_cloud_formats import ept
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
    with pytest.raises(InputError, match=r"is a mesh of 5,132 faces, not a point cloud.*import map c\.ply"):
        clouds.read_header(tmp_path / "c.ply")
    with pytest.raises(InputError, match=r"is a mesh, not a point cloud.*import map c\.obj"):
        clouds.read_header(box(tmp_path / "c.obj", 1.0))


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

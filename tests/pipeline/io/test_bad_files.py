"""Files with wrong content: their handling and errors (docs/reference/formats.md, "What bad input gets")."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.flows.commands.inspect import inspect_path
from scan2sim.pipeline.core.cache import digest
from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Camera, Frame, PointCloud, View
from scan2sim.pipeline.io import clouds, las_header
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.ingest import IngestParams, ingest
from scan2sim.pipeline.steps.views import _problem
from tests.fakes.steps import step_params

FRAME = Frame("local", (700_000.0, 5_400_000.0, 100.0))
SIZES = {"bounds": "<6d", "count": "<Q", "vlrs": "<I", "extended": "<QI", "scale": "<d"}
PLACES = {"bounds": 179, "count": 247, "vlrs": 100, "extended": 235, "scale": 131}


def made(path: Path, n: int = 3000, reach: float = 20.0) -> Path:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(0, reach, (n, 3)).astype(np.float32)
    las.write(path, PointCloud(FRAME, xyz, classification=np.full(n, 2, np.uint8)))
    return path


def patch(path: Path, field: str, *values: float) -> Path:
    body = bytearray(path.read_bytes())
    struct.pack_into(SIZES[field], body, PLACES[field], *values)
    path.write_bytes(body)
    return path


@pytest.mark.parametrize("n", [3000, 120_000])  # all points are checked, or a sample
@pytest.mark.parametrize("bounds", [[0.0] * 6, [1e7, 0.0] * 3, [float("nan")] * 6])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_origin_is_computed_from_points_not_from_the_header(
    tmp_path: Path, suffix: str, bounds: list[float], n: int
) -> None:
    path = patch(made(tmp_path / f"c{suffix}", n), "bounds", *bounds)
    (tmp_path / "tile.toml").write_text(f'name = "t"\ncrs = "local"\nclouds = ["{path.name}"]\n', encoding="utf-8")
    tile = read_tile(tmp_path)
    assert np.abs(np.subtract(tile.frame.origin, (700_010, 5_400_010, 100))).max() <= 1
    params = step_params(IngestParams, crs=tile.frame.crs, origin=tile.frame.origin, unit=tile.frame.unit)
    done = ingest({"cloud.0000": path}, params, tmp_path, silent)
    assert done.metrics["points"] == n
    assert "its header's bounding box is wrong" in done.warnings[0]


def test_valid_header_is_used(tmp_path: Path) -> None:
    assert clouds.read_header(made(tmp_path / "c.laz", 120_000)).notes == ()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(
    ("field", "values"),
    [("count", [2**63]), ("count", [10**12]), ("vlrs", [2**32 - 1]), ("extended", [400, 2**31]), ("scale", [0.0])],
)
def test_las_header_must_fit_into_its_file(tmp_path: Path, suffix: str, field: str, values: list[float]) -> None:
    path = patch(made(tmp_path / f"c{suffix}"), field, *values)
    with pytest.raises(InputError, match=r"(truncated|not a readable LAS file).*again"):
        clouds.read_header(path)


def test_points_beyond_the_las_header_count_are_reported(tmp_path: Path) -> None:
    path = patch(made(tmp_path / "c.las"), "count", 12)
    assert "declares 12 points, but the file has 3,000" in clouds.read_header(path).notes[0]


def test_old_laszip_without_chunks_is_named(tmp_path: Path) -> None:
    path = made(tmp_path / "c.laz")
    data = bytearray(path.read_bytes())
    record = data.index(b"laszip encoded") - 2 + las_header.VLR_HEADER_BYTES
    data[record : record + 2], data[record + 12 : record + 16] = b"\1\0", bytes(4)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"LASzip 1, before 2011.*current LASzip"):
        clouds.read_header(path)


def test_points_over_a_thousand_kilometres_are_rejected(tmp_path: Path) -> None:
    path = made(tmp_path / "c.las", reach=1e6)
    with pytest.raises(DataError, match=r"999\.\d km apart.*limit of a tile is 5 km.*scan2sim tile"):
        ingest({"cloud.0000": path}, step_params(IngestParams, origin=FRAME.origin), tmp_path, silent)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("count", [10**15, 301, 299, -1])
def test_ply_with_a_wrong_number_of_vertices_is_rejected(tmp_path: Path, form: str, count: int) -> None:
    with pytest.raises(InputError, match=r"(its header declares .* vertices, there are 300|negative).*again"):
        clouds.read_header(ply(tmp_path, form, count))


@pytest.mark.parametrize("cut", np.linspace(0, 0.995, 40).tolist())
def test_truncated_ascii_ply_is_rejected(tmp_path: Path, cut: float) -> None:
    path = ply(tmp_path, "ascii", 300)
    path.write_bytes(path.read_bytes()[: int(cut * path.stat().st_size)])
    with pytest.raises(InputError, match=r"c\.ply: is (not a readable PLY cloud|truncated|empty)"):
        clouds.read(path, Frame())


def ply(folder: Path, form: str, count: int) -> Path:
    head = f"ply\nformat {form} 1.0\nelement vertex {count}\n" + "".join(f"property float {k}\n" for k in "xyz")
    rows = np.arange(900, dtype=np.float32).reshape(300, 3)
    body = "".join(f"{x} {y} {z}\n" for x, y, z in rows).encode() if form == "ascii" else rows.tobytes()
    (folder / "c.ply").write_bytes(f"{head}end_header\n".encode() + body)
    return folder / "c.ply"


def pipe(folder: Path, name: str) -> Path:
    os.mkfifo(folder / name)
    return folder / name


def test_pipes_and_folders_are_rejected(tmp_path: Path) -> None:
    made(tmp_path / "c.las")
    with pytest.raises(InputError, match="pipe"):
        clouds.read_header(pipe(tmp_path, "p.laz"))
    (tmp_path / "tile.toml").write_text('name = "t"\ncrs = "local"\nclouds = ["p.laz"]\n', encoding="utf-8")
    with pytest.raises(InputError, match=r"pipe or device.*named under `clouds`"):
        read_tile(tmp_path)
    (tmp_path / "tile.toml").unlink()
    with pytest.raises(InputError, match="pipe"):
        read_tile(pipe(tmp_path, "tile.toml"))
    with pytest.raises(InputError, match="folder"):
        image.size_of(tmp_path)
    with pytest.raises(InputError, match="pipe"):
        image.read_rgb(pipe(tmp_path, "p.jpg"))


def test_photos_that_are_pipes_or_folders_are_skipped_and_digests_do_not_block(tmp_path: Path) -> None:
    (tmp_path / "folder.jpg").mkdir()
    for path, cause in ((pipe(tmp_path, "pipe.jpg"), "pipe or device"), (tmp_path / "folder.jpg", "is a folder")):
        assert digest(path) == ("missing" if path.name == "pipe.jpg" else digest(tmp_path / "folder.jpg"))
        assert cause in (_problem(View("1", Camera("pinhole", 64, 48, 50, 50, 31, 23), np.eye(4), path)) or "")


@pytest.mark.parametrize(
    "text",
    [
        "x = " + "[" * 1000 + "]" * 1000,
        "x = " + "9" * 6000,
        'name = "t"\nclouds = ["c.las"]\ncrs = "' + "x" * 70_000_000,
    ],
    ids=["nested", "digits", "large"],
)
def test_toml_exceeding_the_limits_of_the_parser_is_rejected(tmp_path: Path, text: str) -> None:
    (tmp_path / "tile.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"tile\.toml: is not valid TOML|has .* bytes"):
        read_tile(tmp_path)


def test_byte_order_mark_of_a_tile_is_ignored(tmp_path: Path) -> None:
    made(tmp_path / "c.las")
    (tmp_path / "tile.toml").write_text('\ufeffname = "t"\ncrs = "local"\nclouds = ["c.las"]\n', encoding="utf-8")
    assert read_tile(tmp_path).name == "t"


def test_large_panorama_is_read_and_decompression_bomb_rejected(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "p.jpg"), np.zeros((9600, 19_200), np.uint8))
    assert image.size_of(tmp_path / "p.jpg") == (19_200, 9600)
    image.check_decodes(tmp_path / "p.jpg")

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head, body = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0), zlib.compress(bytes(1000))
    parts = chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + parts)
    with pytest.raises(InputError, match="60,000 x 60,000 pixels, more than 536,870,912"):
        image.size_of(tmp_path / "bomb.png")
    with pytest.raises(InputError, match="more than 536,870,912"):
        image.read_rgb(tmp_path / "bomb.png")


@pytest.mark.parametrize("kept", [0.1, 0.5, 0.9, 0.99])
def test_inspect_reports_a_truncated_result(tmp_path: Path, kept: float) -> None:
    np.savez(tmp_path / "r.npz", a=np.arange(1000), b=np.zeros((3, 4)))
    data = (tmp_path / "r.npz").read_bytes()
    (tmp_path / "r.npz").write_bytes(data[: int(kept * len(data))])
    with pytest.raises(InputError, match=r"r\.npz: can't be read"):
        inspect_path(tmp_path / "r.npz")

"""Cloud files: round trips, and errors of damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Frame, PointCloud
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.clouds import las
from tests.present import present

FRAME = Frame("EPSG:32632", (458_852.0, 5_428_637.0, 100.0))


def made(n: int = 1000) -> PointCloud:
    rng = np.random.default_rng(3)
    return PointCloud(
        FRAME,
        rng.uniform(-50, 50, (n, 3)).astype(np.float32),
        rgb=rng.integers(0, 256, (n, 3)).astype(np.uint8),
        classification=rng.choice([2, 5, 6, 66, 69], n).astype(np.uint8),
        time=1e9 + rng.uniform(0, 10, n),
        intensity=rng.integers(0, 65536, n).astype(np.uint16),
    )


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_keeps_positions_classes_colours_times_and_crs(tmp_path: Path, suffix: str) -> None:
    cloud, path = made(), tmp_path / f"c{suffix}"
    las.write(path, cloud)
    read = clouds.read(path, FRAME)
    assert np.abs(read.xyz - cloud.xyz).max() < 6e-4
    for name in ("rgb", "classification", "time", "intensity"):
        assert np.array_equal(getattr(read, name), getattr(cloud, name)), name
    header = clouds.read_header(path)
    assert header.count == 1000 and header.crs is not None and "UTM zone 32N" in header.crs
    assert np.abs(header.low - FRAME.to_crs(cloud.xyz).min(axis=0)).max() < 1e-3


def test_las_without_crs_and_colours_has_none(tmp_path: Path) -> None:
    las.write(tmp_path / "c.las", PointCloud(Frame(), np.ones((5, 3), np.float32)))
    assert clouds.read_header(tmp_path / "c.las").crs is None
    assert clouds.read(tmp_path / "c.las", Frame()).rgb is None


def test_empty_las_is_rejected(tmp_path: Path) -> None:
    las.write(tmp_path / "c.las", PointCloud(Frame(), np.empty((0, 3), np.float32)))
    with pytest.raises(InputError, match=r"c\.las: contains no points.*Remove it"):
        clouds.read_header(tmp_path / "c.las")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("class_name", ["classification", "label", "class"])
def test_ply_keeps_double_coordinates_colours_and_classes(tmp_path: Path, form: str, class_name: str) -> None:
    cloud, path = made(50), tmp_path / "c.ply"
    write_ply(path, cloud, form, class_name)
    read = clouds.read(path, FRAME)
    assert np.abs(read.xyz - cloud.xyz).max() < 1e-4  # single precision would be half a metre off
    assert np.array_equal(present(read.rgb), present(cloud.rgb))
    assert np.array_equal(present(read.classification), present(cloud.classification))
    header = clouds.read_header(path)
    assert (header.count, header.crs) == (50, None)
    assert np.allclose(header.low, FRAME.to_crs(cloud.xyz).min(axis=0))


def test_ply_without_colours_and_classes_has_none(tmp_path: Path) -> None:
    rows = "\n".join(f"{x} 0 0" for x in range(5))
    heading = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "c.ply").write_text(f"{heading}end_header\n{rows}\n", encoding="utf-8")
    read = clouds.read(tmp_path / "c.ply", Frame())
    assert read.xyz[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert read.rgb is None and read.classification is None


@pytest.mark.parametrize(
    "content", [b"ply\n", b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n1\n"]
)
def test_damaged_ply_is_rejected(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "c.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"c\.ply: is not a readable PLY cloud.*Export it again"):
        clouds.read(tmp_path / "c.ply", Frame())


def write_ply(path: Path, cloud: PointCloud, form: str, class_name: str) -> None:
    order = ">" if "big" in form else "<"
    kind = [*((k, f"{order}f8") for k in "xyz"), *((k, "u1") for k in ("red", "green", "blue", class_name))]
    rows = np.empty(len(cloud), np.dtype(kind))
    for k, name in enumerate("xyz"):
        rows[name] = cloud.frame.to_crs(cloud.xyz)[:, k]
    assert cloud.rgb is not None
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = cloud.rgb[:, k]
    rows[class_name] = cloud.classification
    types = "".join(f"property {'double' if kind[-1] == '8' else 'uchar'} {name}\n" for name, kind in kind)
    heading = f"ply\nformat {form} 1.0\nelement vertex {len(rows)}\n{types}end_header\n"
    if form == "ascii":
        body = "\n".join(" ".join(repr(v) for v in row) for row in rows.tolist()) + "\n"
        path.write_text(heading + body, encoding="utf-8")
    else:
        path.write_bytes(heading.encode() + rows.tobytes())

"""Import of textured meshes: up axis, units, frames, and the cloud that is sampled from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.data_samples.building import Style
from scan2sim.data_samples.mesh_model import TO_FILE, write
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.geometry.surface_distance import distances
from scan2sim.pipeline.importers import mesh_model
from scan2sim.pipeline.importers.mesh_model import import_mesh, sample
from scan2sim.pipeline.importers.robot_map import MapParams
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.source_mesh import SourceMesh
from scan2sim.pipeline.io.tile import read_tile
from tests.present import present


@pytest.mark.parametrize(
    ("file_format", "up", "unit"),
    [("obj", "z", "m"), ("obj", "y", "mm"), ("ply", "y", "m"), ("glb", "y", "m")],
)
def test_mesh_is_levelled_and_scaled_to_metres(tmp_path: Path, file_format: str, up: str, unit: str) -> None:
    path, made, paint = write(
        tmp_path / "in", file_format=file_format, up=up, unit=unit, edge=0.4, style=Style(rooms=1)  # type: ignore[arg-type]
    )  # fmt: skip
    tile = read_tile(import_mesh(path, tmp_path / "tile", MapParams()))
    about = present(tile.robot_map)
    assert about.scene == "indoor"
    assert about.unit == (0.001 if unit == "mm" else 1.0)
    source = SourceMesh.load(present(about.source_mesh)).mesh
    T = np.linalg.inv(about.T_world_map)
    in_file = (source.vertices.astype(np.float64) + source.frame.origin) @ T[:3, :3].T + T[:3, 3]
    back = (in_file @ TO_FILE[up]).astype(np.float32)
    truth = Mesh(Frame(), made.vertices.astype(np.float32), made.faces.astype(np.int32))
    assert distances(back, truth).max() < 1e-3
    assert np.allclose(about.T_world_map[:3, :3] @ TO_FILE[up][:, 2], (0, 0, 1), atol=2e-3)  # the file's up axis is z
    cloud = clouds.read(tile.clouds[0], Frame())
    points = (cloud.xyz @ T[:3, :3].T.astype(np.float32)) @ TO_FILE[up].astype(np.float32)
    floor = np.abs(points[:, 2]) < 0.005
    assert distances(points.astype(np.float32), truth).max() < 5e-3
    rgb = paint.at(points[floor].astype(np.float64), np.full(int(floor.sum()), 2))
    error = np.abs(rgb - present(cloud.rgb)[floor]).mean()
    assert error < (40 if file_format == "ply" else 8)


def test_a_mesh_in_centimetres_is_doubted_unless_its_unit_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unreal, Blender and others write centimetres: a room of 2.7 m would be a hall of 270 m."""
    monkeypatch.setattr(mesh_model, "POINTS", (20_000, 20_000))
    path = write(tmp_path / "in", file_format="obj", edge=0.4, style=Style(rooms=1))[0]
    lines = path.read_text(encoding="utf-8").splitlines()
    scaled = [
        " ".join(["v", *(f"{100 * float(v):.4f}" for v in line.split()[1:4])]) if line.startswith("v ") else line
        for line in lines
    ]
    path.write_text("\n".join(scaled), encoding="utf-8")
    doubts: dict[str, list[str]] = {}
    for units in ("auto", "cm"):
        warned: list[str] = []
        import_mesh(path, tmp_path / units, MapParams.model_validate({"units": units}), warn=warned.append)
        doubts[units] = [line for line in warned if "m high: if it isn't" in line]
    assert len(doubts["auto"]) == 1 and "--units cm" in doubts["auto"][0] and not doubts["cm"]


def test_samples_are_evenly_distributed() -> None:
    square = Mesh(
        Frame(), np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )  # fmt: skip
    face, weights = sample(square, 4000)
    assert abs(int((face == 0).sum()) - 2000) <= 1
    assert (weights >= 0).all()
    assert (weights.sum(axis=1) <= 1 + 1e-6).all()


def test_surface_that_faces_down_is_flipped(tmp_path: Path) -> None:
    path = tmp_path / "ground.obj"
    n = 30
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    z = 0.3 * np.sin(x / 3) + 0.1 * np.cos(y)
    lines = [f"v {a} {b} {c:.4f}" for a, b, c in zip(x.ravel(), y.ravel(), z.ravel(), strict=True)]
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel() + 1
    lines += [f"f {i} {i + 1} {i + n}\nf {i + n} {i + 1} {i + n + 1}" for i in corner]  # clockwise from above
    path.write_text("\n".join(lines), encoding="utf-8")
    warnings: list[str] = []
    tile = read_tile(import_mesh(path, tmp_path / "tile", MapParams(), warn=warnings.append))
    source = SourceMesh.load(present(present(tile.robot_map).source_mesh)).mesh
    assert source.face_normal[:, 2].min() > 0
    assert any("turned around" in text for text in warnings)
    assert any("coloured by class" in text for text in warnings)


def test_tiny_mesh_is_rejected_with_its_unit(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n", encoding="utf-8")
    with pytest.raises(DataError, match="--units"):
        import_mesh(path, tmp_path / "tile", MapParams())

"""OBJ: a reader gets the written geometry."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.io.mesh_formats import PageNames, obj
from scan2sim.pipeline.io.worlds import textured_mesh
from tests.fakes import synthetic
from tests.present import present

NAMES = PageNames("a", ("m_0", "m_1"), ("m_0.png", "m_1.png"), (0, 1))


@pytest.mark.parametrize("make", [synthetic.ground, synthetic.house])
def test_triangles_uv_and_pages_round_trip(tmp_path: Path, make: Callable[[], Mesh]) -> None:
    import trimesh

    mesh = make()
    surface = present(textured_mesh.read(synthetic.textured(tmp_path / "in", mesh)))
    obj.write(tmp_path / "a.obj", surface, NAMES)
    for page in (0, 1):
        (tmp_path / f"m_{page}.png").write_bytes(surface.pages[page].read_bytes())
    read = trimesh.load_scene(tmp_path / "a.obj", process=False)
    for page, (corners, uv) in synthetic.by_page(mesh).items():
        part = next(g for g in read.geometry.values() if g.visual.material.name == f"m_{page}")
        np.testing.assert_allclose(part.vertices[part.faces], corners, atol=1e-4)
        np.testing.assert_allclose(part.visual.uv[part.faces], uv, atol=1e-6)
        assert part.visual.material.image.size == (256, 256)


def test_texture_coordinates_are_unique_with_v_upwards(tmp_path: Path) -> None:
    surface = present(textured_mesh.read(synthetic.textured(tmp_path / "in", synthetic.house())))
    obj.write(tmp_path / "a.obj", surface, NAMES)
    lines = (tmp_path / "a.obj").read_text(encoding="utf-8").splitlines()
    vt = [line for line in lines if line.startswith("vt ")]
    assert len(vt) == len(set(vt)) == 10
    v = [tuple(map(float, line.split()[1:])) for line in lines if line.startswith("v ")]
    first = next(line for line in lines if line.startswith("f ")).split()[1:]  # a wall: two feet and a top
    for corner in first:
        at, t, _ = (int(index) - 1 for index in corner.split("/"))
        assert (v[at][2] > 0) == (float(vt[t].split()[2]) == 1.0)


def test_materials_are_matt_for_gazebo(tmp_path: Path) -> None:
    surface = present(textured_mesh.read(synthetic.textured(tmp_path / "in", synthetic.house())))
    obj.write(tmp_path / "a.obj", surface, NAMES)
    lines = (tmp_path / "a.mtl").read_text(encoding="utf-8").splitlines()
    # gz-common reads a material without Pr as roughness 0, for which Ogre warns of NaNs in its shader
    assert lines.count("Pr 1") == lines.count("Pm 0") == lines.count("Ks 0 0 0") == 2


def test_normals_point_outwards(tmp_path: Path) -> None:
    surface = present(textured_mesh.read(synthetic.textured(tmp_path / "in", synthetic.ground())))
    assert surface.normal[:, 2].min() > 0.9
    np.testing.assert_allclose(np.linalg.norm(surface.normal, axis=1), 1, atol=1e-5)


def test_parts_are_compact_and_cover_the_mesh(tmp_path: Path) -> None:
    mesh = synthetic.ground()
    parts = present(textured_mesh.read(synthetic.textured(tmp_path / "in", mesh))).parts(1000)
    assert max(map(len, parts)) <= 1000
    assert sum(map(len, parts)) == len(mesh)
    assert sum(part.mesh.face_area.sum() for part in parts) == pytest.approx(mesh.face_area.sum(), rel=1e-5)
    spans = [np.ptp(part.mesh.vertices[:, :2], axis=0).max() for part in parts]
    assert max(spans) < 15  # of 20 m: compact, not scattered over the tile

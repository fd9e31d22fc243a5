"""Collada: a reader gets the written geometry, in the form that Gazebo reads completely."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.io.mesh_formats import PageNames
from scan2sim.pipeline.io.mesh_formats import collada as dae
from scan2sim.pipeline.io.worlds import textured_mesh
from tests.fakes import synthetic
from tests.present import present


@pytest.mark.parametrize("make", [synthetic.ground, synthetic.house])
def test_triangles_uv_and_pages_round_trip(tmp_path: Path, make: Callable[[], Mesh]) -> None:
    import collada

    mesh = make()
    surface = present(textured_mesh.read(synthetic.textured(tmp_path / "in", mesh)))
    dae.write(tmp_path / "a.dae", surface, PageNames("a", ("m_0", "m_1"), ("m_0.png", "m_1.png"), (0, 1)))
    read = collada.Collada(str(tmp_path / "a.dae"))
    assert read.assetInfo.upaxis == "Z_UP" and read.assetInfo.unitmeter == 1.0
    for page, (corners, uv) in synthetic.by_page(mesh).items():
        (triangles,) = next(g for g in read.geometries if g.name == f"m_{page}").primitives
        np.testing.assert_allclose(triangles.vertex[triangles.vertex_index], corners, atol=1e-4)
        np.testing.assert_allclose(triangles.texcoordset[0][triangles.texcoord_indexset[0]], uv, atol=1e-6)
        normals = triangles.normal[triangles.normal_index].mean(axis=1)
        side = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert ((normals * side).sum(axis=1) > 0).all()
        offsets = sorted(source[0] for sources in triangles.sources.values() for source in sources)
        assert offsets == [0, 1, 2]
        material = next(m for m in read.materials if m.name == f"m_{page}")
        assert material.effect.diffuse.sampler.surface.image.path == f"m_{page}.png"

"""Unwrapping: charts don't overlap, texel density and page size are met, and the fallback backend is used."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import Camera, Frame, Mesh, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.texturing import texture_layout
from scan2sim.texturing.atlas import Backend, Unwrapped, manifold
from scan2sim.texturing.texture_layout import UnwrapParams
from scan2sim.texturing.unwrap import UNWRAP, unwrap
from scan2sim.texturing.view_selection.choice import Choice
from tests.present import present


def hills(n: int = 24, cell: float = 0.25, seed: int = 0) -> Mesh:
    """Uneven ground of n x n cells."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(n + 1) * cell, np.arange(n + 1) * cell, indexing="ij")
    z = 0.3 * np.sin(x) + rng.normal(0, 0.02, x.shape)
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    a = (i * (n + 1) + j).ravel()
    faces = np.concatenate([np.column_stack([a, a + n + 1, a + n + 2]), np.column_stack([a, a + n + 2, a + 1])])
    return Mesh(Frame(), np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32), faces.astype(np.int32))


def with_fin(mesh: Mesh) -> Mesh:
    """The mesh with an extra face on an inner edge (three faces there), a duplicate face, and a degenerate one."""
    a, b, c = mesh.faces[len(mesh) // 2]
    top = mesh.vertices[[a, b]].mean(axis=0) + np.array([0, 0, 0.4], np.float32)
    vertices = np.concatenate([mesh.vertices, top[None]])
    faces = np.concatenate([mesh.faces, [[a, b, len(vertices) - 1], [a, b, c], [a, a, b]]])
    return Mesh(mesh.frame, vertices, faces.astype(np.int32))


def run(mesh: Mesh, tmp_path: Path, **params: Any) -> tuple[Mesh, list[dict[str, int]], Done]:
    mesh.save(tmp_path / "in.npz")
    done = unwrap({"mesh": tmp_path / "in.npz"}, UnwrapParams(**params), tmp_path, silent)
    return Mesh.load(done.files["mesh"]), json.loads(done.files["pages"].read_text(encoding="utf-8")), done


def cover_count(mesh: Mesh, pages: list[dict[str, int]], k: int) -> npt.NDArray[np.int64]:
    """(H, W) number of faces that cover each texel centre of page k."""
    size = np.array([pages[k]["width"], pages[k]["height"]])
    count = np.zeros(size[::-1], int)
    for corner in present(mesh.uv)[mesh.page == k] * size - 0.5:
        low, high = np.ceil(corner.min(0)).astype(int), np.floor(corner.max(0)).astype(int)
        u, v = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        a, b, c = corner
        det = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        if abs(det) < 1e-6:
            continue
        s = ((u - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (v - a[1])) / det
        t = ((b[0] - a[0]) * (v - a[1]) - (u - a[0]) * (b[1] - a[1])) / det
        inside = (s > 1e-3) & (t > 1e-3) & (s + t < 1 - 1e-3)
        count[v[inside], u[inside]] += 1
    return count


@pytest.mark.parametrize("backend", ["uvatlas", "xatlas"])
def test_charts_do_not_overlap_and_have_the_wanted_density(backend: str, tmp_path: Path) -> None:
    mesh, pages, done = run(hills(), tmp_path, backend=backend, texel=0.02)
    assert mesh.uv is not None and mesh.uv.min() >= 0 and mesh.uv.max() <= 1
    assert cover_count(mesh, pages, 0).max() == 1
    assert done.metrics["texel_m"] == pytest.approx(0.02, rel=0.1)
    assert done.metrics["stretch_median"] < 1.2
    assert done.metrics["utilisation"] > 0.3
    assert not done.warnings


@pytest.mark.parametrize("backend", ["uvatlas", "xatlas"])
def test_pages_stay_within_their_size_and_blocks_are_compact(backend: str, tmp_path: Path) -> None:
    mesh, pages, _ = run(hills(), tmp_path, backend=backend, texel=0.02, page_size=256)
    assert len(pages) > 1 and sorted(set(present(mesh.page).tolist())) == list(range(len(pages)))
    assert all(max(p.values()) <= 256 for p in pages)
    assert all(cover_count(mesh, pages, k).max() == 1 for k in range(len(pages)))
    spread = [np.ptp(mesh.corners[mesh.page == k].reshape(-1, 3), axis=0)[:2].max() for k in range(len(pages))]
    assert np.median(spread) < 5  # of 6 m


def test_non_manifold_mesh_is_fixed_for_uvatlas(tmp_path: Path) -> None:
    mesh, _, done = run(with_fin(hills()), tmp_path, backend="uvatlas", texel=0.02)
    assert done.metrics["fallbacks"] == 0
    flat = present(mesh.uv)[:-1]
    a, b = (np.pad(flat[:, k] - flat[:, 0], ((0, 0), (0, 1))) for k in (1, 2))
    area = np.abs(np.cross(a, b))[:, 2]
    assert (area > 0).all()


def test_manifold_leaves_at_most_two_faces_per_edge() -> None:
    faces, old = manifold(with_fin(hills()).faces[:-1])
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() <= 2
    np.testing.assert_array_equal(old[faces], with_fin(hills()).faces[:-1])
    _, same = manifold(hills().faces)
    assert len(same) == len(hills().vertices)  # a manifold stays in one piece


def test_failed_blocks_use_the_fallback_backend(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = texture_layout._in_child

    def refuse(mesh: Mesh, block: npt.NDArray[np.int64], backend: Backend, params: UnwrapParams) -> Unwrapped | str:
        return "refused" if backend == "uvatlas" else real(mesh, block, backend, params)

    monkeypatch.setattr(texture_layout, "_in_child", refuse)
    _, _, done = run(hills(), tmp_path, backend="uvatlas", texel=0.02)
    assert done.metrics["fallbacks"] == 1
    assert "xatlas" in done.warnings[0]


def test_empty_mesh_is_accepted(tmp_path: Path) -> None:
    mesh, pages, done = run(hills().keep(np.zeros(1152, bool)), tmp_path)
    assert len(mesh) == 0 and present(mesh.uv).shape == (0, 3, 2) and pages == []
    assert done.metrics["pages"] == 0


def test_xatlas_is_deterministic(tmp_path: Path) -> None:
    first, _, _ = run(hills(), tmp_path, backend="xatlas", texel=0.02)
    again, _, _ = run(hills(), tmp_path, backend="xatlas", texel=0.02)
    np.testing.assert_array_equal(first.uv, again.uv)


def test_vegetation_has_texels_of_three_centimetres() -> None:
    assert UnwrapParams(**UNWRAP.class_defaults["vegetation"]).texel == 0.03


def test_texels_from_an_orthophoto_are_half_its_pixels(tmp_path: Path) -> None:
    mesh = hills()
    down = np.diag([1.0, -1, -1, 1])
    down[:3, 3] = 0, 6, 12
    camera = Camera("orthographic", 30, 30, 5.0, 5.0, 0.0, 0.0)  # 20 cm per pixel
    views_io.save(tmp_path / "views.json", [View("map", camera, down, tmp_path / "map.png")])
    detail_view = np.zeros(len(mesh), np.int32)
    Choice(detail_view[:, None], np.ones((len(mesh), 1), np.float32), detail_view).save(tmp_path / "choice.npz")
    mesh.save(tmp_path / "in.npz")
    inputs = {"mesh": tmp_path / "in.npz", "views": tmp_path / "views.json", "choice": tmp_path / "choice.npz"}
    done = unwrap(inputs, UnwrapParams(texel=0.01), tmp_path, silent)
    unwrapped, pages = Mesh.load(done.files["mesh"]), json.loads(done.files["pages"].read_text(encoding="utf-8"))
    assert len(pages) == 1 and np.all(unwrapped.page == 0)
    size = np.array([pages[0]["width"], pages[0]["height"]])
    a, b, c = np.moveaxis(unwrapped.uv * size, 1, 0)
    area = np.abs(np.cross(np.pad(b - a, ((0, 0), (0, 1))), np.pad(c - a, ((0, 0), (0, 1)))))[:, 2] / 2
    assert np.sqrt(unwrapped.face_area / area) == pytest.approx(0.1, rel=0.15)

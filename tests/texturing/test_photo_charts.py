"""Charts by projection into photos: metric, without overlaps, on pages of the wanted size."""

import numpy as np

from scan2sim.pipeline.core.types import I32, Mesh
from scan2sim.texturing import photo_charts
from tests.texturing.corner import BOX, GROUND, join

CENTRES = np.array([[-4.0, -2.0, 1.8], [-4.0, 2.0, 1.8]])


def both() -> tuple[Mesh, I32]:
    """Ground and box as one mesh; its left half belongs to the first camera, its right half to the second."""
    mesh = join((GROUND.vertices, GROUND.faces), (BOX.vertices, BOX.faces))
    middle = mesh.corners.mean(axis=1)
    view = (middle[:, 1] > 0).astype(np.int32)
    towards = CENTRES[view] - middle
    view[np.einsum("ij,ij->i", towards, mesh.face_normal) <= 0] = -1
    return mesh, view


def test_charts_are_metric_and_contain_seen_faces() -> None:
    mesh, view = both()
    charts = photo_charts.cut(mesh, view, CENTRES, 0.02, 2000)
    assert len(charts.face) > 0.95 * (view >= 0).sum()
    a, b = charts.flat[:, 1] - charts.flat[:, 0], charts.flat[:, 2] - charts.flat[:, 0]
    drawn = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2 * 0.02**2
    assert (drawn > 0).all()
    np.testing.assert_allclose(drawn.sum(), mesh.face_area[charts.face].sum(), rtol=0.02)
    assert (charts.flat >= 0).all() and (charts.flat.max(axis=1) <= charts.size[charts.chart]).all()
    assert (view[charts.face] >= 0).all()


def test_each_chart_belongs_to_one_photo() -> None:
    mesh, view = both()
    charts = photo_charts.cut(mesh, view, CENTRES, 0.02, 2000)
    for k in np.unique(charts.chart):
        assert len(np.unique(view[charts.face[charts.chart == k]])) == 1


def test_packed_rectangles_do_not_overlap_and_stay_on_their_page() -> None:
    rng = np.random.default_rng(0)
    size = rng.integers(1, 90, (300, 2))
    position, page, pages = photo_charts.pack(size, 256, 3)
    assert len(pages) > 1 and all(w <= 256 and h <= 256 for w, h in pages)
    for k, (width, height) in enumerate(pages):
        cover_count = np.zeros((height, width), int)
        for i in np.flatnonzero(page == k):
            (x, y), (w, h) = position[i], size[i]
            assert x >= 3 and y >= 3 and x + w + 3 <= width and y + h + 3 <= height
            cover_count[y - 3 : y + h + 3, x - 3 : x + w + 3] += 1
        assert cover_count.max() <= 2  # at most two gutters may overlap at their borders
        assert (position[page == k] >= 0).all()


def test_faces_covered_by_others_are_detected() -> None:
    flat = np.array(
        [[[0, 0], [20, 0], [0, 20]], [[0, 0], [20, 0], [0, 20]], [[30, 30], [50, 30], [30, 50]]], np.float32
    )
    covered = photo_charts.overlapping(flat, np.zeros(3, int), [(64, 64)])
    assert covered.tolist() == [False, True, False]


def test_no_charts_without_seen_faces() -> None:
    mesh, view = both()
    charts = photo_charts.cut(mesh, np.full_like(view, -1), CENTRES, 0.02, 2000)
    assert len(charts.face) == 0 and photo_charts.pack(charts.size, 256, 3)[2] == []
    assert isinstance(mesh, Mesh)

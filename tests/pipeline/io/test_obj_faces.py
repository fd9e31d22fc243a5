"""Faces of OBJ files: relative indices, and concave polygons, which become triangles that cover nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.mesh_models import read
from scan2sim.pipeline.io.obj_faces import triangles_of, triangulated

WALL = np.array(
    [(0, 0), (10, 0), (10, 6), (0, 6), (0, 0), (3, 2), (3, 4), (5, 4), (5, 2), (3, 2)], np.float64
)  # of 10 x 6 m with a window of 2 x 2 m, joined to its outline by a double edge
STEPS = np.array([(3, 1), (2, 1), (2, 2), (1, 2), (1, 3), (0, 3), (0, 0), (3, 0)], np.float64)
STAR = np.array([(r * np.cos(t), r * np.sin(t)) for r, t in zip((2, 0.5) * 5, np.arange(10) * np.pi / 5, strict=True)])


def outline_area(flat: F64) -> float:
    x, y = flat.T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)


@pytest.mark.parametrize("flat", [WALL, STEPS, STAR, WALL[::-1], STEPS[::-1]])
@pytest.mark.parametrize("seed", range(3))
def test_triangles_cover_a_concave_polygon_once(flat: F64, seed: int) -> None:
    corners = np.column_stack([flat, np.zeros(len(flat))]) @ Rotation.random(random_state=seed).as_matrix() + 100
    triangles = triangles_of(corners)
    assert len(triangles) == len(flat) - 2
    a, b, c = (corners[[triangle[k] for triangle in triangles]] for k in range(3))
    normal = np.cross(b - a, c - a) / 2
    assert np.linalg.norm(normal, axis=1).sum() == pytest.approx(outline_area(flat), rel=1e-6)
    fan = np.cross(corners[1:-1] - corners[0], corners[2:] - corners[0]).sum(axis=0)
    assert (normal @ fan > 0).all()  # in the order of the polygon's sides


def test_convex_and_bent_polygons_are_left_as_they_are() -> None:
    octagon = "".join(f"v {np.cos(t)} {np.sin(t)} {{}}\n" for t in np.arange(8) * np.pi / 4) + "f 1 2 3 4 5 6 7 8\n"
    assert triangulated(octagon.format(*[0] * 8)) == octagon.format(*[0] * 8)
    bent = octagon.format(0, 1, 0, 1, 0, 1, 0, 1)
    assert triangulated(bent) == bent


@pytest.mark.parametrize("relative", [False, True])
def test_wall_with_a_window_of_an_obj(tmp_path: Path, relative: bool) -> None:
    """Indices from the end, lines that continue (Rhino), corners with texture coordinates."""
    names = [f"{k - len(WALL) if relative else k + 2}/1" for k in range(len(WALL))]
    points = "".join(f"v {x} 0 {z}\n" for x, z in WALL)
    later = "v 9 9 9\n" if relative else ""
    body = f"v 5 5 5\nvt 0 0\n{points}f {' '.join(names[:4])} \\\n{' '.join(names[4:])}\n{later}"
    (tmp_path / "wall.obj").write_bytes(body.replace("\n", "\r\n" if relative else "\n").encode())
    mesh, notes = read(tmp_path / "wall.obj")
    assert not notes and float(mesh.mesh.face_area.sum()) == pytest.approx(56)


def test_relative_indices_count_from_their_line(tmp_path: Path) -> None:
    one, other = "v 0 0 0\nv 1 0 0\nv 1 1 0\n", "v 5 0 0\nv 9 0 0\nv 9 4 0\nvn 0 0 1\n"
    (tmp_path / "m.obj").write_text(f"{one}f -3 -2 -1\n{other}f -3//-1 -2//-1 -1//-1\nf 1 2 -1\n", encoding="utf-8")
    mesh, notes = read(tmp_path / "m.obj")
    assert not notes and sorted(mesh.mesh.face_area.tolist()) == pytest.approx([0.5, 2, 8])

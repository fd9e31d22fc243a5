"""View selection of sign panels: the photos that see a whole side in detail, and no others."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.geometry import primitives
from scan2sim.texturing.view_selection.choice import Choice
from scan2sim.texturing.view_selection.step import with_sign_panel_views


def test_panel_side_uses_photos_that_see_all_of_it_in_detail() -> None:
    vertices, faces = primitives.plate([(0, 0, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1)], (0.02, 0, 0))
    mesh = Mesh(
        Frame(), vertices.astype(np.float32), faces, classification=np.full(len(faces), CODE["road_sign"], np.uint8)
    )
    front = np.flatnonzero(mesh.face_normal[:, 0] < -0.9)
    view, quality = np.full((len(faces), 4), -1, np.int32), np.zeros((len(faces), 4), np.float32)
    view[front], quality[front] = [2, 0, 1, 3], [0.04, 0.03, 0.02, 0.003]
    view[front[0]], quality[front[0]] = [0, 1, 3, -1], [0.03, 0.02, 0.003, 0]  # photo 2 doesn't see this face
    found = with_sign_panel_views(Choice(view, quality, view[:, 0].copy()), mesh, [1e-3] * 4)
    assert (found.view[front] == [0, 1, -1, -1]).all()  # photo 3 is too coarse
    assert (found.detail_view[front] == 0).all()
    assert (np.delete(found.detail_view, front) == -1).all()

"""Islands: removes small isolated pieces of surface, often artefacts (D3.2, section 4.2)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Mesh


class IslandsParams(Params):
    """Minimum size of a connected component.

    Attributes:
        min_area: connected components with a smaller area are removed, m2.
    """

    min_area: float = Field(0.5, ge=0, le=1_000_000)


def islands(inputs: Inputs, params: IslandsParams, out: Path, report: Report) -> Done:
    """Remove the connected components of `mesh` (faces connected by edges) that are smaller than `min_area`."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    mesh = Mesh.load(inputs["mesh"])
    n = len(mesh.vertices)
    a, b = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(a), np.bool_), (a, b)), shape=(n, n))
    pieces, piece_of_vertex = connected_components(graph, directed=False)
    piece = piece_of_vertex[mesh.faces[:, 0]]
    area = np.bincount(piece, weights=mesh.face_area, minlength=pieces)
    keep = mesh.keep((area >= params.min_area)[piece]) if len(mesh) else mesh
    keep.save(out / "mesh.npz")
    kept = int((area >= params.min_area).sum())
    metrics = {
        "faces_in": len(mesh),
        "faces": len(keep),
        "islands_removed": pieces - kept,
        "pieces": kept,
        "area_m2": round(float(keep.face_area.sum()), 2),
    }
    return Done({"mesh": out / "mesh.npz"}, metrics)


ISLANDS = Step("islands", 1, islands, IslandsParams, class_defaults={"terrain": {"min_area": 2.0}}, per_class=True)

"""Borders step: measures gaps, overlaps and colour steps between a tile and its neighbours, by class."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.core.voronoi_cell import Cell

if TYPE_CHECKING:
    from scan2sim.pipeline.io.worlds.textured_mesh import Textured

SAMPLE_SPACING_M = 0.01
"""Metres between the sample points along an edge: other points than those of the colour harmonization."""


class BordersParams(Params):
    """No settings: the cell decides where borders are."""

    context: TileCell


def borders(inputs: Inputs, params: BordersParams, out: Path, report: Report) -> Done:
    """Measure the borders of `textured.GROUP` with those of the neighbours, `textured.GROUP.NAME`.

    Metrics, by neighbour and class: `length_m`, length of the border; `gap_m`, largest distance from a point on one
    mesh's border to the other mesh's border where that runs alongside, and its 99th percentile `gap_p99_m`;
    `one_sided_m`, length where it doesn't; `shared`, share (0 to 1) of border edges that are identical in both;
    `overlap_m`, overlap beyond the border; `colour_step` and its 95th percentile, grey levels. Street furniture is
    left out, as it has no border.
    """
    from scan2sim.pipeline.io.worlds import textured_mesh

    names = sorted({name.split(".", 2)[2] for name in inputs if name.count(".") == 2})
    found: dict[str, dict[str, dict[str, float]]] = {}
    for i, name in enumerate(names):
        report(i / len(names), name)
        for group in SURFACES:
            if f"textured.{group}.{name}" in inputs:
                own, other = (
                    textured_mesh.read(inputs[key]) for key in (f"textured.{group}", f"textured.{group}.{name}")
                )
                if own is not None and other is not None:
                    found.setdefault(name, {})[group] = _measured(own, other, params.context.cell, name)
    return Done({}, {"neighbours": found})


def _measured(own: Textured, other: Textured, cell: Cell, name: str) -> dict[str, float]:
    from scan2sim.pipeline.tiling.borders.gap import gap

    between, (step, p95, _) = gap(_surface(own.mesh), _surface(other.mesh), cell, name), colour_step(own, other)
    values = {
        "length_m": between.length_m, "gap_m": between.max_m, "gap_p99_m": between.p99_m,
        "one_sided_m": between.one_sided_m,
        "shared": between.shared, "overlap_m": between.overlap_m, "colour_step": step, "colour_step_p95": p95,
    }  # fmt: skip
    return {key: round(float(value), 6 if key.startswith("gap") else 4) for key, value in values.items()}


def _surface(mesh: Mesh) -> Mesh:
    """The mesh without street furniture."""
    return mesh if mesh.classification is None else mesh.keep(mesh.classification == 0)


def colour_step(a: Textured, b: Textured) -> tuple[float, float, float]:
    """Colour step between two textured meshes along their border: (mean, 95th percentile, length of border in metres).

    Absolute differences in grey levels over sample points (other points than those used by the colour harmonization)
    and channels; zero if the meshes don't meet.

    Raises:
        InputError: a page can't be read.
    """
    from scan2sim.texturing.borders.correspondences import open_edges, shared_border
    from scan2sim.texturing.borders.sampling import colours

    border = shared_border([open_edges(a.mesh), open_edges(b.mesh)], SAMPLE_SPACING_M)
    if not len(border):
        return 0.0, 0.0, 0.0
    one, two = (colours(samples, t.pages, len(border)) for samples, t in zip(border.samples, (a, b), strict=True))
    step = np.abs(one - two)
    return float(step.mean()), float(np.percentile(step, 95)), border.length[0]


BORDERS = Step("borders", 3, borders, BordersParams)

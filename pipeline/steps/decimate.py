"""Decimate: mesh simplification, with a target per class (D3.2, section 4.2)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Name
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import Mesh, PointCloud
from scan2sim.pipeline.geometry.coarse_surface import coarse_faces

COARSE_SHARE_MAX = 0.2
"""Largest number of triangles of coarse surface over that of all others; they come in addition to the target."""
TRIANGLES_PER_POINT = 6
"""More than this per point of a sparse map add no shape, fewer lose some (docs/benchmarks/robot-maps.md)."""


class DecimateContext(Context):
    """Borders and points of the mesh.

    Attributes:
        keep_border: open borders must not be simplified, even if that exceeds the target: where tiles or classes meet.
        cell: the tile's cell, if it has neighbours; the mesh stays within it.
        by_points: the surface gets at most `TRIANGLES_PER_POINT` for each point of `cloud`.
    """

    keep_border: bool = False
    cell: TileCell | None = None
    by_points: bool = False


class DecimateParams(Params):
    """Mesh simplification.

    Attributes:
        target: number of triangles; D3.2: 100 K for terrain and buildings, 300 K for vegetation; 50 K for vehicles.
            Coarse surface (`photo_coverage.uncovered`) comes in addition, up to 20 %.
        backend: simplification library, "fast_simplification" or "pymeshlab"; modules of `pipeline/decimation/`.
    """

    target: int = Field(100_000, ge=10_000, le=1_000_000)
    backend: Name = "fast_simplification"
    context: DecimateContext = DecimateContext()


def decimate(inputs: Inputs, params: DecimateParams, out: Path, report: Report) -> Done:
    """Simplify `mesh` by edge collapse to the target, preserving borders (of tiles and classes).

    `furniture` (optional) is added unsimplified, within the target; its faces keep their classes, all other faces then
    get class 0. Points of `cloud` and `uncovered` (optional) show which part is coarse; the number of those of `cloud`
    limits the target if the context asks for it.

    If the border alone exceeds the target, it is simplified as well (unless `keep_border`), with a warning.

    Raises:
        SettingError, UnavailableError: as `can_decimate`.
    """
    from scan2sim.pipeline.decimation import simplify
    from scan2sim.pipeline.tiling.borders.open_edges import pulled_inside

    mesh = Mesh.load(inputs["mesh"])
    furniture = Mesh.load(inputs["furniture"]) if "furniture" in inputs else None
    coarse = int(coarse_faces(mesh, inputs).sum())
    detailed = min(params.target, len(mesh) - coarse)
    allowed = detailed + min(coarse, round(COARSE_SHARE_MAX * detailed)) if coarse else params.target
    target = allowed - len(furniture or ())
    if params.context.by_points:
        target = min(target, TRIANGLES_PER_POINT * len(PointCloud.load(inputs["cloud"])))
    small, warnings, border_kept = simplify(mesh, target, backend=params.backend), [], True
    if len(small) > target * 1.05 and params.context.keep_border:
        warnings.append(f"{len(small):,} triangles instead of {target:,}: common borders can't be simplified")
    elif len(small) > target * 1.05:
        warnings.append(f"the border alone needs {len(small):,} triangles: it was simplified too, to {target:,}")
        small, border_kept = simplify(small, target, keep_border=False, backend=params.backend), False
    if params.context.cell is not None:
        small = pulled_inside(small, params.context.cell.cell)
    if furniture is not None and len(furniture):
        small = with_furniture(small, furniture)
    small.save(out / "mesh.npz")
    metrics = {
        "faces_in": len(mesh),
        "faces": len(small),
        "target": target + len(furniture or ()),
        "border_kept": border_kept,
    }
    return Done({"mesh": out / "mesh.npz"}, metrics, warnings)


def with_furniture(mesh: Mesh, furniture: Mesh) -> Mesh:
    """Concatenate a mesh (class 0) and street furniture, whose faces keep their classes."""
    assert furniture.classification is not None
    return Mesh(
        mesh.frame,
        np.concatenate([mesh.vertices, furniture.vertices]),
        np.concatenate([mesh.faces, furniture.faces + len(mesh.vertices)]).astype(np.int32),
        classification=np.concatenate([np.zeros(len(mesh), np.uint8), furniture.classification]),
    )


def can_decimate(params: DecimateParams) -> None:
    """Check that the library can run on this machine.

    Raises:
        SettingError: there is no backend of that name.
        UnavailableError: it isn't installed.
    """
    from scan2sim.pipeline.decimation import find

    find(params.backend)


DECIMATE = Step(
    "decimate",
    5,
    decimate,
    DecimateParams,
    class_defaults={"vegetation": {"target": 300_000}, "vehicle": {"target": 50_000}},
    check=can_decimate,
    per_class=True,
    memory=(0.4, 30),
)

"""Decimate: fewer triangles, each class to its own target (D3.2, section 4.2)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from scan2sim.pipeline.step import Done, Inputs, Params, Report, Step

if TYPE_CHECKING:
    from scan2sim.pipeline.types import Mesh


class DecimateParams(Params):
    """How many triangles are left.

    Attributes:
        target: triangles; the mission's 100 K for terrain and buildings, 300 K for vegetation; 50 K for vehicles.
        keep_border: never thin the border, be there too many triangles; set by the recipe where tiles meet.
    """

    target: int = Field(100_000, ge=10_000, le=1_000_000)
    keep_border: bool = False


def decimate(inputs: Inputs, params: DecimateParams, out: Path, report: Report) -> Done:
    """Collapse edges of `mesh` down to the target, borders kept (tiles and classes meet there).

    What `furniture` (optional) holds is added as it is, within the target; its faces keep their classes, all others
    have the class 0 then.

    Where the border alone is more than the target allows, the border is thinned as well (but for `keep_border`),
    and a warning says so.
    """
    from scan2sim.pipeline.types import Mesh

    mesh = Mesh.load(inputs["mesh"])
    things = Mesh.load(inputs["furniture"]) if "furniture" in inputs else None
    target = params.target - len(things or ())
    small, warnings = simplify(mesh, target), []
    border_kept = True
    if len(small) > target * 1.05 and params.keep_border:
        warnings.append(f"the border alone needs {len(small):,} triangles, {params.target:,} were asked for: kept")
    elif len(small) > target * 1.05:
        warnings.append(f"the border alone needs {len(small):,} triangles: thinned too, to {params.target:,}")
        small, border_kept = simplify(small, target, preserve_border=False), False
    if things is not None and len(things):
        small = with_things(small, things)
    small.save(out / "mesh.npz")
    facts = {"faces_in": len(mesh), "faces": len(small), "target": params.target, "border_kept": border_kept}
    return Done({"mesh": out / "mesh.npz"}, facts, warnings)


def with_things(mesh: Mesh, things: Mesh) -> Mesh:
    """Both as one, the faces of `things` with their classes."""
    import numpy as np

    from scan2sim.pipeline.types import Mesh

    assert things.label is not None
    return Mesh(
        mesh.frame,
        np.concatenate([mesh.vertices, things.vertices]),
        np.concatenate([mesh.faces, things.faces + len(mesh.vertices)]).astype(np.int32),
        label=np.concatenate([np.zeros(len(mesh), np.uint8), things.label]),
    )


def simplify(mesh: Mesh, target: int, *, preserve_border: bool = True) -> Mesh:
    """Quadric edge collapse (Garland and Heckbert 1997) by pyfqmr, which refuses collapses that flip a face."""
    import numpy as np
    import pyfqmr

    from scan2sim.pipeline.types import Mesh

    if len(mesh) <= target:
        return Mesh(mesh.frame, mesh.vertices, mesh.faces)
    simplifier = pyfqmr.Simplify()
    simplifier.setMesh(mesh.vertices.astype(np.float64), mesh.faces)
    simplifier.simplify_mesh(target_count=target, aggressiveness=5, preserve_border=preserve_border, verbose=0)
    vertices, faces, _ = simplifier.getMesh()
    return Mesh(mesh.frame, vertices.astype(np.float32), faces.astype(np.int32)).keep(np.ones(len(faces), bool))


DECIMATE = Step(
    "decimate",
    2,
    decimate,
    DecimateParams,
    class_defaults={"vegetation": {"target": 300_000}, "vehicle": {"target": 50_000}},
    per_class=True,
    memory=(0.4, 30),
)

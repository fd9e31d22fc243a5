"""Decimate: fewer triangles, each class to its own target (D3.2, section 4.2)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Name
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Mesh


class DecimateParams(Params):
    """How many triangles are left.

    Attributes:
        target: triangles; the mission's 100 K for terrain and buildings, 300 K for vegetation; 50 K for vehicles.
        backend: "pyfqmr", "fast_simplification", "pymeshlab" or "open3d", which can't keep borders: the library that
            does it (`pipeline/decimation/`).
        keep_border: never thin the border, be there too many triangles; set by the recipe where tiles meet.
    """

    target: int = Field(100_000, ge=10_000, le=1_000_000)
    backend: Name = "pyfqmr"
    keep_border: bool = False


def decimate(inputs: Inputs, params: DecimateParams, out: Path, report: Report) -> Done:
    """Collapse edges of `mesh` down to the target, borders kept where the library can (tiles and classes meet there).

    What `furniture` (optional) holds is added as it is, within the target; its faces keep their classes, all others
    have the class 0 then.

    Where the border alone is more than the target allows, the border is thinned as well (but for `keep_border`),
    and a warning says so.

    Raises:
        SettingError, UnavailableError: as `can_decimate`.
    """
    from scan2sim.pipeline.decimation import find, simplify

    border_kept = find(params.backend, keep_border=params.keep_border).KEEPS_BORDER

    mesh = Mesh.load(inputs["mesh"])
    things = Mesh.load(inputs["furniture"]) if "furniture" in inputs else None
    target = params.target - len(things or ())
    small, warnings = simplify(mesh, target, keep_border=border_kept, backend=params.backend), []
    if len(small) > target * 1.05 and params.keep_border:
        warnings.append(f"the border alone needs {len(small):,} triangles, {params.target:,} were asked for: kept")
    elif len(small) > target * 1.05 and border_kept:
        warnings.append(f"the border alone needs {len(small):,} triangles: thinned too, to {params.target:,}")
        small, border_kept = simplify(small, target, keep_border=False, backend=params.backend), False
    if things is not None and len(things):
        small = with_things(small, things)
    small.save(out / "mesh.npz")
    facts = {"faces_in": len(mesh), "faces": len(small), "target": params.target, "border_kept": border_kept}
    return Done({"mesh": out / "mesh.npz"}, facts, warnings)


def with_things(mesh: Mesh, things: Mesh) -> Mesh:
    """Both as one, the faces of `things` with their classes."""
    assert things.classification is not None
    return Mesh(
        mesh.frame,
        np.concatenate([mesh.vertices, things.vertices]),
        np.concatenate([mesh.faces, things.faces + len(mesh.vertices)]).astype(np.int32),
        classification=np.concatenate([np.zeros(len(mesh), np.uint8), things.classification]),
    )


def can_decimate(params: DecimateParams) -> None:
    """Refuse a library that can't run here.

    Raises:
        SettingError: there is none of that name, or it can't keep borders where that is asked.
        UnavailableError: it isn't installed.
    """
    from scan2sim.pipeline.decimation import find

    find(params.backend, keep_border=params.keep_border)


DECIMATE = Step(
    "decimate",
    2,
    decimate,
    DecimateParams,
    class_defaults={"vegetation": {"target": 300_000}, "vehicle": {"target": 50_000}},
    check=can_decimate,
    per_class=True,
    memory=(0.4, 30),
)

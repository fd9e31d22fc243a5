"""Collision: one light mesh for physics, and how far it lies from what is seen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.classes import SURFACES
from scan2sim.pipeline.errors import DataError, StepError
from scan2sim.pipeline.ranges import Seed
from scan2sim.pipeline.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.steps.decimate import with_things
from scan2sim.pipeline.types import Mesh

SAMPLES = 100_000  # points at which the deviation is measured
MOST = 200_000  # triangles, whatever the borders need


class CollisionParams(Params):
    """What bodies collide with.

    Attributes:
        triangles: at most; physics engines stay interactive up to about 50 thousand.
        vegetation: whether plants are solid too.
        seed: of the points at which the deviation is measured.
        keep_border: never thin borders, be there too many triangles; set by the recipe where tiles meet.
    """

    triangles: int = Field(50_000, ge=100, le=MOST)
    vegetation: bool = False
    seed: Seed = 0
    keep_border: bool = False


def collision(inputs: Inputs, params: CollisionParams, out: Path, report: Report) -> Done:
    """Simplify `terrain`, `building` and `vehicle` (and `vegetation`, if asked) into one mesh.

    They are simplified together, so the budget goes where the error would be greatest. Borders are
    kept where the budget allows it (or always, with `keep_border`); if not, a warning says so.
    Street furniture (faces with a class) stays as it is, trunks too; where it would take more than half the budget, it
    is simplified with the rest.

    Raises:
        DataError: no mesh has a face.
        StepError: the budget can't be met; with `keep_border`, the borders alone need over 200,000 triangles.
    """
    from scan2sim.pipeline.decimation import simplify

    left_out = {"vegetation"} if not params.vegetation else set()
    groups = tuple(g for g in SURFACES if g not in left_out and (g in inputs or g != "vehicle"))
    whole = _joined(inputs, groups)
    source, things = _parted(whole, params.triangles)
    report(0.1, f"{len(whole):,} triangles")
    budget = params.triangles - len(things)
    small, warnings = simplify(source, budget), []
    border_kept = len(small) <= budget or params.keep_border
    if len(small) > budget and params.keep_border:
        warnings.append(f"collision: the borders alone need {len(small):,} triangles, kept since other tiles join them")
    elif not border_kept:
        warnings.append(f"collision: the borders alone need {len(small):,} triangles, so they were thinned too")
        small = simplify(small, budget, keep_border=False)
    small = replace(with_things(small, things), classification=None) if len(things) else small
    allowed = MOST if params.keep_border else params.triangles
    if len(small) > allowed:
        raise StepError(
            "collision",
            f"{len(small):,} triangles are left where {allowed:,} are allowed",
            "Raise collision.triangles, or remove small islands",
        )
    report(0.7, "deviation")
    apart = deviation(whole, small, params.seed)
    small.save(out / "collision.npz")
    facts = {
        "triangles_in": len(whole),
        "triangles": len(small),
        "border_kept": border_kept,
        "deviation_m": apart,
    }
    return Done({"mesh": out / "collision.npz"}, facts, warnings)


def _joined(inputs: Inputs, groups: tuple[str, ...]) -> Mesh:
    """The meshes of `groups` that there are, as one."""
    read = {group: Mesh.load(inputs[group]) for group in SURFACES if group in inputs}
    parts = [mesh if group in groups else _parted(mesh, MOST)[1] for group, mesh in read.items()]
    meshes = [mesh for mesh in parts if len(mesh)]
    if not meshes:
        raise DataError(
            "collision",
            f"there is no surface to collide with ({' and '.join(groups)} are empty)",
            "Check the cloud's classes, and voxel, poisson, trim, islands where set, or set collision.vegetation=true",
        )
    first = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    return Mesh(
        meshes[0].frame,
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first[:-1], strict=True)]).astype(np.int32),
        classification=np.concatenate(
            [np.zeros(len(m), np.uint8) if m.classification is None else m.classification for m in meshes]
        ),
    )


def _parted(mesh: Mesh, budget: int) -> tuple[Mesh, Mesh]:
    """The surface, and the street furniture that stays as it is: none where it would take over half the budget."""
    own = np.zeros(len(mesh), bool) if mesh.classification is None else mesh.classification > 0
    if own.sum() > budget / 2:
        own[:] = False
    return mesh.keep(~own), mesh.keep(own)


def deviation(source: Mesh, small: Mesh, seed: int) -> dict[str, float]:
    """Distances in metres from points of `source`, drawn evenly over its area, to `small`."""
    import open3d as o3d

    rng = np.random.default_rng(seed)
    area = source.face_area.astype(np.float64)
    face = rng.choice(len(source), SAMPLES, p=area / area.sum())
    r, s = np.sqrt(rng.random((SAMPLES, 1))), rng.random((SAMPLES, 1))
    a, b, c = np.moveaxis(source.corners[face], 1, 0)
    points = (1 - r) * a + r * (1 - s) * b + r * s * c  # uniform in a triangle: Osada et al. 2002
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(small.vertices), o3d.core.Tensor.from_numpy(small.faces.astype(np.uint32))
    )
    distance = scene.compute_distance(o3d.core.Tensor.from_numpy(points.astype(np.float32))).numpy()
    return {
        "mean": round(float(distance.mean()), 4),
        "p95": round(float(np.percentile(distance, 95)), 4),
        "max": round(float(distance.max()), 4),
    }


COLLISION = Step("collision", 2, collision, CollisionParams)

"""Split: the cloud by class into terrain, building and vegetation (D3.2, section 4.2)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from scan2sim.pipeline.classes import CLASSES, GROUPS, NOISE, group_of
from scan2sim.pipeline.errors import DataError
from scan2sim.pipeline.step import Done, Inputs, Params, Report, Step


class SplitParams(Params):
    """How the split is made.

    Attributes:
        vegetation: "mesh" (as the mission does), "locations" (each plant's place instead of a
            mesh), or "both".
    """

    vegetation: Literal["mesh", "locations", "both"] = "mesh"


def split(inputs: Inputs, params: SplitParams, out: Path, report: Report) -> Done:
    """Cut the classified `cloud` into `terrain`, `building`, `vegetation` and `rest`.

    Signs and poles go with buildings; vehicles, people, wires, noise and what has no class are
    left out of the surface (`rest`), though they still hide what is behind them; noise is dropped.

    Raises:
        DataError: no point belongs to any surface.
    """
    import numpy as np

    from scan2sim.pipeline.types import PointCloud

    cloud = PointCloud.load(inputs["cloud"])
    assert cloud.label is not None
    group = group_of()[cloud.label]
    files, counts, warnings = {}, {}, []
    for i, name in enumerate((*GROUPS, "rest")):
        report(i / 4, name)
        chosen = group == i if name != "rest" else (group == -1) & ~np.isin(cloud.label, NOISE)
        part = cloud.take(np.flatnonzero(chosen))
        part.save(out / f"{name}.npz")
        files[name] = out / f"{name}.npz"
        counts[name] = len(part)
        if name != "rest" and len(part) == 0:
            warnings.append(f"no point is of class {name}: the world will have none")
    if sum(counts[name] for name in GROUPS) == 0:
        raise DataError(
            "classes",
            "no point belongs to terrain, building or vegetation",
            "Check the cloud's classes, or classify it anew with --set segment.overwrite=true",
        )
    known = {c.code: c.name for c in CLASSES}
    codes, numbers = np.unique(cloud.label, return_counts=True)
    classes = {known.get(int(c), f"code_{c}"): int(n) for c, n in zip(codes, numbers, strict=True)}
    return Done(files, {"points_in": len(cloud), "points": counts, "classes": classes}, warnings)


SPLIT = Step("split", 1, split, SplitParams)

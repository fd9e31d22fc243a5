"""Origin: the world's origin, on the ground."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.simulation import ground_origin


def origin(inputs: Inputs, params: Params, out: Path, report: Report) -> Done:
    """The tile's own origin, moved to the height of the ground there (`collision`); without ground it stays.

    File `origin`: JSON, metres in the CRS. Metrics: `above_m`, height above the tile's own origin.
    """
    mesh = Mesh.load(inputs["collision"])
    x, y, z = mesh.frame.origin
    height = ground_origin.ground_height(mesh)
    ground_origin.save(out / "origin.json", (x, y, round(z + (height or 0.0), 2)))
    return Done({"origin": out / "origin.json"}, {"above_m": height})


ORIGIN = Step("origin", 1, origin, memory=(0.5, 2))

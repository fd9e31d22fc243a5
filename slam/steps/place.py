"""Place: poses of a video's frames become a trajectory: upright, in GPS's scale, where GPS says; in all formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.slam.mapping.map_file import Mapped
from scan2sim.slam.mapping.sparse_model import sparse_map
from scan2sim.slam.trajectory import output
from scan2sim.slam.trajectory.align import finish


class PlaceParams(Params):
    """What is made of the poses.

    Attributes:
        georeference: place the trajectory where GPS says; else GPS ties its scale alone.
        colmap: give the COLMAP model its points, too.
    """

    georeference: bool = True
    colmap: bool = False


def place(inputs: Inputs, params: PlaceParams, out: Path, report: Report) -> Done:
    """The trajectory of `mapped` as `trajectory.csv`, `.tum`, `.kitti`, `.geojson` where it is georeferenced."""
    mapped = Mapped.read(inputs["mapped"])
    trajectory, placing = finish(mapped, mapped.gps, georeference=params.georeference)
    folder = out / "path"
    sparse = sparse_map(mapped, placing, trajectory) if params.colmap else None
    output.write(folder, trajectory, placing.frame, camera=mapped.camera, names=mapped.names, sparse=sparse)
    assert trajectory.unsure is not None
    way = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    facts = {
        "length_m": round(float(way.sum()), 2),
        "unsure_share": round(float(trajectory.unsure.mean()), 4),
    }
    alone = "there is no GPS: lengths are in multiples of the first two keyframes' distance"
    return Done({"path": folder, "trajectory": folder / "trajectory.csv"}, facts, [] if mapped.gps else [alone])


PLACE = Step("place", 2, place, PlaceParams)

"""Step `georeference`: aligns a video's poses (upright, scaled by GPS, georeferenced) and writes the trajectory."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.global_map.sparse_model import sparse_map
from scan2sim.slam.trajectory import output
from scan2sim.slam.trajectory.align import aligned_trajectory


class GeoreferenceParams(Params):
    """Settings of the trajectory's alignment and output.

    Attributes:
        georeference: georeference the trajectory by GPS; otherwise GPS determines only its scale.
        colmap: write points and observations into the COLMAP model; otherwise it has only the poses.
    """

    georeference: bool = True
    colmap: bool = False


def georeference(inputs: Inputs, params: GeoreferenceParams, out: Path, report: Report) -> Done:
    """Write the trajectory of `map` as `trajectory.csv`, `.tum`, `.kitti`, and `.geojson` if georeferenced."""
    checkpoint = MapCheckpoint.read(inputs["map"])
    trajectory, alignment = aligned_trajectory(checkpoint, checkpoint.gps, georeference=params.georeference)
    folder = out / "path"
    sparse = sparse_map(checkpoint, alignment, trajectory) if params.colmap else None
    output.write(folder, trajectory, alignment.frame, camera=checkpoint.camera, names=checkpoint.names, sparse=sparse)
    assert trajectory.unsure is not None
    lengths = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    metrics = {
        "length_m": round(float(lengths.sum()), 2),
        "unsure_share": round(float(trajectory.unsure.mean()), 4),
    }
    unscaled = "without GPS the scale is unknown: the unit of length is the distance of the first two keyframes"
    warnings = [] if checkpoint.gps else [unscaled]
    return Done({"path": folder, "trajectory": folder / "trajectory.csv"}, metrics, warnings)


GEOREFERENCE = Step("georeference", 2, georeference, GeoreferenceParams)

"""Steps `read_nuscenes` and `read_pandaset`: sweeps, photos, calibration and poses of a data set's drive as files."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.importers.datasets import nuscenes, pandaset, recording
from scan2sim.pipeline.importers.datasets.nuscenes import NuScenesParams
from scan2sim.pipeline.importers.datasets.recording import DatasetParams, Recording


def read_nuscenes(inputs: Inputs, params: NuScenesParams, out: Path, report: Report) -> Done:
    """Read the tables (`scene`, `sample`, ...) and files of a scene.

    Raises:
        ScanError: as `pipeline.importers.datasets.nuscenes`.
    """
    found = nuscenes.find_scene(inputs["scene"].parent, params.scene)
    return _written(nuscenes.read_scene(found, params), nuscenes.read_sweep, out, report)


def read_pandaset(inputs: Inputs, params: DatasetParams, out: Path, report: Report) -> Done:
    """Read the folder `lidar` of a sequence, and those beside it.

    Raises:
        ScanError: as `pipeline.importers.datasets.pandaset`.
    """
    sequence = inputs["lidar"].parent
    return _written(pandaset.read_sequence(sequence, params), pandaset.sweep_reader(sequence), out, report)


def _written(drive: Recording, read: recording.ReadSweep, out: Path, report: Report) -> Done:
    return Done(recording.write(drive, read, out, report), drive.metrics(), list(drive.warnings))


READ_NUSCENES = Step("read_nuscenes", 1, read_nuscenes, NuScenesParams, memory=(1.0, 0))
READ_PANDASET = Step("read_pandaset", 1, read_pandaset, DatasetParams, memory=(1.0, 0))

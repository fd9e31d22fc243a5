"""Kinds of input: drives of data sets."""

from __future__ import annotations

import shutil
from pathlib import Path

from scan2sim.pipeline.importers.datasets import nuscenes, pandaset, recording
from scan2sim.pipeline.importers.datasets.nuscenes import NuScenesParams
from scan2sim.pipeline.importers.datasets.recording import DatasetParams
from tests.fakes.datasets import Drive, write_nuscenes, write_pandaset

DRIVE = Drive(sweeps=3)


def scene(folder: Path) -> list[Path]:
    """Writer of a scene of nuScenes: the tables and sweeps."""
    write_nuscenes(folder, DRIVE)
    return sorted((*folder.rglob("*.json"), *folder.rglob("*.bin")))


def read_scene(folder: Path) -> object:
    """Reader of the scene, which is written below the folder again."""
    found = nuscenes.find_scene(folder, "scene-0061")
    drive = nuscenes.read_scene(found, NuScenesParams(crs=found.crs("auto")))
    return recording.write(drive, nuscenes.read_sweep, _out(folder))


def sequence(folder: Path) -> list[Path]:
    """Writer of a sequence of PandaSet: all files but the photos."""
    write_pandaset(folder / "001", DRIVE)
    return sorted((*folder.rglob("*.json"), *folder.rglob("*.gz")))


def read_sequence(folder: Path) -> object:
    """Reader of the sequence, which is written below the folder again."""
    place = pandaset.find_sequence(folder / "001")
    drive = pandaset.read_sequence(place, DatasetParams())
    return recording.write(drive, pandaset.sweep_reader(place), _out(folder))


def _out(folder: Path) -> Path:
    shutil.rmtree(folder / "out", ignore_errors=True)
    (folder / "out").mkdir()
    return folder / "out"

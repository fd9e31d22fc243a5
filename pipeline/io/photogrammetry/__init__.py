"""Posed photos of other programs (COLMAP, OpenSfM, Metashape, Bundler, VisualSFM): a file a program.

A program's module has `read(model, photos) -> Model`: it alone knows the program's conventions. A `Model` has this
project's own: cameras as in `pipeline.core.types`, poses camera to model with OpenCV's axes. Where it lies on the Earth
comes from the program's own georeference (`Model.T_earth`), or from the photos' GPS
(`pipeline.importers.georeference`), or is unknown. `pipeline.importers.photogrammetry` makes tiles of models.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, U8, Camera
from scan2sim.pipeline.geometry.similarity import Similarity
from scan2sim.pipeline.importers.tile_folder import without_parents
from scan2sim.pipeline.io.images.image import SUFFIXES, size_of


@dataclass(frozen=True)
class Shot:
    """A posed photo: its file's name as the program has it, its camera's, `pose` (4, 4) camera to model."""

    file: str
    camera: str
    pose: F64


@dataclass(frozen=True)
class Model:
    """What a program has reconstructed.

    Attributes:
        cameras: by name.
        shots: photos that have a pose.
        xyz: (N, 3) sparse points, model coordinates.
        rgb: (N, 3) their colours, or None.
        T_earth: (4, 4) similarity from model coordinates to the Earth's (geocentric, WGS 84, metres), or None where
            the model isn't georeferenced.
        crs: projected CRS that the program names for it, or None.
        notes: what was left out, for the user.
    """

    cameras: dict[str, Camera]
    shots: tuple[Shot, ...]
    xyz: F64
    rgb: U8 | None = None
    T_earth: F64 | None = None
    crs: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def centres(self) -> F64:
        """(P, 3) of the photos, model coordinates."""
        return np.array([shot.pose[:3, 3] for shot in self.shots])

    def moved(self, onto: Similarity) -> Model:
        """The same photos and points after a similarity; its georeference is gone."""

        def pose(shot: Shot) -> F64:
            out = np.eye(4)
            out[:3, :3], out[:3, 3] = onto.rotation @ shot.pose[:3, :3], onto.apply(shot.pose[None, :3, 3])[0]
            return out

        shots = tuple(replace(shot, pose=pose(shot)) for shot in self.shots)
        return replace(self, shots=shots, xyz=onto.apply(self.xyz), T_earth=None)


class Photos:
    """The photos of a folder, found by the names that programs have for them: path, file name, or no suffix."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._names: dict[str, list[Path]] | None = None

    def find(self, name: str) -> Path:
        """The file of a photo.

        Raises:
            InputError: there is none, or more than one.
        """
        name = name.replace("\\", "/")
        path = self.folder / without_parents(name)
        if name and path.is_file():
            return path
        known = self._known()
        found = (
            known.get(Path(name).name.lower()) or known.get(Path(name).stem.lower()) or known.get(name.lower()) or []
        )
        if len(found) == 1:
            return found[0]
        if found:
            raise InputError(self.folder, f"has {len(found)} photos called {Path(name).name}", "Name a narrower folder")
        raise InputError(path, "is missing", "Put it there, or name the folder of the photos")

    def size(self, name: str) -> tuple[int, int]:
        """Width and height of a photo, pixels as they lie in the file."""
        return size_of(self.find(name))

    def _known(self) -> dict[str, list[Path]]:
        if self._names is None:
            self._names = defaultdict(list)
            for path in sorted(p for p in self.folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file()):
                self._names[path.name.lower()].append(path)
                self._names[path.stem.lower()].append(path)
        return self._names


class Program(Protocol):
    """What a program's module has."""

    def read(self, model: Path, photos: Photos) -> Model:
        """What it has reconstructed: a file or folder of its own; `photos` are asked for their sizes."""


def read(kind: str, model: Path, images: Path) -> Model:
    """What a program has reconstructed; `kind` is the name of one's file here.

    Raises:
        SettingError: there is no such program.
        UnavailableError: its files can't be read here.
        InputError: it can't be read, has no posed photo, or a camera that has no counterpart here.
    """
    program: Program = plugins.find(__name__, kind, "import")
    found = program.read(model, Photos(images))
    if not found.shots:
        raise InputError(model, "has no posed photo", "Name a finished reconstruction")
    for shot in found.shots:
        if not np.isfinite(shot.pose).all():
            raise InputError(model, f"the pose of {shot.file} is not finite", "Export it again without that photo")
    return found

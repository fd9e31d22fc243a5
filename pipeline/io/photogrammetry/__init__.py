"""Readers of photogrammetry models (COLMAP, OpenSfM, Metashape, nerfstudio, ...): one module per program.

A program's module has `read(model, photos) -> Model` and converts the program's conventions to this project's: cameras
as in `pipeline.core.types`, poses camera to model with OpenCV's axes. The georeference comes from the program
(`Model.T_earth`), or from the photos' GPS (`pipeline.importers.georeference`), or is unknown.
`pipeline.importers.photogrammetry` turns models into tiles.
"""

from __future__ import annotations

import unicodedata
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Protocol

import numpy as np

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, U8, Camera
from scan2sim.pipeline.geometry.similarity import Similarity
from scan2sim.pipeline.io.images.image import SUFFIXES, size_of
from scan2sim.pipeline.io.tile_folder import without_parents


@dataclass(frozen=True)
class Shot:
    """A posed photo.

    Attributes:
        file: file name as stored by the program.
        camera: name of its camera.
        pose: (4, 4) camera to model.
        mask: image that is 0 where the photo must not be used, or None.
        depth: depth image, see `pipeline.importers.depth_images`, or None.
    """

    file: str
    camera: str
    pose: F64
    mask: Path | None = None
    depth: Path | None = None


@dataclass(frozen=True)
class Model:
    """A reconstruction.

    Attributes:
        cameras: cameras by name.
        shots: photos that have a pose.
        xyz: (N, 3) points, model coordinates: sparse ones, or a cloud of the program.
        rgb: (N, 3) their colours, or None.
        T_earth: (4, 4) similarity from model coordinates to geocentric ones (metres), or None if the model isn't
            georeferenced.
        crs: projected CRS of the program's project, or None.
        notes: warnings for the user, such as photos that are left out.
        up: direction of the model that becomes +z if its CRS isn't known and the user gives none; None for +z.
        datum: geographic CRS (WKT) of the geocentric coordinates, degrees from Greenwich; None: WGS 84.
    """

    cameras: dict[str, Camera]
    shots: tuple[Shot, ...]
    xyz: F64
    rgb: U8 | None = None
    T_earth: F64 | None = None
    crs: str | None = None
    notes: tuple[str, ...] = ()
    up: tuple[float, float, float] | None = None
    datum: str | None = None

    @property
    def centres(self) -> F64:
        """Camera centres (P, 3) of the photos, model coordinates."""
        return np.array([shot.pose[:3, 3] for shot in self.shots])

    def transformed(self, onto: Similarity) -> Model:
        """The model transformed by a similarity, without its georeference."""

        def pose(shot: Shot) -> F64:
            out = np.eye(4)
            out[:3, :3], out[:3, 3] = onto.rotation @ shot.pose[:3, :3], onto.apply(shot.pose[None, :3, 3])[0]
            return out

        shots = tuple(replace(shot, pose=pose(shot)) for shot in self.shots)
        return replace(self, shots=shots, xyz=onto.apply(self.xyz), T_earth=None, up=None)


class Photos:
    """Photos in a folder, looked up by the names that programs store: path, file name, or name without suffix.

    Names may be of another computer: with backslashes, a drive's letter, in other case or Unicode form.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._names: dict[str, list[Path]] | None = None

    def find(self, name: str) -> Path:
        """The file of a photo.

        Raises:
            InputError: no photo of that name, or more than one.
        """
        name = name.replace("\\", "/")
        path = self.folder / without_parents(name)
        if name and path.is_file():
            return path
        known = self._by_name()
        parts = _key(name).split("/")
        found = known.get(parts[-1]) or known.get(_key(Path(name).stem)) or known.get(_key(name)) or []
        agreeing = [_agreement(parts, _key(file.relative_to(self.folder).as_posix()).split("/")) for file in found]
        best = [file for file, agreement in zip(found, agreeing, strict=True) if agreement == max(agreeing)]
        if len(best) == 1:
            return best[0]
        if best:
            raise InputError(self.folder, f"has {len(best)} photos named {Path(name).name}", "Give a narrower folder")
        raise InputError(path, "file not found", "Check the path, or give the folder of the photos")

    def size(self, name: str) -> tuple[int, int]:
        """Width and height of a photo in pixels, without applying the EXIF orientation."""
        return size_of(self.find(name))

    def _by_name(self) -> dict[str, list[Path]]:
        if self._names is None:
            self._names = defaultdict(list)
            for path in sorted(p for p in self.folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file()):
                self._names[_key(path.name)].append(path)
                self._names[_key(path.stem)].append(path)
        return self._names


def _key(name: str) -> str:
    """A name without its case and Unicode form."""
    return unicodedata.normalize("NFC", name).casefold()


def _agreement(given: Sequence[str], path: Sequence[str]) -> tuple[int, int]:
    """Number of equal parts at the end of two paths, and that of further parts of `path`, negative: few are better."""
    ends = zip(reversed(given), reversed(path), strict=False)
    equal = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], ends))
    return equal, equal - len(path)


class Program(Protocol):
    """Interface of a program's module."""

    def read(self, model: Path, photos: Photos) -> Model:
        """Read a reconstruction from a file or folder of the program; `photos` gives sizes of images."""


def read(kind: str, model: Path, images: Path) -> Model:
    """Read a reconstruction; `kind` is the name of a program's module in this package.

    Raises:
        SettingError: unknown program.
        UnavailableError: a package that reads its files isn't installed.
        InputError: it can't be read, has no posed photo, or a camera model that isn't supported.
    """
    program: Program = plugins.find(__name__, kind, "import")
    found = program.read(model, Photos(images))
    if not found.shots:
        raise InputError(model, "has no posed photo", "Give a finished reconstruction")
    for shot in found.shots:
        if not np.isfinite(shot.pose).all():
            raise InputError(model, f"the pose of {shot.file} is not finite", "Export it again without that photo")
    return found

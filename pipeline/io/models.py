"""Posed photos of other programs (COLMAP, OpenSfM, Metashape, Bundler, VisualSFM) as tiles.

A program's file is one module, found by its name, with `read(model, images) -> Model`: it alone knows the program's
conventions. A `Model` has this project's own: cameras as in `pipeline.types`, poses camera to model with OpenCV's
axes. Where it lies on the Earth comes from the program's own georeference (`Model.T_earth`), or from the photos' GPS
(`pipeline.io.photo_gps`), or is unknown.
"""

from __future__ import annotations

import importlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scan2sim.pipeline.errors import InputError, SettingError
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io import crs as crs_io
from scan2sim.pipeline.io import las, photo_gps
from scan2sim.pipeline.io.image import size_of
from scan2sim.pipeline.io.importing import place, tile_folder, without_parents
from scan2sim.pipeline.io.tile import read_tile, tile_name, write_tile
from scan2sim.pipeline.similarity import Similarity
from scan2sim.pipeline.step import Report, silent
from scan2sim.pipeline.types import F64, U8, Camera, Frame, PointCloud

FORMATS = ("colmap", "opensfm", "metashape", "bundler", "nvm")
PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
FAR = 500.0
"""Units between cloud and photos beyond which they are hardly of the same place."""
Up = tuple[float, float, float] | Literal["photos"]


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
            for path in sorted(p for p in self.folder.rglob("*") if p.suffix.lower() in PHOTOS and p.is_file()):
                self._names[path.name.lower()].append(path)
                self._names[path.stem.lower()].append(path)
        return self._names


def read(kind: str, model: Path, images: Path) -> Model:
    """What a program has reconstructed; `kind` is one of `FORMATS`.

    Raises:
        InputError: it can't be read, has no posed photo, or a camera that has no counterpart here.
    """
    found: Model = importlib.import_module(f"scan2sim.pipeline.io.{kind}").read(model, Photos(images))
    if not found.shots:
        raise InputError(model, "has no posed photo", "Name a finished reconstruction")
    for shot in found.shots:
        if not np.isfinite(shot.pose).all():
            raise InputError(model, f"the pose of {shot.file} is not finite", "Export it again without that photo")
    return found


def import_model(
    kind: str,
    model: Path,
    images: Path,
    out: Path,
    *,
    cloud: Path | None = None,
    crs: str | None = None,
    up: Up | None = None,
    scale: float = 1.0,
    gps: bool = False,
    link: bool = False,
    overwrite: bool = False,
    name: str | None = None,
    classes: Mapping[int, int] | None = None,
    warn: Callable[[str], None] = lambda _: None,
    report: Report = silent,
) -> Path:
    """Make a tile of a program's posed photos.

    Args:
        kind: one of `FORMATS`.
        model: the program's file or folder.
        images: folder of the photos.
        out: the tile's folder to make.
        cloud: point cloud; the model's own sparse points by default. One without a CRS is in the model's coordinates
            and moves with it; one with a CRS is where it is, and so must the model be.
        crs: to bring a georeferenced model to (default: the cloud's, the program's, or UTM); for others, the CRS that
            its coordinates are in already ("local" by default).
        up: direction of the model that becomes +z, or "photos" for the mean of the photos' up.
        scale: metres per unit of the model.
        gps: place it by the GPS positions in the photos' EXIF.
        link: link to the photos and the cloud instead of copying them.
        classes: codes of the cloud and what they are here, where they differ (`pipeline.classes`).
        warn: receives what was left out, assumed, and how well it fits.

    Returns:
        Path of the `tile.toml`.

    Raises:
        InputError: a file can't be read or is missing. SettingError: `out` is not empty, or options that contradict.
        DataError: GPS can't tell where it lies.
    """
    told = None if cloud is None else cloud_io.read_header(cloud)  # refuses what is no cloud
    found = read(kind, model, images)
    for note in found.notes:
        warn(f"{model}: {note}")
    if told is not None and told.crs and found.T_earth is None and (gps or up is not None or scale != 1.0):
        raise SettingError(
            "gps, up, scale", f"would move the photos away from {cloud}, which has a CRS", "Align model and cloud first"
        )
    files = [Photos(images).find(shot.file) for shot in found.shots] if gps else []
    own = crs_io.short(told.crs) if told is not None and told.crs else None
    onto, known = _onto(model, found, own, files, crs, up, scale, gps, warn)
    placed = found.moved(onto)
    photos = Photos(images)
    with tile_folder(out, overwrite) as folder:
        if cloud is None:
            las.write(folder / "cloud.laz", _sparse(model, placed, known))
            file = "cloud.laz"
        else:
            assert told is not None
            moving = _moving(cloud, told, found, onto, warn)
            file = _cloud(cloud, folder, onto if moving else None, known, link)
        entries: list[dict[str, Any]] = []
        for i, shot in enumerate(placed.shots):
            report(i / len(placed.shots), shot.file)
            source = photos.find(shot.file)
            entries.append(
                {
                    "file": place(source, folder, f"photos/{source.relative_to(images).as_posix()}", link),
                    "camera": shot.camera,
                    "position": shot.pose[:3, 3],
                    "rotation": shot.pose[:3, :3],
                }
            )
        used = {shot.camera for shot in placed.shots}
        cameras = {key: camera for key, camera in placed.cameras.items() if key in used}
        write_tile(
            folder, name=tile_name(name or Path(out).name), crs=known, clouds=[file], cameras=cameras, photos=entries,
            classes=classes,
        )  # fmt: skip
        read_tile(folder)  # what it refuses is refused here, before the tile appears
    report(1.0, "done")
    return Path(out) / "tile.toml"


def _onto(
    model: Path,
    found: Model,
    cloud_crs: str | None,
    files: Sequence[Path],
    crs: str | None,
    up: Up | None,
    scale: float,
    gps: bool,
    warn: Callable[[str], None],
) -> tuple[Similarity, str]:
    """From the model's coordinates to the tile's, and the tile's CRS."""
    if found.T_earth is not None:
        if gps or up is not None or scale != 1.0:
            raise SettingError("gps, up, scale", f"{model} says itself where it lies", "Leave them out")
        fit = photo_gps.by_earth(model, found.T_earth, found.centres, crs or cloud_crs or found.crs)
        for line in fit.told:
            warn(f"{model}: {line}")
        return fit.onto, fit.crs
    if gps:
        if up is not None or scale != 1.0:
            raise SettingError("up, scale", "GPS tells them", "Give either --gps or --upright and --scale")
        fit = photo_gps.by_photos(model, found.centres, _ups(found), files, crs)
        for line in fit.told:
            warn(f"{model}: {line}")
        return fit.onto, fit.crs
    return Similarity(scale, _upright(_ups(found), up), np.zeros(3)), crs or cloud_crs or crs_io.LOCAL


def _moving(cloud: Path, told: cloud_io.Header, found: Model, onto: Similarity, warn: Callable[[str], None]) -> bool:
    """Whether a cloud is in the model's coordinates, and moves with it, or is where the model is brought to."""
    middle = found.centres.mean(axis=0)
    inside_model, inside_crs = _gap(told, middle), _gap(told, onto.apply(middle[None])[0])
    moving = not told.crs and (found.T_earth is None or inside_model < inside_crs)
    if not told.crs and found.T_earth is not None:
        where = "the model's coordinates, and moves with it" if moving else "the CRS already"
        warn(f"{cloud}: has no CRS; by where the photos are, it is in {where}")
    gap = inside_model * onto.scale if moving else inside_crs
    if gap > FAR:
        warn(f"{cloud}: lies {gap:,.0f} units from the photos: are they in the same coordinates?")
    return moving


def _gap(told: cloud_io.Header, place: F64) -> float:
    """How far a place is from a cloud's bounding box."""
    return float(np.linalg.norm(np.maximum(0, np.maximum(told.low - place, place - told.high))))


def _ups(found: Model) -> F64:
    """(P, 3) up of the photos, model coordinates."""
    return np.array([-shot.pose[:3, 1] for shot in found.shots])


def _upright(ups: F64, up: Up | None) -> F64:
    """(3, 3) the smallest rotation that takes `up` to +z."""
    from scipy.spatial.transform import Rotation

    if up is None:
        return np.eye(3)
    direction = ups.mean(axis=0) if up == "photos" else np.array(up, np.float64)
    length = np.linalg.norm(direction)
    if not length > 1e-6:
        raise SettingError("up", f"{up} is no direction", "Give three numbers that are not all zero")
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(direction / length, z)
    sine, cosine = np.linalg.norm(axis), direction[2] / length
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix()


def _cloud(cloud: Path, folder: Path, onto: Similarity | None, crs: str, link: bool) -> str:
    """The name in the tile of a cloud: as it is, or, where it moves or its format isn't kept, written anew as LAZ."""
    stays = onto is None or (onto.scale == 1 and (onto.rotation == np.eye(3)).all() and not onto.translation.any())
    if stays and cloud.suffix.lower() in cloud_io.AS_THEY_ARE:
        return place(cloud, folder, f"cloud{cloud.suffix.lower()}", link)

    def parts() -> Iterator[PointCloud]:
        for part in cloud_io.chunks(cloud, Frame(crs)):
            xyz = part.frame.to_crs(part.xyz)
            yield _local(crs, xyz if onto is None else onto.apply(xyz), part)

    las.write_parts(folder / "cloud.laz", parts(), software="")  # its classes are the survey's still
    return "cloud.laz"


def _sparse(model: Path, placed: Model, crs: str) -> PointCloud:
    if not len(placed.xyz):
        raise InputError(model, "has no 3D points", "Give a cloud")
    return _local(crs, placed.xyz, PointCloud(Frame(), np.empty((0, 3), np.float32), placed.rgb))


def _local(crs: str, xyz: F64, like: PointCloud) -> PointCloud:
    """CRS coordinates with the attributes of `like`, to be written at once: in the CRS's units, not metres."""
    origin = np.floor(np.median(xyz, axis=0)).tolist()
    frame = Frame(crs, (origin[0], origin[1], origin[2]))
    return replace(like, frame=frame, xyz=frame.to_local(xyz).astype(np.float32), normal=None)

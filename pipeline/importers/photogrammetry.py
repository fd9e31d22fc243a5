"""Tiles of other programs' posed photos (`pipeline.io.photogrammetry`): in a CRS, with a cloud, upright, in metres."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, Frame, PointCloud
from scan2sim.pipeline.geometry.similarity import Similarity
from scan2sim.pipeline.importers import georeference
from scan2sim.pipeline.importers.tile_folder import place, tile_folder
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.photogrammetry import Model, Photos, read
from scan2sim.pipeline.io.tile import read_tile, tile_name, write_tile

FAR = 500.0
"""Units between cloud and photos beyond which they are hardly of the same place."""
Up = tuple[float, float, float] | Literal["photos"]


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
        kind: the program, as `pipeline.io.photogrammetry` names it.
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
        classes: codes of the cloud and what they are here, where they differ (`pipeline.core.classes`).
        warn: receives what was left out, assumed, and how well it fits.

    Returns:
        Path of the `tile.toml`.

    Raises:
        InputError: a file can't be read or is missing. SettingError: `out` is not empty, or options that contradict.
        DataError: GPS can't tell where it lies.
    """
    header = None if cloud is None else cloud_io.read_header(cloud)  # refuses what is no cloud
    found = read(kind, model, images)
    for note in found.notes:
        warn(f"{model}: {note}")
    if header is not None and header.crs and found.T_earth is None and (gps or up is not None or scale != 1.0):
        raise SettingError(
            "gps, up, scale", f"would move the photos away from {cloud}, which has a CRS", "Align model and cloud first"
        )
    files = [Photos(images).find(shot.file) for shot in found.shots] if gps else []
    own = crs_io.short(header.crs) if header is not None and header.crs else None
    onto, known = _onto(model, found, own, files, crs, up, scale, gps, warn)
    placed = found.moved(onto)
    photos = Photos(images)
    with tile_folder(out, overwrite) as folder:
        if cloud is None:
            las.write(folder / "cloud.laz", _sparse(model, placed, known))
            file = "cloud.laz"
        else:
            assert header is not None
            moving = _moving(cloud, header, found, onto, warn)
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
        fit = georeference.by_earth(model, found.T_earth, found.centres, crs or cloud_crs or found.crs)
        for line in fit.notes:
            warn(f"{model}: {line}")
        return fit.onto, fit.crs
    if gps:
        if up is not None or scale != 1.0:
            raise SettingError("up, scale", "GPS tells them", "Give either --gps or --upright and --scale")
        fit = georeference.by_photos(model, found.centres, _ups(found), files, crs)
        for line in fit.notes:
            warn(f"{model}: {line}")
        return fit.onto, fit.crs
    return Similarity(scale, _upright(_ups(found), up), np.zeros(3)), crs or cloud_crs or crs_io.LOCAL


def _moving(cloud: Path, header: cloud_io.Header, found: Model, onto: Similarity, warn: Callable[[str], None]) -> bool:
    """Whether a cloud is in the model's coordinates, and moves with it, or is where the model is brought to."""
    middle = found.centres.mean(axis=0)
    inside_model, inside_crs = _gap(header, middle), _gap(header, onto.apply(middle[None])[0])
    moving = not header.crs and (found.T_earth is None or inside_model < inside_crs)
    if not header.crs and found.T_earth is not None:
        where = "the model's coordinates, and moves with it" if moving else "the CRS already"
        warn(f"{cloud}: has no CRS; by where the photos are, it is in {where}")
    gap = inside_model * onto.scale if moving else inside_crs
    if gap > FAR:
        warn(f"{cloud}: lies {gap:,.0f} units from the photos: are they in the same coordinates?")
    return moving


def _gap(header: cloud_io.Header, place: F64) -> float:
    """How far a place is from a cloud's bounding box."""
    return float(np.linalg.norm(np.maximum(0, np.maximum(header.low - place, place - header.high))))


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

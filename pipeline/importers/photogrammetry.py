"""Importer of photogrammetry models (`pipeline.io.photogrammetry`): georeferences or scales them, adds a cloud."""

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
from scan2sim.pipeline.importers import depth_images, georeference
from scan2sim.pipeline.importers.photo_fit import fitted_cameras
from scan2sim.pipeline.importers.photo_up import up_of_photos
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.photogrammetry import Model, Photos, read
from scan2sim.pipeline.io.tile import read_tile, tile_name, write_tile
from scan2sim.pipeline.io.tile_folder import add_file, names_in, tile_folder

MAX_CLOUD_DISTANCE = 500.0
"""CRS units between cloud and photos above which a warning suggests that their coordinates differ."""
ARBITRARY_AXES = ("colmap", "bundler", "nvm")
"""Programs whose models have any axes and unit, unless they were aligned."""
Up = tuple[float, float, float] | Literal["photos"]


def import_model(
    kind: str,
    model: Path,
    images: Path | None,
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
    """Create a tile from a photogrammetry model.

    Args:
        kind: the program, a module name of `pipeline.io.photogrammetry`.
        model: the program's file or folder.
        images: folder of the photos; default: that of the model.
        out: folder of the tile to create.
        cloud: point cloud; default: the model's points, or those of its depth images. A cloud without a CRS is in the
            model's coordinates and is transformed with it; a cloud with a CRS stays, and the model must fit it.
        crs: target CRS of a georeferenced model (default: the cloud's, the program's, or UTM); for other models, the
            CRS of their coordinates (default: "local").
        up: direction of the model that becomes +z, or "photos" for that by which the photos were held (`photo_up`);
            default: the model's own, if its CRS isn't known.
        scale: metres per unit of the model.
        gps: georeference the model by the GPS positions in the photos' EXIF.
        link: symlink photos and cloud instead of copying them.
        overwrite: replace an existing tile.
        name: name of the tile; default: that of its folder.
        classes: mapping of class codes of the cloud to those of `pipeline.core.classes`, where they differ.
        warn: receives assumptions, omissions and the accuracy of the georeference.
        report: receives progress.

    Returns:
        Path of the `tile.toml`.

    Raises:
        InputError: a file is missing or can't be read. SettingError: `out` is not empty, or options are contradictory.
        DataError: the GPS is insufficient to georeference the model.
    """
    header = None if cloud is None else cloud_io.read_header(cloud)  # fails early if it isn't a cloud
    for note in (*header.notes, *cloud_io.flag_notes(cloud)) if cloud is not None and header is not None else ():
        warn(f"{cloud}: {note}")
    images = images or (model if model.is_dir() else model.parent)
    found = read(kind, model, images)
    for note in found.notes:
        warn(f"{model}: {note}")
    if header is not None and header.crs and found.T_earth is None and (gps or up is not None or scale != 1.0):
        raise SettingError(
            "gps, up, scale",
            f"would move the photos relative to {cloud}, which has a CRS",
            "Align model and cloud first",
        )
    photos = Photos(images)
    files = [photos.find(shot.file) for shot in found.shots] if gps else []
    cloud_crs = crs_io.short(header.crs) if header is not None and header.crs else None
    onto, tile_crs = _model_to_tile(model, found, cloud_crs, files, crs, up, scale, gps, warn)
    if kind in ARBITRARY_AXES and tile_crs == crs_io.LOCAL and crs is None:
        for unknown in _unknown(up, scale):
            warn(f"{model}: {unknown}; --crs local confirms it")
    if cloud is None and not len(found.xyz) and any(shot.depth for shot in found.shots):
        xyz, rgb = depth_images.fuse(found, photos, warn, report)
        found = replace(found, xyz=xyz, rgb=rgb)
    placed = found.transformed(onto)
    with tile_folder(out, overwrite) as folder:
        if cloud is None:
            las.write(folder / "cloud.laz", _sparse(model, placed, tile_crs))
            file = "cloud.laz"
        else:
            assert header is not None
            in_model = _in_model_coordinates(cloud, header, found, onto, warn)
            file = _add_cloud(cloud, folder, onto if in_model else None, tile_crs, link)
        entries: list[dict[str, Any]] = []
        masks: dict[Path, str] = {}
        sources = [photos.find(shot.file) for shot in placed.shots]
        names = names_in("photos", sources, images)
        camera_names, cameras = fitted_cameras(sources, [shot.camera for shot in placed.shots], placed.cameras, warn)
        for i, (shot, source, photo_name) in enumerate(zip(placed.shots, sources, names, strict=True)):
            report(i / len(placed.shots), shot.file)
            if shot.mask is not None and shot.mask not in masks:  # several photos may share one
                masks[shot.mask] = add_file(shot.mask, folder, f"masks/{len(masks)}/{shot.mask.name}", link)
            entries.append(
                {
                    "file": add_file(source, folder, photo_name, link),
                    "camera": camera_names[i],
                    "position": shot.pose[:3, 3],
                    "rotation": shot.pose[:3, :3],
                    "mask": masks[shot.mask] if shot.mask is not None else None,
                }
            )
        cameras = {key: camera for key, camera in cameras.items() if key in camera_names}
        write_tile(
            folder, name=tile_name(name or Path(out).name), crs=tile_crs, clouds=[file], cameras=cameras,
            photos=entries, classes=classes,
        )  # fmt: skip
        read_tile(folder)  # an invalid tile is an error here, before its folder appears
    report(1.0, "done")
    return Path(out) / "tile.toml"


def _model_to_tile(
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
    """Similarity from model to tile coordinates, and the tile's CRS."""
    if found.T_earth is not None:
        if gps or up is not None or scale != 1.0:
            raise SettingError("gps, up, scale", f"{model} is already georeferenced", "Leave these options out")
        target = crs or cloud_crs or found.crs
        fit = georeference.from_geocentric(model, found.T_earth, found.centres, target, found.datum)
        for line in fit.notes:
            warn(f"{model}: {line}")
        return fit.onto, fit.crs
    if gps:
        if up is not None or scale != 1.0:
            raise SettingError("up, scale", "are determined by GPS", "Give either --gps, or --upright and --scale")
        fit = georeference.from_photo_gps(model, found.centres, _ups(found), files, crs)
        for line in fit.notes:
            warn(f"{model}: {line}")
        return fit.onto, fit.crs
    known = crs or cloud_crs or found.crs or crs_io.LOCAL
    if up is None and known == crs_io.LOCAL:
        up = found.up
    return Similarity(scale, _upright(found, up), np.zeros(3)), known


def _unknown(up: Up | None, scale: float) -> Iterator[str]:
    """What is assumed of a model without a georeference."""
    if up is None:
        yield "doesn't say which axis is up: z is assumed (--upright finds it from the photos)"
    if scale == 1.0:
        yield "doesn't say its unit: metres are assumed (--scale, or --gps, determines it)"


def _in_model_coordinates(
    cloud: Path, header: cloud_io.Header, found: Model, onto: Similarity, warn: Callable[[str], None]
) -> bool:
    """Whether a cloud is in model coordinates, and must be transformed with the model, or already in the tile's CRS."""
    middle = found.centres.mean(axis=0)
    distance_model = _distance_to_box(header, middle)
    distance_crs = _distance_to_box(header, onto.apply(middle[None])[0])
    in_model = not header.crs and (found.T_earth is None or distance_model < distance_crs)
    if not header.crs and found.T_earth is not None:
        coordinates = "model coordinates, and is transformed with the model" if in_model else "the CRS already"
        warn(f"{cloud}: has no CRS; judging by the photos' positions, it is in {coordinates}")
    distance = distance_model * onto.scale if in_model else distance_crs
    if distance > MAX_CLOUD_DISTANCE:
        warn(f"{cloud}: is {distance:,.0f} units away from the photos: check that both are in the same coordinates")
    return in_model


def _distance_to_box(header: cloud_io.Header, position: F64) -> float:
    """Distance of a position from a cloud's bounding box."""
    return float(np.linalg.norm(np.maximum(0, np.maximum(header.low - position, position - header.high))))


def _ups(found: Model) -> F64:
    """Up directions (P, 3) of the photos, model coordinates."""
    return np.array([-shot.pose[:3, 1] for shot in found.shots])


def _upright(found: Model, up: Up | None) -> F64:
    """Smallest rotation (3, 3) that maps `up` to +z."""
    from scipy.spatial.transform import Rotation

    if up is None:
        return np.eye(3)
    rotations = np.array([shot.pose[:3, :3] for shot in found.shots])
    direction = up_of_photos(rotations) if up == "photos" else np.array(up, np.float64)
    length = np.linalg.norm(direction)
    if not length > 1e-6:
        raise SettingError("up", f"{up} is not a direction", "Give three numbers that are not all zero")
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(direction / length, z)
    sine, cosine = np.linalg.norm(axis), direction[2] / length
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix()


def _add_cloud(cloud: Path, folder: Path, onto: Similarity | None, crs: str, link: bool) -> str:
    """Copy or link a cloud into the tile, or transform it and convert it to LAZ; returns its name there."""
    unchanged = onto is None or (onto.scale == 1 and (onto.rotation == np.eye(3)).all() and not onto.translation.any())
    if unchanged and cloud.suffix.lower() in cloud_io.COPIED_SUFFIXES:
        return add_file(cloud, folder, f"cloud{cloud.suffix.lower()}", link)

    def parts() -> Iterator[PointCloud]:
        for part in cloud_io.chunks(cloud, Frame(crs)):
            xyz = part.frame.to_crs(part.xyz)
            yield _local(crs, xyz if onto is None else onto.apply(xyz), part)

    las.write_parts(folder / "cloud.laz", parts(), software="")  # class codes stay those of the survey
    return "cloud.laz"


def _sparse(model: Path, placed: Model, crs: str) -> PointCloud:
    if not len(placed.xyz):
        raise InputError(model, "has no 3D points", "Give a cloud")
    return _local(crs, placed.xyz, PointCloud(Frame(), np.empty((0, 3), np.float32), placed.rgb))


def _local(crs: str, xyz: F64, like: PointCloud) -> PointCloud:
    """A cloud from CRS coordinates with the attributes of `like`; its unit is that of the CRS, for writing only."""
    origin = np.floor(np.median(xyz, axis=0)).tolist()
    frame = Frame(crs, (origin[0], origin[1], origin[2]))
    return replace(like, frame=frame, xyz=frame.to_local(xyz).astype(np.float32), normal=None)

"""Importer of a textured mesh (ODM, Metashape, RealityCapture, RTAB-Map, Polycam, ...): OBJ, glTF, PLY with faces.

The mesh becomes level, z up and in metres, as a robot's map does (`pipeline.importers.robot_map`). Points sampled from
its surface are the tile's cloud, from which the classes follow; the mesh itself is kept as the tile's `source_mesh`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32, F64, I32, Frame, Mesh, PointCloud
from scan2sim.pipeline.geometry.height_map import exact_point_spacing
from scan2sim.pipeline.geometry.upright import rotation_to_z
from scan2sim.pipeline.importers.robot_map import (
    AXES,
    MIN_TILT_DEG,
    MapParams,
    check_height,
    level_rotation,
    unit_of,
    write_map,
)
from scan2sim.pipeline.io.tile_folder import tile_folder
from scan2sim.pipeline.robot_maps.describe import describe

if TYPE_CHECKING:
    from scan2sim.pipeline.io.source_mesh import SourceMesh

SPACING_M = 0.04
"""Spacing of the sampled points: finer than the 10 cm voxels of the steps ..."""
POINTS = (20_000, 2_000_000)
"""... if their number is in this range."""
MIN_AREA_M2 = 0.5
UNIT_SAMPLES = 200_000
"""Points from which the unit is guessed, and that are inspected."""
OPEN_SURFACE_SHARE = 0.2
"""Net share of level surface that faces down from which the surface is inside out."""
SOURCE = "source_mesh.npz"
"""Name of the mesh's file in the tile."""


def import_mesh(
    path: Path,
    out: Path,
    params: MapParams,
    *,
    trajectory: Path | None = None,
    name: str | None = None,
    overwrite: bool = False,
    warn: Callable[[str], None] = lambda _: None,
    report: Report = silent,
) -> Path:
    """Create a tile from a textured mesh.

    Args:
        path: the mesh; materials and textures are found beside it.
        out: folder of the tile to create.
        params: settings; glTF is in metres and y up by its specification, unless they say otherwise.
        trajectory: path of the sensor in the mesh's frame and unit (.csv, .tum, .kitti), or None.
        name: name of the tile; default: that of its folder.
        overwrite: replace an existing tile.
        warn: receives what was assumed, found and removed.
        report: receives progress.

    Returns:
        Path of the `tile.toml`.

    Raises:
        InputError: the mesh is missing, damaged or has no faces. SettingError: `out` is not empty.
        DataError: it is too small to be a world.
    """
    from scan2sim.pipeline.io.mesh_models import read

    report(0.0, "reading")
    source, notes = read(path)
    for note in notes:
        warn(note)
    guessed = params.units == "auto"
    if guessed and is_gltf(path):
        params = params.model_copy(update={"units": "m"})
    some = surface_points(source.mesh).xyz
    unit = unit_of(some, exact_point_spacing(some), params, warn)
    origin = unit * np.asarray(source.mesh.frame.origin)
    mesh = replace(source.mesh, vertices=source.mesh.vertices * np.float32(unit))
    area = float(mesh.face_area.sum(dtype=np.float64))
    if not area > MIN_AREA_M2:
        cause = f"has a surface of only {area:.2g} m2 if its unit is {unit:g} m"
        raise DataError(path, cause, "Name the unit with --units")
    report(0.4, "up axis")
    face, weights = sample(mesh, int(np.clip(area / SPACING_M**2, *POINTS)))
    points = _positions(mesh, face, weights)
    R = _rotation(points, params, origin, usual_rotation(path), warn)
    x, y, z = (R @ origin).tolist()
    frame = Frame(origin=(x, y, z))
    mesh = replace(mesh, frame=frame, vertices=mesh.vertices @ R.T.astype(np.float32))
    source = _facing_out(replace(source, mesh=mesh), warn)
    report(0.6, "colours")
    rgb = _colours(source, face, weights, warn)
    cloud = PointCloud(frame, points @ R.T.astype(np.float32), rgb)
    if guessed:
        check_height(cloud.xyz, warn)
    report(0.7, "description")
    found = describe(cloud.xyz, -np.asarray(frame.origin))
    scene = found.scene if params.scene == "auto" else params.scene
    if params.scene == "auto":
        warn(f"the mesh is assumed to be {scene} (--scene)")
    T_world_map = np.eye(4)
    T_world_map[:3, :3] = R
    about = {"scene": scene, "spacing": round(found.spacing, 4), "unit": unit, "source_mesh": SOURCE}
    report(0.9, "writing")
    with tile_folder(out, overwrite) as folder:
        source.save(folder / SOURCE)
        write_map(folder, name or Path(out).name, cloud, None, about, T_world_map, trajectory)
    report(1.0, "done")
    return Path(out) / "tile.toml"


def sample(mesh: Mesh, count: int, seed: int = 0) -> tuple[I32, F32]:
    """Points evenly spread over the surface: face (N,) and barycentric weights (N, 2) of its second and third corner.

    Every face gets its share of the points, within one point.
    """
    random = np.random.default_rng(seed)
    area = np.cumsum(mesh.face_area, dtype=np.float64)
    at = (np.arange(count) + random.uniform(size=count)) / count * area[-1]
    face = np.searchsorted(area, at, side="right").clip(max=len(mesh) - 1).astype(np.int32)
    u, v = np.sqrt(random.uniform(size=count)), random.uniform(size=count)
    return face, np.column_stack([u * (1 - v), u * v]).astype(np.float32)


def surface_points(mesh: Mesh) -> PointCloud:
    """`UNIT_SAMPLES` points of a mesh's surface, in its own unit."""
    return PointCloud(mesh.frame, _positions(mesh, *sample(mesh, UNIT_SAMPLES)))


def _positions(mesh: Mesh, face: I32, weights: F32) -> F32:
    a, b, c = np.moveaxis(mesh.corners[face], 1, 0)
    return np.asarray(a + weights[:, :1] * (b - a) + weights[:, 1:] * (c - a), np.float32)


def is_gltf(path: Path) -> bool:
    """Whether a mesh is glTF, by its suffix: in metres and y up by its specification."""
    return path.suffix.lower() in (".glb", ".gltf")


def usual_rotation(path: Path) -> F64:
    """(3, 3) rotation to z up by the specification of a mesh's format; surfaces may prove otherwise."""
    return rotation_to_z(np.array(AXES["y" if is_gltf(path) else "z"], np.float64))


def _rotation(points: F32, params: MapParams, origin: F64, usual: F64, warn: Callable[[str], None]) -> F64:
    """(3, 3) rotation to a level world; exactly along an axis of the mesh if it is closer than `MIN_TILT_DEG`."""
    R = level_rotation(points, params, origin, warn, usual)
    up = np.zeros(3)
    axis = int(np.abs(R[2]).argmax())
    up[axis] = np.sign(R[2, axis])
    return rotation_to_z(up) if np.abs(R[2, axis]) > np.cos(np.radians(MIN_TILT_DEG)) else R


def _facing_out(source: SourceMesh, warn: Callable[[str], None]) -> SourceMesh:
    """The mesh with its faces turned around if its level surfaces face down: an open surface such as terrain."""
    mesh = source.mesh
    up = mesh.face_normal[:, 2] * mesh.face_area
    if up.sum(dtype=np.float64) > -OPEN_SURFACE_SHARE * np.abs(up).sum(dtype=np.float64):
        return source
    warn("the surface faces down: its triangles are turned around")
    assert mesh.uv is not None
    turned = replace(mesh, faces=np.ascontiguousarray(mesh.faces[:, ::-1]), uv=np.ascontiguousarray(mesh.uv[:, ::-1]))
    return replace(source, mesh=turned, colour=np.ascontiguousarray(source.colour[:, ::-1]))


def _colours(source: SourceMesh, face: I32, weights: F32, warn: Callable[[str], None]) -> np.ndarray | None:
    """(N, 3) uint8 colours of the points; None if no face has a colour."""
    share = float(np.average(source.coloured, weights=source.mesh.face_area))
    if share == 0:
        warn("the mesh has neither a texture nor colours: its surfaces are coloured by class")
        return None
    return source.colours(face, weights[:, 0].copy(), weights[:, 1].copy())

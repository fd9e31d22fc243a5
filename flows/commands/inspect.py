"""`scan2sim inspect`: prints a summary of a cloud, folder of clouds, tile, mesh, world, trajectory or bag."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.markup import escape
from rich.table import Table

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.display import console
from scan2sim.flows.commands.inspect_bag import show_bag
from scan2sim.flows.commands.inspect_map import Facts, colour_fact, folder_of_clouds, map_facts, mesh_facts
from scan2sim.pipeline.core.classes import name_of
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Frame, Tile
from scan2sim.pipeline.importers.bag.reader import is_bag
from scan2sim.pipeline.io import clouds, file_checks, foreign_files, sbet, trajectory, xml
from scan2sim.pipeline.io.geodata.crs import name as crs_name
from scan2sim.pipeline.io.mesh_files import find_mesh, is_mesh
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.plausibility.check import find_implausible
from scan2sim.pipeline.pose_check.check import find_mistake

app = App()
MAX_MATERIALS = 20
"""Materials of a mesh that are listed."""


@app.command()
def inspect(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="PATH", help="A point cloud, folder of clouds, tile, mesh, world, trajectory or ROS bag."
        ),
    ],
    urdf: Annotated[
        Path | None, typer.Option(help="URDF file of the robot, whose fixed joints the import of a ROS bag would use.")
    ] = None,
) -> None:
    """Show a summary of a point cloud, a folder of clouds, a tile, a mesh, a world, a trajectory or a ROS bag."""
    inspect_path(path, urdf)


def inspect_path(path: Path, urdf: Path | None = None) -> None:
    """Print a summary of `path`; `urdf`: of the robot that recorded a bag.

    Raises:
        InputError: it doesn't exist, or is of an unknown kind.
    """
    if is_bag(path) and not any((path / name).exists() for name in ("ept.json", "tile.toml", "world")):
        show_bag(path, urdf)
        return
    kind, facts = _reader(path)(path)
    table = Table(
        show_header=False, box=None, title=escape(f"{kind}: {path}"), title_justify="left", title_style="bold"
    )
    for name, value in facts:
        table.add_row(name, escape(value))
    console.print(table, highlight=False)


def _reader(path: Path) -> Callable[[Path], tuple[str, Facts]]:
    if path.is_dir():
        if (path / "ept.json").is_file():
            return lambda p: _cloud(p / "ept.json")
        if (path / "tile.toml").is_file():
            return _tile
        if (path / "world").is_dir():
            return lambda p: _world(_sdf(p / "world"))
        if any(path.glob("*.sdf")):
            return lambda p: _world(_sdf(p))
        if (mesh := find_mesh(path)) is not None:
            return lambda _: _mesh(mesh)
        if any(clouds.is_cloud(file) for file in file_checks.files(path)):
            return folder_of_clouds
        raise InputError(
            path,
            "contains neither a tile.toml, nor a world, a mesh or clouds",
            "Name a cloud, a tile (or one of a survey), a mesh, a world, a trajectory or a ROS bag",
        )
    file_checks.check(path, "Check the path")
    readers = {
        **dict.fromkeys(clouds.formats(), _cloud), ".toml": _tile, ".sdf": _world, ".npz": _result,
        ".obj": _mesh, ".dae": _mesh, ".glb": _mesh, ".gltf": _mesh, ".ply": _ply,
    }  # fmt: skip
    if path.name in readers:
        return readers[path.name]
    if sbet.is_sbet(path):
        return _sbet
    if trajectory.is_trajectory(path):
        return _trajectory
    if path.suffix.lower() not in readers:
        cause = f"has an unknown file type ({path.suffix or 'no suffix'})"
        raise foreign_files.unread(path, cause, f"Known: {' '.join(readers)}")
    return readers[path.suffix.lower()]


def _bounds(low: object, high: object) -> str:
    size = np.asarray(high) - np.asarray(low)
    return " x ".join(f"{v:,.2f}" for v in size) + "   from " + ", ".join(f"{v:,.2f}" for v in np.asarray(low))


def _cloud(path: Path) -> tuple[str, Facts]:
    header = clouds.read_header(path)
    low = tuple(np.floor(header.low).tolist())
    cloud = clouds.read(path, Frame(origin=low))
    area = float(np.prod(np.maximum((header.high - header.low)[:2], 1e-3)))
    facts = [
        ("points", f"{header.count:,}"),
        ("CRS", crs_name(header.crs)),
        ("extent", _bounds(header.low, header.high)),
        ("density", f"{header.count / area:,.1f} per square unit of its bounding box"),
        ("colours", colour_fact(cloud)),
        *(("warning", note) for note in (*header.notes, *clouds.flag_notes(path))),
    ]
    if header.crs is None:
        facts += map_facts(cloud)
    if cloud.time is not None and len(cloud):
        facts.append(("GPS time", f"{cloud.time.min():.3f} to {cloud.time.max():.3f} s"))
    if cloud.classification is not None:
        table = clouds.code_table(path, {})
        codes, counts = np.unique(cloud.classification, return_counts=True)
        facts += [
            (
                "classes" if i == 0 else "",
                f"{code:3d} {name_of(int(table[code])):<16}{count:>14,}  {count / len(cloud):6.1%}",
            )
            for i, (code, count) in enumerate(zip(codes.tolist(), counts.tolist(), strict=True))
        ]
    return "cloud", facts


def _sbet(path: Path) -> tuple[str, Facts]:
    found = sbet.describe(path)
    facts: Facts = [
        ("records", f"{found.records:,} at {found.rate_hz:.0f} Hz"),
        ("times", f"{found.times[0]:,.1f} to {found.times[1]:,.1f} s"),
        *(
            (name, f"{low:.{digits}f} to {high:.{digits}f}")
            for name, (low, high), digits in (
                ("latitude", found.latitude, 6), ("longitude", found.longitude, 6), ("height", found.height, 1),
            )
        ),
        ("use", "the scanner's path: `import clouds CLOUD --trajectory` or `import sweeps SWEEPS`"),
    ]  # fmt: skip
    return "SBET trajectory", facts


def _trajectory(path: Path) -> tuple[str, Facts]:
    try:
        found, timed = trajectory.read(path, timed=True), True
    except InputError:
        found, timed = trajectory.read(path), False
    span = float(found.times[-1] - found.times[0])
    length = float(np.linalg.norm(np.diff(found.positions, axis=0), axis=1).sum())
    times = f"{found.times[0]:.3f} to {found.times[-1]:.3f} s, {(len(found) - 1) / max(span, 1e-9):,.1f} Hz"
    uses = ["`import clouds CLOUD --trajectory`"] if timed else []
    uses += ["`import sweeps SWEEPS`"] if found.rotations is not None else []
    return "trajectory", [
        ("poses", f"{len(found):,}"),
        ("times", times if timed else f"none: {trajectory.KITTI_RATE_HZ:g} poses per second are assumed"),
        ("extent", _bounds(found.positions.min(axis=0), found.positions.max(axis=0))),
        ("length", f"{length:,.1f} in units of its coordinates"),
        ("rotations", "no" if found.rotations is None else "yes"),
        ("use", f"the scanner's path: {' or '.join(uses)}"),
    ]


def _mistake(tile: Tile) -> str | None:
    """Warning of a usual mistake in the poses of a tile's photos, or that they couldn't be checked."""
    try:
        mistake = find_mistake(tile)
    except Exception as error:  # the check must not cost the summary
        return f"the photos couldn't be checked against the cloud ({type(error).__name__}: {error})"
    return f"{mistake}: import it again with this option" if mistake else None


def _tile(path: Path) -> tuple[str, Facts]:
    tile = read_tile(path)
    count = sum(clouds.read_header(p).count for p in tile.clouds)
    missing = sum(not view.photo.is_file() for view in tile.views)
    warning = _mistake(tile) if tile.views and not missing and tile.robot_map is None else None
    cameras = sorted({f"{v.camera.model} {v.camera.width}x{v.camera.height}" for v in tile.views})
    return "tile", [
        ("name", tile.name),
        ("CRS", f"{crs_name(tile.frame.crs)}, 1 unit = {tile.frame.unit:g} m"),
        ("origin", ", ".join(f"{v:,.0f}" for v in tile.frame.origin) + " m"),
        ("clouds", f"{len(tile.clouds)} files, {count:,} points"),
        ("photos", f"{len(tile.views)}" + (f", {missing} of them missing" if missing else "")),
        ("cameras", "; ".join(cameras) or "none"),
        ("masks", str(sum(v.mask is not None for v in tile.views))),
        ("trajectory", f"{len(tile.trajectory.times):,} positions" if tile.trajectory else "none"),
        ("ground truth", "yes" if tile.truth_mesh else "no"),
        *([("warning", warning)] if warning else []),
        *(("warning", text) for text in find_implausible(tile)),
    ]


def _mesh(path: Path) -> tuple[str, Facts]:
    import trimesh

    try:
        loaded = trimesh.load_scene(path, process=False)
        shapes = [loaded.geometry[loaded.graph[node][1]] for node in loaded.graph.nodes_geometry]
        meshes = [shape for shape in shapes if isinstance(shape, trimesh.Trimesh)]
        bounds = loaded.bounds
    except Exception as error:  # trimesh's parsers raise any exception on damaged files
        raise InputError(path, f"is not a readable mesh ({error})", "Export it again") from None
    names = sorted({str(getattr(getattr(m.visual, "material", None), "name", None)) for m in meshes} - {"None"})
    others = f" and {len(names) - MAX_MATERIALS} others" if len(names) > MAX_MATERIALS else ""
    return "mesh", [
        ("parts", str(len(meshes))),
        ("triangles", f"{sum(len(m.faces) for m in meshes):,}"),
        ("vertices", f"{sum(len(m.vertices) for m in meshes):,}"),
        ("extent", _bounds(*bounds) if bounds is not None else "empty"),
        ("materials", (", ".join(names[:MAX_MATERIALS]) or "none") + others),
        *(mesh_facts(path) if is_mesh(path) else []),
    ]


def _ply(path: Path) -> tuple[str, Facts]:
    with open(path, "rb") as file:
        head = file.read(4096)
    return _mesh(path) if b"element face" in head and b"element face 0" not in head else _cloud(path)


def _result(path: Path) -> tuple[str, Facts]:
    try:
        with np.load(path) as data:
            facts = [(name, f"{data[name].shape} {data[name].dtype}") for name in data.files]
    except Exception as error:  # zipfile, zlib and numpy raise any exception on damaged files
        raise InputError(path, f"can't be read ({error})", "Run the step that writes it again") from None
    return "cached result", facts


def _sdf(folder: Path) -> Path:
    worlds = sorted(folder.glob("*.sdf"))
    if not worlds:
        raise InputError(folder, "contains no .sdf file", "Name the folder of a world")
    return worlds[0]


def _world(path: Path) -> tuple[str, Facts]:
    root = xml.root(path)
    place = [root.findtext(f".//spherical_coordinates/{k}") for k in ("latitude_deg", "longitude_deg", "elevation")]
    facts = [
        ("SDF", root.get("version", "?")),
        ("includes", ", ".join(e.text or "" for e in root.iter("uri")) or "none"),
        ("place", "{} N, {} E, {} m".format(*place) if place[0] else "no georeference"),
    ]
    metadata = path.parent / "metadata.json"
    if metadata.is_file():
        try:
            body = json.loads(metadata.read_text(encoding="utf-8"))
            facts += [(key, json.dumps(value)) for key, value in body.items() if key not in ("crs",)]
        except (ValueError, AttributeError, RecursionError) as error:
            raise InputError(metadata, f"is not readable as JSON ({str(error)[:100]})", "Export it again") from None
    size = sum(p.stat().st_size for p in path.parent.rglob("*") if p.is_file())
    return "world", [*facts, ("size", f"{size / 1e6:,.1f} MB")]

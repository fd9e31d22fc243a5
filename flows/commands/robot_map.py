"""Makes a tile of a robot's map (`scan2sim run map.pcd`); the import is cached like a step."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from scan2sim.flows.commands.display import console, warn
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import plan_and_run
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import STORE
from scan2sim.flows.pipelines.graph import Task
from scan2sim.pipeline.core.cache import Digests, Store
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.importers.robot_map import MapParams, map_files
from scan2sim.pipeline.io.file_checks import copy_tree
from scan2sim.pipeline.io.mesh_files import companions, find_mesh
from scan2sim.pipeline.io.tile import read_tile, tile_name
from scan2sim.pipeline.io.worlds.merge import link
from scan2sim.pipeline.robot_maps.label_colours import read_legend
from scan2sim.pipeline.steps.import_map import IMPORT_MAP, ImportMapParams

FOLDER = "map"
"""Folder of the imported map below the output folder."""
Up = Annotated[
    str,
    typer.Option(metavar="auto|z|-z|y|-y|x|-x", help=f"Robots' maps: {MapParams.model_fields['up'].description}"),
]
Units = Annotated[
    str, typer.Option(metavar="auto|m|cm|mm|ft", help=f"Robots' maps: {MapParams.model_fields['units'].description}")
]
Scene = Annotated[
    str,
    typer.Option(metavar="auto|indoor|outdoor", help=f"Robots' maps: {MapParams.model_fields['scene'].description}"),
]
NoImages = Annotated[bool, typer.Option("--no-images", help="Leave out the posed images inside E57 files.")]
ClassesFromColours = Annotated[
    str,
    typer.Option(metavar="LEGEND", help=f"Robots' maps: {MapParams.model_fields['classes_from_colours'].description}"),
]
SensorPath = Annotated[
    Path | None,
    typer.Option("--trajectory", help="Robots' maps: path of the sensor in the map's frame and unit (.tum, .csv)."),
]


def is_map(path: Path) -> bool:
    """Whether a path is not a tile: neither a .toml file nor a folder with a tile.toml."""
    return path.exists() and not ((path / "tile.toml").exists() if path.is_dir() else path.suffix == ".toml")


def map_params(**options: Any) -> MapParams:
    """Settings of the import from options of the command; a legend is read from its file, so that the cache sees it.

    Raises:
        SettingError: an option is invalid.
    """
    if legend := options.get("classes_from_colours"):
        options["classes_from_colours"] = read_legend(legend)
    return MapParams.of("", options)


def map_sources(path: Path) -> dict[str, Path]:
    """Inputs of the step `import_map`: the mesh with the files that it refers to, or the clouds.

    Raises:
        InputError: a folder contains several meshes, or neither a mesh nor a cloud.
    """
    mesh = find_mesh(path)
    if mesh is None:
        return {f"cloud.{i:04d}": file for i, file in enumerate(map_files(path))}
    return {"mesh": mesh} | {f"beside.{i:04d}": file for i, file in enumerate(companions(mesh))}


def tile_of_map(path: Path, out: Path, params: MapParams, trajectory: Path | None = None) -> Path:
    """Import a map (a cloud, a folder of clouds, or a mesh) into `out/map/tile`; prints what was assumed and removed.

    Returns:
        Path of the `tile.toml`.

    Raises:
        ScanError: see `pipeline.importers.robot_map.import_map` and `mesh_model.import_mesh`.
    """
    sources = map_sources(path)
    if trajectory is not None:
        sources["trajectory"] = trajectory
    settings = ImportMapParams(**params.model_dump(), name=tile_name(path.stem))
    folder = out / FOLDER
    with locked(folder):
        store = Store(folder / STORE)
        digests = Digests(store.root / "digests.json")
        log = Log(folder / "run.log")
        with log.errors(folder):
            planned, done = plan_and_run([Task(IMPORT_MAP, settings, sources)], store, log, {IMPORT_MAP.name}, digests)
        made = store.folder(planned[0].task.full_name, planned[0].key) / "tile"
        tile = folder / "tile"
        shutil.rmtree(tile, ignore_errors=True)
        copy_tree(made, tile, link)
        store.sweep({planned[0].task.id.name: planned[0].key})
        digests.save()
    for text in done[IMPORT_MAP.name].warnings:
        warn(text)
    console.print(f"[dim]{_found(read_tile(tile))}")
    return tile / "tile.toml"


def imported_tile(path: Path, out: Path) -> Path:
    """Path of a tile, or of the tile that an earlier run made of a map.

    Raises:
        InputError: the map was not imported yet, or the path is neither a tile nor a map.
    """
    if not is_map(path):
        return path
    map_sources(path)  # an error if it is no map either
    tile = out / FOLDER / "tile" / "tile.toml"
    if not tile.is_file():
        raise InputError(path, f"no run of this map in {out}", "Its steps are known once it is imported: scan2sim run")
    return tile


def _found(tile: Tile) -> str:
    """What the import found of a map, as a line for the user."""
    found = tile.robot_map
    assert found is not None
    up = found.T_world_map[2, :3]
    axis = int(np.argmax(np.abs(up)))
    tilt = math.degrees(math.acos(min(1.0, abs(float(up[axis])))))
    name = f"{'-' if up[axis] < 0 else ''}{'xyz'[axis]}"
    units = f"points {found.spacing:.2g} m apart, 1 unit = {found.unit:g} m"
    return f"map: {found.scene}, {units}, up {name}, tilted by {tilt:.1f} degrees (--scene, --units, --up)"

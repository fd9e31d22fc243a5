"""CARLA package for import: FBX meshes, roads as OpenDRIVE, and a JSON description.

Layout according to CARLA's documentation (0.9.16, "Manual package preparation", "Import/Package a Large Map", "Add new
props"): `carla/<name>.json`; the ground as a map, `carla/<name>/<name>.fbx` and `.xodr`, with mesh names by which
CARLA's importer distinguishes roads, sidewalks and terrain (`<name>_Road_Road_<tile>`); everything else as props with
tags for its semantic camera, `carla/props/<prop>/<prop>.fbx`, one per tile and class. Ground larger than
`LARGE_MAP_TILE_M` is written as a large map, in squares `<name>_Tile_<x>_<y>.fbx`, y growing southwards, with texture
pages in `.fbm` folders. Its props are a package of their own, `carla/<name>_props.json`: in the package of a large map,
CARLA's importer would take them for tiles, whose vertices it makes relative to their squares.

All coordinates are metres from the scene's origin, y to the north. CARLA flips y on import of both FBX and OpenDRIVE.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.classes import CODE, CODE_OF_SURFACE, group_of
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F64, I64, U8
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.geodata import opendrive
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds import fbx
from scan2sim.pipeline.io.worlds.fbx import Part
from scan2sim.pipeline.io.worlds.scene import Scene, SceneTile, Surface, by_class
from scan2sim.pipeline.io.worlds.scene_roads import roads_of
from scan2sim.pipeline.io.worlds.textured_mesh import Textured

FOLDER = "carla"
LARGE_MAP_TILE_M = 2000.0
"""Side length of a large map's tile, CARLA's default."""
GROUND_NAMES = {CODE["road"]: "Road_Road", CODE["bridge_deck"]: "Road_Road", CODE["sidewalk"]: "Road_Sidewalk"}
"""Mesh names by which CARLA's importer recognizes ground classes; all others are terrain."""
TERRAIN_NAME = "Terrain"
PROP_TAGS = {
    CODE["building"]: "Building", CODE["tower"]: "Building", CODE["wall_or_fence"]: "Wall", CODE["pole"]: "Pole",
    CODE["road_sign"]: "TrafficSign", CODE["low_vegetation"]: "Vegetation", CODE["mid_vegetation"]: "Vegetation",
    CODE["high_vegetation"]: "Vegetation", CODE["vehicle"]: "Car",
}  # fmt: skip
"""Semantic tags of props; CARLA labels assets by the folder of that name, and gives others no label (`Tagger.cpp`)."""
DEFAULT_TAG = "Static"


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the package."""
    package = _Package(scene, folder / FOLDER, params)
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        package.add(tile)
    package.save()
    return {f"{FOLDER}/{file}": count for file, count in package.triangles.items()}


class _Package:
    """The package of a scene; `triangles` counts those of each file."""

    def __init__(self, scene: Scene, folder: Path, params: SceneParams) -> None:
        self._scene, self._folder, self._params = scene, folder, params
        self._squares = _squares(scene)
        self._ground: dict[tuple[int, int], list[Part]] = {}
        self._props: list[dict[str, str]] = []
        self.triangles: dict[str, int] = {}

    def add(self, tile: SceneTile) -> None:
        """Add a tile's ground to the map, and write its other surfaces as props."""
        for group, shape in world_formats.shown(tile, self._params).items():
            placed = _placed(shape, np.asarray(tile.offset))
            if group == "terrain":
                self._add_ground(tile, placed)
                continue
            for surface in by_class(group, placed):
                self._prop(tile, surface)

    def save(self) -> None:
        """Write the map, its roads, and the JSON description."""
        name = self._scene.name
        map_entry: dict[str, Any] = {"name": name, "use_carla_materials": False}
        make_folder(self._folder / name)
        if opendrive.write(self._folder / name / f"{name}.xodr", name, self._scene.frame, roads_of(self._scene)):
            map_entry["xodr"] = f"./{name}/{name}.xodr"
        files = []
        for square, parts in sorted(self._ground.items()):
            files.append(f"{name}/{self._file(square)}.fbx")
            self._write(files[-1], parts)
        if self._squares > 1:
            map_entry |= {"tile_size": LARGE_MAP_TILE_M, "tiles": [f"./{file}" for file in files]}
        elif files:  # a world without ground has no map
            map_entry["source"] = f"./{files[0]}"
        maps = [map_entry] if files else []
        packages = {name: (maps, self._props)}
        if self._squares > 1:
            packages = {name: (maps, []), f"{name}_props": ([], self._props)}
        for package, (its_maps, its_props) in packages.items():
            text = json.dumps({"maps": its_maps, "props": its_props}, indent=2)
            (self._folder / f"{package}.json").write_text(text + "\n", encoding="ascii")

    def _add_ground(self, tile: SceneTile, ground: Textured) -> None:
        codes, squares = _codes(tile, ground), self._square(ground.mesh.corners.mean(axis=1))
        for square in np.unique(squares, axis=0).tolist():
            in_square = (squares == square).all(axis=1)
            file = self._file((square[0], square[1]))
            pages = self._folder / self._scene.name / (f"{file}.fbm" if self._squares > 1 else "")
            for kind in sorted({GROUND_NAMES.get(code, TERRAIN_NAME) for code in np.unique(codes[in_square]).tolist()}):
                of_kind = in_square & np.isin(
                    codes, [code for code in range(256) if GROUND_NAMES.get(code, TERRAIN_NAME) == kind]
                )
                name = f"{self._scene.name}_{kind}_{tile.name}"
                parts = self._parts(name, f"{tile.name}_terrain", ground.keep(of_kind), pages)
                self._ground.setdefault((square[0], square[1]), []).extend(parts)

    def _prop(self, tile: SceneTile, surface: Surface) -> None:
        name = f"{self._scene.name}_{tile.name}_{surface.name}"
        file = f"props/{name}/{name}.fbx"
        prop_folder = self._folder / "props" / name
        self._write(file, list(self._parts(name, name, surface.shape, prop_folder)))
        tag = PROP_TAGS.get(surface.code, DEFAULT_TAG)
        self._props.append({"name": name, "size": "huge", "source": f"./{file}", "tag": tag})

    def _parts(self, name: str, group: str, shape: Textured, pages: Path) -> Iterator[Part]:
        """Split a shape into one object per texture page; writes the pages into a folder."""
        written = world_formats.write_pages(pages, group, shape, self._params)
        for page in written.used:
            image = written.images[page]
            image_path = f"{pages.name}/{image}" if pages.suffix == ".fbm" else image
            yield Part(f"{name}_{page}", shape.on_page(page), image_path)

    def _write(self, file: str, parts: list[Part]) -> None:
        make_folder((self._folder / file).parent)
        fbx.write(self._folder / file, parts)
        self.triangles[file] = sum(len(part.shape) for part in parts)

    def _square(self, positions: F64) -> I64:
        """Square (N, 2) of a large map that contains each position."""
        if self._squares == 1:
            return np.zeros((len(positions), 2), np.int64)
        low, high = _bounds_xy(self._scene)
        across, down = positions[:, 0] - low[0], high[1] - positions[:, 1]
        return np.floor(np.column_stack([across, down]) / LARGE_MAP_TILE_M).astype(np.int64)

    def _file(self, square: tuple[int, int]) -> str:
        name = self._scene.name
        return name if self._squares == 1 else f"{name}_Tile_{square[0]}_{square[1]}"


def _bounds_xy(scene: Scene) -> tuple[F64, F64]:
    """Corners (2,) of the bounding box of all tiles, metres from the scene's origin."""
    low = np.min([np.add(tile.offset, tile.low) for tile in scene.tiles], axis=0)[:2]
    return low, np.max([np.add(tile.offset, tile.high) for tile in scene.tiles], axis=0)[:2]


def _squares(scene: Scene) -> int:
    """Maximum number of squares of the map."""
    low, high = _bounds_xy(scene)
    return int(np.prod(np.maximum(np.ceil((high - low) / LARGE_MAP_TILE_M), 1)))


def _placed(shape: Textured, offset: F64) -> Textured:
    """A shape in scene coordinates, float64."""
    vertices: Any = shape.mesh.vertices.astype(np.float64) + offset
    return replace(shape, mesh=replace(shape.mesh, vertices=vertices))


def _codes(tile: SceneTile, ground: Textured) -> U8:
    """Class (F,) of the nearest face of the ground's collision mesh for each face."""
    from scipy.spatial import cKDTree

    solid = tile.solid()
    is_ground = None if solid.classification is None else group_of()[solid.classification] == 0
    if is_ground is None or solid.classification is None or not is_ground.any():
        return np.full(len(ground), CODE_OF_SURFACE["terrain"], np.uint8)
    centres = solid.corners[is_ground].mean(axis=1) + np.asarray(tile.offset)
    _, nearest = cKDTree(centres).query(ground.mesh.corners.mean(axis=1))
    return np.asarray(solid.classification[is_ground][nearest])

"""CARLA: a package to import, with FBX, the roads as OpenDRIVE, and the JSON that describes it.

Layout, as CARLA's documentation asks (0.9.16, "Manual package preparation", "Import/Package a Large Map", "Add new
props"): `carla/<name>.json`; the ground as a map, `carla/<name>/<name>.fbx` and `.xodr`, its meshes named so that
CARLA's importer tells roads, sidewalks and terrain (`<name>_Road_Road_<tile>`); all else as props with tags for its
semantic camera, `carla/props/<prop>/<prop>.fbx`, one a tile and class. Ground that is longer than `SQUARE` comes as a
large map, in squares `<name>_Tile_<x>_<y>.fbx`, y growing southwards, their texture pages in `.fbm` folders.

All coordinates are metres from the scene's origin, y to the north. CARLA turns y itself, of FBX and OpenDRIVE alike.
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
from scan2sim.pipeline.io.worlds.textured_mesh import Textured
from scan2sim.pipeline.roads.scene_roads import drawn

FOLDER = "carla"
SQUARE = 2000.0
"""Metres a side of a large map's tile, CARLA's own default."""
GROUND = {CODE["road"]: "Road_Road", CODE["bridge_deck"]: "Road_Road", CODE["sidewalk"]: "Road_Sidewalk"}
"""What CARLA's importer calls classes of the ground; all others are terrain."""
TERRAIN = "Terrain"
TAGS = {
    CODE["building"]: "Building", CODE["tower"]: "Building", CODE["wall_or_fence"]: "Wall", CODE["pole"]: "Pole",
    CODE["road_sign"]: "TrafficSign", CODE["low_vegetation"]: "Vegetation", CODE["mid_vegetation"]: "Vegetation",
    CODE["high_vegetation"]: "Vegetation", CODE["vehicle"]: "Vehicles",
}  # fmt: skip
"""Tags of props; CARLA labels what lies in a folder of that name."""
OTHER = "Static"


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the package."""
    package = _Package(scene, folder / FOLDER, params)
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        package.add(tile)
    package.save()
    return {f"{FOLDER}/{file}": count for file, count in package.triangles.items()}


class _Package:
    """What is written of a scene; `triangles` of all files."""

    def __init__(self, scene: Scene, folder: Path, params: SceneParams) -> None:
        self._scene, self._folder, self._params = scene, folder, params
        self._squares = _squares(scene)
        self._ground: dict[tuple[int, int], list[Part]] = {}
        self._props: list[dict[str, str]] = []
        self.triangles: dict[str, int] = {}

    def add(self, tile: SceneTile) -> None:
        """Take a tile's ground for the map, and write all else as props."""
        for group, shape in tile.textured().items():
            placed = _placed(shape, np.asarray(tile.offset))
            if group == "terrain":
                self._take(tile, placed)
                continue
            for surface in by_class(group, placed):
                self._prop(tile, surface)

    def save(self) -> None:
        """Write the map, its roads, and the description."""
        name = self._scene.name
        about: dict[str, Any] = {"name": name, "use_carla_materials": False}
        make_folder(self._folder / name)
        if opendrive.write(self._folder / name / f"{name}.xodr", name, self._scene.frame, drawn(self._scene)):
            about["xodr"] = f"./{name}/{name}.xodr"
        files = []
        for square, parts in sorted(self._ground.items()):
            files.append(f"{name}/{self._file(square)}.fbx")
            self._write(files[-1], parts)
        if self._squares > 1:
            about |= {"tile_size": SQUARE, "tiles": [f"./{file}" for file in files]}
        elif files:  # a world without ground has no map
            about["source"] = f"./{files[0]}"
        text = json.dumps({"maps": [about] if files else [], "props": self._props}, indent=2)
        (self._folder / f"{name}.json").write_text(text + "\n", encoding="ascii")

    def _take(self, tile: SceneTile, ground: Textured) -> None:
        codes, squares = _codes(tile, ground), self._square(ground.mesh.corners.mean(axis=1))
        for square in np.unique(squares, axis=0).tolist():
            here = (squares == square).all(axis=1)
            file = self._file((square[0], square[1]))
            pages = self._folder / self._scene.name / (f"{file}.fbm" if self._squares > 1 else "")
            for kind in sorted({GROUND.get(code, TERRAIN) for code in np.unique(codes[here]).tolist()}):
                own = here & np.isin(codes, [code for code in range(256) if GROUND.get(code, TERRAIN) == kind])
                name = f"{self._scene.name}_{kind}_{tile.name}"
                parts = self._parts(name, f"{tile.name}_terrain", ground.keep(own), pages)
                self._ground.setdefault((square[0], square[1]), []).extend(parts)

    def _prop(self, tile: SceneTile, surface: Surface) -> None:
        name = f"{self._scene.name}_{tile.name}_{surface.name}"
        file = f"props/{name}/{name}.fbx"
        place = self._folder / "props" / name
        self._write(file, list(self._parts(name, name, surface.shape, place)))
        tag = TAGS.get(surface.code, OTHER)
        self._props.append({"name": name, "size": "huge", "source": f"./{file}", "tag": tag})

    def _parts(self, name: str, group: str, shape: Textured, pages: Path) -> Iterator[Part]:
        """A shape, an object a page; its pages go into a folder."""
        written = world_formats.write_pages(pages, group, shape, self._params)
        for page in written.used:
            image = written.images[page]
            inside = f"{pages.name}/{image}" if pages.suffix == ".fbm" else image
            yield Part(f"{name}_{page}", shape.on_page(page), inside)

    def _write(self, file: str, parts: list[Part]) -> None:
        make_folder((self._folder / file).parent)
        fbx.write(self._folder / file, parts)
        self.triangles[file] = sum(len(part.shape) for part in parts)

    def _square(self, places: F64) -> I64:
        """(N, 2) the square that each place lies in."""
        if self._squares == 1:
            return np.zeros((len(places), 2), np.int64)
        low, high = _plan(self._scene)
        across, down = places[:, 0] - low[0], high[1] - places[:, 1]
        return np.floor(np.column_stack([across, down]) / SQUARE).astype(np.int64)

    def _file(self, square: tuple[int, int]) -> str:
        name = self._scene.name
        return name if self._squares == 1 else f"{name}_Tile_{square[0]}_{square[1]}"


def _plan(scene: Scene) -> tuple[F64, F64]:
    """Corners (2,) of the box around all tiles, metres from the scene's origin."""
    low = np.min([np.add(tile.offset, tile.low) for tile in scene.tiles], axis=0)[:2]
    return low, np.max([np.add(tile.offset, tile.high) for tile in scene.tiles], axis=0)[:2]


def _squares(scene: Scene) -> int:
    """How many squares a map may take."""
    low, high = _plan(scene)
    return int(np.prod(np.maximum(np.ceil((high - low) / SQUARE), 1)))


def _placed(shape: Textured, offset: F64) -> Textured:
    """A shape in the scene, float64."""
    vertices: Any = shape.mesh.vertices.astype(np.float64) + offset
    return replace(shape, mesh=replace(shape.mesh, vertices=vertices))


def _codes(tile: SceneTile, ground: Textured) -> U8:
    """(F,) the classes of the ground that bodies touch, nearest to each face."""
    from scipy.spatial import cKDTree

    solid = tile.solid()
    own = None if solid.classification is None else group_of()[solid.classification] == 0
    if own is None or solid.classification is None or not own.any():
        return np.full(len(ground), CODE_OF_SURFACE["terrain"], np.uint8)
    touched = solid.corners[own].mean(axis=1) + np.asarray(tile.offset)
    _, nearest = cKDTree(touched).query(ground.mesh.corners.mean(axis=1))
    return np.asarray(solid.classification[own][nearest])

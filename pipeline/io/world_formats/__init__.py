"""Formats that worlds are exported in: a file a format (`pipeline.core.plugins`), named in `export.formats` and `--to`.

A format's module has `write`; one that holds levels of detail (`Scene.coarse`) tells by `LEVELS` how many of each tile
are made where nobody asks for a number. All files and folders that it makes have ASCII names, and name each other
relatively.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol

from pydantic import Field

from scan2sim.pipeline.core.errors import DataError, SettingError
from scan2sim.pipeline.core.plugins import find, module, names
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.io import robot_formats
from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.mesh_formats import PageNames, obj
from scan2sim.pipeline.io.worlds import sdf
from scan2sim.pipeline.io.worlds.glb import GlbParams, ways
from scan2sim.pipeline.io.worlds.scene import Scene, SceneTile, by_class
from scan2sim.pipeline.io.worlds.textured_mesh import Textured
from scan2sim.pipeline.simulation.collision_shapes import Solid, solids
from scan2sim.pipeline.simulation.robot import ROBOT
from scan2sim.pipeline.simulation.spawn import find as find_start

PACKAGE = "scan2sim.pipeline.io.world_formats"
SHOWN = ("obj", "collada")
"""Formats that Gazebo's model shows, the better one first."""


class SceneParams(GlbParams):
    """How a scene is written.

    Attributes:
        meshes: formats of the meshes in Gazebo's model, files of `pipeline/io/mesh_formats`; it shows the OBJ, which
            Gazebo reads several times faster than Collada, or Collada where there is no OBJ.
        max_visual_triangles: of one mesh that is shown; larger surfaces are written in parts.
        pages: "png", lossless, or "jpeg", a sixth or so of its size, for texture pages that are files of their own.
        source_pages: beside each of these, a page that says where each texel's colour is from: 255 a photo, 128 the
            cloud's points, 64 filled, 0 no surface.
    """

    meshes: tuple[str, ...] = Field(
        SHOWN, description="Formats of the meshes in Gazebo's model.", json_schema_extra={"range": "a list of formats"}
    )
    max_visual_triangles: int = Field(
        200_000, ge=1_000, le=10_000_000, description="Of one mesh that is shown; larger surfaces come in parts."
    )
    pages: Literal["png", "jpeg"] = Field("png", description="Texture pages that are files: lossless, or a sixth.")
    source_pages: bool = Field(False, description="Beside texture pages, pages that say where colours are from.")


class Format(Protocol):
    """Of whole scenes."""

    def write(self, scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
        """Write a scene below `folder`; returns the triangles of every mesh file, by its path there."""


def known() -> list[str]:
    """Names of all formats."""
    return names(PACKAGE)


def levels(formats: Sequence[str]) -> int:
    """Levels of detail that some formats want of each tile."""
    return max((getattr(find(PACKAGE, name, "export.formats"), "LEVELS", 1) for name in formats), default=1)


def check(formats: Sequence[str], params: SceneParams, setting: str, robot: bool = False) -> None:
    """Refuse formats that there aren't, or that can't be written here, and a robot that none of them holds.

    Raises:
        SettingError: there is no such format, or nothing that Gazebo shows; or they hold no robot.
        UnavailableError: a package is missing.
    """
    for name in formats:
        find(PACKAGE, name, setting)
    for name in params.meshes:
        find("scan2sim.pipeline.io.mesh_formats", name, "export.meshes")
    ways(params)
    if "gazebo" in formats and not set(SHOWN) & set(params.meshes):
        raise SettingError("export.meshes", f"has nothing that Gazebo shows ({' or '.join(SHOWN)})", "Name one, too")
    driven = names(robot_formats.PACKAGE)
    if robot and not set(formats) & set(driven):
        raise SettingError("--robot", f"is held by none of {', '.join(formats)}", f"Name one of: {', '.join(driven)}")


def write(
    scene: Scene, formats: Sequence[str], folder: Path, params: SceneParams, report: Report, robot: bool = False
) -> None:
    """Write a scene in some formats below `folder`, its lists and `metadata.json` beside them.

    With `robot`, a small one (`pipeline.simulation.robot`) stands on the road, in those formats that hold one.

    Raises:
        ScanError: as `check`, or there is no place for the robot, before anything is written.
    """
    check(formats, params, "export.formats", robot)
    if robot:
        _check_names(scene)
        scene = replace(scene, start=find_start(scene))
    make_folder(folder)
    triangles: dict[str, int] = {}
    for i, name in enumerate(formats):

        def part(fraction: float, message: str = "", begun: int = i, what: str = name) -> None:
            report((begun + fraction) / len(formats), f"{what} {message}".strip())

        triangles |= find(PACKAGE, name, "export.formats").write(scene, folder, params, part)
        if scene.start and name in names(robot_formats.PACKAGE):
            module(robot_formats.PACKAGE, name).write(ROBOT, scene.start, folder)
    for tile in scene.tiles:
        for file, path in tile.lists.items():
            shutil.copyfile(path, folder / (file if len(scene.tiles) == 1 else f"{tile.name}_{file}"))
    text = json.dumps(metadata(scene, triangles), indent=2)
    (folder / "metadata.json").write_text(text + "\n", encoding="utf-8")


def _check_names(scene: Scene) -> None:
    """Refuse a tile, or a world, that is called as the robot is."""
    if ROBOT.name in {scene.name, *(tile.name for tile in scene.tiles)}:
        raise DataError(
            ROBOT.name, "is a tile's or the world's name, and the robot's", "Name it otherwise: export.name"
        )


def metadata(scene: Scene, triangles: dict[str, int]) -> dict[str, Any]:
    """What a reader needs to put a scene back on the map, and to check that it is whole."""
    place = sdf.Georeference.of(scene.frame)
    about = {"name": scene.name, "crs": scene.frame.crs, "unit_m": scene.frame.unit}
    whole: dict[str, Any] = {
        "world_origin_m": list(scene.origin),
        "wgs84": place and place.facts(),
        "friction": scene.tiles[0].friction,
        "triangles_by_file": triangles,
    }
    if scene.start:
        start = {"position_m": list(scene.start.position), "angles_rad": list(scene.start.angles), "on": scene.start.by}
        whole["robot"] = {"name": ROBOT.name, **start}
    if len(scene.tiles) == 1:
        tile = scene.tiles[0]
        here = "crs = (local + origin_m) / unit_m; OBJ and Collada are local, z-up; GLB is local, y-up (x, z, -y)"
        return {**about, "origin_m": list(tile.frame.origin), "to_crs": here, "groups": dict(tile.groups), **whole}
    tiles = {
        tile.name: {
            "origin_m": list(tile.frame.origin),
            "offset_m": list(tile.offset),
            "low_m": list(tile.low),
            "high_m": list(tile.high),
        }
        for tile in scene.tiles
    }
    here = "crs = (world + world_origin_m) / unit_m; world = local + offset_m, local as in a tile's meshes"
    return {**about, "to_crs": here, "tiles": tiles, **whole}


def write_pages(folder: Path, group: str, shape: Textured, params: SceneParams) -> PageNames:
    """Put a group's texture pages into `folder`; returns what they are called."""
    make_folder(folder)
    materials = tuple(f"{group}_{page}" for page in range(len(shape.pages)))
    images = tuple(f"{name}.{'png' if params.pages == 'png' else 'jpg'}" for name in materials)
    for page in shape.used_pages:
        if params.pages == "png":
            shutil.copyfile(shape.pages[page], folder / images[page])  # may be edited freely
        else:
            image.write(folder / images[page], image.read_rgb(shape.pages[page]), quality=params.jpeg_quality)
        if params.source_pages and len(shape.seen) == len(shape.pages):
            shutil.copyfile(shape.seen[page], folder / f"{materials[page]}_seen.png")
    return PageNames(group, materials, images, tuple(shape.used_pages))


def write_solids(folder: Path, tile: SceneTile) -> tuple[list[Solid], dict[str, int]]:
    """What bodies collide with in a tile; meshes go into `folder` (`collision_<name>.obj`), with their triangles."""
    found = solids(tile.solid(), tile.friction)
    triangles = {}
    for solid in found:
        if isinstance(solid.shape, Mesh):
            obj.write_plain(folder / f"collision_{solid.name}.obj", solid.shape)
            triangles[f"collision_{solid.name}.obj"] = len(solid.shape)
    return found, triangles


@dataclass(frozen=True)
class Single:
    """A mesh file with one material, which is all that some readers take.

    Attributes:
        name: of the file, without its suffix, and of its material.
        code: LAS code of its class.
        label: its name.
        image: name of its texture page's file, in the same folder.
        triangles: how many.
    """

    name: str
    code: int
    label: str
    image: str
    triangles: int


def write_single(folder: Path, tile: SceneTile, params: SceneParams) -> Iterator[Single]:
    """Write an OBJ for each class and page of a tile below `folder`, and its pages."""
    for group, shape in tile.textured().items():
        pages = write_pages(folder, group, shape, params)
        for surface in by_class(group, shape):
            for page in surface.shape.used_pages:
                for part in surface.on_page(page).parts(params.max_visual_triangles):
                    name = f"{part.name}_{page}"
                    names = PageNames(name, pages.materials, pages.images, (page,))
                    obj.write(folder / f"{name}.obj", part.shape, names)
                    yield Single(name, part.code, part.label, pages.images[page], len(part.shape))

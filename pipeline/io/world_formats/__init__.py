"""Export formats of worlds: one module per format (`pipeline.core.plugins`), selected by `export.formats` and `--to`.

A format's module has `write`; one that supports levels of detail (`Scene.coarse`) has `LEVELS`, the default number of
levels per tile. All files and folders that it writes have ASCII names and refer to each other by relative paths.
"""

from __future__ import annotations

import json
import os
import shutil
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path
from typing import Any, Literal, Protocol

from pydantic import Field

from scan2sim.pipeline.core.classes import CEILING
from scan2sim.pipeline.core.errors import DataError, ScanError, SettingError, SpaceError, from_exception
from scan2sim.pipeline.core.parameters import is_reserved
from scan2sim.pipeline.core.plugins import find, module, names
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.geometry.open_backs import open_backs
from scan2sim.pipeline.io import robot_formats
from scan2sim.pipeline.io.file_checks import copy_tree, make_folder
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.mesh_formats import PageNames, obj
from scan2sim.pipeline.io.navigation import ros_launch
from scan2sim.pipeline.io.worlds import readme, sdf
from scan2sim.pipeline.io.worlds.glb import GlbParams, find_encoders
from scan2sim.pipeline.io.worlds.scene import BACKDROP, Scene, SceneTile, by_class
from scan2sim.pipeline.io.worlds.spawn import default_pose, find_spawn_pose, free_space_pose
from scan2sim.pipeline.io.worlds.textured_mesh import Textured
from scan2sim.pipeline.simulation.collision_shapes import Solid, solids
from scan2sim.pipeline.simulation.robot import ROBOT, Robot, Start

PACKAGE = "scan2sim.pipeline.io.world_formats"
GAZEBO_VISUAL_FORMATS = ("obj", "collada")
"""Mesh formats that a Gazebo model can use as visuals, the preferred one first."""


class SceneParams(GlbParams):
    """Settings of the scene writers.

    Attributes:
        meshes: mesh formats of the Gazebo model, modules of `pipeline/io/mesh_formats`; its visuals are OBJ, which
            Gazebo reads several times faster than Collada, or Collada if OBJ isn't selected.
        max_visual_triangles: maximum number of triangles of a visual mesh; larger surfaces are split.
        pages: format of texture pages in separate files: "png", lossless, or "jpeg", about a sixth of the size.
        source_pages: write a mask for each of these pages with the source of each texel's colour: 255 a photo, 128
            the cloud's points, 64 inpainted, 0 no surface.
        ceiling: ceilings of indoor maps: a model of their own, or left out.
        backdrop: the backdrop, if there is one, is part of the world (Gazebo, GLB, USD). Gazebo's depth and RGB-D
            cameras, which can't ignore it as its lidars can, need worlds without it.
    """

    meshes: tuple[str, ...] = Field(
        GAZEBO_VISUAL_FORMATS,
        description="Mesh formats of the Gazebo model.",
        json_schema_extra={"range": "a list of formats"},
    )
    max_visual_triangles: int = Field(
        200_000,
        ge=1_000,
        le=10_000_000,
        description="Maximum number of triangles of a visual mesh; larger surfaces are split.",
    )
    pages: Literal["png", "jpeg"] = Field(
        "png", description="Format of separate texture pages: png (lossless), or jpeg (about a sixth of the size)."
    )
    ceiling: Literal["model", "hidden"] = Field(
        "model",
        description="Ceilings of a robot's map of rooms: model (in Gazebo's world a model of its own, which can be "
        "removed), or hidden.",
    )
    source_pages: bool = Field(False, description="Write a mask for each texture page with the source of colours.")
    backdrop: bool = Field(True, description="Write the backdrop, if there is one (Gazebo, GLB, USD).")


class Format(Protocol):
    """Interface of a format's module."""

    def write(self, scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
        """Write a scene below `folder`; returns the number of triangles of every mesh file, by its path there."""


def format_names() -> list[str]:
    """Names of all formats."""
    return names(PACKAGE)


def levels(formats: Sequence[str]) -> int:
    """Number of levels of detail per tile that the given formats need by default."""
    return max((getattr(find(PACKAGE, name, "export.formats"), "LEVELS", 1) for name in formats), default=1)


def check(formats: Sequence[str], params: SceneParams, setting: str, robot: bool = False) -> None:
    """Check that the formats exist, can be written on this machine, and support the robot.

    Raises:
        SettingError: unknown format, no mesh format that Gazebo can show, or no format that supports the robot.
        UnavailableError: a package is missing.
    """
    for name in formats:
        find(PACKAGE, name, setting)
    for name in params.meshes:
        find("scan2sim.pipeline.io.mesh_formats", name, "export.meshes")
    find_encoders(params)
    if "gazebo" in formats and not set(GAZEBO_VISUAL_FORMATS) & set(params.meshes):
        visual_formats = " or ".join(GAZEBO_VISUAL_FORMATS)
        raise SettingError("export.meshes", "has no format that Gazebo can show", f"Add {visual_formats}")
    with_robot = names(robot_formats.PACKAGE)
    if robot and not set(formats) & set(with_robot):
        cause = f"is not supported by {', '.join(formats)}"
        raise SettingError("--robot", cause, f"Add one of: {', '.join(with_robot)}")


def write(
    scene: Scene,
    formats: Sequence[str],
    folder: Path,
    params: SceneParams,
    report: Report,
    robot: bool = False,
    failed: dict[str, ScanError] | None = None,
) -> None:
    """Write a scene in the given formats below `folder`, with its lists, `metadata.json` and `README.md`.

    Args:
        scene: the scene.
        formats: names of the formats.
        folder: the world's folder.
        params: settings of the writers.
        report: receives the progress.
        robot: formats that support it get a small robot (`pipeline.simulation.robot`) on the road.
        failed: receives the errors of optional parts by name, and nothing of them is written: formats other than the
            world's own (Gazebo, or else the first one), lists, files for navigation, the pose for robots ("spawn"),
            recorded traffic of Gazebo's world, the README ("readme"). None: their errors are raised.

    Raises:
        ScanError: as `check`, a name is reserved, or there is no start pose for the robot; raised before anything is
            written.
    """
    check(formats, params, "export.formats", robot)
    _check_reserved(scene)
    if params.ceiling == "hidden":
        scene = replace(scene, tiles=tuple(map(_without_ceiling, scene.tiles)))
    if not params.backdrop:
        tiles = tuple(replace(tile, shows_backdrop=False) for tile in scene.tiles)
        scene = replace(scene, tiles=tiles, dome=None)
    if robot:
        _check_names(scene)
        scene = replace(scene, start=find_spawn_pose(scene))
    make_folder(folder)
    with optional_part("spawn", folder, failed):
        scene = replace(scene, spawn=scene.start or default_pose(scene))
    triangles: dict[str, int] = {}
    main = "gazebo" if "gazebo" in formats else next(iter(formats), "")
    for i, name in enumerate(formats):

        def report_format(fraction: float, message: str = "", finished: int = i, format_name: str = name) -> None:
            report((finished + fraction) / len(formats), f"{format_name} {message}".strip())

        with optional_part(name, folder, None if name == main else failed) as place:
            triangles |= find(PACKAGE, name, "export.formats").write(scene, place, params, report_format)
            if scene.start and name in names(robot_formats.PACKAGE):
                module(robot_formats.PACKAGE, name).write(_robot_for(scene), scene.start, place)
    if "gazebo" in formats:
        with optional_part("traffic", folder, failed) as place:
            find(PACKAGE, "gazebo", "export.formats").write_traffic(scene, place)
    with optional_part("lists", folder, failed) as place:
        _write_lists(scene, place)
    navigation: dict[str, Any] = {}
    if len(scene.tiles) == 1:
        with optional_part("navigation", folder, failed) as place:
            navigation = _write_navigation(scene, place, formats)
    text = json.dumps(metadata(scene, triangles) | navigation, indent=2)
    (folder / "metadata.json").write_text(text + "\n", encoding="utf-8")
    with optional_part("readme", folder, failed) as place:
        readme.write(place, scene, formats)


@contextmanager
def optional_part(name: str, folder: Path, failed: dict[str, ScanError] | None) -> Iterator[Path]:
    """A folder to write a part of the world into, moved to `folder` when complete; its error is added to `failed`.

    Without `failed` it is `folder` itself, and errors are raised; so are those about a full disk.
    """
    if failed is None:
        yield folder
        return
    temporary = folder / f".{name}"
    try:
        make_folder(temporary)
        yield temporary
        copy_tree(temporary, folder, os.replace)
    except Exception as error:
        failed[name] = from_exception(error, name, folder)
        if isinstance(failed[name], SpaceError):
            raise failed[name] from error
        failed[name].add_note(traceback.format_exc())
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write_lists(scene: Scene, folder: Path) -> None:
    """Write the lists of detected objects of all tiles."""
    for tile in scene.tiles:
        for file, path in tile.lists.items():
            shutil.copyfile(path, folder / (file if len(scene.tiles) == 1 else f"{tile.name}_{file}"))


def _write_navigation(scene: Scene, folder: Path, formats: Sequence[str]) -> dict[str, Any]:
    """Write the files for navigation of a world that has any: occupancy maps, points, with Gazebo a launch file.

    Returns:
        The entry about navigation in metadata.json, if there is one.
    """
    files, start = scene.tiles[0].navigation_files, scene.start or free_space_pose(scene)
    about = scene.tiles[0].navigation()
    entry = {} if about is None else {"navigation": about}
    for name, path in files.items():
        shutil.copyfile(path, folder / name)
    if "gazebo" not in formats or (start is None and scene.robot_map is None):
        return entry
    spawn = scene.start is None and start is not None and not _is_robot_name(scene)
    if spawn and start is not None:
        module(robot_formats.PACKAGE, "gazebo").write(ROBOT, start, folder)
    ros_launch.write(
        folder / f"{scene.name}.launch.py", f"{scene.name}.sdf", ROBOT, start, spawn=spawn,
        occupancy="map.yaml" in files, T_world_map=scene.robot_map.T_world_map if scene.robot_map else None,
    )  # fmt: skip
    return entry


def _is_robot_name(scene: Scene) -> bool:
    """Whether a tile or the world has the robot's name."""
    return ROBOT.name in {scene.name, *(tile.name for tile in scene.tiles)}


def _robot_for(scene: Scene) -> Robot:
    """The robot, with a camera that sees as far as the sky."""
    return replace(ROBOT, camera=replace(ROBOT.camera, max_range=max(ROBOT.camera.max_range, ceil(scene.far or 0))))


def _without_ceiling(tile: SceneTile) -> SceneTile:
    """The tile without its ceilings, unless it consists of nothing else."""
    groups = {group: figures for group, figures in tile.groups.items() if group != CEILING}
    return replace(tile, groups=groups) if groups else tile


def _check_reserved(scene: Scene) -> None:
    """Raise an error if a tile or the world has a name that simulators reserve, as in worlds of earlier versions."""
    for name in (scene.name, *(tile.name for tile in scene.tiles)):
        if is_reserved(name):
            cause = "is reserved by simulators (SDF, MuJoCo), and the name of a tile or the world"
            raise DataError(name, cause, "Change `name` in the tile.toml or survey.toml, and run it again")


def _check_names(scene: Scene) -> None:
    """Raise an error if a tile or the world has the robot's name."""
    if _is_robot_name(scene):
        raise DataError(
            ROBOT.name, "is the name of the robot, and of a tile or the world", "Choose another name: export.name"
        )


def metadata(scene: Scene, triangles: dict[str, int]) -> dict[str, Any]:
    """Content of metadata.json: georeference of a scene, and its files to check that it is complete."""
    georeference = sdf.Georeference.of(scene.frame)
    common = {"name": scene.name, "crs": scene.frame.crs, "unit_m": scene.frame.unit}
    rest: dict[str, Any] = {
        "world_origin_m": list(scene.origin),
        "wgs84": georeference and georeference.as_metadata(),
        "friction": scene.tiles[0].friction,
        "triangles_by_file": triangles,
    }
    rest |= sky_metadata(scene)
    rest |= spawn_metadata(scene)
    if scene.start:
        rest["robot"] = {"name": ROBOT.name, **_pose(scene.start)}
    if scene.robot_map:
        rest |= {"T_world_map": scene.robot_map.T_world_map.tolist(), "map_unit_m": scene.robot_map.unit}
    if len(scene.tiles) == 1:
        tile = scene.tiles[0]
        to_crs = "crs = (local + origin_m) / unit_m; OBJ and Collada are local, z-up; GLB is local, y-up (x, z, -y)"
        backdrop = sorted(file for file in triangles if Path(file).name.startswith(BACKDROP))
        rest |= {"backdrop": [file for file in backdrop if file.endswith(".obj")]} if backdrop else {}
        return {**common, "origin_m": list(tile.frame.origin), "to_crs": to_crs, "groups": dict(tile.groups), **rest}
    tiles = {
        tile.name: {
            "origin_m": list(tile.frame.origin),
            "offset_m": list(tile.offset),
            "low_m": list(tile.low),
            "high_m": list(tile.high),
        }
        for tile in scene.tiles
    }
    to_crs = "crs = (world + world_origin_m) / unit_m; world = local + offset_m, local as in a tile's meshes"
    return {**common, "to_crs": to_crs, "tiles": tiles, **rest}


def spawn_metadata(scene: Scene) -> dict[str, Any]:
    """Entry of metadata.json: a pose on free ground for the user's robots."""
    return {"spawn": _pose(scene.spawn)} if scene.spawn else {}


def _pose(start: Start) -> dict[str, Any]:
    return {"position_m": list(start.position), "angles_rad": list(start.angles), "on": start.by}


def sky_metadata(scene: Scene) -> dict[str, Any]:
    """Entries of metadata.json: colour of the sky, and the far clipping distance that cameras need for a dome."""
    colour = {"sky_rgb": list(scene.sky)} if scene.sky else {}
    return colour | ({"camera_far_m": ceil(scene.far)} if scene.far else {})


def write_pages(folder: Path, group: str, shape: Textured, params: SceneParams, prefix: str = "") -> PageNames:
    """Write a group's texture pages into `folder`; returns their names. `prefix` is that of the images' names."""
    make_folder(folder)
    materials = tuple(f"{group}_{page}" for page in range(len(shape.pages)))
    images = tuple(f"{prefix}{name}.{'png' if params.pages == 'png' else 'jpg'}" for name in materials)
    for page in shape.used_pages:
        if params.pages == "png":
            shutil.copyfile(shape.pages[page], folder / images[page])  # a copy, not a link: users may edit it
        else:
            image.write(folder / images[page], image.read_rgb(shape.pages[page]), quality=params.jpeg_quality)
        if params.source_pages and len(shape.seen) == len(shape.pages):
            shutil.copyfile(shape.seen[page], folder / f"{materials[page]}_seen.png")
    return PageNames(group, materials, images, tuple(shape.used_pages))


def write_solids(folder: Path, tile: SceneTile) -> tuple[list[Solid], dict[str, int]]:
    """Write the collision meshes of a tile (`collision_<name>.obj`); returns all shapes and the triangle counts."""
    found = solids(tile.solid(), tile.friction)
    triangles = {}
    for solid in found:
        if isinstance(solid.shape, Mesh):
            obj.write_plain(folder / f"collision_{solid.name}.obj", solid.shape)
            triangles[f"collision_{solid.name}.obj"] = len(solid.shape)
    return found, triangles


@dataclass(frozen=True)
class SingleMaterialMesh:
    """A mesh file with one material, for readers that don't support several.

    Attributes:
        name: name of the file, without its suffix, and of its material.
        code: LAS code of its class.
        label: name of its class.
        image: file of its texture page, in the same folder.
        triangles: number of triangles.
    """

    name: str
    code: int
    label: str
    image: str
    triangles: int


def shown(tile: SceneTile, params: SceneParams) -> dict[str, Textured]:
    """Surfaces of a tile by group, with the backs of upright faces that have none, if `params.double_sided`.

    For simulators that don't draw the back of a face, and have no flag that all of their sensors regard: Gazebo's lidar
    and segmentation camera replace materials by their own.
    """
    shapes = tile.textured()
    if not params.double_sided:
        return shapes
    meshes = [shape.mesh for shape in shapes.values()]
    return {group: shape.with_backs(open_backs(shape.mesh, meshes)) for group, shape in shapes.items()}


def write_single_material(folder: Path, tile: SceneTile, params: SceneParams) -> Iterator[SingleMaterialMesh]:
    """Write an OBJ for each class and texture page of a tile, and the pages, below `folder`."""
    for group, shape in shown(tile, params).items():
        pages = write_pages(folder, group, shape, params)
        for surface in by_class(group, shape):
            for page in surface.shape.used_pages:
                for part in surface.on_page(page).parts(params.max_visual_triangles):
                    name = f"{part.name}_{page}"
                    names = PageNames(name, pages.materials, pages.images, (page,))
                    obj.write(folder / f"{name}.obj", part.shape, names)
                    yield SingleMaterialMesh(name, part.code, part.label, pages.images[page], len(part.shape))

"""Gazebo: a world and a static model for each tile, in SDF; meshes in the formats of `export.meshes`.

Layout: `<name>.sdf`, and for each tile `models/<tile>/` with `model.sdf`, `model.config` and `meshes/`: one file per
class (a visual with its label), and the collision shapes (`collision_<class>.obj`; poles and trunks are cylinders).
`<name>_traffic.world` is the world with the recorded traffic: actors whose shapes are in `models/<actor>/`.
Texture pages have the model's name (`<tile>_<class>_<page>.png`): Gazebo takes textures of the same file name for one,
whatever their folders (gz-rendering #139), so that all tiles would get those of the first.
What only cameras see is in visuals of their own (`backdrop.obj`, `backdrop_sky.obj`), with a visibility flag.
Ceilings of rooms are a model of their own, `<tile>_ceiling`, so that a user can remove them for a view from above.
Tiles of a survey are in separate levels, which the simulator loads on demand; its sky,
`models/<name>_sky/`, is in none.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from scan2sim.pipeline.core.classes import CEILING
from scan2sim.pipeline.core.plugins import find
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.scenario_formats import gazebo_actors
from scan2sim.pipeline.io.scenario_formats.actor_meshes import write_obj
from scan2sim.pipeline.io.world_formats import GAZEBO_VISUAL_FORMATS, SceneParams
from scan2sim.pipeline.io.worlds import sdf
from scan2sim.pipeline.io.worlds.scene import BACKDROP, Scene, SceneTile, by_class
from scan2sim.pipeline.io.worlds.scene_traffic import scenario_of
from scan2sim.pipeline.io.worlds.textured_mesh import Textured


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the models in local metres, z up, and the world that places them."""
    triangles: dict[str, int] = {}
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        written = _models(folder / "models", tile, params)
        triangles |= {f"models/{file}": count for file, count in written.items()}
    triangles |= write_dome(folder, scene, params)
    _write_world(folder / f"{scene.name}.sdf", scene)
    return triangles


def write_traffic(scene: Scene, folder: Path) -> None:
    """Write the world with recorded traffic as `<name>_traffic.world`, and the actors' models; nothing if none moves.

    Raises:
        SpaceError: the disk is full or not writable.
    """
    scenario = scenario_of(scene)
    for actor in scenario.moving:
        meshes = folder / "models" / actor.name / "meshes"
        make_folder(meshes)
        write_obj(meshes / f"{actor.name}.obj", actor)
        sdf.write_config(meshes.parent, actor.name, f"Shape of a recorded {actor.track.category}.")
    if scenario.moving:
        _write_world(folder / f"{scenario.name}_traffic.world", scene, gazebo_actors.elements(scenario))


def _write_world(path: Path, scene: Scene, actors: str = "") -> None:
    """Write a world file; the models of its tiles are found in `models/` beside it."""
    georeference = sdf.Georeference.of(scene.frame)
    if len(scene.tiles) == 1:
        tile = scene.tiles[0]
        names = (tile.name, _ceiling_name(tile)) if _has_ceiling(tile) else (tile.name,)
        sdf.write_world(path, names, georeference, tile.offset, scene.start, scene.sky, actors, scene.spawn)
    else:
        placed = [sdf.PlacedModel(tile.name, tile.offset, tile.low, tile.high) for tile in scene.tiles]
        sdf.write_levels(
            path, scene.name, georeference, placed, sdf.LEVEL_BUFFER_M, sdf.PERFORMER_NAME, scene.start, scene.sky,
            {scene.dome.name: scene.dome.offset} if scene.dome else {}, actors, scene.spawn,
        )  # fmt: skip


def write_dome(folder: Path, scene: Scene, params: SceneParams) -> dict[str, int]:
    """Write the model of a survey's sky below a world's folder; returns the number of triangles of its mesh files."""
    if scene.dome is None:
        return {}
    return {f"models/{file}": count for file, count in _models(folder / "models", scene.dome, params).items()}


def _has_ceiling(tile: SceneTile) -> bool:
    return CEILING in tile.groups and len(tile.groups) > 1


def _ceiling_name(tile: SceneTile) -> str:
    return f"{tile.name}_{CEILING}"


def _models(models: Path, tile: SceneTile, params: SceneParams) -> dict[str, int]:
    """Write a tile's models; returns the number of triangles of their mesh files, by path below `models`."""
    shapes = world_formats.shown(tile, params)
    parts = {tile.name: shapes}
    if _has_ceiling(tile):
        parts = {
            tile.name: {group: shape for group, shape in shapes.items() if group != CEILING},
            _ceiling_name(tile): {CEILING: shapes[CEILING]},
        }
    triangles: dict[str, int] = {}
    for name, own in parts.items():
        written = _model(models / name, name, own, tile if name == tile.name else None, params)
        triangles |= {f"{name}/meshes/{file}": count for file, count in written.items()}
    return triangles


def _model(
    folder: Path, name: str, shapes: Mapping[str, Textured], solid: SceneTile | None, params: SceneParams
) -> dict[str, int]:
    """Write a model of some surfaces, and what bodies collide with (`solid`); returns the triangles of its files."""
    formats = {name: find("scan2sim.pipeline.io.mesh_formats", name, "export.meshes") for name in params.meshes}
    visual_suffix = next(formats[name].SUFFIX for name in GAZEBO_VISUAL_FORMATS if name in formats)
    meshes = folder / "meshes"
    triangles: dict[str, int] = {}
    visuals: dict[str, sdf.Visual] = {}
    surfaces = {group: (shape, by_class(group, shape)) for group, shape in shapes.items()}
    backdrop = solid.backdrop() if solid else []
    for group, (shape, own) in (surfaces | {surface.name: (surface.shape, [surface]) for surface in backdrop}).items():
        names = world_formats.write_pages(meshes, group, shape, params, f"{name}_")
        for surface in own:
            for part in surface.parts(params.max_visual_triangles):
                for mesh_format in formats.values():
                    mesh_format.write(meshes / f"{part.name}{mesh_format.SUFFIX}", part.shape, names)
                    triangles[f"{part.name}{mesh_format.SUFFIX}"] = len(part.shape)
                reflectance = part.shape.median_reflectance() if params.reflectance else None
                visuals[f"meshes/{part.name}{visual_suffix}"] = sdf.Visual(
                    part.code, reflectance, part.group == BACKDROP
                )
    solids, solid_triangles = world_formats.write_solids(meshes, solid) if solid else ([], {})
    sdf.write_model(folder, name, visuals, solids)
    return triangles | solid_triangles

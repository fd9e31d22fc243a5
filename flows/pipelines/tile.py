"""Pipeline definition of a tile: the task graph from clouds and photos to the world and its reports."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.flows.pipelines.graph import Output, Task, TaskId
from scan2sim.flows.pipelines.map_defaults import map_defaults
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile_graph import Sources, TileGraph
from scan2sim.pipeline.core.classes import GROUPS, INDOOR_GROUPS
from scan2sim.pipeline.core.step import Step
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.steps.clip import CLIP
from scan2sim.pipeline.steps.collision import COLLISION
from scan2sim.pipeline.steps.decimate import DECIMATE
from scan2sim.pipeline.steps.detect_furniture import DETECT_FURNITURE
from scan2sim.pipeline.steps.dynamic_objects import DYNAMIC_OBJECTS
from scan2sim.pipeline.steps.export import EXPORT
from scan2sim.pipeline.steps.facades import FACADES
from scan2sim.pipeline.steps.floor import FLOOR
from scan2sim.pipeline.steps.foliage import FOLIAGE
from scan2sim.pipeline.steps.free_space import FREE_SPACE
from scan2sim.pipeline.steps.furniture import FURNITURE
from scan2sim.pipeline.steps.geometry import GEOMETRY
from scan2sim.pipeline.steps.ghosts import GHOSTS
from scan2sim.pipeline.steps.ground import GROUND
from scan2sim.pipeline.steps.ingest import INGEST
from scan2sim.pipeline.steps.islands import ISLANDS
from scan2sim.pipeline.steps.join import JOIN
from scan2sim.pipeline.steps.lidar_score import LIDAR_SCORE
from scan2sim.pipeline.steps.map_colours import MAP_COLOURS
from scan2sim.pipeline.steps.navigation import NAVIGATION
from scan2sim.pipeline.steps.origin import ORIGIN
from scan2sim.pipeline.steps.overlap import OVERLAP
from scan2sim.pipeline.steps.path import PATH
from scan2sim.pipeline.steps.photo_coverage import PHOTO_COVERAGE
from scan2sim.pipeline.steps.pictures import PICTURES
from scan2sim.pipeline.steps.planes import PLANES
from scan2sim.pipeline.steps.plants import PLANTS
from scan2sim.pipeline.steps.poisson import POISSON
from scan2sim.pipeline.steps.preview import PREVIEW
from scan2sim.pipeline.steps.rasters import RASTERS
from scan2sim.pipeline.steps.reflectance import REFLECTANCE
from scan2sim.pipeline.steps.roads import ROADS
from scan2sim.pipeline.steps.rooms import ROOMS
from scan2sim.pipeline.steps.split import SPLIT
from scan2sim.pipeline.steps.split_mesh import SPLIT_MESH
from scan2sim.pipeline.steps.sweeps import SWEEPS
from scan2sim.pipeline.steps.tracks import FILES as TRACKS_FILES
from scan2sim.pipeline.steps.tracks import TRACKS
from scan2sim.pipeline.steps.trim import TRIM
from scan2sim.pipeline.steps.vehicle_models import VEHICLE_MODELS
from scan2sim.pipeline.steps.views import VIEWS
from scan2sim.pipeline.steps.visibility import VISIBILITY
from scan2sim.pipeline.steps.voxel import VOXEL
from scan2sim.pipeline.steps.walls import WALLS
from scan2sim.segmentation.huggingface import network_files
from scan2sim.segmentation.label_images import LabelImages
from scan2sim.segmentation.steps.instances import INSTANCES
from scan2sim.segmentation.steps.label import LABEL
from scan2sim.segmentation.steps.segment import SEGMENT
from scan2sim.segmentation.steps.signs import SIGNS
from scan2sim.texturing.backdrop.step import BACKDROP
from scan2sim.texturing.borders.colour_harmonization import COLOUR_HARMONIZATION
from scan2sim.texturing.borders.measure import BORDERS
from scan2sim.texturing.exposure import EXPOSURE
from scan2sim.texturing.photo_consistency import PHOTO_CONSISTENCY
from scan2sim.texturing.pose_refinement.step import POSE_REFINEMENT
from scan2sim.texturing.score import SCORE
from scan2sim.texturing.sky_colour import SKY_COLOUR
from scan2sim.texturing.splats.step import SPLATS
from scan2sim.texturing.texture import TEXTURE
from scan2sim.texturing.unwrap import UNWRAP
from scan2sim.texturing.view_selection.step import VIEW_SELECTION

STEPS: tuple[Step, ...] = (
    INGEST, PATH, DYNAMIC_OBJECTS, SWEEPS, VIEWS, LABEL, SEGMENT, INSTANCES, TRACKS, VEHICLE_MODELS, PHOTO_COVERAGE,
    GHOSTS, MAP_COLOURS, OVERLAP, DETECT_FURNITURE, FURNITURE, SPLIT, SPLIT_MESH, VOXEL, FLOOR, GROUND, WALLS, FACADES,
    ROOMS, POISSON, TRIM, FREE_SPACE, PLANES, ISLANDS, CLIP, JOIN, DECIMATE, PLANTS, UNWRAP, POSE_REFINEMENT, SIGNS,
    FOLIAGE, VISIBILITY, EXPOSURE, PHOTO_CONSISTENCY, VIEW_SELECTION, TEXTURE, COLOUR_HARMONIZATION, ROADS,
    SKY_COLOUR, BACKDROP, SPLATS, COLLISION, ORIGIN, NAVIGATION, REFLECTANCE, EXPORT, RASTERS, GEOMETRY, SCORE,
    LIDAR_SCORE, PICTURES, PREVIEW, BORDERS,
)  # fmt: skip
SIDE_PRODUCTS: tuple[Step, ...] = (
    TRACKS, VEHICLE_MODELS,
    GHOSTS, DETECT_FURNITURE, FURNITURE, SIGNS, PLANTS, ROADS, SKY_COLOUR, BACKDROP, SPLATS, NAVIGATION, REFLECTANCE,
    RASTERS, GEOMETRY, SCORE, LIDAR_SCORE, PICTURES, PREVIEW, BORDERS,
)  # fmt: skip
"""Steps without which the world is finished if they fail, in tiles and in surveys. Optional parts of the step `export`
are those of `pipeline.io.world_formats.write`; reports and the files of a whole survey are those of `flows.reports`."""


MAX_OWN_COORDINATES_M = 10_000.0
"""Largest coordinates of a robot's map that its world keeps; simulators render in float32."""


@dataclass(frozen=True)
class Scan:
    """Inputs from the classified scan.

    Attributes:
        has_ground_photos: whether there are photos other than orthophotos.
        path: path of the scanner or else of the cameras; empty if there is none.
        scanner_path: the same, but only of the scanner, for rays to the points.
        views: photos with poses.
        cameras: poses and lenses of the photos, without the photos: what depends on these alone.
        moving: points of moving objects.
        sweeps: sweeps of the scanner to score the world by; empty without the scanner's path.
        labels: classes in the photos; empty without photos from the ground.
    """

    has_ground_photos: bool
    path: Sources
    scanner_path: Sources
    views: Sources
    cameras: Sources
    moving: Sources
    sweeps: Sources
    labels: Sources


@dataclass(frozen=True)
class Parts:
    """The cloud split by class.

    Attributes:
        groups: classes that get a surface.
        cloud_groups: classes that the cloud is split into.
        furniture: outputs of step `furniture` by name.
        instances: detected instances (vehicles, ...), as an input.
        keep_vehicles: whether parked vehicles get a surface.
        clouds: thinned points of each class, inputs `cloud.CLASS`.
        uncovered: points of each class that photos don't cover, inputs `uncovered`; empty if there are none.
    """

    groups: list[str]
    cloud_groups: tuple[str, ...]
    furniture: Sources
    instances: Sources
    keep_vehicles: bool
    clouds: Sources
    uncovered: Mapping[str, Sources]


def build_graph(
    tile: Tile, settings: Settings, survey_tiles: Collection[str] | None = None, without: Collection[TaskId] = ()
) -> list[Task]:
    """The task graph of a tile, each task after those of the same tile that it reads.

    Args:
        tile: the tile to build.
        settings: of all steps.
        survey_tiles: names of all tiles of the survey that are built: tasks are then named `tile/step`, and steps at
            the borders read results of the neighbours. None: the tile is built alone, and ends at its borders.
        without: side products of this tile and its neighbours to leave out, because they failed.

    Raises:
        SettingError: a setting that doesn't exist or is out of range.
    """
    settings.check(STEPS)
    settings = settings.with_defaults({**map_defaults(tile.robot_map), **_splats_defaults(settings)})
    graph = TileGraph(tile, settings, survey_tiles, SIDE_PRODUCTS, without)
    scan = _classify(graph)
    instances, cloud, uncovered = _select_points(graph, scan)
    furniture = _detect_furniture(graph, scan, cloud)
    parts = _split(graph, scan, {"cloud": cloud, **uncovered}, instances, furniture)
    source = _split_source_mesh(graph, scan, parts)
    synthesized = {} if source else _synthesize_points(graph, scan, parts)
    for group in parts.groups:
        if source:
            _add_source_surface(graph, group)
        else:
            _add_surface(graph, scan, parts, group, synthesized.get(group, {}))
    tracks = _add_tracks(graph, scan, instances)
    parked = _model_vehicles(graph, tracks)
    lists = _list_objects(graph, scan, parts) | tracks
    closed, surfaces, photos, lists = _analyse_photos(graph, scan, parts, lists)
    textured = _texture(graph, parts, surfaces, photos, synthesized, source)
    splats = _add_splats(graph, scan, parts, surfaces, photos)
    solid, origin = _add_solid(graph, closed, parked, _only_splats_show(graph, parts) if splats else {})
    roads = _add_roads(graph, scan, textured, origin)
    sky = _add_sky(graph, scan, photos)
    backdrop = _add_backdrop(graph, scan, surfaces, photos)
    navigation = _add_navigation(graph, scan, closed, solid | origin)
    more = lists | roads | sky | backdrop | splats | solid | origin | navigation
    _export(graph, scan, parts, textured, photos, parked["textured"], more)
    _measure(graph, scan, parts, surfaces, textured, photos, synthesized, sky | backdrop | splats)
    _show(graph, scan, parts, textured, photos, sky, splats, navigation)
    return graph.tasks


def _classify(graph: TileGraph) -> Scan:
    """Read the cloud, remove moving objects, and classify points by photos and shape."""
    tile, output, add = graph.tile, graph.output, graph.add
    frame: dict[str, Any] = {"crs": tile.frame.crs, "origin": tile.frame.origin, "unit": tile.frame.unit}
    add(INGEST, {f"cloud.{i:04d}": path for i, path in enumerate(tile.clouds)}, **frame, classes=dict(tile.classes))
    path: Sources = {}
    if positions := scanner_path(tile):
        add(PATH, {}, **positions)
        path = {"path": output(PATH, "path")}
    rays = path if tile.trajectory is not None else {}  # cameras are not at the scanner's position
    ground_views = [view for view in tile.views if view.camera.model != "orthographic"]
    cameras = _position_rows([view.centre for view in ground_views])
    add(DYNAMIC_OBJECTS, {"cloud": output(INGEST, "cloud")} | rays, positions=cameras)
    cloud: Sources = {"cloud": output(DYNAMIC_OBJECTS, "cloud")}
    sweeps: Sources = {}
    if rays:
        add(SWEEPS, cloud | rays)
        cloud, sweeps = {"cloud": output(SWEEPS, "cloud")}, {"sweeps": output(SWEEPS, "sweeps")}
    photos: Sources = {f"photo.{i}": view.photo for i, view in enumerate(tile.views)}
    masks: Sources = {f"mask.{i}": view.mask for i, view in enumerate(tile.views) if view.mask}
    add(VIEWS, photos | masks | cloud, poses=tuple(views_io.to_json(view, with_paths=False) for view in tile.views))
    views: Sources = {"views": output(VIEWS, "views")}
    poses: Sources = {"views": output(VIEWS, "cameras")}
    moving: Sources = {"moving": output(DYNAMIC_OBJECTS, "moving")}
    labels: Sources = {}
    if ground_views:
        add(LABEL, cloud | views | _label_files(graph.settings, tile), **_segment_settings(graph.settings))
        labels = {"labels": output(LABEL, "labels")}
    add(SEGMENT, cloud | path | (poses | moving | labels if ground_views else {}), **_spacing(tile))
    return Scan(bool(ground_views), path, rays, views, poses, moving, sweeps, labels)


def _spacing(tile: Tile) -> dict[str, Any]:
    """Context of step `segment`: the point spacing of a robot's map; empty for other clouds."""
    if tile.robot_map is None:
        return {}
    return {"spacing" if tile.robot_map.scene == "outdoor" else "indoor_spacing": tile.robot_map.spacing}


def _select_points(graph: TileGraph, scan: Scan) -> tuple[Sources, Output, Sources]:
    """Detect instances, separate points that photos don't cover, and take the neighbours' points at borders.

    Returns:
        The instances, as an input, the resulting cloud, and the uncovered points, as an input.
    """
    output, add, path = graph.output, graph.add, scan.path
    instances: Sources = {}
    uncovered: Sources = {}
    last = SEGMENT  # the step whose cloud is split; the same one in all tiles of a survey
    if graph.params(INSTANCES).detect and (path or graph.neighbours):
        classified: Sources = {name: output(SEGMENT, name) for name in ("cloud", "confidence")}
        add(INSTANCES, classified | scan.moving | path)
        last, instances = INSTANCES, {"instances": output(INSTANCES, "instances")} if path else {}
    limit = graph.params(PHOTO_COVERAGE).limit
    if limit != "off" and (graph.neighbours or (path and (scan.has_ground_photos or limit != "auto"))):
        views = scan.cameras if scan.has_ground_photos else {}
        voxel = graph.params(VOXEL, "terrain").size
        add(PHOTO_COVERAGE, {"cloud": output(last, "cloud")} | path | views, voxel=voxel, cell=graph.cell or None)
        last = PHOTO_COVERAGE
        if graph.tile.robot_map is None:
            uncovered = {"uncovered": output(PHOTO_COVERAGE, "uncovered")}
    if graph.tile.robot_map is not None:
        add(GHOSTS, {"cloud": output(last, "cloud")}, spacing=graph.tile.robot_map.spacing)
        last = GHOSTS if graph.is_enabled(GHOSTS) else last
        add(MAP_COLOURS, {"cloud": output(last, "cloud")} | path)
        last = MAP_COLOURS
    if graph.neighbours:
        if uncovered:
            others = graph.neighbour_outputs(last, "uncovered", prefix="cloud")
            add(OVERLAP, {"cloud": uncovered["uncovered"]} | others, "uncovered", **graph.cell)
            uncovered = {"uncovered": output(OVERLAP, "cloud", "uncovered")}
        add(OVERLAP, {"cloud": output(last, "cloud")} | graph.neighbour_outputs(last, "cloud"), **graph.cell)
        last = OVERLAP
    return instances, output(last, "cloud"), uncovered


def _detect_furniture(graph: TileGraph, scan: Scan, cloud: Output) -> Sources:
    """Detect street furniture and model it; returns the outputs of step `furniture`."""
    if not (scan.path or graph.neighbours) or graph.params(FURNITURE).when != "auto" or _is_indoor(graph):
        return {}
    graph.add(DETECT_FURNITURE, {"cloud": cloud} | scan.path, **graph.cell)
    if not (graph.is_enabled(DETECT_FURNITURE) and graph.is_enabled(FURNITURE)):
        return {}
    detections = graph.neighbour_outputs(DETECT_FURNITURE, "detections")
    own = {"cloud": cloud, "detections": graph.output(DETECT_FURNITURE, "detections")}
    graph.add(FURNITURE, own | detections, **graph.cell)
    names = (*GROUPS[1:], "furniture_points", "sign_panels", "neighbour_poles", "geojson", "csv")
    return {name: graph.output(FURNITURE, name) for name in names}


def _split(graph: TileGraph, scan: Scan, clouds: Sources, instances: Sources, furniture: Sources) -> Parts:
    """Split the covered and uncovered points by class, and thin each part."""
    params = graph.params(SPLIT)
    keep_vehicles = params.vehicles == "keep" and bool(instances)
    furniture_points = {name: furniture[name] for name in furniture if name == "furniture_points"}
    indoor: dict[str, Any] = {"indoor": True} if _is_indoor(graph) else {}
    graph.add(SPLIT, clouds | (instances if keep_vehicles else {}) | furniture_points, **indoor)
    more = (*(("vehicle",) if keep_vehicles else ()), *(INDOOR_GROUPS if indoor else ()))
    groups = [group for group in (*GROUPS, *more) if group != "vegetation" or params.vegetation != "locations"]
    cloud_groups = (*GROUPS, "rest", *more)
    for part in cloud_groups:
        graph.add(VOXEL, {"cloud": graph.output(SPLIT, part)} | scan.path, part)
    thinned: Sources = {f"cloud.{part}": graph.output(VOXEL, "cloud", part) for part in cloud_groups}
    uncovered: dict[str, Sources] = {}
    if "uncovered" in clouds:
        uncovered = {group: {"uncovered": graph.output(SPLIT, f"uncovered_{group}")} for group in GROUPS}
    return Parts(groups, cloud_groups, furniture, instances, keep_vehicles, thinned, uncovered)


def _synthesize_points(graph: TileGraph, scan: Scan, parts: Parts) -> dict[str, Sources]:
    """Add points that the scanner did not see: occluded ground, walls below roofs and above its view; by class."""
    synthesized: dict[str, Sources] = {}
    if graph.tile.robot_map is not None:
        return {"terrain": _add_floor(graph, scan)}
    airborne = {"always": True, "never": False, "auto": not scan.path}  # whether steps for airborne clouds run
    when = graph.params(GROUND).when
    hidden = parts.instances if when == "auto" else {}
    if hidden or airborne[when]:
        others = graph.neighbour_outputs(INSTANCES, "instances") if hidden else {}
        synthesized["terrain"] = _synthesize_from_voxels(graph, GROUND, (*GROUPS, "rest"), hidden | others)
    if airborne[graph.params(WALLS).when] and not _is_indoor(graph):
        below: Sources = {"ground": synthesized["terrain"]["synthesized"]} if "terrain" in synthesized else {}
        below |= {"footprints": graph.tile.footprints} if graph.tile.footprints else {}
        synthesized["building"] = _synthesize_from_voxels(graph, WALLS, ("building", "terrain"), below)
    elif scan.scanner_path and scan.has_ground_photos and graph.params(FACADES).when == "auto":
        clouds = {"cloud": parts.clouds["cloud.building"]} | _other_clouds(parts, "building")
        photos = scan.views | scan.labels
        voxel = graph.params(VOXEL, "building").size
        graph.add(FACADES, clouds | scan.scanner_path | photos, voxel=voxel, cell=graph.cell or None)
        synthesized["building"] = {"synthesized": graph.output(FACADES, "synthesized")}
    return synthesized


def _add_floor(graph: TileGraph, scan: Scan) -> Sources:
    """The ground of a robot's map; returns the points of its assumed part."""
    assert graph.tile.robot_map is not None
    clouds: Sources = {part: graph.output(VOXEL, "cloud", part) for part in (*GROUPS, "rest")}
    graph.add(FLOOR, clouds | scan.path, scene=graph.tile.robot_map.scene, spacing=graph.tile.robot_map.spacing)
    return {"synthesized": graph.output(FLOOR, "synthesized")}


def _synthesize_from_voxels(graph: TileGraph, step: Step, classes: Sequence[str], more: Sources) -> Sources:
    """Add a step that synthesizes points from the voxels of some classes, including those of the neighbours."""
    inputs: Sources = {part: graph.output(VOXEL, "cloud", part) for part in classes}
    for part in classes:
        inputs |= graph.neighbour_outputs(VOXEL, "cloud", part, prefix=part)
    graph.add(step, inputs | more, **graph.cell)
    return {"synthesized": graph.output(step, "synthesized")}


def _split_source_mesh(graph: TileGraph, scan: Scan, parts: Parts) -> Sources:
    """Split the textured mesh that the tile was made from by class; returns it as an input, empty if there is none.

    Scans of rooms have holes: bodies collide with a floor without any.
    """
    if graph.tile.robot_map is None or graph.tile.robot_map.source_mesh is None:
        return {}
    source: Sources = {"source_mesh": graph.tile.robot_map.source_mesh}
    clouds = {name: graph.output(SPLIT, name) for name in parts.cloud_groups}
    target = {group: graph.params(DECIMATE, group).target for group in parts.groups}
    min_area = {group: graph.params(ISLANDS, group).min_area for group in parts.groups}
    graph.add(SPLIT_MESH, source | clouds, origin=graph.tile.frame.origin, target=target, min_area=min_area)
    if _has_floor(graph):
        _add_floor(graph, scan)
    return source


def _add_source_surface(graph: TileGraph, group: str) -> None:
    """The mesh of a class from the textured mesh that the tile was made from: remove islands, decimate."""
    graph.add(ISLANDS, {"mesh": graph.output(SPLIT_MESH, group)}, group)
    graph.add(DECIMATE, {"mesh": graph.output(ISLANDS, "mesh", group)}, group, keep_border=True)


def _add_surface(graph: TileGraph, scan: Scan, parts: Parts, group: str, synthesized: Sources) -> None:
    """The mesh of a class: reconstruct, trim, snap to planes, join with the neighbours' meshes, decimate."""
    output, add, cell = graph.output, graph.add, graph.cell
    if _is_indoor(graph) and group in ("building", *INDOOR_GROUPS):
        _add_rooms(graph, parts, group)
        return
    voxel = graph.params(VOXEL, group).size
    if group == "terrain" and graph.tile.robot_map is not None:
        add(DECIMATE, {"mesh": output(FLOOR, "mesh")}, group)
        return
    points: Sources = {"cloud": output(VOXEL, "cloud", group), **synthesized}
    uncovered = parts.uncovered.get(group, {})
    add(POISSON, points | uncovered, group, voxel=voxel, cell=cell or None)
    add(TRIM, {"mesh": output(POISSON, "mesh", group)} | points | uncovered, group, voxel=voxel)
    surface = output(TRIM, "mesh", group)
    if scan.scanner_path and graph.params(FREE_SPACE, group).when == "auto":
        rays = {"cloud": output(SWEEPS, "cloud")} | scan.scanner_path
        add(FREE_SPACE, {"mesh": surface} | rays, group, cell=cell or None)
        surface = output(FREE_SPACE, "mesh", group)
    when = graph.params(PLANES).when
    if group == "building" and (when == "always" or (when == "auto" and scan.path)):
        clouds = {**points, "points": output(SPLIT, group), **_other_clouds(parts, group)}
        add(PLANES, {"mesh": surface, **clouds}, voxel=voxel, cell=cell or None)
        surface = output(PLANES, "mesh")
    add(ISLANDS, {"mesh": surface}, group)
    surface = output(ISLANDS, "mesh", group)
    if cell:
        add(CLIP, {"mesh": surface}, group, **cell)
        surface = output(CLIP, "mesh", group)
    if graph.neighbours:
        clipped = {name: output(CLIP, name, group) for name in ("mesh", "on")}
        others = {f"{name}.{tile}": output(CLIP, name, group, tile) for tile in graph.border_owners for name in clipped}
        add(JOIN, clipped | others, group, **cell)
        surface = output(JOIN, "mesh", group)
    furniture = {"furniture": parts.furniture[group]} if group in parts.furniture else {}
    by_points = graph.tile.robot_map is not None
    counted = uncovered | ({"cloud": points["cloud"]} if uncovered or by_points else {})
    context = {"keep_border": bool(cell), "cell": cell or None, "by_points": by_points}
    add(DECIMATE, {"mesh": surface} | counted | furniture, group, **context)


def _has_floor(graph: TileGraph) -> bool:
    """Whether bodies collide with a floor map: in robots' maps, but not in meshes of terrain, which has no holes."""
    return graph.tile.robot_map is not None and (graph.tile.robot_map.source_mesh is None or _is_indoor(graph))


def _is_mesh(graph: TileGraph) -> bool:
    """Whether the tile was made from a textured mesh."""
    return graph.tile.robot_map is not None and graph.tile.robot_map.source_mesh is not None


def _is_indoor(graph: TileGraph) -> bool:
    """Whether the tile is a robot's map of rooms."""
    return graph.tile.robot_map is not None and graph.tile.robot_map.scene == "indoor"


def _has_rooms(graph: TileGraph) -> bool:
    """Whether rooms are modelled: the tile is a robot's map of rooms, and a cloud."""
    return _is_indoor(graph) and _has_floor(graph)


def _add_rooms(graph: TileGraph, parts: Parts, group: str) -> None:
    """Walls, ceilings or furniture of a robot's map of rooms, modelled instead of reconstructed."""
    assert graph.tile.robot_map is not None
    others: Sources = {
        f"other.{part}": graph.output(SPLIT, part) for part in parts.cloud_groups if part not in (group, "rest")
    }
    cloud: Sources = {"cloud": graph.output(SPLIT, group)}
    graph.add(ROOMS, cloud | others, group, surface=group, spacing=graph.tile.robot_map.spacing)
    graph.add(DECIMATE, {"mesh": graph.output(ROOMS, "mesh", group)}, group)


def _list_objects(graph: TileGraph, scan: Scan, parts: Parts) -> Sources:
    """Lists of ghosts, openings of rooms, street furniture and plants, as inputs of the export."""
    lists: Sources = {"rooms": graph.output(ROOMS, "list", "building")} if _has_rooms(graph) else {}
    if graph.tile.robot_map is not None and graph.is_enabled(GHOSTS):
        lists["ghosts"] = graph.output(GHOSTS, "geojson")
    if parts.furniture and scan.path:
        lists |= {"furniture_geojson": parts.furniture["geojson"], "furniture_csv": parts.furniture["csv"]}
    if graph.params(SPLIT).vegetation != "mesh" and graph.is_enabled(PLANTS):
        clouds = {name: graph.output(VOXEL, "cloud", name) for name in ("vegetation", "terrain")}
        graph.add(PLANTS, clouds, **graph.cell)
        lists |= {"plants": graph.output(PLANTS, "geojson"), "plants_csv": graph.output(PLANTS, "csv")}
    return lists


def _add_tracks(graph: TileGraph, scan: Scan, instances: Sources) -> Sources:
    """Follow road users through the sweeps; returns their tracks as inputs of the export."""
    wanted = scan.scanner_path and instances and graph.tile.robot_map is None
    if not wanted or graph.params(TRACKS).when == "never" or not graph.is_enabled(TRACKS):
        return {}
    classified: Sources = {"cloud": graph.output(INSTANCES, "cloud")}
    views = scan.views if scan.has_ground_photos else {}
    graph.add(TRACKS, classified | scan.moving | scan.scanner_path | instances | views)
    return {name: graph.output(TRACKS, name) for name in TRACKS_FILES}


def _model_vehicles(graph: TileGraph, tracks: Sources) -> dict[str, Sources]:
    """Models of parked vehicles as inputs: their `mesh`, and their `textured` mesh; empty if they aren't wanted."""
    if graph.params(SPLIT).vehicles != "assets" or not tracks or not graph.is_enabled(VEHICLE_MODELS):
        return {"mesh": {}, "textured": {}}
    graph.add(VEHICLE_MODELS, {"tracks": tracks["tracks"]}, **graph.cell)
    return {name: {"vehicle": graph.output(VEHICLE_MODELS, name)} for name in ("mesh", "textured")}


def _plant_models(graph: TileGraph, output: str) -> Sources:
    """Models of plants as an input, if there is no mesh of the vegetation."""
    wanted = graph.params(PLANTS).models and graph.params(SPLIT).vegetation == "locations"
    return {"vegetation": graph.output(PLANTS, output)} if wanted and graph.is_enabled(PLANTS) else {}


def _analyse_photos(
    graph: TileGraph, scan: Scan, parts: Parts, lists: Sources
) -> tuple[Sources, Sources, Sources, Sources]:
    """Refine poses, fit signs to photos, open foliage, and compute visibility, exposure and photo consistency.

    Returns:
        The closed mesh of each class, the final one, the inputs about photos (`cameras`: poses and lenses of `views`),
        and the lists with the fitted signs.
    """
    output, add = graph.output, graph.add
    surfaces: Sources = {group: output(DECIMATE, "mesh", group) for group in parts.groups}
    photos, cameras = scan.views, scan.cameras
    if scan.has_ground_photos and graph.params(POSE_REFINEMENT).when == "auto":
        rest = {"cloud.rest": parts.clouds["cloud.rest"]}
        add(POSE_REFINEMENT, _mesh_inputs(surfaces) | rest | scan.moving | photos)
        photos = {"views": output(POSE_REFINEMENT, "views")}
        cameras = {"views": output(POSE_REFINEMENT, "cameras")}
    fits_signs = scan.has_ground_photos and parts.furniture and graph.params(SIGNS).when == "auto"
    if fits_signs and graph.is_enabled(SIGNS):
        known = {name: parts.furniture[name] for name in ("sign_panels", "neighbour_poles", "geojson")}
        add(SIGNS, _mesh_inputs(surfaces) | known | photos | scan.labels, **graph.cell)
        surfaces |= {group: output(SIGNS, group) for group in parts.groups if group in ("building", "vegetation")}
        lists = lists | {"furniture_geojson": output(SIGNS, "geojson"), "furniture_csv": output(SIGNS, "csv")}
    closed = surfaces
    surfaces = closed | _open_foliage(graph, scan, closed)
    slim: Sources = {"furniture": output(SPLIT, "furniture")} if parts.furniture else {}
    add(VISIBILITY, _mesh_inputs(surfaces) | parts.clouds | slim | scan.moving | cameras)
    photos = {**photos, "depth": output(VISIBILITY, "depth")}
    prior = graph.params(EXPOSURE).prior
    add(EXPOSURE, photos | ({"prior": Path(prior)} if prior else {}))
    photos = {**photos, "exposures": output(EXPOSURE, "exposures")}
    add(PHOTO_CONSISTENCY, photos | scan.labels)
    photos |= {"photo_consistency": output(PHOTO_CONSISTENCY, "photo_consistency"), "cameras": cameras["views"]}
    return closed, surfaces, photos, lists


def _open_foliage(graph: TileGraph, scan: Scan, surfaces: Sources) -> Sources:
    """Replace vegetation that rays of the scanner pass through by leaf cards; returns its mesh, empty if it is kept."""
    if "vegetation" not in surfaces or graph.params(FOLIAGE).when == "never":
        return {}
    rays = {"cloud": _classified(graph, scan)} | scan.scanner_path
    graph.add(FOLIAGE, {"mesh": surfaces["vegetation"]} | rays, cell=graph.cell or None)
    return {"vegetation": graph.output(FOLIAGE, "mesh")}


def _classified(graph: TileGraph, scan: Scan) -> Output:
    """The tile's own classified points, static and without held-out sweeps."""
    detected = graph.params(INSTANCES).detect and (scan.path or graph.neighbours)
    return graph.output(INSTANCES if detected else SEGMENT, "cloud")


def _add_sky(graph: TileGraph, scan: Scan, photos: Sources) -> Sources:
    """Colour of the sky in the photos; returns it as an input of what shows the world."""
    if not scan.has_ground_photos or _is_indoor(graph) or not graph.is_enabled(SKY_COLOUR):
        return {}
    known = {name: photos[name] for name in ("views", "depth", "exposures")}
    graph.add(SKY_COLOUR, known | scan.labels)
    return {"sky": graph.output(SKY_COLOUR, "sky")}


def _texture(
    graph: TileGraph,
    parts: Parts,
    surfaces: Sources,
    photos: Sources,
    synthesized: Mapping[str, Sources],
    source: Sources,
) -> Sources:
    """Select views, unwrap and texture each class, and harmonize its colours with the neighbours'."""
    output, add = graph.output, graph.add
    furniture: Sources = {"cloud.furniture": output(SPLIT, "furniture")} if parts.furniture else {}
    points = parts.clouds | furniture | _synthesized_inputs(synthesized)
    if graph.tile.robot_map is not None:  # points finer than the voxels show lane markings
        points |= {"raw.terrain": output(SPLIT, "terrain"), "colour_source": output(MAP_COLOURS, "source")}
    cameras: Sources = {"views": photos["cameras"]}
    seen: Sources = cameras | {name: photos[name] for name in ("depth", "photo_consistency")}
    corrected = {name: photos[name] for name in ("views", "depth", "exposures", "photo_consistency")}
    for group in parts.groups:
        mesh: Sources = {"mesh": surfaces[group]}
        add(VIEW_SELECTION, mesh | seen, group)
        choice: Sources = {"choice": output(VIEW_SELECTION, "choice", group)}
        by_photo = choice | cameras if graph.params(UNWRAP, group).backend == "photo" else {}
        uncovered = parts.uncovered.get(group, {})
        coarse = uncovered | ({"cloud": parts.clouds[f"cloud.{group}"]} if uncovered else {})
        add(UNWRAP, mesh | by_photo | source | coarse, group)
        unwrapped = {name: output(UNWRAP, name, group) for name in ("mesh", "pages")}
        removed = parts.instances if group == "terrain" and not parts.keep_vehicles else {}
        known = {**choice, **points, **corrected, **removed, **source, **uncovered}
        add(TEXTURE, unwrapped | known, group, surface=group)
    last = TEXTURE
    if graph.neighbours:
        last = COLOUR_HARMONIZATION
        for group in parts.groups:
            others = graph.neighbour_outputs(TEXTURE, "textured", group, prefix="neighbour")
            add(COLOUR_HARMONIZATION, {"textured": output(TEXTURE, "textured", group)} | others, group)
    return {group: output(last, "textured", group) for group in parts.groups}


def _add_backdrop(graph: TileGraph, scan: Scan, surfaces: Sources, photos: Sources) -> Sources:
    """What cameras see beyond the scan; returns it as an input of the export and the score."""
    if not scan.has_ground_photos or _is_indoor(graph) or graph.params(BACKDROP).when == "never":
        return {}
    known = {name: photos[name] for name in ("views", "depth", "exposures")} | scan.labels
    meshes = _mesh_inputs(surfaces | _plant_models(graph, "mesh"))
    graph.add(BACKDROP, known | meshes, cell=graph.cell or None)
    return {"backdrop": graph.output(BACKDROP, "backdrop")} if graph.is_enabled(BACKDROP) else {}


def _add_splats(graph: TileGraph, scan: Scan, parts: Parts, surfaces: Sources, photos: Sources) -> Sources:
    """Splats, which show cameras what photos show; returns them as an input of the export and the score."""
    if not scan.has_ground_photos or _is_indoor(graph) or graph.params(SPLATS).when == "never":
        return {}
    known = {name: photos[name] for name in ("views", "depth", "exposures")} | scan.labels
    meshes = _mesh_inputs(surfaces | _plant_models(graph, "mesh"))
    known |= parts.instances | scan.moving
    graph.add(SPLATS, known | meshes, cell=graph.cell or None, origin=graph.tile.frame.origin)
    return {"splats": graph.output(SPLATS, "splats")} if graph.is_enabled(SPLATS) else {}


def _splats_defaults(settings: Settings) -> Mapping[str, Mapping[str, Any]]:
    """Splats show no parked vehicles either if the user has removed these; by default they do."""
    return {"splats": {"parked": False}} if settings.values.get("split", {}).get("vehicles") == "remove" else {}


def _only_splats_show(graph: TileGraph, parts: Parts) -> Sources:
    """Instances, as an input, if splats show parked vehicles that have neither a surface nor a model."""
    return parts.instances if graph.params(SPLATS).parked and graph.params(SPLIT).vehicles == "remove" else {}


def _add_solid(
    graph: TileGraph, surfaces: Sources, parked: Mapping[str, Sources], boxes: Sources
) -> tuple[Sources, Sources]:
    """The collision mesh, and the world's origin unless it is chosen or that of a robot's map; as inputs of steps.

    Args:
        graph: the graph.
        surfaces: closed meshes by class.
        parked: models of parked vehicles.
        boxes: instances, of which parked vehicles become boxes.
    """
    # the floor of a robot's map is denoised already, and its assumed part must not follow points nearby
    terrain: Sources = {} if _has_floor(graph) else {"cloud": graph.output(SPLIT, "terrain")}
    ground = {"terrain": graph.output(FLOOR, "mesh")} if _has_floor(graph) and _is_mesh(graph) else {}
    meshes = {**surfaces, **ground, **_plant_models(graph, "mesh"), **parked["mesh"]}
    graph.add(COLLISION, meshes | terrain | boxes, **graph.cell)
    solid: Sources = {"collision": graph.output(COLLISION, "mesh")}
    if world_origin(graph.tile, graph.settings) is not None:
        return solid, {}
    graph.add(ORIGIN, solid)
    return solid, {"origin": graph.output(ORIGIN, "origin")}


def _add_roads(graph: TileGraph, scan: Scan, textured: Sources, origin: Sources) -> Sources:
    """Extract the roads; returns them and the path as inputs of the export."""
    if not scan.path or graph.params(ROADS).when == "never" or not graph.is_enabled(ROADS):
        return scan.path
    ground = {"cloud": graph.output(SPLIT, "terrain"), "textured": textured["terrain"]}
    chosen = world_origin(graph.tile, graph.settings)
    inputs = ground | scan.path | origin
    graph.add(ROADS, inputs, name=graph.tile.name, world_origin=chosen, cell=graph.cell or None)
    outputs = {"roads": "geojson", "roads_seen": "seen", "opendrive": "opendrive"}
    return scan.path | {name: graph.output(ROADS, output) for name, output in outputs.items()}


def _export(
    graph: TileGraph,
    scan: Scan,
    parts: Parts,
    textured: Sources,
    photos: Sources,
    parked: Sources,
    more: Sources,
) -> None:
    """The world, with what else was made for it (`more`), and rasters."""
    output, add, name = graph.output, graph.add, graph.tile.name
    planted = textured | _plant_models(graph, "textured") | parked
    choice = {f"choice.{group}": output(VIEW_SELECTION, "choice", group) for group in parts.groups}
    floor = {"floor": output(FLOOR, "mask")} if _has_floor(graph) else {}
    reflectance = _add_reflectance(graph, scan, textured)
    inputs = planted | choice | parts.instances | {"views": photos["cameras"]} | floor | more | reflectance
    add(EXPORT, inputs, **_export_context(graph))
    if graph.params(EXPORT).rasters:
        add(RASTERS, textured, name=name, **_raster_context(graph.settings))


def _add_reflectance(graph: TileGraph, scan: Scan, textured: Sources) -> Sources:
    """Reflectance of the textured surfaces; returns it as an input of the export."""
    if not graph.params(EXPORT).reflectance or not graph.is_enabled(REFLECTANCE):
        return {}
    surfaces: Sources = {f"textured.{group}": folder for group, folder in textured.items()}
    rays = scan.sweeps | scan.moving if scan.sweeps else {}
    graph.add(REFLECTANCE, {"cloud": graph.output(SEGMENT, "cloud")} | scan.scanner_path | rays | surfaces)
    return {"reflectance": graph.output(REFLECTANCE, "reflectance")}


def _add_navigation(graph: TileGraph, scan: Scan, surfaces: Sources, placed: Sources) -> Sources:
    """Occupancy maps and points for localization; returns them as an input of the export.

    `placed` are the collision mesh and the world's origin.
    """
    when, robot_map = graph.params(NAVIGATION).when, graph.tile.robot_map
    wanted = when == "always" or (when == "auto" and robot_map is not None)
    if graph.cell or not wanted or not graph.is_enabled(NAVIGATION):
        return {}
    cloud = {"cloud": graph.output(DYNAMIC_OBJECTS, "cloud")} if robot_map else {}
    meshes = placed | _mesh_inputs(surfaces)
    context = _frames(graph.tile, graph.settings)
    if robot_map:
        context |= {"spacing": robot_map.spacing, "has_floor": _has_floor(graph)}
    graph.add(NAVIGATION, meshes | cloud | scan.path, **context)
    return {"navigation": graph.output(NAVIGATION, "navigation")}


def _frames(tile: Tile, settings: Settings) -> dict[str, Any]:
    """Contexts of `navigation` and `export`: origin of the world, and the transform from the robot's map."""
    frames: dict[str, Any] = {"world_origin": world_origin(tile, settings)}
    if tile.robot_map is not None:
        rows = tuple(map(tuple, tile.robot_map.T_world_map.tolist()))
        frames |= {"T_world_map": rows, "unit": tile.robot_map.unit}
    return frames


def _export_context(graph: TileGraph) -> dict[str, Any]:
    """Context of `export`: name and frames, and whether the tile shows rooms."""
    indoor = {"indoor": True} if _is_indoor(graph) else {}
    return {"name": graph.tile.name, **_frames(graph.tile, graph.settings), **indoor}


def world_origin(tile: Tile, settings: Settings) -> tuple[float, float, float] | None:
    """Origin of the simulator's world in the CRS, metres; None: the tile's own.

    World coordinates of a robot's map are the map's, unless it has a CRS or is too far for float32.
    """
    chosen: tuple[float, float, float] | None = settings.params(EXPORT).world_origin
    near = max(map(abs, tile.frame.origin)) <= MAX_OWN_COORDINATES_M
    if chosen is None and tile.robot_map is not None and tile.frame.crs == "local" and near:
        return 0.0, 0.0, 0.0
    return chosen


def _measure(
    graph: TileGraph,
    scan: Scan,
    parts: Parts,
    surfaces: Sources,
    textured: Sources,
    photos: Sources,
    synthesized: Mapping[str, Sources],
    sky: Sources,
) -> None:
    """Metrics of surfaces, textures and borders."""
    output, add, tile = graph.output, graph.add, graph.tile
    truth: Sources = {}
    if tile.truth_mesh and tile.truth_points:
        truth = {"truth.mesh": tile.truth_mesh, "truth.points": tile.truth_points}
    clouds = parts.clouds | _synthesized_inputs(synthesized)
    add(GEOMETRY, _mesh_inputs(surfaces) | clouds | truth, **graph.cell)
    seen: Sources = {name: photos[name] for name in ("views", "depth")}
    add(SCORE, textured | seen | scan.labels | sky | parts.instances | truth)
    if scan.sweeps:
        cloud = {"cloud": _classified(graph, scan)}
        meshes = _mesh_inputs(surfaces | _plant_models(graph, "mesh"))
        found = scan.sweeps | scan.moving | meshes | cloud | parts.instances
        add(LIDAR_SCORE, found, vehicles=parts.keep_vehicles, cell=graph.cell or None)
    if graph.neighbours:
        step = COLOUR_HARMONIZATION
        own = {f"textured.{group}": output(step, "textured", group) for group in parts.groups}
        others = {
            f"textured.{group}.{tile}": output(step, "textured", group, tile)
            for group in parts.groups
            for tile in graph.border_owners
        }
        add(BORDERS, own | others, **graph.cell)


def _show(
    graph: TileGraph,
    scan: Scan,
    parts: Parts,
    textured: Sources,
    photos: Sources,
    sky: Sources,
    splats: Sources,
    navigation: Sources,
) -> None:
    """The walkable preview and the pictures of the report."""
    graph.add(PREVIEW, textured | _plant_models(graph, "textured") | scan.path | splats)
    stages = {f"decimate.{group}": graph.output(DECIMATE, "mesh", group) for group in parts.groups}
    graph.add(PICTURES, textured | stages | parts.clouds | {"views": photos["views"]} | sky | scan.path | navigation)


def _other_clouds(parts: Parts, group: str) -> Sources:
    """The voxels of all other classes, as inputs."""
    return {f"other.{part}": parts.clouds[f"cloud.{part}"] for part in parts.cloud_groups if part != group}


def _mesh_inputs(surfaces: Sources) -> Sources:
    return {f"mesh.{group}": mesh for group, mesh in surfaces.items()}


def _synthesized_inputs(synthesized: Mapping[str, Sources]) -> Sources:
    return {f"synthesized.{group}": points["synthesized"] for group, points in synthesized.items()}


def check_here(settings: Settings) -> None:
    """Reject settings that don't exist or can't be used on this machine, before a tile is read.

    Raises:
        SettingError: as `build_graph`.
        ScanError: a step can't run on this machine.
    """
    settings.check(STEPS)
    for step in STEPS:
        if step.check:
            step.check(settings.params(step))


def _label_files(settings: Settings, tile: Tile) -> dict[str, Path | Output]:
    """The user's label images, or weights and what a network reads beside them, as inputs: part of the cache key."""
    given = settings.params(LABEL)
    if given.images is not None:
        images = LabelImages(given.images, tile.views)
        files = [*images.files.values(), *([images.names] if images.names.is_file() else [])]
        return {f"image.{i}": file for i, file in enumerate(files)}
    return {f"weights.{i}": file for i, file in enumerate(network_files(given.weights) if given.weights else ())}


def _segment_settings(settings: Settings) -> dict[str, Any]:
    """Settings of step `segment` that step `label` needs: when photos are classified."""
    segment_params = settings.params(SEGMENT)
    return {
        "overwrite": segment_params.overwrite,
        "min_classified": segment_params.min_classified,
        "photos": segment_params.photos,
    }


def _raster_context(settings: Settings) -> dict[str, Any]:
    """Settings of `export` and `unwrap` that step `rasters` needs."""
    wanted, texel = settings.params(EXPORT).rasters, settings.params(UNWRAP, "terrain").texel
    return {"pixel": texel if wanted is True else wanted, "texel": texel}


def scanner_path(tile: Tile) -> dict[str, Any]:
    """Parameters of step `path`: positions of the trajectory or else of the cameras; empty if there is neither.

    Orthophotos have no camera position.
    """
    if tile.trajectory is not None:
        return {"positions": _position_rows(tile.trajectory.positions), "times": tuple(tile.trajectory.times.tolist())}
    views = [view for view in tile.views if view.camera.model != "orthographic"]
    if not views:
        return {}
    times = tuple(view.time for view in views)
    return {
        "positions": _position_rows([view.centre for view in views]),
        "times": times if all(t is not None for t in times) else None,
    }


def _position_rows(positions: object) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in np.asarray(positions).round(4).tolist())

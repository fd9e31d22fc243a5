"""Pipeline definition of a tile: the task graph from clouds and photos to the world and its reports."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.flows.pipelines.graph import Output, Task, TaskId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile_graph import Sources, TileGraph
from scan2sim.pipeline.core.classes import GROUPS
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
from scan2sim.pipeline.steps.furniture import FURNITURE
from scan2sim.pipeline.steps.geometry import GEOMETRY
from scan2sim.pipeline.steps.ground import GROUND
from scan2sim.pipeline.steps.ingest import INGEST
from scan2sim.pipeline.steps.islands import ISLANDS
from scan2sim.pipeline.steps.join import JOIN
from scan2sim.pipeline.steps.overlap import OVERLAP
from scan2sim.pipeline.steps.path import PATH
from scan2sim.pipeline.steps.photo_coverage import PHOTO_COVERAGE
from scan2sim.pipeline.steps.pictures import PICTURES
from scan2sim.pipeline.steps.planes import PLANES
from scan2sim.pipeline.steps.plants import PLANTS
from scan2sim.pipeline.steps.poisson import POISSON
from scan2sim.pipeline.steps.preview import PREVIEW
from scan2sim.pipeline.steps.rasters import RASTERS
from scan2sim.pipeline.steps.roads import ROADS
from scan2sim.pipeline.steps.split import SPLIT
from scan2sim.pipeline.steps.trim import TRIM
from scan2sim.pipeline.steps.views import VIEWS
from scan2sim.pipeline.steps.visibility import VISIBILITY
from scan2sim.pipeline.steps.voxel import VOXEL
from scan2sim.pipeline.steps.walls import WALLS
from scan2sim.segmentation.steps.instances import INSTANCES
from scan2sim.segmentation.steps.label import LABEL
from scan2sim.segmentation.steps.segment import SEGMENT
from scan2sim.segmentation.steps.signs import SIGNS
from scan2sim.texturing.borders.colour_harmonization import COLOUR_HARMONIZATION
from scan2sim.texturing.borders.measure import BORDERS
from scan2sim.texturing.exposure import EXPOSURE
from scan2sim.texturing.photo_consistency import PHOTO_CONSISTENCY
from scan2sim.texturing.pose_refinement.step import POSE_REFINEMENT
from scan2sim.texturing.score import SCORE
from scan2sim.texturing.texture import TEXTURE
from scan2sim.texturing.unwrap import UNWRAP
from scan2sim.texturing.view_selection.step import VIEW_SELECTION

STEPS: tuple[Step, ...] = (
    INGEST, PATH, DYNAMIC_OBJECTS, VIEWS, LABEL, SEGMENT, INSTANCES, PHOTO_COVERAGE, OVERLAP, DETECT_FURNITURE,
    FURNITURE, SPLIT, VOXEL, GROUND, WALLS, FACADES, POISSON, TRIM, PLANES, ISLANDS, CLIP, JOIN, DECIMATE, PLANTS,
    UNWRAP, POSE_REFINEMENT, SIGNS, VISIBILITY, EXPOSURE, PHOTO_CONSISTENCY, VIEW_SELECTION, TEXTURE,
    COLOUR_HARMONIZATION, ROADS, COLLISION, EXPORT, RASTERS, GEOMETRY, SCORE, PICTURES, PREVIEW, BORDERS,
)  # fmt: skip


@dataclass(frozen=True)
class Scan:
    """Inputs from the classified scan.

    Attributes:
        has_ground_photos: whether there are photos other than orthophotos.
        path: path of the scanner or else of the cameras; empty if there is none.
        scanner_path: the same, but only of the scanner, for rays to the points.
        views: photos with poses.
        moving: points of moving objects.
        labels: classes in the photos; empty without photos from the ground.
    """

    has_ground_photos: bool
    path: Sources
    scanner_path: Sources
    views: Sources
    moving: Sources
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
    """

    groups: list[str]
    cloud_groups: tuple[str, ...]
    furniture: Sources
    instances: Sources
    keep_vehicles: bool
    clouds: Sources


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
    graph = TileGraph(tile, settings, survey_tiles, without)
    scan = _classify(graph)
    instances, cloud = _select_points(graph, scan)
    furniture = _detect_furniture(graph, scan, cloud)
    parts = _split(graph, scan, cloud, instances, furniture)
    synthesized = _synthesize_points(graph, scan, parts)
    for group in parts.groups:
        _add_surface(graph, scan, parts, group, synthesized.get(group, {}))
    lists = _list_objects(graph, scan, parts)
    surfaces, photos, lists = _analyse_photos(graph, scan, parts, lists)
    textured = _texture(graph, parts, surfaces, photos, synthesized)
    roads = _add_roads(graph, scan, textured)
    _export(graph, parts, surfaces, textured, photos, lists | roads)
    _measure(graph, parts, surfaces, textured, photos, synthesized)
    _show(graph, scan, parts, textured, photos)
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
    photos: Sources = {f"photo.{i}": view.photo for i, view in enumerate(tile.views)}
    masks: Sources = {f"mask.{i}": view.mask for i, view in enumerate(tile.views) if view.mask}
    add(VIEWS, photos | masks | cloud, poses=tuple(views_io.to_json(view, with_paths=False) for view in tile.views))
    views: Sources = {"views": output(VIEWS, "views")}
    moving: Sources = {"moving": output(DYNAMIC_OBJECTS, "moving")}
    labels: Sources = {}
    if ground_views:
        add(LABEL, cloud | views | _weights_input(graph.settings), **_segment_settings(graph.settings))
        labels = {"labels": output(LABEL, "labels")}
    add(SEGMENT, cloud | path | (views | moving | labels if ground_views else {}))
    return Scan(bool(ground_views), path, rays, views, moving, labels)


def _select_points(graph: TileGraph, scan: Scan) -> tuple[Sources, Output]:
    """Detect instances, remove points that photos don't cover, and take the neighbours' points at borders.

    Returns:
        The instances, as an input, and the resulting cloud.
    """
    output, add, path = graph.output, graph.add, scan.path
    instances: Sources = {}
    last = SEGMENT  # the step whose cloud is split; the same one in all tiles of a survey
    if graph.params(INSTANCES).detect and (path or graph.neighbours):
        classified: Sources = {name: output(SEGMENT, name) for name in ("cloud", "confidence")}
        add(INSTANCES, classified | scan.moving | path)
        last, instances = INSTANCES, {"instances": output(INSTANCES, "instances")} if path else {}
    limit = graph.params(PHOTO_COVERAGE).limit
    if limit != "off" and (graph.neighbours or (path and (scan.has_ground_photos or limit != "auto"))):
        views = scan.views if scan.has_ground_photos else {}
        add(PHOTO_COVERAGE, {"cloud": output(last, "cloud")} | path | views, voxel=graph.params(VOXEL, "terrain").size)
        last = PHOTO_COVERAGE
    if graph.neighbours:
        add(OVERLAP, {"cloud": output(last, "cloud")} | graph.neighbour_outputs(last, "cloud"), **graph.cell)
        last = OVERLAP
    return instances, output(last, "cloud")


def _detect_furniture(graph: TileGraph, scan: Scan, cloud: Output) -> Sources:
    """Detect street furniture and model it; returns the outputs of step `furniture`."""
    if not (scan.path or graph.neighbours) or graph.params(FURNITURE).when != "auto":
        return {}
    graph.add(DETECT_FURNITURE, {"cloud": cloud} | scan.path, **graph.cell)
    if not (graph.is_enabled(DETECT_FURNITURE) and graph.is_enabled(FURNITURE)):
        return {}
    detections = graph.neighbour_outputs(DETECT_FURNITURE, "detections")
    own = {"cloud": cloud, "detections": graph.output(DETECT_FURNITURE, "detections")}
    graph.add(FURNITURE, own | detections, **graph.cell)
    names = (*GROUPS[1:], "furniture_points", "sign_panels", "neighbour_poles", "geojson", "csv")
    return {name: graph.output(FURNITURE, name) for name in names}


def _split(graph: TileGraph, scan: Scan, cloud: Output, instances: Sources, furniture: Sources) -> Parts:
    """Split the cloud by class, and thin each part."""
    params = graph.params(SPLIT)
    keep_vehicles = params.vehicles == "keep" and bool(instances)
    furniture_points = {name: furniture[name] for name in furniture if name == "furniture_points"}
    graph.add(SPLIT, {"cloud": cloud} | (instances if keep_vehicles else {}) | furniture_points)
    vehicle = ("vehicle",) if keep_vehicles else ()
    groups = [group for group in (*GROUPS, *vehicle) if group != "vegetation" or params.vegetation != "locations"]
    cloud_groups = (*GROUPS, "rest", *vehicle)
    for part in cloud_groups:
        graph.add(VOXEL, {"cloud": graph.output(SPLIT, part)} | scan.path, part)
    clouds: Sources = {f"cloud.{part}": graph.output(VOXEL, "cloud", part) for part in cloud_groups}
    return Parts(groups, cloud_groups, furniture, instances, keep_vehicles, clouds)


def _synthesize_points(graph: TileGraph, scan: Scan, parts: Parts) -> dict[str, Sources]:
    """Add points that the scanner did not see: occluded ground, walls below roofs and above its view; by class."""
    synthesized: dict[str, Sources] = {}
    airborne = {"always": True, "never": False, "auto": not scan.path}  # whether steps for airborne clouds run
    when = graph.params(GROUND).when
    hidden = parts.instances if when == "auto" else {}
    if hidden or airborne[when]:
        others = graph.neighbour_outputs(INSTANCES, "instances") if hidden else {}
        synthesized["terrain"] = _synthesize_from_voxels(graph, GROUND, (*GROUPS, "rest"), hidden | others)
    if airborne[graph.params(WALLS).when]:
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


def _synthesize_from_voxels(graph: TileGraph, step: Step, classes: Sequence[str], more: Sources) -> Sources:
    """Add a step that synthesizes points from the voxels of some classes, including those of the neighbours."""
    inputs: Sources = {part: graph.output(VOXEL, "cloud", part) for part in classes}
    for part in classes:
        inputs |= graph.neighbour_outputs(VOXEL, "cloud", part, prefix=part)
    graph.add(step, inputs | more, **graph.cell)
    return {"synthesized": graph.output(step, "synthesized")}


def _add_surface(graph: TileGraph, scan: Scan, parts: Parts, group: str, synthesized: Sources) -> None:
    """The mesh of a class: reconstruct, trim, snap to planes, join with the neighbours' meshes, decimate."""
    output, add, cell = graph.output, graph.add, graph.cell
    voxel = graph.params(VOXEL, group).size
    points: Sources = {"cloud": output(VOXEL, "cloud", group), **synthesized}
    add(POISSON, points, group, voxel=voxel, cell=cell or None)
    add(TRIM, {"mesh": output(POISSON, "mesh", group), **points}, group, voxel=voxel)
    surface = output(TRIM, "mesh", group)
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
    add(DECIMATE, {"mesh": surface, **furniture}, group, keep_border=bool(cell))


def _list_objects(graph: TileGraph, scan: Scan, parts: Parts) -> Sources:
    """Lists of street furniture and plants, as inputs of the export."""
    lists: Sources = {}
    if parts.furniture and scan.path:
        lists = {"furniture": parts.furniture["geojson"], "furniture_csv": parts.furniture["csv"]}
    if graph.params(SPLIT).vegetation != "mesh" and graph.is_enabled(PLANTS):
        clouds = {name: graph.output(VOXEL, "cloud", name) for name in ("vegetation", "terrain")}
        graph.add(PLANTS, clouds, **graph.cell)
        lists |= {"plants": graph.output(PLANTS, "geojson"), "plants_csv": graph.output(PLANTS, "csv")}
    return lists


def _plant_models(graph: TileGraph, output: str) -> Sources:
    """Models of plants as an input, if there is no mesh of the vegetation."""
    wanted = graph.params(PLANTS).models and graph.params(SPLIT).vegetation == "locations"
    return {"vegetation": graph.output(PLANTS, output)} if wanted and graph.is_enabled(PLANTS) else {}


def _analyse_photos(graph: TileGraph, scan: Scan, parts: Parts, lists: Sources) -> tuple[Sources, Sources, Sources]:
    """Refine poses, fit signs to photos, and compute visibility, exposure and photo consistency.

    Returns:
        The final mesh of each class, the inputs about photos, and the lists with the fitted signs.
    """
    output, add = graph.output, graph.add
    surfaces: Sources = {group: output(DECIMATE, "mesh", group) for group in parts.groups}
    photos = scan.views
    if scan.has_ground_photos and graph.params(POSE_REFINEMENT).when == "auto":
        rest = {"cloud.rest": parts.clouds["cloud.rest"]}
        add(POSE_REFINEMENT, _mesh_inputs(surfaces) | rest | scan.moving | photos)
        photos = {"views": output(POSE_REFINEMENT, "views")}
    fits_signs = scan.has_ground_photos and parts.furniture and graph.params(SIGNS).when == "auto"
    if fits_signs and graph.is_enabled(SIGNS):
        known = {name: parts.furniture[name] for name in ("sign_panels", "neighbour_poles", "geojson")}
        add(SIGNS, _mesh_inputs(surfaces) | known | photos | scan.labels, **graph.cell)
        surfaces |= {group: output(SIGNS, group) for group in parts.groups if group in ("building", "vegetation")}
        lists = lists | {"furniture": output(SIGNS, "geojson"), "furniture_csv": output(SIGNS, "csv")}
    add(VISIBILITY, _mesh_inputs(surfaces) | parts.clouds | scan.moving | photos)
    photos = {**photos, "depth": output(VISIBILITY, "depth")}
    prior = graph.params(EXPOSURE).prior
    add(EXPOSURE, photos | ({"prior": Path(prior)} if prior else {}))
    photos = {**photos, "exposures": output(EXPOSURE, "exposures")}
    add(PHOTO_CONSISTENCY, photos)
    return surfaces, {**photos, "photo_consistency": output(PHOTO_CONSISTENCY, "photo_consistency")}, lists


def _texture(
    graph: TileGraph, parts: Parts, surfaces: Sources, photos: Sources, synthesized: Mapping[str, Sources]
) -> Sources:
    """Select views, unwrap and texture each class, and harmonize its colours with the neighbours'."""
    output, add = graph.output, graph.add
    furniture: Sources = {"cloud.furniture": output(SPLIT, "furniture")} if parts.furniture else {}
    points = parts.clouds | furniture | _synthesized_inputs(synthesized)
    for group in parts.groups:
        mesh = {"mesh": surfaces[group]}
        add(VIEW_SELECTION, mesh | photos, group)
        choice = {"choice": output(VIEW_SELECTION, "choice", group)}
        by_photo = {**choice, **photos} if graph.params(UNWRAP, group).backend == "photo" else {}
        add(UNWRAP, mesh | by_photo, group)
        unwrapped = {name: output(UNWRAP, name, group) for name in ("mesh", "pages")}
        removed = parts.instances if group == "terrain" and not parts.keep_vehicles else {}
        add(TEXTURE, {**unwrapped, **choice, **points, **photos, **removed}, group)
    last = TEXTURE
    if graph.neighbours:
        last = COLOUR_HARMONIZATION
        for group in parts.groups:
            others = graph.neighbour_outputs(TEXTURE, "textured", group, prefix="neighbour")
            add(COLOUR_HARMONIZATION, {"textured": output(TEXTURE, "textured", group)} | others, group)
    return {group: output(last, "textured", group) for group in parts.groups}


def _add_roads(graph: TileGraph, scan: Scan, textured: Sources) -> Sources:
    """Extract the roads; returns them and the path as inputs of the export."""
    if not scan.path or graph.params(ROADS).when == "never" or not graph.is_enabled(ROADS):
        return scan.path
    ground = {"cloud": graph.output(SPLIT, "terrain"), "textured": textured["terrain"]}
    origin = graph.params(EXPORT).world_origin
    graph.add(ROADS, ground | scan.path, name=graph.tile.name, world_origin=origin, cell=graph.cell or None)
    outputs = {"roads": "geojson", "roads_seen": "seen", "opendrive": "opendrive"}
    return scan.path | {name: graph.output(ROADS, output) for name, output in outputs.items()}


def _export(
    graph: TileGraph, parts: Parts, surfaces: Sources, textured: Sources, photos: Sources, lists: Sources
) -> None:
    """The collision mesh, the world, and rasters."""
    output, add, name = graph.output, graph.add, graph.tile.name
    terrain = {"cloud": output(SPLIT, "terrain")}
    add(COLLISION, {**surfaces, **_plant_models(graph, "mesh"), **terrain}, **graph.cell)
    planted = textured | _plant_models(graph, "textured")
    choice = {f"choice.{group}": output(VIEW_SELECTION, "choice", group) for group in parts.groups}
    views = {"views": photos["views"], "collision": output(COLLISION, "mesh")}
    add(EXPORT, planted | choice | lists | parts.instances | views, name=name)
    if graph.params(EXPORT).rasters:
        add(RASTERS, textured, name=name, **_raster_context(graph.settings))


def _measure(
    graph: TileGraph,
    parts: Parts,
    surfaces: Sources,
    textured: Sources,
    photos: Sources,
    synthesized: Mapping[str, Sources],
) -> None:
    """Metrics of surfaces, textures and borders."""
    output, add, tile = graph.output, graph.add, graph.tile
    truth: Sources = {}
    if tile.truth_mesh and tile.truth_points:
        truth = {"truth.mesh": tile.truth_mesh, "truth.points": tile.truth_points}
    clouds = parts.clouds | _synthesized_inputs(synthesized)
    add(GEOMETRY, _mesh_inputs(surfaces) | clouds | truth, **graph.cell)
    add(SCORE, textured | {name: photos[name] for name in ("views", "depth")} | parts.instances | truth)
    if graph.neighbours:
        step = COLOUR_HARMONIZATION
        own = {f"textured.{group}": output(step, "textured", group) for group in parts.groups}
        others = {
            f"textured.{group}.{tile}": output(step, "textured", group, tile)
            for group in parts.groups
            for tile in graph.border_owners
        }
        add(BORDERS, own | others, **graph.cell)


def _show(graph: TileGraph, scan: Scan, parts: Parts, textured: Sources, photos: Sources) -> None:
    """The walkable preview and the pictures of the report."""
    graph.add(PREVIEW, textured | _plant_models(graph, "textured") | scan.path)
    stages = {f"decimate.{group}": graph.output(DECIMATE, "mesh", group) for group in parts.groups}
    graph.add(PICTURES, textured | stages | parts.clouds | {"views": photos["views"]} | scan.path)


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


def _weights_input(settings: Settings) -> dict[str, Path | Output]:
    """The user's weights file as an input, so that other weights change the cache key."""
    weights = settings.params(LABEL).weights
    return {"weights": weights} if weights and weights.is_file() else {}


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

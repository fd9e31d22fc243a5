"""Pipeline definition of a tile: the task graph from clouds and photos to the world and its reports."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.flows.pipelines.graph import Output, Task, TaskId
from scan2sim.flows.pipelines.settings import Settings
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


Sources = dict[str, Path | Output]
"""Inputs of a task by name: source files and outputs of other tasks."""


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
    graph = _GraphBuilder(tile, settings, survey_tiles, without)
    evidence = graph.classify()
    graph.split_cloud(graph.merge_neighbours())
    synthesized = graph.synthesize_points(evidence)
    for group in graph.groups:
        graph.add_surface(group, synthesized.get(group, {}))
    lists = graph.add_lists()
    surfaces, seen = graph.analyse_photos(evidence, lists)
    textured = graph.add_textures(surfaces, seen, synthesized)
    lists |= graph.add_roads(textured)
    graph.add_results(surfaces, textured, seen, lists, synthesized)
    return graph.tasks


class _GraphBuilder:
    """Builds the task graph of a tile.

    Attributes:
        tasks: tasks added so far.
        cell: parameters of the steps at borders; empty if the tile isn't part of a survey.
        neighbours: names of the neighbouring tiles that are built, too.
        border_owners: those neighbours that own the border with this tile.
        has_ground_photos: whether there are photos other than orthophotos.
        path: path of the scanner or else of the cameras, as an input; empty if there is none.
        scanner_path: the same, but only of the scanner, for rays to the points.
        instances: detected instances (vehicles, ...), as an input.
        furniture: outputs of step `furniture` by name.
        keep_vehicles: whether parked vehicles get a surface.
        groups: classes that get a surface.
        cloud_groups: classes that the cloud is split into.
    """

    def __init__(
        self, tile: Tile, settings: Settings, survey_tiles: Collection[str] | None, without: Collection[TaskId]
    ) -> None:
        self.tasks: list[Task] = []
        self.tile, self.settings, self._without = tile, settings, without
        self._name = "" if survey_tiles is None else tile.name
        self.cell: dict[str, Any] = {}
        if tile.cell:
            self.cell = {"seed": tile.cell.seed, "neighbours": dict(tile.cell.neighbours)}
        self.neighbours = [name for name in self.cell.get("neighbours", {}) if name in (survey_tiles or ())]
        self.border_owners = [name for name in self.neighbours if name < tile.name]
        self.has_ground_photos = any(view.camera.model != "orthographic" for view in tile.views)
        self.path: Sources = {}
        self.scanner_path: Sources = {}
        self.instances: Sources = {}
        self.furniture: Sources = {}
        self.keep_vehicles = False
        self.groups: list[str] = []
        self.cloud_groups: tuple[str, ...] = ()

    def output(self, step: Step, name: str, group: str = "", other: str | None = None) -> Output:
        """An output of a task of this tile, or of the neighbour `other`."""
        return Output(TaskId(step.name, group, self._name if other is None else other), name)

    def is_enabled(self, step: Step, other: str | None = None) -> bool:
        """Whether a step of this tile, or of the neighbour `other`, is not among the failed side products."""
        return TaskId(step.name, tile=self._name if other is None else other) not in self._without

    def add(self, step: Step, inputs: Mapping[str, Path | Output], group: str = "", **given: Any) -> None:
        """Add a task, unless it is a side product that failed."""
        if self.is_enabled(step):
            self.tasks.append(Task(step, self.settings.params(step, group, **given), inputs, group, self._name))

    def neighbour_outputs(self, step: Step, name: str, group: str = "", prefix: str | None = None) -> Sources:
        """An output of the tasks of all neighbours, as inputs `prefix.tile`; default prefix: the output's name."""
        tiles = [tile for tile in self.neighbours if self.is_enabled(step, tile)]
        return {f"{prefix or name}.{tile}": self.output(step, name, group, tile) for tile in tiles}

    def classify(self) -> Sources:
        """Add the classification of points by photos and shape; returns the inputs with the photos' classes."""
        tile, output, add = self.tile, self.output, self.add
        frame: dict[str, Any] = {"crs": tile.frame.crs, "origin": tile.frame.origin, "unit": tile.frame.unit}
        files = {f"cloud.{i:04d}": path for i, path in enumerate(tile.clouds)}
        add(INGEST, files, **frame, classes=dict(tile.classes))
        path = scanner_path(tile)
        if path:
            add(PATH, {}, **path)
            self.path = {"path": output(PATH, "path")}
        self.scanner_path = (
            self.path if tile.trajectory is not None else {}
        )  # cameras are not at the scanner's position
        cameras = _position_rows([view.centre for view in tile.views if view.camera.model != "orthographic"])
        add(DYNAMIC_OBJECTS, {"cloud": output(INGEST, "cloud")} | self.scanner_path, cameras=cameras)
        whole: Sources = {"cloud": output(DYNAMIC_OBJECTS, "cloud")}
        photos: Sources = {f"photo.{i}": view.photo for i, view in enumerate(tile.views)}
        masks: Sources = {f"mask.{i}": view.mask for i, view in enumerate(tile.views) if view.mask}
        add(VIEWS, photos | masks | whole, poses=tuple(views_io.to_json(view, with_paths=False) for view in tile.views))
        evidence: Sources = {}
        if self.has_ground_photos:
            add(LABEL, whole | self._views_input() | _weights_input(self.settings), **_label_params(self.settings))
            evidence = {**self._views_input(), **self._moving_input(), "labels": output(LABEL, "labels")}
        add(SEGMENT, whole | self.path | evidence)
        return evidence

    def _views_input(self) -> Sources:
        return {"views": self.output(VIEWS, "views")}

    def _moving_input(self) -> Sources:
        return {"moving": self.output(DYNAMIC_OBJECTS, "moving")}

    def merge_neighbours(self) -> Output:
        """Add instances, photo coverage and the neighbours' points at borders; returns the resulting cloud."""
        output, add = self.output, self.add
        last = SEGMENT  # the step whose cloud is split; the same one in all tiles of a survey
        if self.settings.params(INSTANCES).detect and (self.path or self.neighbours):
            classified: Sources = {name: output(SEGMENT, name) for name in ("cloud", "confidence")}
            add(INSTANCES, classified | self._moving_input() | self.path)
            last, self.instances = INSTANCES, {"instances": output(INSTANCES, "instances")} if self.path else {}
        limit = self.settings.params(PHOTO_COVERAGE).limit
        if limit != "off" and (self.neighbours or (self.path and (self.has_ground_photos or limit != "auto"))):
            shown = self._views_input() if self.has_ground_photos else {}
            size = self.settings.params(VOXEL, "terrain").size
            add(PHOTO_COVERAGE, {"cloud": output(last, "cloud")} | self.path | shown, voxel=size)
            last = PHOTO_COVERAGE
        if not (self.neighbours and self.tile.cell):
            return output(last, "cloud")
        others = self.neighbour_outputs(last, "cloud")
        cell = self.tile.cell
        add(OVERLAP, {"cloud": output(last, "cloud")} | others, name=self.tile.name, buffer=cell.buffer, **self.cell)
        return output(OVERLAP, "cloud")

    def split_cloud(self, cloud: Output) -> None:
        """Add removal of street furniture from the cloud, its split by class, and the voxel filter of each part."""
        enabled = (self.path or self.neighbours) and self.settings.params(FURNITURE).when == "auto"
        if enabled:
            self.add(DETECT_FURNITURE, {"cloud": cloud} | self.path, **self.cell)
        if enabled and self.is_enabled(DETECT_FURNITURE) and self.is_enabled(FURNITURE):
            detections = {"detections": self.output(DETECT_FURNITURE, "detections")} | self.neighbour_outputs(
                DETECT_FURNITURE, "detections"
            )
            self.add(FURNITURE, {"cloud": cloud} | detections, name=self.tile.name, **self.cell)
            names = (*GROUPS[1:], "furniture_points", "sign_panels", "neighbour_poles", "geojson", "csv")
            self.furniture = {name: self.output(FURNITURE, name) for name in names}
        split_params = self.settings.params(SPLIT)
        self.keep_vehicles = split_params.vehicles == "keep" and bool(self.instances)
        removed_points = {name: self.furniture[name] for name in self.furniture if name == "furniture_points"}
        self.add(SPLIT, {"cloud": cloud} | (self.instances if self.keep_vehicles else {}) | removed_points)
        vehicle = ("vehicle",) if self.keep_vehicles else ()
        self.groups = [g for g in (*GROUPS, *vehicle) if g != "vegetation" or split_params.vegetation != "locations"]
        self.cloud_groups = (*GROUPS, "rest", *vehicle)
        for part in self.cloud_groups:
            self.add(VOXEL, {"cloud": self.output(SPLIT, part)} | self.path, part)

    def synthesize_points(self, evidence: Sources) -> dict[str, Sources]:
        """Add points that the scanner did not see: occluded ground, walls below roofs and above its view; by class."""
        synthesized: dict[str, Sources] = {}
        when = self.settings.params(GROUND).when
        hidden = self.instances if when == "auto" else {}
        if hidden or self._runs_on_airborne(when):
            others: Sources = {}
            for name in hidden:
                others |= self.neighbour_outputs(INSTANCES, name)
            synthesized["terrain"] = self._add_synthesis(GROUND, (*GROUPS, "rest"), {**hidden, **others})
        if self._runs_on_airborne(self.settings.params(WALLS).when):
            below: Sources = {"ground": synthesized["terrain"]["synthesized"]} if "terrain" in synthesized else {}
            below |= {"footprints": self.tile.footprints} if self.tile.footprints else {}
            synthesized["building"] = self._add_synthesis(WALLS, ("building", "terrain"), below)
        if (
            self.scanner_path
            and self.has_ground_photos
            and "building" not in synthesized
            and self.settings.params(FACADES).when == "auto"
        ):
            shown = {name: evidence[name] for name in ("views", "labels")}
            size = self.settings.params(VOXEL, "building").size
            clouds = {"cloud": self.output(VOXEL, "cloud", "building")} | self._other_clouds("building")
            self.add(FACADES, clouds | self.scanner_path | shown, voxel=size, **self.cell)
            synthesized["building"] = {"synthesized": self.output(FACADES, "synthesized")}
        return synthesized

    def _runs_on_airborne(self, when: str) -> bool:
        """Whether a step for airborne clouds runs: always, or if there is no path on the ground."""
        return when == "always" or (when == "auto" and not self.path)

    def _add_synthesis(self, step: Step, parts: Sequence[str], more: Sources) -> Sources:
        """Add a step that synthesizes points from the voxels of some classes, including those of the neighbours."""
        inputs: Sources = {part: self.output(VOXEL, "cloud", part) for part in parts}
        for part in parts:
            inputs |= self.neighbour_outputs(VOXEL, "cloud", part, prefix=part)
        cell = self.tile.cell
        border = {"name": self.tile.name, "buffer": cell.buffer, **self.cell} if cell else {}
        self.add(step, inputs | more, **border)
        return {"synthesized": self.output(step, "synthesized")}

    def _other_clouds(self, group: str) -> Sources:
        """The voxels of all other classes, as inputs."""
        return {f"other.{part}": self.output(VOXEL, "cloud", part) for part in self.cloud_groups if part != group}

    def add_surface(self, group: str, synthesized: Sources) -> None:
        """Add the mesh of a class: reconstruct, trim, snap to planes, join with the neighbours' meshes, decimate."""
        output, add, cell = self.output, self.add, self.cell
        cloud, size = output(VOXEL, "cloud", group), self.settings.params(VOXEL, group).size
        point_inputs: Sources = {"cloud": cloud, **synthesized}
        add(POISSON, point_inputs, group, voxel=size, aligned=bool(cell))
        add(TRIM, {"mesh": output(POISSON, "mesh", group), **point_inputs}, group, voxel=size)
        surface = output(TRIM, "mesh", group)
        when = self.settings.params(PLANES).when
        if group == "building" and (when == "always" or (when == "auto" and self.path)):
            points = {**point_inputs, "points": output(SPLIT, group)}
            add(PLANES, {"mesh": surface, **points, **self._other_clouds(group)}, voxel=size, **cell)
            surface = output(PLANES, "mesh")
        add(ISLANDS, {"mesh": surface}, group)
        surface = output(ISLANDS, "mesh", group)
        if cell:
            add(CLIP, {"mesh": surface}, group, **cell)
            surface = output(CLIP, "mesh", group)
        if self.neighbours:
            clipped = {name: output(CLIP, name, group) for name in ("mesh", "on")}
            others = {
                f"{name}.{tile}": output(CLIP, name, group, tile) for tile in self.border_owners for name in clipped
            }
            add(JOIN, clipped | others, group, name=self.tile.name, **cell)
            surface = output(JOIN, "mesh", group)
        things = {"furniture": self.furniture[group]} if group in self.furniture else {}
        add(DECIMATE, {"mesh": surface, **things}, group, keep_border=bool(cell))

    def add_lists(self) -> Sources:
        """Add lists of street furniture and plants; returns them as inputs of the export."""
        lists: Sources = {}
        if self.furniture and self.path:
            lists = {"furniture": self.furniture["geojson"], "furniture_csv": self.furniture["csv"]}
        if self.settings.params(SPLIT).vegetation != "mesh" and self.is_enabled(PLANTS):
            clouds = {name: self.output(VOXEL, "cloud", name) for name in ("vegetation", "terrain")}
            self.add(PLANTS, clouds, **self.cell)
            lists |= {"plants": self.output(PLANTS, "geojson"), "plants_csv": self.output(PLANTS, "csv")}
        return lists

    def plant_models(self, output: str) -> Sources:
        """Models of plants as an input, if there is no mesh of the vegetation."""
        wanted = self.settings.params(PLANTS).models and self.settings.params(SPLIT).vegetation == "locations"
        return {"vegetation": self.output(PLANTS, output)} if wanted and self.is_enabled(PLANTS) else {}

    def analyse_photos(self, evidence: Sources, lists: Sources) -> tuple[Sources, Sources]:
        """Add pose refinement, sign fitting, visibility, exposure and photo consistency; adds signs to `lists`.

        Returns:
            The final mesh of each class, and the inputs about photos.
        """
        output, add = self.output, self.add
        surfaces: Sources = {group: output(DECIMATE, "mesh", group) for group in self.groups}
        seen, clouds = self._views_input(), self._cloud_inputs()
        if self.has_ground_photos and self.settings.params(POSE_REFINEMENT).when == "auto":
            add(
                POSE_REFINEMENT,
                _mesh_inputs(surfaces) | {"cloud.rest": clouds["cloud.rest"]} | self._moving_input() | seen,
            )
            seen = {"views": output(POSE_REFINEMENT, "views")}
        if (
            self.has_ground_photos
            and self.furniture
            and self.settings.params(SIGNS).when == "auto"
            and self.is_enabled(SIGNS)
        ):
            plates = {name: self.furniture[name] for name in ("sign_panels", "neighbour_poles", "geojson")}
            add(SIGNS, _mesh_inputs(surfaces) | plates | seen | {"labels": evidence["labels"]}, **self.cell)
            surfaces |= {group: output(SIGNS, group) for group in self.groups if group in ("building", "vegetation")}
            lists |= {"furniture": output(SIGNS, "geojson"), "furniture_csv": output(SIGNS, "csv")}
        add(VISIBILITY, _mesh_inputs(surfaces) | clouds | self._moving_input() | seen)
        seen = {**seen, "depth": output(VISIBILITY, "depth")}
        prior = self.settings.params(EXPOSURE).prior
        add(EXPOSURE, seen | ({"prior": Path(prior)} if prior else {}))
        seen = {**seen, "exposures": output(EXPOSURE, "exposures")}
        add(PHOTO_CONSISTENCY, seen)
        return surfaces, {**seen, "photo_consistency": output(PHOTO_CONSISTENCY, "photo_consistency")}

    def _cloud_inputs(self) -> Sources:
        return {f"cloud.{part}": self.output(VOXEL, "cloud", part) for part in self.cloud_groups}

    def add_textures(self, surfaces: Sources, seen: Sources, synthesized: Mapping[str, Sources]) -> Sources:
        """Add view selection, unwrapping and texturing of each class, and colour harmonization with the neighbours."""
        output, add = self.output, self.add
        own: Sources = {"cloud.furniture": output(SPLIT, "furniture")} if self.furniture else {}
        points = self._cloud_inputs() | own | _synthesized_inputs(synthesized)
        for group in self.groups:
            mesh = {"mesh": surfaces[group]}
            add(VIEW_SELECTION, mesh | seen, group)
            choice = {"choice": output(VIEW_SELECTION, "choice", group)}
            by_photo = {**choice, **seen} if self.settings.params(UNWRAP, group).backend == "photo" else {}
            add(UNWRAP, mesh | by_photo, group)
            unwrapped = {name: output(UNWRAP, name, group) for name in ("mesh", "pages")}
            occluders = self.instances if group == "terrain" and not self.keep_vehicles else {}
            add(TEXTURE, {**unwrapped, **choice, **points, **seen, **occluders}, group)
        last = TEXTURE
        if self.neighbours:
            last = COLOUR_HARMONIZATION
            for group in self.groups:
                others = self.neighbour_outputs(TEXTURE, "textured", group, prefix="neighbour")
                add(COLOUR_HARMONIZATION, {"textured": output(TEXTURE, "textured", group)} | others, group)
        return {group: output(last, "textured", group) for group in self.groups}

    def add_roads(self, textured: Sources) -> Sources:
        """Add the roads; returns them and the path as inputs of the export."""
        if not self.path or self.settings.params(ROADS).when == "never" or not self.is_enabled(ROADS):
            return self.path
        ground = {"cloud": self.output(SPLIT, "terrain"), "textured": textured["terrain"]}
        origin = self.settings.params(EXPORT).world_origin
        self.add(ROADS, ground | self.path, name=self.tile.name, world_origin=origin, **self.cell)
        outputs = {"roads": "geojson", "roads_seen": "seen", "opendrive": "opendrive"}
        return self.path | {name: self.output(ROADS, output) for name, output in outputs.items()}

    def add_results(
        self, surfaces: Sources, textured: Sources, seen: Sources, lists: Sources, synthesized: Mapping[str, Sources]
    ) -> None:
        """Add the export of the world, rasters, metrics, images and previews."""
        output, add, tile = self.output, self.add, self.tile
        cell = {"place": self.cell["seed"], "neighbours": self.cell["neighbours"]} if self.cell else {}
        add(COLLISION, {**surfaces, **self.plant_models("mesh"), "cloud": output(SPLIT, "terrain")}, **cell)
        planted = self.plant_models("textured")
        choice = {f"choice.{g}": output(VIEW_SELECTION, "choice", g) for g in self.groups}
        shown = {"views": seen["views"], "collision": output(COLLISION, "mesh")}
        add(EXPORT, textured | planted | choice | lists | self.instances | shown, name=tile.name)
        if self.settings.params(EXPORT).rasters:
            add(RASTERS, textured, name=tile.name, **_raster_params(self.settings))
        truth: Sources = {}
        if tile.truth_mesh and tile.truth_points:
            truth = {"truth.mesh": tile.truth_mesh, "truth.points": tile.truth_points}
        add(
            GEOMETRY,
            _mesh_inputs(surfaces) | self._cloud_inputs() | _synthesized_inputs(synthesized) | truth,
            **self.cell,
        )
        add(SCORE, textured | {name: seen[name] for name in ("views", "depth")} | self.instances | truth)
        if self.neighbours:
            mine = {f"textured.{g}": output(COLOUR_HARMONIZATION, "textured", g) for g in self.groups}
            theirs = {
                f"textured.{g}.{n}": output(COLOUR_HARMONIZATION, "textured", g, n)
                for g in self.groups
                for n in self.border_owners
            }
            add(BORDERS, mine | theirs, **self.cell)
        add(PREVIEW, textured | planted | self.path)
        stages = {f"decimate.{g}": output(DECIMATE, "mesh", g) for g in self.groups}
        add(PICTURES, textured | stages | self._cloud_inputs() | {"views": seen["views"]} | self.path)


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


def _label_params(settings: Settings) -> dict[str, Any]:
    """Parameters of step `label` that are settings of step `segment`: when photos are classified."""
    segment_params = settings.params(SEGMENT)
    return {
        "overwrite": segment_params.overwrite,
        "min_classified": segment_params.min_classified,
        "photos": segment_params.photos,
    }


def _raster_params(settings: Settings) -> dict[str, Any]:
    """Parameters of step `rasters` that are settings of `export` and `unwrap`."""
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

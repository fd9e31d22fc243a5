"""Which steps make a tile, in order: the whole graph on one page."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.flows.pipelines.graph import Node, NodeId, Output
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.classes import GROUPS
from scan2sim.pipeline.core.step import Step
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.steps.carve import CARVE
from scan2sim.pipeline.steps.clip import CLIP
from scan2sim.pipeline.steps.collision import COLLISION
from scan2sim.pipeline.steps.decimate import DECIMATE
from scan2sim.pipeline.steps.export import EXPORT
from scan2sim.pipeline.steps.facades import FACADES
from scan2sim.pipeline.steps.finds import FINDS
from scan2sim.pipeline.steps.furniture import FURNITURE
from scan2sim.pipeline.steps.geometry import GEOMETRY
from scan2sim.pipeline.steps.ground import GROUND
from scan2sim.pipeline.steps.ingest import INGEST
from scan2sim.pipeline.steps.islands import ISLANDS
from scan2sim.pipeline.steps.join import JOIN
from scan2sim.pipeline.steps.overlap import OVERLAP
from scan2sim.pipeline.steps.path import PATH
from scan2sim.pipeline.steps.pictures import PICTURES
from scan2sim.pipeline.steps.planes import PLANES
from scan2sim.pipeline.steps.plants import PLANTS
from scan2sim.pipeline.steps.poisson import POISSON
from scan2sim.pipeline.steps.preview import PREVIEW
from scan2sim.pipeline.steps.rasters import RASTERS
from scan2sim.pipeline.steps.reach import REACH
from scan2sim.pipeline.steps.roads import ROADS
from scan2sim.pipeline.steps.split import SPLIT
from scan2sim.pipeline.steps.trim import TRIM
from scan2sim.pipeline.steps.views import VIEWS
from scan2sim.pipeline.steps.visibility import VISIBILITY
from scan2sim.pipeline.steps.voxel import VOXEL
from scan2sim.pipeline.steps.walls import WALLS
from scan2sim.segmentation.steps.instances import THINGS
from scan2sim.segmentation.steps.label import LABEL
from scan2sim.segmentation.steps.segment import SEGMENT
from scan2sim.segmentation.steps.signs import SIGNS
from scan2sim.texturing.borders.colour_harmonization import LEVEL
from scan2sim.texturing.borders.measure import BORDERS
from scan2sim.texturing.exposure import EXPOSURE
from scan2sim.texturing.photo_consistency import AGREEMENT
from scan2sim.texturing.pose_refinement.step import REFINE
from scan2sim.texturing.score import SCORE
from scan2sim.texturing.texture import TEXTURE
from scan2sim.texturing.unwrap import UNWRAP
from scan2sim.texturing.view_selection.step import CHOOSE

STEPS: tuple[Step, ...] = (
    INGEST, PATH, CARVE, VIEWS, LABEL, SEGMENT, THINGS, REACH, OVERLAP, FINDS, FURNITURE, SPLIT, VOXEL, GROUND, WALLS,
    FACADES, POISSON, TRIM, PLANES, ISLANDS, CLIP, JOIN, DECIMATE, PLANTS, UNWRAP, REFINE, SIGNS, VISIBILITY, EXPOSURE,
    AGREEMENT, CHOOSE, TEXTURE, LEVEL, ROADS, COLLISION, EXPORT, RASTERS, GEOMETRY, SCORE, PICTURES, PREVIEW, BORDERS,
)  # fmt: skip


Sources = dict[str, Path | Output]


def recipe(
    tile: Tile, settings: Settings, beside: Collection[str] | None = None, without: Collection[NodeId] = ()
) -> list[Node]:
    """The graph of a tile, each node after those that it reads of the same tile.

    Args:
        tile: to be made.
        settings: of all steps.
        beside: names of the tiles of its survey that are made, too: nodes are `tile/step` then, and what happens at the
            borders reads neighbours' results. Without it the tile is made for itself, and ends at its borders.
        without: side products that failed, of this tile and its neighbours: the graph is as if they were switched off.

    Raises:
        SettingError: a setting that doesn't exist or is out of range.
    """
    settings.check(STEPS)
    graph = _Graph(tile, settings, beside, without)
    evidence = graph.classes()
    graph.parts(graph.whole())
    made = graph.made_up(evidence)
    for group in graph.groups:
        graph.surface(group, made.get(group, {}))
    lists = graph.places()
    surfaces, seen = graph.photos(evidence, lists)
    textured = graph.textures(surfaces, seen, made)
    lists |= graph.roads(textured)
    graph.results(surfaces, textured, seen, lists, made)
    return graph.nodes


class _Graph:
    """A tile's graph as it grows.

    Attributes:
        nodes: so far.
        cell: parameters of what happens at borders; empty where the tile was cut from nothing.
        adjoining: neighbours that are made, too, and
        first: those of them that own the border with this one.
        photographed: whether there are photos from the ground.
        scanner: the path, where there is one, and
        rays: it again where it is the scanner's own, not the cameras'.
        listed: the things that were found.
        standing: furniture, by class, and what is known of it.
        kept: whether vehicles are.
        groups: classes that get a surface; `parted`: all that the cloud is split into.
    """

    def __init__(
        self, tile: Tile, settings: Settings, beside: Collection[str] | None, without: Collection[NodeId]
    ) -> None:
        self.nodes: list[Node] = []
        self.tile, self.settings, self._without = tile, settings, without
        self._name = "" if beside is None else tile.name
        self.cell: dict[str, Any] = {}
        if tile.cell:
            self.cell = {"seed": tile.cell.seed, "neighbours": dict(tile.cell.neighbours)}
        self.adjoining = [name for name in self.cell.get("neighbours", {}) if name in (beside or ())]
        self.first = [name for name in self.adjoining if name < tile.name]
        self.photographed = any(view.camera.model != "orthographic" for view in tile.views)
        self.scanner: Sources = {}
        self.rays: Sources = {}
        self.listed: Sources = {}
        self.standing: Sources = {}
        self.kept = False
        self.groups: list[str] = []
        self.parted: tuple[str, ...] = ()

    def at(self, step: Step, name: str, group: str = "", other: str | None = None) -> Output:
        """An output of a node of this tile, or of the neighbour `other`."""
        return Output(NodeId(step.name, group, self._name if other is None else other), name)

    def runs(self, step: Step, other: str | None = None) -> bool:
        """Whether a side product of this tile, or of the neighbour `other`, has not failed."""
        return NodeId(step.name, tile=self._name if other is None else other) not in self._without

    def add(self, step: Step, inputs: Mapping[str, Path | Output], group: str = "", **given: Any) -> None:
        """One more node, unless it is a side product that failed."""
        if self.runs(step):
            self.nodes.append(Node(step, self.settings.params(step, group, **given), inputs, group, self._name))

    def of_neighbours(self, step: Step, name: str, group: str = "", prefix: str | None = None) -> Sources:
        """An output of all neighbours' nodes, by `prefix` (default: its name) and the tile's name."""
        made = [tile for tile in self.adjoining if self.runs(step, tile)]
        return {f"{prefix or name}.{tile}": self.at(step, name, group, tile) for tile in made}

    def classes(self) -> Sources:
        """What each point is, by photos and shape; returns what photos tell of points."""
        tile, at, add = self.tile, self.at, self.add
        frame: dict[str, Any] = {"crs": tile.frame.crs, "origin": tile.frame.origin, "unit": tile.frame.unit}
        files = {f"cloud.{i:04d}": path for i, path in enumerate(tile.clouds)}
        add(INGEST, files, **frame, classes=dict(tile.classes))
        path = scanner_path(tile)
        if path:
            add(PATH, {}, **path)
            self.scanner = {"path": at(PATH, "path")}
        self.rays = self.scanner if tile.trajectory is not None else {}  # cameras aren't where the scanner was
        cameras = _rows([view.centre for view in tile.views if view.camera.model != "orthographic"])
        add(CARVE, {"cloud": at(INGEST, "cloud")} | self.rays, cameras=cameras)
        whole: Sources = {"cloud": at(CARVE, "cloud")}
        photos: Sources = {f"photo.{i}": view.photo for i, view in enumerate(tile.views)}
        masks: Sources = {f"mask.{i}": view.mask for i, view in enumerate(tile.views) if view.mask}
        add(VIEWS, photos | masks | whole, poses=tuple(views_io.to_json(view, with_paths=False) for view in tile.views))
        evidence: Sources = {}
        if self.photographed:
            add(LABEL, whole | self._views() | _weights(self.settings), **_kept(self.settings))
            evidence = {**self._views(), **self._moving(), "labels": at(LABEL, "labels")}
        add(SEGMENT, whole | self.scanner | evidence)
        return evidence

    def _views(self) -> Sources:
        return {"views": self.at(VIEWS, "views")}

    def _moving(self) -> Sources:
        return {"moving": self.at(CARVE, "moving")}

    def whole(self) -> Output:
        """The cloud without what moves or is too far, with what neighbours know of the border; returns it."""
        at, add = self.at, self.add
        last = SEGMENT  # step whose cloud is split, in every tile of a survey the same
        if self.settings.params(THINGS).find and (self.scanner or self.adjoining):
            classified: Sources = {name: at(SEGMENT, name) for name in ("cloud", "confidence")}
            add(THINGS, classified | self._moving() | self.scanner)
            last, self.listed = THINGS, {"things": at(THINGS, "things")} if self.scanner else {}
        limit = self.settings.params(REACH).limit
        if limit != "off" and (self.adjoining or (self.scanner and (self.photographed or limit != "auto"))):
            shown = self._views() if self.photographed else {}
            size = self.settings.params(VOXEL, "terrain").size
            add(REACH, {"cloud": at(last, "cloud")} | self.scanner | shown, voxel=size)
            last = REACH
        if not (self.adjoining and self.tile.cell):
            return at(last, "cloud")
        others = self.of_neighbours(last, "cloud")
        cell = self.tile.cell
        add(OVERLAP, {"cloud": at(last, "cloud")} | others, name=self.tile.name, buffer=cell.buffer, **self.cell)
        return at(OVERLAP, "cloud")

    def parts(self, cloud: Output) -> None:
        """Furniture taken out, the rest split by class and thinned."""
        wanted = (self.scanner or self.adjoining) and self.settings.params(FURNITURE).when == "auto"
        if wanted:
            self.add(FINDS, {"cloud": cloud} | self.scanner, **self.cell)
        if wanted and self.runs(FINDS) and self.runs(FURNITURE):
            found = {"finds": self.at(FINDS, "finds")} | self.of_neighbours(FINDS, "finds")
            self.add(FURNITURE, {"cloud": cloud} | found, name=self.tile.name, **self.cell)
            names = (*GROUPS[1:], "taken", "plates", "beside", "geojson", "csv")
            self.standing = {name: self.at(FURNITURE, name) for name in names}
        given = self.settings.params(SPLIT)
        self.kept = given.vehicles == "keep" and bool(self.listed)
        taken = {name: self.standing[name] for name in self.standing if name == "taken"}
        self.add(SPLIT, {"cloud": cloud} | (self.listed if self.kept else {}) | taken)
        vehicle = ("vehicle",) if self.kept else ()
        self.groups = [g for g in (*GROUPS, *vehicle) if g != "vegetation" or given.vegetation != "locations"]
        self.parted = (*GROUPS, "rest", *vehicle)
        for part in self.parted:
            self.add(VOXEL, {"cloud": self.at(SPLIT, part)} | self.scanner, part)

    def made_up(self, evidence: Sources) -> dict[str, Sources]:
        """Points that no scanner saw: ground below what hid it, walls below roofs and above its reach; by class."""
        made: dict[str, Sources] = {}
        when = self.settings.params(GROUND).when
        hidden = self.listed if when == "auto" else {}
        if hidden or self._from_above(when):
            others: Sources = {}
            for name in hidden:
                others |= self.of_neighbours(THINGS, name)
            made["terrain"] = self._make_up(GROUND, (*GROUPS, "rest"), {**hidden, **others})
        if self._from_above(self.settings.params(WALLS).when):
            below: Sources = {"ground": made["terrain"]["made"]} if "terrain" in made else {}
            below |= {"footprints": self.tile.footprints} if self.tile.footprints else {}
            made["building"] = self._make_up(WALLS, ("building", "terrain"), below)
        if self.rays and self.photographed and "building" not in made and self.settings.params(FACADES).when == "auto":
            shown = {name: evidence[name] for name in ("views", "labels")}
            size = self.settings.params(VOXEL, "building").size
            clouds = {"cloud": self.at(VOXEL, "cloud", "building")} | self._beside("building")
            self.add(FACADES, clouds | self.rays | shown, voxel=size, **self.cell)
            made["building"] = {"made": self.at(FACADES, "made")}
        return made

    def _from_above(self, when: str) -> bool:
        """Whether a step for airborne clouds is to run."""
        return when == "always" or (when == "auto" and not self.scanner)

    def _make_up(self, step: Step, parts: Sequence[str], more: Sources) -> Sources:
        """What a step makes up of the voxels of some classes, the neighbours' among them."""
        inputs: Sources = {part: self.at(VOXEL, "cloud", part) for part in parts}
        for part in parts:
            inputs |= self.of_neighbours(VOXEL, "cloud", part, prefix=part)
        cell = self.tile.cell
        around = {"name": self.tile.name, "buffer": cell.buffer, **self.cell} if cell else {}
        self.add(step, inputs | more, **around)
        return {"made": self.at(step, "made")}

    def _beside(self, group: str) -> Sources:
        """The voxels of all other classes."""
        return {f"other.{part}": self.at(VOXEL, "cloud", part) for part in self.parted if part != group}

    def surface(self, group: str, made: Sources) -> None:
        """A class's mesh: reconstructed, trimmed, straightened, met with the neighbours', decimated."""
        at, add, cell = self.at, self.add, self.cell
        cloud, size = at(VOXEL, "cloud", group), self.settings.params(VOXEL, group).size
        borne: Sources = {"cloud": cloud, **made}
        add(POISSON, borne, group, voxel=size, aligned=bool(cell))
        add(TRIM, {"mesh": at(POISSON, "mesh", group), **borne}, group, voxel=size)
        surface = at(TRIM, "mesh", group)
        when = self.settings.params(PLANES).when
        if group == "building" and (when == "always" or (when == "auto" and self.scanner)):
            points = {**borne, "points": at(SPLIT, group)}
            add(PLANES, {"mesh": surface, **points, **self._beside(group)}, voxel=size, **cell)
            surface = at(PLANES, "mesh")
        add(ISLANDS, {"mesh": surface}, group)
        surface = at(ISLANDS, "mesh", group)
        if cell:
            add(CLIP, {"mesh": surface}, group, **cell)
            surface = at(CLIP, "mesh", group)
        if self.adjoining:
            clipped = {name: at(CLIP, name, group) for name in ("mesh", "on")}
            others = {f"{name}.{tile}": at(CLIP, name, group, tile) for tile in self.first for name in clipped}
            add(JOIN, clipped | others, group, name=self.tile.name, **cell)
            surface = at(JOIN, "mesh", group)
        things = {"furniture": self.standing[group]} if group in self.standing else {}
        add(DECIMATE, {"mesh": surface, **things}, group, keep_border=bool(cell))

    def places(self) -> Sources:
        """Lists of what stands where, for the export."""
        lists: Sources = {}
        if self.standing and self.scanner:
            lists = {"furniture": self.standing["geojson"], "furniture_csv": self.standing["csv"]}
        if self.settings.params(SPLIT).vegetation != "mesh" and self.runs(PLANTS):
            clouds = {name: self.at(VOXEL, "cloud", name) for name in ("vegetation", "terrain")}
            self.add(PLANTS, clouds, **self.cell)
            lists |= {"plants": self.at(PLANTS, "geojson"), "plants_csv": self.at(PLANTS, "csv")}
        return lists

    def planted(self, output: str) -> Sources:
        """Models of plants, where there is no mesh of vegetation."""
        wanted = self.settings.params(PLANTS).models and self.settings.params(SPLIT).vegetation == "locations"
        return {"vegetation": self.at(PLANTS, output)} if wanted and self.runs(PLANTS) else {}

    def photos(self, evidence: Sources, lists: Sources) -> tuple[Sources, Sources]:
        """What photos see of the meshes, and how well they agree; signs are fitted to them, and listed in `lists`.

        Returns:
            The final mesh of each class, and what is known of the photos.
        """
        at, add = self.at, self.add
        surfaces: Sources = {group: at(DECIMATE, "mesh", group) for group in self.groups}
        seen, clouds = self._views(), self._clouds()
        if self.photographed and self.settings.params(REFINE).when == "auto":
            add(REFINE, _meshes(surfaces) | {"cloud.rest": clouds["cloud.rest"]} | self._moving() | seen)
            seen = {"views": at(REFINE, "views")}
        if self.photographed and self.standing and self.settings.params(SIGNS).when == "auto" and self.runs(SIGNS):
            plates = {name: self.standing[name] for name in ("plates", "beside", "geojson")}
            add(SIGNS, _meshes(surfaces) | plates | seen | {"labels": evidence["labels"]}, **self.cell)
            surfaces |= {group: at(SIGNS, group) for group in self.groups if group in ("building", "vegetation")}
            lists |= {"furniture": at(SIGNS, "geojson"), "furniture_csv": at(SIGNS, "csv")}
        add(VISIBILITY, _meshes(surfaces) | clouds | self._moving() | seen)
        seen = {**seen, "depth": at(VISIBILITY, "depth")}
        prior = self.settings.params(EXPOSURE).prior
        add(EXPOSURE, seen | ({"prior": Path(prior)} if prior else {}))
        seen = {**seen, "exposures": at(EXPOSURE, "exposures")}
        add(AGREEMENT, seen)
        return surfaces, {**seen, "agreement": at(AGREEMENT, "agreement")}

    def _clouds(self) -> Sources:
        return {f"cloud.{part}": self.at(VOXEL, "cloud", part) for part in self.parted}

    def textures(self, surfaces: Sources, seen: Sources, made: Mapping[str, Sources]) -> Sources:
        """Each class's mesh with its pages, in the neighbours' colours at borders."""
        at, add = self.at, self.add
        own: Sources = {"cloud.furniture": at(SPLIT, "furniture")} if self.standing else {}
        points = self._clouds() | own | _invented(made)
        for group in self.groups:
            mesh = {"mesh": surfaces[group]}
            add(CHOOSE, mesh | seen, group)
            choice = {"choice": at(CHOOSE, "choice", group)}
            by_photo = {**choice, **seen} if self.settings.params(UNWRAP, group).backend == "photo" else {}
            add(UNWRAP, mesh | by_photo, group)
            unwrapped = {name: at(UNWRAP, name, group) for name in ("mesh", "pages")}
            stood = self.listed if group == "terrain" and not self.kept else {}
            add(TEXTURE, {**unwrapped, **choice, **points, **seen, **stood}, group)
        last = TEXTURE
        if self.adjoining:
            last = LEVEL
            for group in self.groups:
                others = self.of_neighbours(TEXTURE, "textured", group, prefix="neighbour")
                add(LEVEL, {"textured": at(TEXTURE, "textured", group)} | others, group)
        return {group: at(last, "textured", group) for group in self.groups}

    def roads(self, textured: Sources) -> Sources:
        """Roads as data, and the path, for the export."""
        if not self.scanner or self.settings.params(ROADS).when == "never" or not self.runs(ROADS):
            return self.scanner
        ground = {"cloud": self.at(SPLIT, "terrain"), "textured": textured["terrain"]}
        origin = self.settings.params(EXPORT).world_origin
        self.add(ROADS, ground | self.scanner, name=self.tile.name, world_origin=origin, **self.cell)
        outputs = {"roads": "geojson", "roads_seen": "seen", "opendrive": "opendrive"}
        return self.scanner | {name: self.at(ROADS, output) for name, output in outputs.items()}

    def results(
        self, surfaces: Sources, textured: Sources, seen: Sources, lists: Sources, made: Mapping[str, Sources]
    ) -> None:
        """What users get: the world, maps, figures and pictures."""
        at, add, tile = self.at, self.add, self.tile
        cell = {"place": self.cell["seed"], "neighbours": self.cell["neighbours"]} if self.cell else {}
        add(COLLISION, {**surfaces, **self.planted("mesh"), "cloud": at(SPLIT, "terrain")}, **cell)
        planted = self.planted("textured")
        choice = {f"choice.{g}": at(CHOOSE, "choice", g) for g in self.groups}
        shown = {"views": seen["views"], "collision": at(COLLISION, "mesh")}
        add(EXPORT, textured | planted | choice | lists | self.listed | shown, name=tile.name)
        if self.settings.params(EXPORT).rasters:
            add(RASTERS, textured, name=tile.name, **_fineness(self.settings))
        truth: Sources = {}
        if tile.truth_mesh and tile.truth_points:
            truth = {"truth.mesh": tile.truth_mesh, "truth.points": tile.truth_points}
        add(GEOMETRY, _meshes(surfaces) | self._clouds() | _invented(made) | truth, **self.cell)
        add(SCORE, textured | {name: seen[name] for name in ("views", "depth")} | self.listed | truth)
        if self.adjoining:
            mine = {f"textured.{g}": at(LEVEL, "textured", g) for g in self.groups}
            theirs = {f"textured.{g}.{n}": at(LEVEL, "textured", g, n) for g in self.groups for n in self.first}
            add(BORDERS, mine | theirs, **self.cell)
        add(PREVIEW, textured | planted | self.scanner)
        stages = {f"decimate.{g}": at(DECIMATE, "mesh", g) for g in self.groups}
        add(PICTURES, textured | stages | self._clouds() | {"views": seen["views"]} | self.scanner)


def _meshes(surfaces: Sources) -> Sources:
    return {f"mesh.{group}": mesh for group, mesh in surfaces.items()}


def _invented(made: Mapping[str, Sources]) -> Sources:
    return {f"made.{group}": points["made"] for group, points in made.items()}


def check_here(settings: Settings) -> None:
    """Refuse settings that don't exist or can't be had on this machine, before there is a tile.

    Raises:
        SettingError: as `recipe`.
        ScanError: of a step that can't run here.
    """
    settings.check(STEPS)
    for step in STEPS:
        if step.check:
            step.check(settings.params(step))


def _weights(settings: Settings) -> dict[str, Path | Output]:
    """The user's weights as an input: others make other classes."""
    weights = settings.params(LABEL).weights
    return {"weights": weights} if weights and weights.is_file() else {}


def _kept(settings: Settings) -> dict[str, Any]:
    """When photos are looked at for classes: `segment` says so, for both steps."""
    given = settings.params(SEGMENT)
    return {"overwrite": given.overwrite, "min_classified": given.min_classified, "photos": given.photos}


def _fineness(settings: Settings) -> dict[str, Any]:
    """Of rasters: `export` says so."""
    wanted, texel = settings.params(EXPORT).rasters, settings.params(UNWRAP, "terrain").texel
    return {"pixel": texel if wanted is True else wanted, "texel": texel}


def scanner_path(tile: Tile) -> dict[str, Any]:
    """Parameters of the path: the trajectory, else the cameras; empty where there is neither.

    An orthophoto is taken from no place at all.
    """
    if tile.trajectory is not None:
        return {"positions": _rows(tile.trajectory.positions), "times": tuple(tile.trajectory.times.tolist())}
    views = [view for view in tile.views if view.camera.model != "orthographic"]
    if not views:
        return {}
    times = tuple(view.time for view in views)
    return {
        "positions": _rows([view.centre for view in views]),
        "times": times if all(t is not None for t in times) else None,
    }


def _rows(positions: object) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in np.asarray(positions).round(4).tolist())

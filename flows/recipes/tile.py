"""Which steps make a tile, in order: the whole graph on one page."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from scan2sim.flows.recipes.graph import Node, NodeId, Output
from scan2sim.flows.recipes.settings import Settings
from scan2sim.pipeline.classes import GROUPS
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.step import Step
from scan2sim.pipeline.steps.carve import CARVE
from scan2sim.pipeline.steps.clip import CLIP
from scan2sim.pipeline.steps.collision import COLLISION
from scan2sim.pipeline.steps.decimate import DECIMATE
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
from scan2sim.pipeline.steps.pictures import PICTURES
from scan2sim.pipeline.steps.planes import PLANES
from scan2sim.pipeline.steps.plants import PLANTS
from scan2sim.pipeline.steps.poisson import POISSON
from scan2sim.pipeline.steps.preview import PREVIEW
from scan2sim.pipeline.steps.rasters import RASTERS
from scan2sim.pipeline.steps.reach import REACH
from scan2sim.pipeline.steps.split import SPLIT
from scan2sim.pipeline.steps.trim import TRIM
from scan2sim.pipeline.steps.views import VIEWS
from scan2sim.pipeline.steps.visibility import VISIBILITY
from scan2sim.pipeline.steps.voxel import VOXEL
from scan2sim.pipeline.steps.walls import WALLS
from scan2sim.pipeline.types import Tile
from scan2sim.segmentation.label import LABEL
from scan2sim.segmentation.segment import SEGMENT
from scan2sim.segmentation.signs import SIGNS
from scan2sim.segmentation.things import THINGS
from scan2sim.texturing.agreement import AGREEMENT
from scan2sim.texturing.borders.level import LEVEL
from scan2sim.texturing.borders.measure import BORDERS
from scan2sim.texturing.choose import CHOOSE
from scan2sim.texturing.exposure import EXPOSURE
from scan2sim.texturing.refine import REFINE
from scan2sim.texturing.score import SCORE
from scan2sim.texturing.texture import TEXTURE
from scan2sim.texturing.unwrap import UNWRAP

STEPS: tuple[Step, ...] = (
    INGEST, PATH, CARVE, VIEWS, LABEL, SEGMENT, THINGS, REACH, OVERLAP, FURNITURE, SPLIT, VOXEL, GROUND, WALLS, FACADES,
    POISSON, TRIM, PLANES, ISLANDS, CLIP, JOIN, DECIMATE, PLANTS, UNWRAP, REFINE, SIGNS, VISIBILITY, EXPOSURE,
    AGREEMENT, CHOOSE, TEXTURE, LEVEL, COLLISION, EXPORT, RASTERS, GEOMETRY, SCORE, PICTURES, PREVIEW, BORDERS,
)  # fmt: skip


def recipe(tile: Tile, settings: Settings, beside: Collection[str] | None = None) -> list[Node]:
    """The graph of a tile, each node after those that it reads of the same tile.

    Args:
        tile: to be made.
        settings: of all steps.
        beside: names of the tiles of its survey that are made, too: labels are `tile/step` then, and what happens at
            borders reads neighbours' results. Without it the tile is made for itself, and ends at its borders.

    Raises:
        SettingError: a setting that doesn't exist or is out of range.
    """
    settings.check(STEPS)
    nodes: list[Node] = []

    def at(step: Step, name: str, group: str = "", other: str = tile.name) -> Output:
        """An output of a node of this tile, or of a neighbour."""
        return Output(NodeId(step.name, group, "" if beside is None else other), name)

    def add(step: Step, inputs: Mapping[str, Path | Output], group: str = "", **given: Any) -> None:
        of = "" if beside is None else tile.name
        nodes.append(Node(step, settings.params(step, group, **given), inputs, group, of))

    frame: dict[str, Any] = {"crs": tile.frame.crs, "origin": tile.frame.origin, "unit": tile.frame.unit}
    files = {f"cloud.{i:04d}": path for i, path in enumerate(tile.clouds)}
    add(INGEST, files, **frame, classes=dict(tile.classes))
    path = scanner_path(tile)
    if path:
        add(PATH, {}, **path)
    scanner = {"path": at(PATH, "path")} if path else {}
    cameras = _rows([view.centre for view in tile.views if view.camera.model != "orthographic"])
    rays = scanner if tile.trajectory is not None else {}  # cameras aren't where the scanner was
    add(CARVE, {"cloud": at(INGEST, "cloud")} | rays, cameras=cameras)
    whole = {"cloud": at(CARVE, "cloud")}
    moving = {"moving": at(CARVE, "moving")}
    photos: dict[str, Path | Output] = {f"photo.{i}": view.photo for i, view in enumerate(tile.views)}
    masks: dict[str, Path | Output] = {f"mask.{i}": view.mask for i, view in enumerate(tile.views) if view.mask}
    add(VIEWS, photos | masks | whole, poses=tuple(views_io.to_json(view, with_paths=False) for view in tile.views))
    seen: dict[str, Path | Output] = {"views": at(VIEWS, "views")}
    photographed = any(view.camera.model != "orthographic" for view in tile.views)
    if photographed:
        add(LABEL, whole | seen | _weights(settings), **_kept(settings))
    told = {**seen, **moving, "labels": at(LABEL, "labels")} if photographed else {}
    add(SEGMENT, whole | scanner | told)
    last = SEGMENT  # step whose cloud is split, in every tile of a survey the same
    cell: dict[str, Any] = {"seed": tile.cell.seed, "neighbours": dict(tile.cell.neighbours)} if tile.cell else {}
    met = [name for name in cell.get("neighbours", {}) if name in (beside or ())]
    first = [name for name in met if name < tile.name]  # they own the borders with this one
    listed: dict[str, Path | Output] = {}
    if settings.params(THINGS).find and (path or met):
        classified = {name: at(SEGMENT, name) for name in ("cloud", "confidence")}
        add(THINGS, classified | moving | scanner)
        last, listed = THINGS, {"things": at(THINGS, "things")} if path else {}
    limit = settings.params(REACH).limit
    if limit != "off" and (met or (path and (photographed or limit != "auto"))):
        shown = seen if photographed else {}
        add(REACH, {"cloud": at(last, "cloud")} | scanner | shown, voxel=settings.params(VOXEL, "terrain").size)
        last = REACH
    cloud = at(last, "cloud")
    if met and tile.cell:
        others = {f"cloud.{name}": at(last, "cloud", other=name) for name in met}
        add(OVERLAP, {"cloud": cloud} | others, name=tile.name, buffer=tile.cell.buffer, **cell)
        cloud = at(OVERLAP, "cloud")
    standing: dict[str, Path | Output] = {}
    if path and settings.params(FURNITURE).when == "auto":
        add(FURNITURE, {"cloud": cloud} | scanner, **cell)
        standing = {name: at(FURNITURE, name) for name in (*GROUPS[1:], "taken", "plates", "geojson", "csv")}
    kept = listed if settings.params(SPLIT).vehicles == "keep" else {}
    add(SPLIT, {"cloud": cloud} | kept | {name: standing[name] for name in standing if name == "taken"})

    vegetation = settings.params(SPLIT).vegetation
    groups = [g for g in GROUPS if g != "vegetation" or vegetation != "locations"]
    groups += ["vehicle"] if kept else []
    parted = (*GROUPS, "rest", "vehicle") if kept else (*GROUPS, "rest")
    for part in parted:
        add(VOXEL, {"cloud": at(SPLIT, part)} | scanner, part)
    made: dict[str, dict[str, Path | Output]] = {}  # by group, what no airborne scanner sees
    around = {"name": tile.name, "buffer": tile.cell.buffer, **cell} if tile.cell else {}
    for step, group, parts in (
        (GROUND, "terrain", (*GROUPS, "rest")),
        (WALLS, "building", ("building", "terrain")),
    ):
        when = settings.params(step).when
        hidden = listed if step is GROUND and when == "auto" else {}
        if when == "always" or (when == "auto" and not path) or hidden:
            seen_from_above = {part: at(VOXEL, "cloud", part) for part in parts}
            theirs = {f"{part}.{name}": at(VOXEL, "cloud", part, name) for part in parts for name in met}
            below: dict[str, Path | Output] = {}
            if step is WALLS:
                below = {"ground": made["terrain"]["made"]} if "terrain" in made else {}
                below |= {"footprints": tile.footprints} if tile.footprints else {}
            others = {f"{k}.{name}": at(THINGS, k, other=name) for k in hidden for name in met}
            add(step, seen_from_above | theirs | below | hidden | others, **around)
            made[group] = {"made": at(step, "made")}
    if rays and photographed and settings.params(FACADES).when == "auto" and "building" not in made:
        shown = {name: told[name] for name in ("views", "labels")}
        size = settings.params(VOXEL, "building").size
        beside_it = {f"other.{part}": at(VOXEL, "cloud", part) for part in parted if part != "building"}
        add(FACADES, {"cloud": at(VOXEL, "cloud", "building")} | beside_it | rays | shown, voxel=size, **cell)
        made["building"] = {"made": at(FACADES, "made")}
    for group in groups:
        cloud, size = at(VOXEL, "cloud", group), settings.params(VOXEL, group).size
        borne = {"cloud": cloud, **made.get(group, {})}
        add(POISSON, borne, group, voxel=size, aligned=bool(cell))
        add(TRIM, {"mesh": at(POISSON, "mesh", group), **borne}, group, voxel=size)
        surface = at(TRIM, "mesh", group)
        when = settings.params(PLANES).when
        if group == "building" and (when == "always" or (when == "auto" and path)):
            others = {f"other.{part}": at(VOXEL, "cloud", part) for part in parted if part != group}
            points = {"cloud": cloud, "points": at(SPLIT, group)}
            add(PLANES, {"mesh": surface, **points, **others, **made.get(group, {})}, voxel=size, **cell)
            surface = at(PLANES, "mesh")
        add(ISLANDS, {"mesh": surface}, group)
        surface = at(ISLANDS, "mesh", group)
        if cell:
            add(CLIP, {"mesh": surface}, group, **cell)
            clipped = {"mesh": at(CLIP, "mesh", group), "on": at(CLIP, "on", group)}
            surface = clipped["mesh"]
        if met:
            others = {f"{k}.{name}": at(CLIP, k, group, name) for name in first for k in clipped}
            add(JOIN, clipped | others, group, name=tile.name, **cell)
            surface = at(JOIN, "mesh", group)
        things = {"furniture": standing[group]} if group in standing else {}
        add(DECIMATE, {"mesh": surface, **things}, group, keep_border=bool(cell))
    surfaces: dict[str, Path | Output] = {g: at(DECIMATE, "mesh", g) for g in groups}
    meshes = {f"mesh.{g}": surfaces[g] for g in groups}
    clouds = {f"cloud.{part}": at(VOXEL, "cloud", part) for part in parted}
    own = {"cloud.furniture": at(SPLIT, "furniture")} if standing else {}
    invented = {f"made.{group}": points["made"] for group, points in made.items()}
    lists: dict[str, Path | Output] = {}
    if standing:
        lists = {"furniture": standing["geojson"], "furniture_csv": standing["csv"]}
    if vegetation != "mesh":
        add(PLANTS, {name: at(VOXEL, "cloud", name) for name in ("vegetation", "terrain")}, **cell)
        lists |= {"plants": at(PLANTS, "geojson"), "plants_csv": at(PLANTS, "csv")}

    if photographed and settings.params(REFINE).when == "auto":
        add(REFINE, meshes | {"cloud.rest": clouds["cloud.rest"]} | moving | seen)
        seen = {"views": at(REFINE, "views")}
    if photographed and standing and settings.params(SIGNS).when == "auto":
        plates = {name: standing[name] for name in ("plates", "geojson")}
        add(SIGNS, meshes | plates | seen | {"labels": at(LABEL, "labels")}, **cell)
        surfaces |= {g: at(SIGNS, g) for g in groups if g in ("building", "vegetation")}
        meshes = {f"mesh.{g}": surfaces[g] for g in groups}
        lists |= {"furniture": at(SIGNS, "geojson"), "furniture_csv": at(SIGNS, "csv")}
    add(VISIBILITY, meshes | clouds | moving | seen)
    seen = seen | {"depth": at(VISIBILITY, "depth")}
    prior = settings.params(EXPOSURE).prior
    add(EXPOSURE, seen | ({"prior": Path(prior)} if prior else {}))
    seen = seen | {"exposures": at(EXPOSURE, "exposures")}
    add(AGREEMENT, seen)
    seen = seen | {"agreement": at(AGREEMENT, "agreement")}
    for group in groups:
        mesh = {"mesh": surfaces[group]}
        add(CHOOSE, mesh | seen, group)
        choice = {"choice": at(CHOOSE, "choice", group)}
        by_photo = {**choice, **seen} if settings.params(UNWRAP, group).backend == "photo" else {}
        add(UNWRAP, mesh | by_photo, group)
        unwrapped = {name: at(UNWRAP, name, group) for name in ("mesh", "pages")}
        stood = listed if group == "terrain" and not kept else {}
        add(TEXTURE, {**unwrapped, **choice, **clouds, **own, **invented, **seen, **stood}, group)
    textured: dict[str, Path | Output] = {g: at(TEXTURE, "textured", g) for g in groups}
    for group in groups if met else ():
        others = {f"neighbour.{name}": at(TEXTURE, "textured", group, name) for name in met}
        add(LEVEL, {"textured": textured[group]} | others, group)
        textured[group] = at(LEVEL, "textured", group)
    add(COLLISION, surfaces, keep_border=bool(cell))
    add(EXPORT, textured | lists | listed | {"collision": at(COLLISION, "mesh")}, name=tile.name)
    if settings.params(EXPORT).rasters:
        add(RASTERS, textured, name=tile.name, **_fineness(settings))

    truth: dict[str, Path | Output] = {}
    if tile.truth_mesh and tile.truth_points:
        truth = {"truth.mesh": tile.truth_mesh, "truth.points": tile.truth_points}
    add(GEOMETRY, meshes | clouds | invented | truth, **cell)
    add(SCORE, textured | {name: seen[name] for name in ("views", "depth")} | listed | truth)
    stages = {f"decimate.{g}": at(DECIMATE, "mesh", g) for g in groups}
    if met:
        mine = {f"textured.{g}": at(LEVEL, "textured", g) for g in groups}
        theirs = {f"textured.{g}.{n}": at(LEVEL, "textured", g, n) for g in groups for n in first}
        add(BORDERS, mine | theirs, **cell)
    add(PREVIEW, textured | scanner)
    add(PICTURES, textured | stages | clouds | {"views": seen["views"]} | scanner)
    return nodes


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
    import numpy as np

    return tuple(tuple(row) for row in np.asarray(positions).round(4).tolist())

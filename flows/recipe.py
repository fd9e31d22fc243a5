"""Which steps make a tile, in order: the whole graph on one page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.settings import Settings
from pipeline.classes import GROUPS
from pipeline.io import views as views_io
from pipeline.step import Params, Step
from pipeline.steps.collision import COLLISION
from pipeline.steps.decimate import DECIMATE
from pipeline.steps.export import EXPORT
from pipeline.steps.geometry import GEOMETRY
from pipeline.steps.ingest import INGEST
from pipeline.steps.islands import ISLANDS
from pipeline.steps.path import PATH
from pipeline.steps.pictures import PICTURES
from pipeline.steps.plants import PLANTS
from pipeline.steps.poisson import POISSON
from pipeline.steps.split import SPLIT
from pipeline.steps.trim import TRIM
from pipeline.steps.views import VIEWS
from pipeline.steps.visibility import VISIBILITY
from pipeline.steps.voxel import VOXEL
from pipeline.types import Tile
from segmentation.label import LABEL
from segmentation.segment import SEGMENT
from texturing.agreement import AGREEMENT
from texturing.choose import CHOOSE
from texturing.exposure import EXPOSURE
from texturing.score import SCORE
from texturing.texture import TEXTURE
from texturing.unwrap import UNWRAP

STEPS: tuple[Step, ...] = (
    INGEST, PATH, VIEWS, LABEL, SEGMENT, SPLIT, VOXEL, POISSON, TRIM, ISLANDS, DECIMATE, PLANTS, UNWRAP,
    VISIBILITY, EXPOSURE, AGREEMENT, CHOOSE, TEXTURE, COLLISION, EXPORT, GEOMETRY, SCORE, PICTURES,
)  # fmt: skip
PER_CLASS: tuple[Step, ...] = (VOXEL, POISSON, TRIM, ISLANDS, DECIMATE, CHOOSE, UNWRAP, TEXTURE)


@dataclass(frozen=True)
class Output:
    """An output of a node, as another's input."""

    node: str
    name: str


@dataclass(frozen=True)
class Node:
    """A step to be run.

    Attributes:
        label: unique in the graph: the step's name, with the class where it is per class.
        step, params: what is run.
        inputs: name to a source file, or to another node's output.
    """

    label: str
    step: Step
    params: Params
    inputs: Mapping[str, Path | Output]


def recipe(tile: Tile, settings: Settings) -> list[Node]:
    """The graph of a tile, each node after those that it reads.

    Raises:
        SettingError: a setting that doesn't exist or is out of range.
    """
    settings.check(STEPS, PER_CLASS)
    nodes: list[Node] = []

    def add(step: Step, inputs: Mapping[str, Path | Output], group: str | None = None, **given: Any) -> str:
        label = f"{step.name}.{group}" if group else step.name
        nodes.append(Node(label, step, settings.params(step, group, **given), inputs))
        return label

    frame: dict[str, Any] = {"crs": tile.frame.crs, "origin": tile.frame.origin, "unit": tile.frame.unit}
    add(INGEST, {f"cloud.{i:04d}": path for i, path in enumerate(tile.clouds)}, **frame)
    whole = {"cloud": Output("ingest", "cloud")}
    path = scanner_path(tile)
    if path:
        add(PATH, {}, **path)
    scanner = {"path": Output("path", "path")} if path else {}
    photos: dict[str, Path | Output] = {f"photo.{i}": view.photo for i, view in enumerate(tile.views)}
    masks: dict[str, Path | Output] = {f"mask.{i}": view.mask for i, view in enumerate(tile.views) if view.mask}
    add(VIEWS, photos | masks | whole, poses=tuple(views_io.to_json(view, with_paths=False) for view in tile.views))
    seen: dict[str, Path | Output] = {"views": Output("views", "views")}
    if tile.views:
        add(LABEL, whole | seen | _weights(settings), **_kept(settings))
    add(SEGMENT, whole | scanner | ({**seen, "labels": Output("label", "labels")} if tile.views else {}))
    add(SPLIT, {"cloud": Output("segment", "cloud")})

    vegetation = settings.params(SPLIT).vegetation
    groups = [g for g in GROUPS if g != "vegetation" or vegetation != "locations"]
    for part in (*GROUPS, "rest"):
        add(VOXEL, {"cloud": Output("split", part)} | scanner, part)
    for group in groups:
        cloud, size = Output(f"voxel.{group}", "cloud"), settings.params(VOXEL, group).size
        add(POISSON, {"cloud": cloud}, group, voxel=size)
        add(TRIM, {"mesh": Output(f"poisson.{group}", "mesh"), "cloud": cloud}, group, voxel=size)
        add(ISLANDS, {"mesh": Output(f"trim.{group}", "mesh")}, group)
        add(DECIMATE, {"mesh": Output(f"islands.{group}", "mesh")}, group)
    meshes = {f"mesh.{g}": Output(f"decimate.{g}", "mesh") for g in groups}
    clouds = {f"cloud.{part}": Output(f"voxel.{part}", "cloud") for part in (*GROUPS, "rest")}
    plants: dict[str, Path | Output] = {}
    if vegetation != "mesh":
        add(PLANTS, {name: Output(f"voxel.{name}", "cloud") for name in ("vegetation", "terrain")})
        plants = {"plants": Output("plants", "geojson"), "plants_csv": Output("plants", "csv")}

    add(VISIBILITY, meshes | clouds | seen)
    seen = seen | {"depth": Output("visibility", "depth")}
    prior = settings.params(EXPOSURE).prior
    add(EXPOSURE, seen | ({"prior": Path(prior)} if prior else {}))
    seen = seen | {"exposures": Output("exposure", "exposures")}
    add(AGREEMENT, seen)
    seen = seen | {"agreement": Output("agreement", "agreement")}
    for group in groups:
        mesh = {"mesh": Output(f"decimate.{group}", "mesh")}
        add(CHOOSE, mesh | seen, group)
        choice = {"choice": Output(f"choose.{group}", "choice")}
        by_photo = {**choice, **seen} if settings.params(UNWRAP, group).backend == "photo" else {}
        add(UNWRAP, mesh | by_photo, group)
        unwrapped = {name: Output(f"unwrap.{group}", name) for name in ("mesh", "pages")}
        add(TEXTURE, {**unwrapped, **choice, **clouds, **seen}, group)
    textured = {g: Output(f"texture.{g}", "textured") for g in groups}
    add(COLLISION, {g: Output(f"decimate.{g}", "mesh") for g in groups})
    add(EXPORT, textured | plants | {"collision": Output("collision", "mesh")}, name=tile.name)

    truth: dict[str, Path | Output] = {}
    if tile.truth_mesh and tile.truth_points:
        truth = {"truth.mesh": tile.truth_mesh, "truth.points": tile.truth_points}
    add(GEOMETRY, meshes | clouds | truth)
    add(SCORE, textured | {name: seen[name] for name in ("views", "depth")} | truth)
    stages = {f"decimate.{g}": Output(f"decimate.{g}", "mesh") for g in groups}
    add(PICTURES, textured | stages | clouds | {"views": seen["views"]} | scanner)
    return nodes


def _weights(settings: Settings) -> dict[str, Path | Output]:
    """The user's weights as an input: others make other classes."""
    weights = settings.params(LABEL).weights
    return {"weights": weights} if weights and weights.is_file() else {}


def _kept(settings: Settings) -> dict[str, Any]:
    """When photos are looked at for classes: `segment` says so, for both steps."""
    given = settings.params(SEGMENT)
    return {"overwrite": given.overwrite, "min_classified": given.min_classified, "photos": given.photos}


def scanner_path(tile: Tile) -> dict[str, Any]:
    """Parameters of the path: the trajectory, else the cameras; empty where there is neither."""
    if tile.trajectory is not None:
        return {"positions": _rows(tile.trajectory.positions), "times": tuple(tile.trajectory.times.tolist())}
    if not tile.views:
        return {}
    times = tuple(view.time for view in tile.views)
    return {
        "positions": _rows([view.centre for view in tile.views]),
        "times": times if all(t is not None for t in times) else None,
    }


def _rows(positions: object) -> tuple[tuple[float, ...], ...]:
    import numpy as np

    return tuple(tuple(row) for row in np.asarray(positions).round(4).tolist())

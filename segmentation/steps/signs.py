"""Signs step: sign panels fitted to photos, also where the scan ends (`segmentation.sign_panels`)."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import F32, F64, U8, Frame, Mesh, View
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.pipeline.furniture.object_lists import sign_panel_columns, write_lists
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image

if TYPE_CHECKING:
    from scan2sim.pipeline.furniture.sign_panels import SignPanel

SEARCH_RADIUS_M = 0.4
"""Largest error of the position of a panel from points or from a network's classes."""
SAME_PANEL_M = 0.5
"""Distance in metres between the centres of panels within which they are the same."""
MAX_ADJACENT_PANELS = 2
"""Panels that are searched above a panel, and below it."""
PHOTOS_CACHED = 8
"""Photos kept in memory."""


class SignsParams(Params):
    """Settings of the fitting of sign panels to photos.

    Attributes:
        when: "auto": if there are photos taken from the ground; "never": keep the panels from points.
        context: the tile's cell, if it has neighbours; panels on poles of a neighbouring tile belong to that tile;
            panels without a pole within half a metre of a border belong to no tile.
    """

    when: Literal["auto", "never"] = "auto"
    context: TileCell | None = None


def signs(inputs: Inputs, params: SignsParams, out: Path, report: Report) -> Done:
    """Fit sign panels to photos: those detected in the points, and those detected in the photos.

    Inputs: `mesh.terrain`, `mesh.building`, `mesh.vegetation` (optional); `sign_panels`, `neighbour_poles` and
    `geojson` of `furniture`; `views`; `labels` (a network's classes; without them no signs are detected in photos).
    Files: `building` and `vegetation`, meshes with the panels and without the surfaces reconstructed from their points;
    `geojson` and `csv` as of `furniture`. Metrics: panels `from_points`; `fitted` to photos, of these `new`.
    """
    from scan2sim.pipeline.furniture.sign_panels import SignPanel
    from scan2sim.segmentation.sign_panels.attach import (
        move_poles_behind,
        with_panels,
        without_panels,
        without_smear,
    )

    groups = [group for group in ("terrain", "building", "vegetation") if f"mesh.{group}" in inputs]
    meshes = {group: Mesh.load(inputs[f"mesh.{group}"]) for group in groups}
    frame = meshes["building"].frame
    known = [SignPanel.from_json(row) for row in json.loads(inputs["sign_panels"].read_text(encoding="utf-8"))]
    features = json.loads(inputs["geojson"].read_text(encoding="utf-8"))["features"]
    rows = [f["properties"] | dict(zip("xyz", f["geometry"]["coordinates"], strict=True)) for f in features]
    views, held = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    used = [i for i, view in enumerate(views) if not held[i] and view.camera.model != "orthographic"]
    cell = params.context.cell if params.context else None
    poles = np.array([frame.to_local([row["x"], row["y"], row["z"]]) for row in rows if row["kind"] != "trunk"])
    others = np.array(json.loads(inputs["neighbour_poles"].read_text(encoding="utf-8")))
    own = partial(_own, frame, cell, poles.reshape(-1, 3), others.reshape(-1, 3))
    found = _found(views, used, _probabilities(inputs, used), known, own, report)
    building = meshes["building"]
    if found:
        replaced = [old for old in known if any(np.linalg.norm(old.centre - p.centre) < SAME_PANEL_M for p in found)]
        building, shifts = move_poles_behind(without_panels(building, replaced), found)
        meshes["building"] = with_panels(without_smear(building, found, cell), found)
        meshes |= {group: without_smear(meshes[group], found, cell) for group in groups if group == "vegetation"}
        rows = _updated_rows(rows, found, shifts, meshes["terrain"])
    files = {group: out / f"{group}.npz" for group in groups if group != "terrain"}
    for group, file in files.items():
        meshes[group].save(file)
    new = sum(all(np.linalg.norm(old.centre - p.centre) >= SAME_PANEL_M for old in known) for p in found)
    metrics = {"from_points": len(known), "fitted": len(found), "new": new}
    return Done(files | write_lists(out, frame.crs, rows), metrics)


def _probabilities(inputs: Inputs, used: Sequence[int]) -> dict[int, U8]:
    """A network's probabilities by index of view, for the classified views."""
    files = {i: inputs["labels"] / f"{i}.npy" for i in used} if "labels" in inputs else {}
    return {i: np.load(file) for i, file in files.items() if file.is_file()}


def _own(frame: Frame, cell: Cell | None, poles: F64, others: F64, position: F64) -> bool:
    """Whether a panel at a position (3,) belongs to this tile: it is on one of its `poles`, or clearly in its `cell`.

    Args:
        frame: frame of the tile.
        cell: Voronoi cell of the tile; None: there are no neighbouring tiles.
        poles: (P, 3) poles of this tile.
        others: (Q, 3) poles of neighbouring tiles, which fit the panels on these poles.
        position: (3,) local metres.
    """
    from scan2sim.pipeline.furniture.classify import PANEL_SEARCH_RADIUS_M

    if cell is None:
        return True
    own, other = (np.hypot(*(feet - position)[:, :2].T).min(initial=np.inf) for feet in (poles, others))
    if min(own, other) < PANEL_SEARCH_RADIUS_M:
        return bool(own <= other)
    return bool(cell.outside(position[None, :2] + np.asarray(frame.origin[:2]))[0] < -SAME_PANEL_M)


def _found(
    views: Sequence[View],
    used: Sequence[int],
    probabilities: Mapping[int, U8],
    known: Sequence[SignPanel],
    own: Callable[[F64], bool],
    report: Report,
) -> list[SignPanel]:
    """Panels fitted to photos, around the panels from points and around the signs detected in photos."""
    from scan2sim.segmentation.sign_panels.fit_outline import close_ups, fit_adjacent_panel, fit_panel
    from scan2sim.segmentation.sign_panels.triangulate import triangulate_signs

    used_views = [views[i] for i in used]
    photo = lru_cache(maxsize=PHOTOS_CACHED)(lambda k: image.usable_photo(used_views[k]))
    candidates: list[tuple[F64, F64 | None]] = [(panel.centre, panel.normal) for panel in known]
    candidates += [(position, None) for position in triangulate_signs(views, probabilities)]
    found: list[SignPanel] = []
    for done, (position, normal) in enumerate(candidates):
        report(done / len(candidates), f"{len(found)} sign panels")
        is_fitted = any(np.linalg.norm(position - panel.centre) < SAME_PANEL_M for panel in found)
        if (normal is None and not own(position)) or is_fitted:
            continue
        photos = close_ups(position, used_views, photo)
        panel = None if photos is None else fit_panel(photos, SEARCH_RADIUS_M, normal)
        if photos is None or panel is None:
            continue
        if any(np.linalg.norm(panel.centre - p.centre) < SAME_PANEL_M / 2 for p in found):
            continue
        found.append(panel)
        for up in (1, -1):
            last: SignPanel | None = panel
            for _ in range(MAX_ADJACENT_PANELS):
                last = None if last is None else fit_adjacent_panel(photos, last, up)
                found += [] if last is None else [last]
    return found


def _updated_rows(
    rows: Sequence[Mapping[str, Any]], panels: Sequence[SignPanel], shifts: Sequence[F64], terrain: Mesh
) -> list[dict[str, Any]]:
    """Rows of the furniture list updated with the panels; panels without a known pole get a row of kind "sign"."""
    from scan2sim.pipeline.furniture.classify import PANEL_SEARCH_RADIUS_M

    frame, out = terrain.frame, [dict(row) for row in rows]
    by_size = sorted(zip(panels, shifts, strict=True), key=lambda pair: pair[0].width * pair[0].height)
    for panel, shift in by_size:  # the columns of a pole are those of its largest panel
        at = np.array([frame.to_local([row["x"], row["y"], row["z"]]) for row in out]).reshape(-1, 3)
        distance = np.hypot(*(at[:, :2] - panel.centre[:2]).T)
        distance[[row["kind"] == "trunk" for row in out]] = np.inf
        if len(out) and distance.min() < PANEL_SEARCH_RADIUS_M:
            row, foot = out[int(distance.argmin())], at[int(distance.argmin())] + shift
        else:
            row, foot = {"kind": "sign"}, np.array([*panel.centre[:2], _ground_z(terrain.vertices, panel.centre)])
            out.append(row)
        x, y, z = frame.to_crs(foot).round(3).tolist()
        top = round(float(panel.centre[2] + panel.height / 2 - foot[2]), 2)
        row |= {"x": x, "y": y, "z": z, "height_m": max(top, row.get("height_m", 0.0))} | sign_panel_columns(panel)
        row["kind"] = "lamp" if row["kind"] == "lamp" else "sign"
    return out


def _ground_z(vertices: F32, position: F64) -> float:
    """Height z of the ground vertex nearest in plan to a position."""
    if not len(vertices):
        return float(position[2])
    return float(vertices[np.hypot(*(vertices[:, :2] - position[:2]).T).argmin(), 2])


SIGNS = Step("signs", 4, signs, SignsParams)

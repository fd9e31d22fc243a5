"""Signs: the plates of traffic signs fitted to photos, also where the scan ends (kernels in fit_outline.py)."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Place
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, F64, U8, Bools, Frame, Mesh, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.steps.furniture import listed, of_plate
from scan2sim.pipeline.tiling.voronoi_cell import Cell

if TYPE_CHECKING:
    from scan2sim.pipeline.furniture.sign_panels import Plate

    Bools = Bools

REACH = 0.4
"""Metres by which points or a network's classes may misplace a plate."""
SAME = 0.5
"""Metres between the middles of plates that are one."""
MORE = 2
"""Plates looked for above and below one, each."""
KEPT = 8
"""Photos kept in memory."""


class SignsParams(Params):
    """Whether plates are fitted to photos.

    Attributes:
        when: "auto": where there are photos from the ground; "never": plates stay as points tell.
        seed, neighbours: as of `furniture`: plates on poles of the neighbours' are theirs, and plates without a pole
            within half a metre of a border are nobody's; set by the recipe.
    """

    when: Literal["auto", "never"] = "auto"
    seed: Place | None = None
    neighbours: dict[str, Place] = Field(default_factory=dict)


def signs(inputs: Inputs, params: SignsParams, out: Path, report: Report) -> Done:
    """Fit the plates of signs to photos: those that points tell of, and those that photos show.

    Inputs: `mesh.terrain`, `mesh.building`, `mesh.vegetation` (if any); `plates`, `beside` and `geojson` of
    `furniture`; `views`; `labels` (a network's classes; without them photos show no signs that points don't).
    Files: `building` and `vegetation`, meshes with the plates, and without what points of plates made before them;
    `geojson` and `csv` as of `furniture`. Facts: `from_points`, plates; `fitted` to photos, of these `new`.
    """
    from scan2sim.pipeline.furniture.sign_panels import Plate
    from scan2sim.segmentation.sign_panels.attach import behind, cleared, with_plates, without

    groups = [group for group in ("terrain", "building", "vegetation") if f"mesh.{group}" in inputs]
    meshes = {group: Mesh.load(inputs[f"mesh.{group}"]) for group in groups}
    frame = meshes["building"].frame
    known = [Plate.from_json(row) for row in json.loads(inputs["plates"].read_text(encoding="utf-8"))]
    features = json.loads(inputs["geojson"].read_text(encoding="utf-8"))["features"]
    rows = [f["properties"] | dict(zip("xyz", f["geometry"]["coordinates"], strict=True)) for f in features]
    views, held = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    used = [i for i, view in enumerate(views) if not held[i] and view.camera.model != "orthographic"]
    cell = None if params.seed is None else Cell(params.seed, params.neighbours)
    poles = np.array([frame.to_local([row["x"], row["y"], row["z"]]) for row in rows if row["kind"] != "trunk"])
    others = np.array(json.loads(inputs["beside"].read_text(encoding="utf-8")))
    own = partial(_own, frame, cell, poles.reshape(-1, 3), others.reshape(-1, 3))
    found = _found(views, used, _probabilities(inputs, used), known, own, report)
    building = meshes["building"]
    if found:
        replaced = [old for old in known if any(np.linalg.norm(old.centre - p.centre) < SAME for p in found)]
        building, moved = behind(without(building, replaced), found)
        meshes["building"] = with_plates(cleared(building, found, cell), found)
        meshes |= {group: cleared(meshes[group], found, cell) for group in groups if group == "vegetation"}
        rows = _listed(rows, found, moved, meshes["terrain"])
    files = {group: out / f"{group}.npz" for group in groups if group != "terrain"}
    for group, file in files.items():
        meshes[group].save(file)
    new = sum(all(np.linalg.norm(old.centre - p.centre) >= SAME for old in known) for p in found)
    facts = {"from_points": len(known), "fitted": len(found), "new": new}
    return Done(files | listed(out, frame.crs, rows), facts)


def _probabilities(inputs: Inputs, used: Sequence[int]) -> dict[int, U8]:
    """A network's probabilities by index of view, of those that it looked at."""
    files = {i: inputs["labels"] / f"{i}.npy" for i in used} if "labels" in inputs else {}
    return {i: np.load(file) for i, file in files.items() if file.is_file()}


def _own(frame: Frame, cell: Cell | None, poles: F64, others: F64, place: F64) -> bool:
    """Whether what hangs at a place (3,) is this tile's to fit: on one of its `poles` (P, 3), or clearly in its `cell`.

    Of `others`' poles (Q, 3), their tiles say.
    """
    from scan2sim.pipeline.furniture.classify import AROUND

    if cell is None:
        return True
    apart, away = (np.hypot(*(feet - place)[:, :2].T).min(initial=np.inf) for feet in (poles, others))
    if min(apart, away) < AROUND:
        return bool(apart <= away)
    return bool(cell.outside(place[None, :2] + np.asarray(frame.origin[:2]))[0] < -SAME)


def _found(
    views: Sequence[View],
    used: Sequence[int],
    probabilities: Mapping[int, U8],
    known: Sequence[Plate],
    own: Callable[[F64], bool],
    report: Report,
) -> list[Plate]:
    """Plates that photos agree on, around those of points and where photos show signs."""
    from scan2sim.segmentation.sign_panels.fit_outline import beside, close_ups, fitted
    from scan2sim.segmentation.sign_panels.triangulate import hanging

    seen = [views[i] for i in used]
    photo = lru_cache(maxsize=KEPT)(lambda k: image.usable_photo(seen[k]))
    wanted: list[tuple[F64, F64 | None]] = [(plate.centre, plate.normal) for plate in known]
    wanted += [(place, None) for place in hanging(views, probabilities)]
    found: list[Plate] = []
    for done, (place, normal) in enumerate(wanted):
        report(done / len(wanted), f"{len(found)} plates")
        if (normal is None and not own(place)) or any(np.linalg.norm(place - plate.centre) < SAME for plate in found):
            continue
        shown = close_ups(place, seen, photo)
        plate = None if shown is None else fitted(shown, REACH, normal)
        if shown is None or plate is None or any(np.linalg.norm(plate.centre - p.centre) < SAME / 2 for p in found):
            continue
        found.append(plate)
        for up in (1, -1):
            last: Plate | None = plate
            for _ in range(MORE):
                last = None if last is None else beside(shown, last, up)
                found += [] if last is None else [last]
    return found


def _listed(
    rows: Sequence[Mapping[str, Any]], plates: Sequence[Plate], moved: Sequence[F64], terrain: Mesh
) -> list[dict[str, Any]]:
    """The list's rows with the plates: those of the pole that each hangs on, or of a sign whose pole isn't known."""
    from scan2sim.pipeline.furniture.classify import AROUND

    frame, out = terrain.frame, [dict(row) for row in rows]
    by_size = sorted(zip(plates, moved, strict=True), key=lambda one: one[0].width * one[0].height)
    for plate, shift in by_size:  # the largest has the last word
        at = np.array([frame.to_local([row["x"], row["y"], row["z"]]) for row in out]).reshape(-1, 3)
        apart = np.hypot(*(at[:, :2] - plate.centre[:2]).T)
        apart[[row["kind"] == "trunk" for row in out]] = np.inf
        if len(out) and apart.min() < AROUND:
            row, foot = out[int(apart.argmin())], at[int(apart.argmin())] + shift
        else:
            row, foot = {"kind": "sign"}, np.array([*plate.centre[:2], _ground(terrain.vertices, plate.centre)])
            out.append(row)
        x, y, z = frame.to_crs(foot).round(3).tolist()
        top = round(float(plate.centre[2] + plate.height / 2 - foot[2]), 2)
        row |= {"x": x, "y": y, "z": z, "height_m": max(top, row.get("height_m", 0.0))} | of_plate(plate)
        row["kind"] = "lamp" if row["kind"] == "lamp" else "sign"
    return out


def _ground(vertices: F32, place: F64) -> float:
    """Height of the ground's vertex next to a place, on the plan."""
    return float(vertices[np.hypot(*(vertices[:, :2] - place[:2]).T).argmin(), 2]) if len(vertices) else float(place[2])


SIGNS = Step("signs", 4, signs, SignsParams, side_product=True)

"""Split: the cloud by class into terrain, building and vegetation (D3.2, section 4.2)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import numpy as np

from scan2sim.pipeline.core.classes import CODE, GROUPS, NOISE, UNKNOWN, group_of, known, name_of
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Bools, PointCloud

REST, FURNITURE, VEHICLE = -1, len(GROUPS) + 1, len(GROUPS) + 2
"""Of a point, beside the groups' numbers: it is of no surface, street furniture's, a parked vehicle's."""
NOTABLE = 0.01
"""Share of points without a class from which on a run warns."""
AROUND = 0.4
"""Metres around a vehicle's box within which points of the class are its own: mirrors, antennas."""


class SplitParams(Params):
    """How the split is made.

    Attributes:
        vegetation: "mesh" (as the mission does), "locations" (each plant's place instead of a
            mesh), or "both".
        vehicles: "remove", or "keep" what is parked as a surface of its own (of streets with a path); what moved goes.
    """

    vegetation: Literal["mesh", "locations", "both"] = "mesh"
    vehicles: Literal["remove", "keep"] = "remove"


def split(inputs: Inputs, params: SplitParams, out: Path, report: Report) -> Done:
    """Cut the classified `cloud` into `terrain`, `building`, `vegetation` and `rest`.

    Signs and poles go with buildings, but for the points that `taken` (optional, `index` and `own` of an .npz) says are
    street furniture's: they become `furniture`, and those of a neighbouring tile's `rest`. To keep vehicles, `things`
    lists their boxes: points of the class in those of parked ones become `vehicle`. Other vehicles, people, wires and
    what has no class are left out of the surface (`rest`), though they still hide what is behind; noise is dropped.

    Raises:
        DataError: no point belongs to any surface.
    """
    cloud = PointCloud.load(inputs["cloud"])
    assert cloud.classification is not None
    group = group_of()[cloud.classification]
    if "taken" in inputs:
        with np.load(inputs["taken"]) as taken:
            group[taken["index"]] = np.where(taken["own"], FURNITURE, REST)
    files, counts, warnings = {}, {}, []
    parts = [*GROUPS, "rest"] + (["furniture"] if "taken" in inputs else [])
    if params.vehicles == "keep" and "things" in inputs:
        group[parked(cloud, inputs["things"])] = VEHICLE
        parts.append("vehicle")
    elif params.vehicles == "keep":
        warnings.append("vehicles are kept only where a path tells which are parked (and things.find looks for them)")
    number: dict[str, int] = {name: i for i, name in enumerate(GROUPS)}
    number |= {"furniture": FURNITURE, "vehicle": VEHICLE}
    for i, name in enumerate(parts):
        report(i / len(parts), name)
        chosen = (group == REST) & ~np.isin(cloud.classification, NOISE) if name == "rest" else group == number[name]
        part = cloud.take(np.flatnonzero(chosen))
        part.save(out / f"{name}.npz")
        files[name] = out / f"{name}.npz"
        counts[name] = len(part)
        if name in GROUPS and len(part) == 0:
            warnings.append(f"no point is of class {name}: the world will have none")
    if sum(counts[name] for name in GROUPS) == 0:
        raise DataError(
            "classes",
            "no point belongs to terrain, building or vegetation",
            "Check the cloud's classes, or classify it anew with --set segment.overwrite=true",
        )
    codes, numbers = np.unique(cloud.classification, return_counts=True)
    classes = {name_of(int(c)): int(n) for c, n in zip(codes, numbers, strict=True)}
    vanished = {int(c): int(n) for c, n in zip(codes, numbers, strict=True) if not known()[c]}
    if sum(vanished.values()) > NOTABLE * len(cloud):
        which = ", ".join(f"{name_of(code)} {n / len(cloud):.1%}" for code, n in vanished.items())
        foreign = max((code for code in vanished if code not in UNKNOWN), key=vanished.__getitem__, default=None)
        mapping = f'Say what codes are by [classes] in tile.toml ({foreign} = "building"), or have'
        warnings.append(
            f"{sum(vanished.values()) / len(cloud):.1%} of the points have no class that says what they are ({which}): "
            f"the world has no surface there. {mapping if foreign else 'Have'} all classes told "
            "anew by --set segment.overwrite=true"
        )
    return Done(files, {"points_in": len(cloud), "points": counts, "classes": classes}, warnings)


def parked(cloud: PointCloud, things: Path) -> Bools:
    """(N,) which points of the class vehicle are in a box of `things` (GeoJSON of the step) that didn't move."""
    inside = np.zeros(len(cloud), bool)
    vehicle = np.flatnonzero(cloud.classification == CODE["vehicle"])
    for feature in json.loads(things.read_text(encoding="utf-8"))["features"]:
        properties = feature["properties"]
        if properties["moved"] or properties["kind"] == "person":
            continue
        ring = np.array(feature["geometry"]["coordinates"][0][:4])
        corners = cloud.frame.to_local(np.column_stack([ring, np.full(4, properties["ground_z"])]))
        away = cloud.xyz[vehicle] - corners.mean(axis=0)
        own = np.abs(away[:, 2] - properties["height_m"] / 2) < properties["height_m"] / 2 + AROUND
        for side in (corners[0] - corners[1], corners[1] - corners[2]):
            length = np.linalg.norm(side)
            own &= np.abs(away @ side) < length * (length / 2 + AROUND)
        inside[vehicle[own]] = True
    return inside


SPLIT = Step("split", 5, split, SplitParams)

"""Split: separates the cloud by class into terrain, building and vegetation (D3.2, section 4.2)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import numpy as np

from scan2sim.pipeline.core.classes import CODE, GROUPS, NOISE, UNKNOWN, classified_codes, group_of, name_of
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Bools, PointCloud

REST, FURNITURE, VEHICLE = -1, len(GROUPS) + 1, len(GROUPS) + 2
"""Numbers of further parts beside those of the groups: no surface, street furniture, parked vehicle."""
UNCLASSIFIED_FRACTION_WARNING = 0.01
"""Fraction of unclassified points above which the step warns."""
VEHICLE_BOX_MARGIN_M = 0.4
"""Margin around a vehicle's box for points of the class vehicle: mirrors, antennas."""


class SplitParams(Params):
    """What becomes of vegetation and vehicles.

    Attributes:
        vegetation: "mesh" (as in D3.2), "locations" (a list of plants with positions instead of a mesh), or "both".
        vehicles: "remove", or "keep" parked vehicles as a separate surface (requires a scanner's path); moving
            vehicles are always removed.
    """

    vegetation: Literal["mesh", "locations", "both"] = "mesh"
    vehicles: Literal["remove", "keep"] = "remove"


def split(inputs: Inputs, params: SplitParams, out: Path, report: Report) -> Done:
    """Split the classified `cloud` into `terrain`, `building`, `vegetation` and `rest`.

    Signs and poles belong to `building`, except for points of street furniture listed in `furniture_points` (optional
    .npz with `index` and `own`): they become `furniture`, or `rest` if the object belongs to a neighbouring tile. To
    keep vehicles, `instances` (GeoJSON) lists their boxes: points of class vehicle in boxes of parked ones become
    `vehicle`. Other vehicles, people, wires and unclassified points are not meshed (`rest`) but remain occluders;
    noise is removed.

    Raises:
        DataError: no point belongs to any surface.
    """
    cloud = PointCloud.load(inputs["cloud"])
    assert cloud.classification is not None
    group = group_of()[cloud.classification]
    if "furniture_points" in inputs:
        with np.load(inputs["furniture_points"]) as taken:
            group[taken["index"]] = np.where(taken["own"], FURNITURE, REST)
    files, counts, warnings = {}, {}, []
    parts = [*GROUPS, "rest"] + (["furniture"] if "furniture_points" in inputs else [])
    if params.vehicles == "keep" and "instances" in inputs:
        group[parked(cloud, inputs["instances"])] = VEHICLE
        parts.append("vehicle")
    elif params.vehicles == "keep":
        warnings.append("split.vehicles=keep has no effect: it needs instances.detect and a scanner's path")
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
            warnings.append(f"no point is of class {name}: the world will have no {name}")
    if sum(counts[name] for name in GROUPS) == 0:
        raise DataError(
            "classes",
            "no point belongs to terrain, building or vegetation",
            "Check the cloud's classes, or classify it again with --set segment.overwrite=true",
        )
    codes, numbers = np.unique(cloud.classification, return_counts=True)
    classes = {name_of(int(c)): int(n) for c, n in zip(codes, numbers, strict=True)}
    unmeshed = {int(c): int(n) for c, n in zip(codes, numbers, strict=True) if not classified_codes()[c]}
    if sum(unmeshed.values()) > UNCLASSIFIED_FRACTION_WARNING * len(cloud):
        which = ", ".join(f"{name_of(code)} {n / len(cloud):.1%}" for code, n in unmeshed.items())
        foreign = max((code for code in unmeshed if code not in UNKNOWN), key=unmeshed.__getitem__, default=None)
        mapping = f'Map the codes in [classes] of tile.toml ({foreign} = "building"), or classify'
        warnings.append(
            f"{sum(unmeshed.values()) / len(cloud):.1%} of the points have no known class ({which}): "
            f"the world has no surface there. {mapping if foreign else 'Classify'} the cloud "
            "again with --set segment.overwrite=true"
        )
    return Done(files, {"points_in": len(cloud), "points": counts, "classes": classes}, warnings)


def parked(cloud: PointCloud, instances: Path) -> Bools:
    """(N,) bool, True for points of class vehicle in the box of a parked vehicle in `instances` (GeoJSON)."""
    inside = np.zeros(len(cloud), bool)
    vehicle = np.flatnonzero(cloud.classification == CODE["vehicle"])
    for feature in json.loads(instances.read_text(encoding="utf-8"))["features"]:
        properties = feature["properties"]
        if properties["moved"] or properties["kind"] == "person":
            continue
        ring = np.array(feature["geometry"]["coordinates"][0][:4])
        corners = cloud.frame.to_local(np.column_stack([ring, np.full(4, properties["ground_z"])]))
        offset = cloud.xyz[vehicle] - corners.mean(axis=0)
        own = np.abs(offset[:, 2] - properties["height_m"] / 2) < properties["height_m"] / 2 + VEHICLE_BOX_MARGIN_M
        for side in (corners[0] - corners[1], corners[1] - corners[2]):
            length = np.linalg.norm(side)
            own &= np.abs(offset @ side) < length * (length / 2 + VEHICLE_BOX_MARGIN_M)
        inside[vehicle[own]] = True
    return inside


SPLIT = Step("split", 5, split, SplitParams)

"""Split: separates the cloud by class into terrain, building and vegetation (D3.2, section 4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scan2sim.pipeline.core.classes import (
    CODE,
    GROUPS,
    INDOOR_GROUPS,
    NOISE,
    UNKNOWN,
    classified_codes,
    group_of,
    name_of,
)
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Bools, PointCloud
from scan2sim.pipeline.dynamic_objects.instance_boxes import in_boxes

REST, FURNITURE, VEHICLE, CEILING = -1, len(GROUPS) + 1, len(GROUPS) + 2, len(GROUPS) + 3
"""Numbers of further parts beside those of the groups: no surface, furniture, parked vehicle, ceiling."""
UNCLASSIFIED_FRACTION_WARNING = 0.01
"""Fraction of unclassified points above which the step warns."""
LEFT_OUT_FRACTION_WARNING = 0.3
"""Fraction of points of other classes without a surface, such as vehicles, above which the step warns."""


class SplitContext(Context):
    """Whether the cloud is a robot's map of rooms: ceilings and furniture then have surfaces."""

    indoor: bool = False


class SplitParams(Params):
    """What becomes of vegetation and vehicles.

    Attributes:
        vegetation: "mesh" (as in D3.2), "locations" (a list of plants with positions instead of a mesh), or "both".
        vehicles: parked vehicles: "remove"; "keep" as a separate surface; or "assets", simple closed models of their
            size and colour in their place (step `vehicle_models`). The latter two require a scanner's path. Moving
            vehicles are always removed.
        context: whether the cloud shows rooms.
    """

    vegetation: Literal["mesh", "locations", "both"] = "mesh"
    vehicles: Literal["remove", "keep", "assets"] = "remove"
    context: SplitContext = SplitContext()


def split(inputs: Inputs, params: SplitParams, out: Path, report: Report) -> Done:
    """Split the classified `cloud` into `terrain`, `building`, `vegetation` and `rest`.

    Signs and poles belong to `building`, except for points of street furniture listed in `furniture_points` (optional
    .npz with `index` and `own`): they become `furniture`, or `rest` if the object belongs to a neighbouring tile. To
    keep vehicles, `instances` (GeoJSON) lists their boxes: points of class vehicle in boxes of parked ones become
    `vehicle`. Of a map of rooms, `ceiling` and `furniture` are parts of their own. Other vehicles, people, wires and
    unclassified points are not meshed (`rest`) but remain occluders; noise is removed. Points that photos don't cover
    (`uncovered`, optional) become `uncovered_terrain`, `uncovered_building` and `uncovered_vegetation`.

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
    number |= {"furniture": FURNITURE, "vehicle": VEHICLE, "ceiling": CEILING}
    for indoor_group in INDOOR_GROUPS if params.context.indoor else ():
        group[cloud.classification == CODE[indoor_group]] = number[indoor_group]
        parts.append(indoor_group)
    for i, name in enumerate(parts):
        report(i / len(parts), name)
        chosen = (group == REST) & ~np.isin(cloud.classification, NOISE) if name == "rest" else group == number[name]
        part = cloud.take(np.flatnonzero(chosen))
        part.save(out / f"{name}.npz")
        files[name] = out / f"{name}.npz"
        counts[name] = len(part)
        if name in (GROUPS[:2] if params.context.indoor else GROUPS) and len(part) == 0:
            warnings.append(f"no point is of class {name}: the world will have no {name}")
    if sum(counts[name] for name in counts if name != "rest") == 0:
        raise DataError(
            "classes",
            "no point belongs to terrain, building or vegetation",
            "Check the cloud's classes, or classify it again with --set segment.overwrite=true",
        )
    if "uncovered" in inputs:
        coarse = PointCloud.load(inputs["uncovered"])
        assert coarse.classification is not None
        for i, name in enumerate(GROUPS):
            files[f"uncovered_{name}"] = out / f"uncovered_{name}.npz"
            coarse.take(group_of()[coarse.classification] == i).save(files[f"uncovered_{name}"])
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
    left_out = (group == REST) & classified_codes()[cloud.classification] & ~np.isin(cloud.classification, NOISE)
    if left_out.mean() > LEFT_OUT_FRACTION_WARNING:
        names = sorted({name_of(int(code)) for code in np.unique(cloud.classification[left_out])})
        warnings.append(
            f"{left_out.mean():.0%} of the points are of classes that get no surface ({', '.join(names)}): check the "
            "classes, and of a robot's map --scene and --units"
        )
    return Done(files, {"points_in": len(cloud), "points": counts, "classes": classes}, warnings)


def parked(cloud: PointCloud, instances: Path) -> Bools:
    """(N,) bool, True for points of class vehicle in the box of a parked vehicle in `instances` (GeoJSON)."""

    def still(instance: Mapping[str, Any]) -> bool:
        return not instance["moved"] and instance["kind"] != "person"

    inside = np.asarray(cloud.classification == CODE["vehicle"])
    inside[inside] = in_boxes(cloud.xyz[inside], cloud.frame, instances, still)
    return inside


SPLIT = Step("split", 6, split, SplitParams)

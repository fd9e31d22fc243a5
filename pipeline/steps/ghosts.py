"""Ghosts: proposes trails of moving people and vehicles in a robot's map, and removes those that the user chooses."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from scan2sim.pipeline.core.classes import CODE, GROUPS, group_of
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import PointCloud
from scan2sim.pipeline.io.file_checks import link_or_copy
from scan2sim.pipeline.io.geodata import geojson
from scan2sim.pipeline.robot_maps.ghosts import Ghost, find_ghosts

WITHOUT_SURFACE_SHARE = 0.7
"""Share of a ghost's points that are people's from which nothing is left to remove."""
Selection = Annotated[
    str,
    BeforeValidator(lambda value: str(value) if isinstance(value, int) else value),  # `remove=1`
    Field(
        pattern=r"^(none|all|[0-9]{1,6}(,[0-9]{1,6})*)$",
        json_schema_extra={"range": "none, all, or numbers from ghosts.geojson: 1,3"},
    ),
]


class GhostsContext(Context):
    """The map's point spacing in metres."""

    spacing: float = 0.05


class GhostsParams(Params):
    """Ghosts: trails of people and vehicles that moved while a robot's map was recorded.

    Attributes:
        remove: which of the proposed ghosts to remove.
        context: the map.
    """

    remove: Selection = "none"
    context: GhostsContext = GhostsContext()

    def is_removed(self, number: int) -> bool:
        """Whether to remove the ghost of a number, counted from 1."""
        return self.remove == "all" or (self.remove != "none" and number in map(int, self.remove.split(",")))


def ghosts(inputs: Inputs, params: GhostsParams, out: Path, report: Report) -> Done:
    """Find ghosts among the classified points of `cloud`.

    Files: `cloud`, without the removed ghosts; `geojson`, the middle line of each ghost, with its number and size.
    """
    cloud = PointCloud.load(inputs["cloud"])
    found = ghosts_in(cloud, params.context.spacing)
    files = {"cloud": out / "cloud.npz", "geojson": out / "ghosts.geojson"}
    lines: list[tuple[list[list[float]], dict[str, Any]]] = []
    removed = np.zeros(len(cloud), bool)
    for number, ghost in enumerate(found, 1):
        chosen = params.is_removed(number)
        removed[ghost.points] |= chosen
        properties = {
            "id": number, "kind": ghost.kind, "length_m": round(ghost.length, 1), "width_m": round(ghost.width, 2),
            "height_m": round(ghost.height, 2), "points": len(ghost.points), "removed": chosen,
        }  # fmt: skip
        lines.append((cloud.frame.to_crs(ghost.path).round(2).tolist(), properties))
    geojson.write_lines(files["geojson"], cloud.frame.crs, lines)
    if removed.any():
        cloud.take(~removed).save(files["cloud"])
    else:
        link_or_copy(inputs["cloud"], files["cloud"])
    choices = {number: params.is_removed(number) for number in range(1, len(found) + 1)}
    warnings = [] if all(choices.values()) else [_proposal(choices)]
    return Done(files, {"ghosts": len(found), "removed_points": int(removed.sum())}, warnings)


def ghosts_in(cloud: PointCloud, spacing: float) -> list[Ghost]:
    """Ghosts in a classified cloud whose points are `spacing` metres apart; not those that have no surface anyway.

    In rooms, `segment` gives trails over seen floor the class `person`, which gets no surface.
    """
    assert cloud.classification is not None
    is_floor = group_of()[cloud.classification] == GROUPS.index("terrain")
    is_wall, is_ceiling = (cloud.classification == CODE[name] for name in ("wall", "ceiling"))
    found = find_ghosts(cloud.xyz, is_floor, is_wall, is_ceiling, spacing)
    is_person = cloud.classification == CODE["person"]
    return [ghost for ghost in found if is_person[ghost.points].mean() < WITHOUT_SURFACE_SHARE]


def _proposal(chosen: dict[int, bool]) -> str:
    """Warning about the ghosts, by number, that are not removed."""
    count = len(chosen) - sum(chosen.values())
    what = "cluster may be the trail of a moving person or vehicle" if count == 1 else (
        "clusters may be trails of moving people or vehicles")  # fmt: skip
    return f"{count} long {what} (ghosts.geojson): remove with --set ghosts.remove=all or {','.join(map(str, chosen))}"


GHOSTS = Step("ghosts", 1, ghosts, GhostsParams)

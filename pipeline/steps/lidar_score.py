"""Lidar score: what a lidar measures in the world along the rays of recorded sweeps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.classes import CODE, SURFACES, surface_of
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import F32, U8, Bools, Mesh, PointCloud
from scan2sim.pipeline.dynamic_objects.instance_boxes import in_boxes
from scan2sim.pipeline.io.images.album import Album
from scan2sim.pipeline.lidar.sweeps import Sweeps, moving_returns, near_moving
from scan2sim.pipeline.lidar.unreturned import near_excluded, unreturned_rays

MAX_CLASS_DISTANCE_M = 0.5
"""Distance to a classified point within which a return is of its class."""
MAX_CLASSIFIED_POINTS = 2_000_000
"""Classified points among which the nearest one is searched."""


class LidarScoreContext(Context):
    """What the world contains.

    Attributes:
        vehicles: whether parked vehicles have a surface; their returns then count.
        cell: the tile's cell, if it has neighbours; only rays inside it, where the world ends, count.
    """

    vehicles: bool = False
    cell: TileCell | None = None


class LidarScoreParams(Params):
    """No settings."""

    context: LidarScoreContext = LidarScoreContext()


def lidar_score(inputs: Inputs, params: LidarScoreParams, out: Path, report: Report) -> Done:
    """Cast the rays of `sweeps` through `mesh.*`, and compare with their returns.

    Inputs: `sweeps` (of the step `sweeps`); `mesh.<surface>`; the classified `cloud`; `moving`, points of moving
    objects, which are not in the sweeps; `instances` (optional). Returns of moving objects, people and removed vehicles
    don't count: those next to a moving point of their sweep, and those in the box of an instance. Without `instances`,
    they are those next to a point of the class.

    File: `images`, a folder with a picture of each sweep's range images (`range_image.RangeImage.picture`), and an
    `index.json`. Metrics: `rays`, of returns that count; `excluded`, share of the others; `all`, `by_surface`,
    `by_distance` (`range_errors`); `phantoms` (`phantoms.row`); `range_image`, means of the sweeps' measures
    (`range_image`); `sweeps`, these of each sweep by the title of its picture.
    """
    from scan2sim.pipeline.lidar.casting import Scanner
    from scan2sim.pipeline.lidar.score import score

    report(0.0, "reading")
    sweeps = Sweeps.load(inputs["sweeps"])
    unreturned, unknown = unreturned_rays(sweeps)
    names = [name for name in SURFACES if f"mesh.{name}" in inputs]
    meshes = [Mesh.load(inputs[f"mesh.{name}"]) for name in names]
    frame = meshes[0].frame
    if params.context.cell is not None:
        cell, shift = params.context.cell.cell, np.asarray(frame.origin[:2])
        own = (cell.outside(sweeps.xyz[:, :2] + shift) <= 0) & (cell.outside(sweeps.origins[:, :2] + shift) <= 0)
        sweeps = sweeps.take(own)
        unreturned = unreturned.take(cell.outside(unreturned.origins[:, :2] + shift) <= 0)
    report(0.1, "classes of the returns")
    code = nearest_class(sweeps.xyz, PointCloud.load(inputs["cloud"]))
    moving = moving_returns(sweeps, PointCloud.load(inputs["moving"]))
    left_out = near_moving(sweeps, moving)

    def inside(xyz: F32) -> Bools:
        if "instances" not in inputs:
            return np.zeros(len(xyz), bool)
        return in_boxes(xyz, frame, inputs["instances"], _removed(params.context.vehicles))

    left_out |= inside(sweeps.xyz)
    if "instances" not in inputs:
        left_out |= np.isin(code, (CODE["person"], CODE["vehicle"]))
    unreturned = unreturned.take(~near_excluded(unreturned, Sweeps.join([moving, sweeps.take(left_out)])))
    excluded, sweeps, code = float(left_out.mean()) if len(left_out) else 0.0, sweeps.take(~left_out), code[~left_out]
    scored = score(
        Scanner.of(meshes),
        sweeps,
        names,
        surface_of(names)[code],
        unreturned,
        unknown,
        inside,
        lambda done: report(0.3 + 0.6 * done, "casting"),
    )
    album = Album(out / "images")
    album.folder.mkdir()
    by_sweep: dict[str, Any] = {}
    for number, image in scored.images.items():
        title, measures = f"Sweep {number}.", scored.sweeps[number]
        by_sweep[title] = {name: None if value is None else round(value, 4) for name, value in measures.items()}
        album.add(f"sweep_{number:04d}", image.picture(), "lidar", title, _caption(measures))
    album.save()
    metrics = {
        "rays": scored.all["rays"],
        "excluded": round(excluded, 4),
        "all": scored.all,
        "by_surface": scored.by_surface,
        "by_distance": scored.by_distance,
        "phantoms": scored.phantoms,
        "range_image": scored.range_image(),
        "sweeps": by_sweep,
    }
    return Done({"images": album.folder}, metrics)


def nearest_class(xyz: F32, cloud: PointCloud) -> U8:
    """Class (N,) of the nearest classified point of `cloud`, 0 (never classified) farther than 0.5 m from any."""
    from scipy.spatial import cKDTree

    assert cloud.classification is not None
    every = slice(None, None, max(1, len(cloud) // MAX_CLASSIFIED_POINTS))
    tree = cKDTree(cloud.xyz[every])
    _, nearest = tree.query(xyz, distance_upper_bound=MAX_CLASS_DISTANCE_M, workers=-1)
    return np.append(cloud.classification[every], np.uint8(0))[nearest]


def _removed(vehicles: bool) -> Callable[[Mapping[str, Any]], bool]:
    """Function of an instance's properties: whether the world leaves it out; `vehicles`: parked ones are kept."""

    def removed(instance: Mapping[str, Any]) -> bool:
        return not vehicles or bool(instance["moved"]) or instance["kind"] == "person"

    return removed


def _caption(measures: Mapping[str, float | None]) -> str:
    f_score, median = measures["f_score"], measures["depth_median_m"]
    if f_score is None or median is None:
        return "No return of it counts."
    return f"F-score {f_score:.2f}, median depth error {100 * median:.0f} cm."


LIDAR_SCORE = Step("lidar_score", 2, lidar_score, LidarScoreParams, memory=(1.0, 4))

"""Score of a world by recorded sweeps: range errors of all returns, and the literature's measures of each sweep."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, Bools
from scan2sim.pipeline.lidar import phantoms, range_errors
from scan2sim.pipeline.lidar.casting import Scanner, Simulated
from scan2sim.pipeline.lidar.range_image import RangeImage, range_image
from scan2sim.pipeline.lidar.sweeps import Sweeps
from scan2sim.pipeline.lidar.unreturned import UnreturnedRays, pass_through


@dataclass(frozen=True)
class SweepScore:
    """Score of a world by sweeps.

    Attributes:
        all: `range_errors.row` of all returns up to `range_errors.MAX_RANGE_M`.
        by_surface, by_distance: the same by surface and by recorded distance.
        phantoms: `phantoms.row` of all rays, with those that had no return.
        sweeps: `RangeImage.measures` of each sweep, by its number.
        images: range image of each sweep, by its number.
    """

    all: dict[str, Any]
    by_surface: dict[str, dict[str, Any]]
    by_distance: dict[str, dict[str, Any]]
    phantoms: dict[str, Any]
    sweeps: dict[int, dict[str, float | None]]
    images: dict[int, RangeImage]

    def range_image(self) -> dict[str, float | None]:
        """Means of the measures over the sweeps that have them."""
        found: dict[str, float | None] = {}
        for key in ("depth_rmse_m", "depth_median_m", "chamfer_m2", "f_score"):
            known = [value for one in self.sweeps.values() if (value := one[key]) is not None]
            found[key] = round(float(np.mean(known)), 4) if known else None
        return found


def score(
    scanner: Scanner,
    sweeps: Sweeps,
    names: Sequence[str],
    recorded_on: npt.NDArray[np.integer],
    unreturned: UnreturnedRays | None = None,
    unknown: str = "",
    inside: Callable[[F32], Bools] = lambda xyz: np.zeros(len(xyz), bool),
    progress: Callable[[float], None] = lambda _: None,
) -> SweepScore:
    """Cast the rays of the sweeps through the world, and compare ranges and points.

    Args:
        scanner: the scanner in the world.
        sweeps: returns that count: without those of moving objects, and of others that the world leaves out.
        names: of the world's surfaces.
        recorded_on: (N,) index of the surface that each return was recorded on, -1 if unknown.
        unreturned: rays of the sweeps without a return, likewise without those towards such objects;
            None: unknown.
        unknown: the reason if rays without a return are unknown.
        inside: whether points (N, 3) are in objects that the world leaves out.
        progress: receives the share of the sweeps that are done.
    """
    recorded = np.linalg.norm(sweeps.xyz - sweeps.origins, axis=1)
    max_range = min(float(recorded.max(initial=0)), range_errors.MAX_RANGE_M)
    near = recorded < range_errors.MAX_RANGE_M
    sweeps, recorded_on = sweeps.take(near), recorded_on[near]
    numbers = np.unique(sweeps.number).tolist()
    parts: list[Simulated] = []
    index = [np.flatnonzero(sweeps.number == number) for number in numbers]
    images: dict[int, RangeImage] = {}
    for done, (number, own) in enumerate(zip(numbers, index, strict=True)):
        progress(done / len(numbers))
        one = sweeps.take(own)
        rays = scanner.scan(one.origins, one.xyz)
        images[number] = range_image(one.scanned, rays.recorded, rays.range, one.origins, rays.directions)
        parts.append(rays)
    rays = Simulated.join(parts) if parts else scanner.scan(sweeps.origins, sweeps.xyz)
    unreturned = UnreturnedRays.join([]) if unreturned is None else unreturned
    distance, surface = scanner.cast(unreturned.origins, unreturned.directions)
    clear = ~pass_through(unreturned, np.where(surface >= 0, distance, 0), inside)
    order = np.concatenate(index) if index else np.zeros(0, np.int64)
    return SweepScore(
        range_errors.row(rays),
        range_errors.by_surface(rays, names, recorded_on[order]),
        range_errors.by_distance(rays),
        phantoms.row(
            rays,
            unreturned.take(clear),
            distance[clear],
            surface[clear],
            names,
            max_range,
            unknown,
        ),
        {number: image.measures() for number, image in images.items()},
        images,
    )

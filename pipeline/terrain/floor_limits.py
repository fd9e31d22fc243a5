"""Limits of the floor map, and the floor of one storey."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F64, Bools


@dataclass(frozen=True)
class FloorLimits:
    """Lengths in metres, areas in square metres."""

    cell_spacings: float = 1.2  # cell size in point spacings
    max_cells: int = 4_000_000  # cells become larger beyond that
    cluster_gap: float = 0.3  # heights of a column that are further apart are different surfaces
    wall_extent: float = 0.35  # higher clusters of a column contain the foot of a wall
    outside_open_share: float = 0.25  # share of a part's edge that is no wall, from which it is behind the walls
    step: float = 0.3  # height difference up to which neighbouring heights are one surface: stairs, kerbs
    neighbour_radius: float = 0.5  # horizontal distance up to which heights are neighbours
    slope: float = 0.3  # of ground between separate parts
    max_furniture: float = 4.0  # area of a surface over the floor up to which it is furniture
    headroom: float = 1.8  # least distance of two storeys
    min_storey: float = 3.0  # least area of a floor over another
    min_storey_share: float = 0.02
    seam: float = 0.3  # heights at which the stairs belong to both storeys
    support: float = 0.06  # height difference of neighbours that support a height
    isolated_share: float = 0.2  # share of the typical number of neighbours below which a height is isolated
    smoothing: float = 0.4  # radius of neighbours that a height is averaged over
    plane_tolerance: tuple[float, float] = (0.03, 0.1)  # range of distances up to which a height is on a plane
    min_support: float = 0.2  # share of neighbours at the same height; fewer are a spike or a pit
    min_plane: float = 2.0  # least area of a plane that heights are snapped to
    fine_noise: float = 0.02  # noise from which heights are averaged over steps, too: noise hides them
    noise_smoothing: float = 60.0  # standard deviation of that average per noise above `fine_noise`
    max_noise: float = 0.1  # distance from a plane beside it up to which a small area is noise ...
    max_noise_area: float = 0.5
    obstacle: float = 1.0  # height over the floor up to which points stand on it
    scanned_radius: float = 0.25  # distance to a scanned height within which the floor is scanned
    filtered_share: float = 0.15  # share of scanned cells below which the ground was removed by a filter
    filtered_gap: float = 10.0  # half the width of roads between walls, whose ground was removed outdoors
    wall_height: float = 0.4  # extent of a column that is a wall, for its foot
    foot_block: float = 1.0  # cells in which the lowest feet of walls are sought
    foot_percentile: float = 20.0  # of the feet in a block
    foot_smoothing: float = 3.0  # standard deviation of the average over feet
    foot_radius: float = 3.0  # distance of feet that determine the sensor's height
    foot_clearance: float = 0.6  # feet and path don't count so near to scanned ground
    path_radius: float = 0.4  # free around the sensor's path
    sensor_height: tuple[float, float] = (0.05, 3.0)
    well_gap: float = 0.3  # half the width up to which a gap between floor and stairs is closed
    slab: float = 0.6  # thickness of a ceiling with the floor above it
    membrane_cells: int = 150_000  # a membrane over more cells is computed on larger ones


LIMITS = FloorLimits()


@dataclass(frozen=True)
class Storey:
    """Floor of a storey on the cells of a raster.

    Attributes:
        height: (rows, columns) metres; NaN where there is no floor.
        scanned: (rows, columns) whether the height is measured; the other heights are assumed.
    """

    height: F64
    scanned: Bools

    @property
    def there(self) -> Bools:
        """(rows, columns) cells with floor."""
        return np.isfinite(self.height)

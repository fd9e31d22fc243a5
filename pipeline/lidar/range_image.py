"""Range images of sweeps, and the measures of the literature on simulated sweeps over them.

The conventions are LiDAR4D's (Zheng et al., "LiDAR4D: Dynamic Neural Fields for Novel Space-time View LiDAR
Synthesis", CVPR 2024; `utils/metrics.py` and `utils/convert.py` of its repository): 66 x 1030 pixels, elevations from
+2.0 degrees down to -24.9 (a field of 26.9 degrees), the nearest return of each pixel, ranges up to 80 m, missing
returns as 0; Chamfer distance as the sum of both means of squared distances; F-score at a squared distance of .05 m2.

Two things differ. Each pixel's ray is that of its nearest return, not that through its centre: at grazing incidence
half a pixel is 40 cm of range on a road 20 m away. And pixels without a return don't count: whether their rays passed
on or met glass isn't recorded, while the literature counts them as equal where they are predicted empty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, F64, I64, U8

ROWS, COLUMNS = 66, 1030
TOP_DEG, FIELD_DEG = 2.0, 26.9
"""Elevation of the top of a range image, and the angle between its top and its bottom."""
MAX_RANGE_M = 80.0
F_SCORE_THRESHOLD_M2 = 0.05
SHOWN_ERROR_M = 1.0
"""Error that a picture shows at full colour."""
ENLARGED = 3
"""Height of a row in a picture, pixels."""
EMPTY_RGB, MISSING_RGB = (24, 28, 34), (255, 0, 255)
"""Colours of pixels without a recorded return, and of those without a simulated one."""


@dataclass(frozen=True)
class RangeImage:
    """Recorded and simulated ranges of the same rays.

    Attributes:
        row, column: (N,) pixels.
        recorded, simulated: (N,) metres; simulated is 0 where nothing is hit within `MAX_RANGE_M`.
        origins, directions: (N, 3) rays, local axes.
    """

    row: I64
    column: I64
    recorded: F64
    simulated: F64
    origins: F64
    directions: F64

    def measures(self) -> dict[str, float | None]:
        """`depth_rmse_m`, `depth_median_m` (median absolute error), `chamfer_m2`, `f_score`; None without rays."""
        if not len(self.row):
            return dict.fromkeys(("depth_rmse_m", "depth_median_m", "chamfer_m2", "f_score"))
        error = self.simulated - self.recorded
        hit = self.simulated > 0
        recorded = self.origins + self.recorded[:, None] * self.directions
        simulated = self.origins[hit] + self.simulated[hit, None] * self.directions[hit]
        chamfer, f_score = compare_points(recorded, simulated)
        return {
            "depth_rmse_m": float(np.sqrt((error**2).mean())),
            "depth_median_m": float(np.median(np.abs(error))),
            "chamfer_m2": chamfer,
            "f_score": f_score,
        }

    def picture(self) -> U8:
        """The recorded image, the simulated one, and their difference below each other, (H, W, 3).

        Difference: grey is equal, red too early, blue too late, up to `SHOWN_ERROR_M`; missing returns are magenta.
        Empty pixels next to others have their colour.
        """
        error = (self.simulated - self.recorded) / SHOWN_ERROR_M
        strength = np.clip(np.abs(error), 0, 1)[:, None]
        full = np.where(error[:, None] < 0, (230, 60, 40), (50, 110, 240))
        difference = (170 * (1 - strength) + full * strength).astype(np.uint8)
        missing = self.simulated <= 0
        parts = [_colours(self.recorded), _colours(self.simulated), difference]
        for part in parts[1:]:
            part[missing] = MISSING_RGB
        gap = np.full((ENLARGED, COLUMNS, 3), 255, np.uint8)
        images = [np.repeat(self._image(part), ENLARGED, axis=0) for part in parts]
        return np.vstack([images[0], gap, images[1], gap, images[2]])

    def _image(self, colours: U8) -> U8:
        image = np.full((ROWS, COLUMNS, 3), EMPTY_RGB, np.uint8)
        for down, across in ((0, 1), (0, -1), (1, 0), (-1, 0), (0, 0)):  # scan lines have gaps of a pixel
            image[np.clip(self.row + down, 0, ROWS - 1), np.clip(self.column + across, 0, COLUMNS - 1)] = colours
        return image


def range_image(
    points: npt.NDArray[np.floating], recorded: F32, simulated: F32, origins: F64, directions: F64
) -> RangeImage:
    """Range image of the nearest recorded return of each pixel.

    Args:
        points: (N, 3) directions to the returns (of any length) in the scanner's axes: x forward, z up.
        recorded, simulated: (N,) ranges, metres; simulated is inf without a hit.
        origins, directions: (N, 3) rays, local axes.
    """
    row, column = pixels(points)
    inside = (row >= 0) & (row < ROWS) & (column >= 0) & (column < COLUMNS) & (recorded < MAX_RANGE_M)
    index = np.flatnonzero(inside)
    order = index[np.argsort(recorded[index], kind="stable")]
    _, first = np.unique(row[order] * COLUMNS + column[order], return_index=True)
    chosen = order[first]
    found = np.where(simulated[chosen] <= MAX_RANGE_M, simulated[chosen], 0.0).astype(np.float64)
    return RangeImage(
        row[chosen], column[chosen], recorded[chosen].astype(np.float64), found, origins[chosen], directions[chosen]
    )


def pixels(points: npt.NDArray[np.floating]) -> tuple[I64, I64]:
    """Row and column (N,) of directions (N, 3) in the scanner's axes; outside the image they are out of its range."""
    x, y, z = np.asarray(points, np.float64).T
    column = np.round((np.pi - np.arctan2(y, x)) / (2 * np.pi / COLUMNS))
    above_bottom = np.degrees(np.arctan2(z, np.hypot(x, y))) + FIELD_DEG - TOP_DEG
    row = np.round(ROWS - above_bottom / (FIELD_DEG / ROWS))
    return row.astype(np.int64), column.astype(np.int64)


def compare_points(recorded: F64, simulated: F64) -> tuple[float | None, float]:
    """Chamfer distance in m2 (sum of both means of squared distances; None without points) and F-score.

    Args:
        recorded, simulated: (N, 3) and (M, 3) points, metres.
    """
    from scipy.spatial import cKDTree

    if not len(recorded) or not len(simulated):
        return None, 0.0
    there = cKDTree(recorded).query(simulated, workers=-1)[0] ** 2
    back = cKDTree(simulated).query(recorded, workers=-1)[0] ** 2
    precision, recall = (float((squared < F_SCORE_THRESHOLD_M2).mean()) for squared in (there, back))
    f_score = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    return float(there.mean() + back.mean()), f_score


def _colours(ranges: F64) -> U8:
    """Colours (N, 3) of ranges (N,): near is bright, on a square root scale up to `MAX_RANGE_M`."""
    import cv2

    level = np.round(255 * (1 - np.sqrt(np.clip(ranges / MAX_RANGE_M, 0, 1)))).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(level[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1], np.uint8)

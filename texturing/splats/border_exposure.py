"""Exposure of splats at the borders of tiles: that of the photos taken there, on which both tiles are trained.

The colours of a tile's world have the mean exposure of its photos, which differs from the neighbour's. Both tiles know
how the photos near their border show their colours, so each takes the mean exposure of these photos there, without a
word of the other. Further inside it fades into the tile's own.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.splats import GAIN, MAX_COLOUR, MIN_COLOUR, OFFSET, POSITION, RGB, Splats
from scan2sim.pipeline.core.types import F32, F64
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.texturing.splats.exposure import CURVE_OFFSET

NEAR_M = 10.0
"""Distance from the border, and from the cell, up to which photos count for its exposure, near ones more."""
FADE_M = 20.0
"""Distance from the border over which it fades."""
MIN_DISTANCE_M = 0.01


def with_border_exposure(splats: Splats, photos: F32, cell: Cell, origin: npt.ArrayLike) -> tuple[Splats, F32]:
    """Splats of a tile in the exposure of the photos at its borders, and how the photos show these colours.

    Args:
        splats: those within the cell.
        photos: (P, 15) photos of the layer (`SplatLayer.photos`).
        cell: the tile's cell.
        origin: (2,) or (3,) origin of local coordinates, world metres.
    """
    gain, offset = _changes(splats.xyz, photos, cell, np.asarray(origin, np.float64)[:2])
    parameters = splats.parameters.copy()
    parameters[:, RGB] = np.clip(gain * parameters[:, RGB] + offset, MIN_COLOUR, MAX_COLOUR)
    gain, offset = _changes(photos[:, POSITION], photos, cell, np.asarray(origin, np.float64)[:2])
    changed = photos.copy()
    changed[:, GAIN] = photos[:, GAIN] / gain
    changed[:, OFFSET] = photos[:, OFFSET] - changed[:, GAIN] * offset
    return Splats(parameters), changed


def _changes(xyz: F32, photos: F32, cell: Cell, origin: F64) -> tuple[F32, F32]:
    """Gain and offset (N, 3) of the colours at local positions (N, 3)."""
    at, taken = xyz[:, :2] + origin, photos[:, POSITION][:, :2] + origin
    near_cell = cell.outside(taken) < NEAR_M
    nearest = np.full(len(xyz), np.inf)
    total, gain, offset = np.zeros((len(xyz), 1)), np.zeros((len(xyz), 3)), np.zeros((len(xyz), 3))
    for neighbour in sorted(cell.neighbours):
        near = near_cell * np.maximum(0, 1 - np.abs(cell.beyond(neighbour, taken)) / NEAR_M)
        if near.any():
            distance = np.maximum(np.abs(cell.beyond(neighbour, at)), MIN_DISTANCE_M)
            nearest = np.minimum(nearest, distance)
            weight = 1 / distance[:, None]
            total += weight
            gain += weight * np.average(photos[:, GAIN], axis=0, weights=near)
            offset += weight * (np.average(photos[:, OFFSET], axis=0, weights=near) - CURVE_OFFSET)
    share = np.maximum(0, 1 - nearest / FADE_M)[:, None]
    total = np.maximum(total, 1e-9)
    return (1 - share + share * gain / total).astype(np.float32), (share * offset / total).astype(np.float32)

"""Plants: list of plants with positions and sizes, instead of a vegetation mesh (alternative of D3.2, section 4.2)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import F32, F64, U8, PointCloud

CANOPY_CELL_M = 0.25
MIN_HEIGHT_M = 0.4
"""Minimum height of a plant above the ground."""
MIN_TOP_DISTANCE_M = 1.5
"""Minimum distance between the tops of two plants."""


class PlantsParams(Params):
    """Detection of plants.

    Attributes:
        models: whether the world shows low-poly trees and bushes if vegetation is only listed (`split.vegetation` is
            "locations").
        context: the tile's cell, if it has neighbours; plants outside it belong to them.
    """

    models: bool = True
    context: TileCell | None = None


def plants(inputs: Inputs, params: PlantsParams, out: Path, report: Report) -> Done:
    """Detect the tops of plants in the canopy of `vegetation` above `terrain`; write GeoJSON and CSV.

    Position and base height are in the tile's CRS; height and crown radius (of the circle with the area of the crown)
    in metres; red, green and blue (0 to 255) are the mean of the crown's points, or a default green if they have no
    colour. Crowns are grown from the tops by watershed (Vincent and Soille 1991). With `models`, a textured mesh of
    low-poly plants is written too (`mesh`, and its folder `textured`).
    """
    from scan2sim.pipeline.io.geodata import geojson
    from scan2sim.pipeline.terrain import low_poly_plants

    cloud, ground = PointCloud.load(inputs["vegetation"]), PointCloud.load(inputs["terrain"])
    found, crown = crowns(cloud.xyz, ground.xyz) if len(cloud) else (np.empty((0, 5)), np.empty(0, int))
    colour = _colours(cloud, crown, len(found))
    if params.context:
        cell = params.context.cell
        own = cell.outside(found[:, :2] + np.asarray(cloud.frame.origin[:2])) <= 0
        found, colour = found[own], colour[own]
    places = cloud.frame.to_crs(found[:, :3])
    names = ("x", "y", "z", "height_m", "crown_radius_m", "red", "green", "blue")
    digits = (3, 3, 3, 2, 2)
    sizes = np.column_stack([places, found[:, 3:]]).tolist()
    rows = [
        dict(zip(names, [*map(round, size, digits), *rgb], strict=True))
        for size, rgb in zip(sizes, colour.tolist(), strict=True)
    ]
    text = "\n".join([",".join(names), *(",".join(str(value) for value in row.values()) for row in rows)])
    (out / "plants.csv").write_text(text + "\n", encoding="utf-8")
    features = [((row["x"], row["y"], row["z"]), {name: row[name] for name in names[3:]}) for row in rows]
    geojson.write_points(out / "plants.geojson", cloud.frame.crs, features)
    files = {"geojson": out / "plants.geojson", "csv": out / "plants.csv"}
    if params.models:
        models = out / "models"
        models.mkdir()
        low_poly_plants.plant(found[:, :3], found[:, 3], found[:, 4], colour, cloud.frame, models)
        files |= {"textured": models, "mesh": models / "mesh.npz"}
    return Done(files, {"points": len(cloud), "plants": len(rows)})


def _colours(cloud: PointCloud, crown: npt.NDArray[np.int_], count: int) -> U8:
    """Mean colours (P, 3) of the points of each crown; a default green if they have none."""
    from scan2sim.pipeline.terrain.low_poly_plants import DEFAULT_LEAF_RGB

    use = cloud.coloured & (crown >= 0)
    each = np.bincount(crown[use], minlength=count)
    colour = np.tile(np.array(DEFAULT_LEAF_RGB, float), (count, 1))
    if cloud.rgb is not None:
        for k in range(3):
            total = np.bincount(crown[use], cloud.rgb[use, k], count)
            colour[each > 0, k] = total[each > 0] / each[each > 0]
    return np.rint(colour).astype(np.uint8)


def crowns(xyz: F32, ground: F32) -> tuple[F64, npt.NDArray[np.int_]]:
    """Plants (P, 5): x, y, z of the base, height, crown radius, local metres; and (N,) plant of each point, or -1."""
    from scipy import ndimage
    from scipy.spatial import cKDTree

    low = (
        np.floor(xyz[:, :2].min(axis=0) / CANOPY_CELL_M) * CANOPY_CELL_M
    )  # origin at whole cells: neighbouring tiles get the same tops
    cell = ((xyz[:, :2] - low) / CANOPY_CELL_M).astype(int)
    canopy = np.full(cell.max(axis=0) + 1, -np.inf)
    np.maximum.at(canopy, (cell[:, 0], cell[:, 1]), xyz[:, 2])
    filled = np.isfinite(canopy)
    centres = (np.argwhere(filled) + 0.5) * CANOPY_CELL_M + low
    base = np.zeros_like(canopy)
    if len(ground):
        _, nearest = cKDTree(ground[:, :2]).query(centres, workers=-1)
        base[filled] = ground[nearest, 2]
    else:
        base[filled] = xyz[:, 2].min()
    height = np.where(filled, canopy - base, 0.0)
    smooth = ndimage.gaussian_filter(height, MIN_TOP_DISTANCE_M / CANOPY_CELL_M / 4)
    size = max(3, round(MIN_TOP_DISTANCE_M / CANOPY_CELL_M) | 1)
    top = (smooth == ndimage.maximum_filter(smooth, size)) & (height > MIN_HEIGHT_M)
    markers, count = ndimage.label(top)
    levels = np.clip((smooth.max() - smooth) / max(smooth.max(), 1e-6) * 65535, 0, 65535).astype(np.uint16)
    background = ~filled
    markers[background] = -1
    grown = ndimage.watershed_ift(levels, markers.astype(np.int32)) if count else markers
    if not count:
        return np.empty((0, 5)), np.full(len(xyz), -1)
    plant = np.arange(1, count + 1)
    middle = np.array(ndimage.center_of_mass(top, markers * top, plant))
    row, column = middle.astype(int).T
    crown = np.where(filled, grown, 0)
    tall = ndimage.maximum(height, crown, plant)
    area = np.bincount(crown[crown > 0], minlength=count + 1)[1 : count + 1] * CANOPY_CELL_M**2
    found = np.column_stack([(middle + 0.5) * CANOPY_CELL_M + low, base[row, column], tall, np.sqrt(area / np.pi)])
    return found, np.maximum(crown[cell[:, 0], cell[:, 1]], 0) - 1


PLANTS = Step("plants", 3, plants, PlantsParams)

"""Rasters: orthophoto, DSM (surface heights) and DTM (terrain heights) of the world, for GIS."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.errors import DataError, SettingError
from scan2sim.pipeline.core.parameters import Name, Texel
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, U8

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.renderer import Image, Renderer

BAND_PIXELS = 2_000_000
"""Number of pixels that are rendered at a time, in whole rows."""
MAX_PIXELS = 1e9
"""Maximum size of a raster: half an hour of rendering."""
MAX_SAMPLES = 4
"""Maximum number of rays per pixel in each direction."""


class RastersContext(Context):
    """Resolution of the rasters (`export.rasters`, `unwrap.texel`).

    Attributes:
        name: name of the tile.
        pixel: pixel size in metres.
        texel: texel size of the ground's texture in metres; larger pixels are the mean of several rays.
    """

    name: Name = "tile"
    pixel: float = Field(0.05, ge=0.001, le=100)
    texel: Texel = 0.01


class RastersParams(Params):
    """No settings; enabled by `export.rasters`."""

    context: RastersContext = RastersContext()


def rasters(inputs: Inputs, params: RastersParams, out: Path, report: Report) -> Done:
    """Render the textured groups from straight above (orthographic), in the tile's CRS.

    Files below `rasters/`: `<name>_orthophoto.tif` (colours), `<name>_dsm.tif` (heights of the highest surface) and
    `<name>_dtm.tif` (heights of the terrain mesh; no data where there is none).

    Raises:
        DataError: no group has a face.
        SettingError: the raster would be too large.
    """
    from scan2sim.pipeline.camera import renderer as render
    from scan2sim.pipeline.io.geodata import geotiff
    from scan2sim.pipeline.io.geodata.crs import LOCAL

    bodies = {group: render.textured(inputs[group]) for group in SURFACES if group in inputs}
    bodies = {group: body for group, body in bodies.items() if len(body.mesh)}
    if not bodies:
        raise DataError(
            "rasters", "there is nothing to render: all surfaces are empty", "Check the classes of the cloud"
        )
    vertices = np.concatenate([body.mesh.vertices for body in bodies.values()])
    low, high = vertices.min(axis=0).astype(float), vertices.max(axis=0).astype(float)
    frame = next(iter(bodies.values())).mesh.frame
    pixel = params.context.pixel
    grid = geotiff.Grid.around(frame, low, high, pixel)
    if grid.width * grid.height > MAX_PIXELS:
        raise SettingError(
            "export.rasters",
            f"{pixel:g} m per pixel would give {grid.width} x {grid.height} pixels",
            f"Set export.rasters={pixel * (grid.width * grid.height / MAX_PIXELS) ** 0.5 * 1.1:.2g} or more",
        )

    def rendered(renderer: Renderer, samples: int = 1) -> Iterator[Image]:
        rows = max(1, BAND_PIXELS // grid.width)
        for first in range(0, grid.height, rows):
            south_west, north_east = grid.band(first, min(rows, grid.height - first))
            corners = np.append(south_west, low[2]), np.append(north_east, high[2])
            yield renderer.above(*corners, width=grid.width, samples=samples)

    def heights(renderer: Renderer) -> Iterator[F64]:
        for image in rendered(renderer):
            z = high[2] + 1.0 - image.range.astype(float) + frame.origin[2]
            yield np.where(image.hit, z / frame.unit, np.nan)

    def colours() -> Iterator[U8]:
        for image in rendered(
            render.Renderer(list(bodies.values())),
            min(MAX_SAMPLES, round(params.context.pixel / params.context.texel)) or 1,
        ):
            yield np.dstack([image.rgb, image.hit * np.uint8(255)])

    folder = out / "rasters"
    folder.mkdir()
    plain = {group: render.Body(body.mesh) for group, body in bodies.items()}
    report(0.0, "orthophoto")
    geotiff.write_colours(folder / f"{params.context.name}_orthophoto.tif", grid, colours())
    report(0.6, "DSM")
    geotiff.write_heights(
        folder / f"{params.context.name}_dsm.tif", grid, heights(render.Renderer(list(plain.values())))
    )
    report(0.8, "DTM")
    ground = [plain["terrain"]] if "terrain" in plain else []
    geotiff.write_heights(folder / f"{params.context.name}_dtm.tif", grid, heights(render.Renderer(ground)))
    metrics: dict[str, Any] = {
        "width": grid.width,
        "height": grid.height,
        "pixel_m": params.context.pixel,
        "bytes": sum(file.stat().st_size for file in folder.iterdir()),
    }
    local = "the tile has no CRS, so its rasters have none: they are in the tile's local coordinates"
    return Done({"rasters": folder}, metrics, [local] if frame.crs == LOCAL else [])


RASTERS = Step("rasters", 2, rasters, RastersParams, memory=(1.3, 3))

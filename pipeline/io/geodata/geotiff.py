"""Cloud-optimised GeoTIFF (COG), written with GDAL (rasterio), so that GIS tools can read parts of it over HTTP.

A tile's rasters are aligned to the CRS (pixel borders at multiples of the pixel size), so that those of neighbours fit
together without resampling; `write_vrt` combines them into a virtual mosaic.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import from_os_error
from scan2sim.pipeline.core.types import F64, U8, Frame
from scan2sim.pipeline.io.geodata.crs import LOCAL, _parsed

NODATA = -9999.0
"""No-data value of height rasters."""
JPEG_QUALITY = 90
"""JPEG quality of orthophotos."""
KINDS = {
    "orthophoto": "Orthophoto",
    "dsm": "Heights of the highest surface",
    "dtm": "Heights of the ground",
}
"""Kind of a raster, as in its file name `<tile>_<kind>.tif`, to its title."""


@dataclass(frozen=True)
class Grid:
    """Pixel grid of a raster; row 0 is in the north.

    Attributes:
        frame: frame of the tile.
        column, row: the upper left pixel, in pixels east and north of the CRS's origin.
        width, height: size in pixels.
        pixel: pixel size, CRS units.
    """

    frame: Frame
    column: int
    row: int
    width: int
    height: int
    pixel: float

    @classmethod
    def around(cls, frame: Frame, low: npt.ArrayLike, high: npt.ArrayLike, metres: float) -> Self:
        """The grid with pixels of `metres` that covers the box from `low` to `high` (3,), local metres."""
        pixel = metres / frame.unit
        west, south = np.floor(frame.to_crs(low)[:2] / pixel).astype(int).tolist()
        east, north = np.ceil(frame.to_crs(high)[:2] / pixel).astype(int).tolist()
        return cls(frame, west, north, max(1, east - west), max(1, north - south), pixel)

    def band(self, first: int, rows: int) -> tuple[F64, F64]:
        """South-west and north-east corner (2,) of a band of rows, local metres."""
        south, north = self.row - first - rows, self.row - first
        corners = np.array([[self.column, south, 0], [self.column + self.width, north, 0]], float)
        low, high = self.frame.to_local(corners * self.pixel)
        return low[:2], high[:2]


def write_colours(path: Path, grid: Grid, bands: Iterable[U8]) -> None:
    """Write an orthophoto as JPEG with a mask; `bands` yields (rows, W, 4) RGBA from north to south, alpha 0: no data.

    Raises:
        SpaceError: the disk is full or not writable.
    """
    from rasterio.enums import ColorInterp

    interpretation = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
    with _cog(path, grid, 4, "uint8", compress="JPEG", quality=JPEG_QUALITY) as raster:
        raster.colorinterp = interpretation
        _fill(raster, bands)


def write_heights(path: Path, grid: Grid, bands: Iterable[F64]) -> None:
    """Write heights, float32 lossless; `bands` yields (rows, W) in CRS units from north to south, NaN: no data.

    Raises:
        SpaceError: the disk is full or not writable.
    """
    with _cog(path, grid, 1, "float32", compress="DEFLATE", predictor="FLOATING_POINT", nodata=NODATA) as raster:
        raster.units = ("metre" if grid.frame.unit == 1 else f"{grid.frame.unit:.9g} metre",)
        _fill(raster, (np.where(np.isnan(band), NODATA, band)[..., None] for band in bands))


@contextmanager
def _cog(path: Path, grid: Grid, count: int, dtype: str, **creation: Any) -> Iterator[Any]:
    """An open raster to write to; it is converted to a cloud-optimised GeoTIFF at `path` on exit.

    The pixels are written to a draft on disk, so that memory doesn't grow with the raster.
    """
    import rasterio
    import rasterio.shutil
    from rasterio.errors import RasterioError
    from rasterio.transform import Affine

    draft = path.with_name(f".{path.name}")
    nodata = creation.pop("nodata", None)
    try:
        with rasterio.open(
            draft, "w", driver="GTiff", width=grid.width, height=grid.height, count=count, dtype=dtype, nodata=nodata,
            crs=None if grid.frame.crs == LOCAL else _parsed(grid.frame.crs).to_wkt(), tiled=True, bigtiff="IF_SAFER",
            transform=Affine(grid.pixel, 0, grid.column * grid.pixel, 0, -grid.pixel, grid.row * grid.pixel),
        ) as raster:  # fmt: skip
            yield raster
        options = {"overviews": "IGNORE_EXISTING", "overview_resampling": "AVERAGE", "blocksize": 512}
        rasterio.shutil.copy(
            draft, path, driver="COG", bigtiff="IF_SAFER", num_threads="ALL_CPUS", **options, **creation
        )
    except (OSError, RasterioError) as error:  # GDAL's errors don't name the cause
        path.unlink(missing_ok=True)
        raise from_os_error(error if isinstance(error, OSError) else OSError(str(error)), path) from error
    finally:
        draft.unlink(missing_ok=True)


def _fill(raster: Any, bands: Iterable[npt.NDArray[Any]]) -> None:
    """Write bands of rows, (rows, W, count) each, one below the other."""
    from rasterio.windows import Window

    first = 0
    for band in bands:
        raster.write(np.moveaxis(band, 2, 0).astype(raster.dtypes[0]), window=Window(0, first, raster.width, len(band)))
        first += len(band)


def _add_sources(
    band: ET.Element, folder: Path, sources: Sequence[Any], index: str, west: float, north: float, pixel: float
) -> None:
    """Add the sources of a VRT band: source and target rectangle of each raster."""
    for path, profile, bounds, *_ in sources:
        size = {"xSize": str(profile["width"]), "ySize": str(profile["height"])}
        at = {"xOff": str(round((bounds.left - west) / pixel)), "yOff": str(round((north - bounds.top) / pixel))}
        source = ET.SubElement(band, "ComplexSource")  # unlike SimpleSource, it skips no-data pixels
        name = ET.SubElement(source, "SourceFilename", relativeToVRT="1")
        name.text = Path(os.path.relpath(path, folder)).as_posix()
        ET.SubElement(source, "SourceBand").text = index
        ET.SubElement(source, "SrcRect", {"xOff": "0", "yOff": "0", **size})
        ET.SubElement(source, "DstRect", {**at, **size})
        if profile["nodata"] is not None:
            ET.SubElement(source, "NODATA").text = f"{profile['nodata']:g}"
        elif index.startswith("mask"):
            ET.SubElement(source, "NODATA").text = "0"
        else:
            ET.SubElement(source, "UseMaskBand").text = "true"


def find(folder: Path, name: str) -> dict[str, Path]:
    """The existing rasters of a tile in `folder`, file by kind."""
    files = {kind: folder / f"{name}_{kind}.tif" for kind in KINDS}
    return {kind: file for kind, file in files.items() if file.is_file()}


def write_vrt(path: Path, rasters: Sequence[Path]) -> None:
    """Write a virtual mosaic (VRT) of aligned rasters of one kind, with paths relative to `path`.

    Raises:
        SpaceError: the disk is full or not writable.
    """
    import rasterio

    sources = []
    for name in rasters:
        with rasterio.open(name) as raster:
            sources.append((name, raster.profile, raster.bounds, raster.colorinterp, raster.crs))
    _, profile, _, colours, crs = sources[0]
    pixel = profile["transform"].a
    west, north = min(b.left for _, _, b, *_ in sources), max(b.top for _, _, b, *_ in sources)
    size = (
        round((max(b.right for _, _, b, *_ in sources) - west) / pixel),
        round((north - min(b.bottom for _, _, b, *_ in sources)) / pixel),
    )
    root = ET.Element("VRTDataset", rasterXSize=str(size[0]), rasterYSize=str(size[1]))
    if crs is not None:
        ET.SubElement(root, "SRS").text = crs.to_wkt()
    ET.SubElement(root, "GeoTransform").text = f"{west!r}, {pixel!r}, 0, {north!r}, 0, {-pixel!r}"
    kind = {"uint8": "Byte", "float32": "Float32"}[profile["dtype"]]
    count = profile["count"]
    for index in range(1, count + 1):
        band = ET.SubElement(root, "VRTRasterBand", dataType=kind, band=str(index))
        if profile["nodata"] is not None:
            ET.SubElement(band, "NoDataValue").text = f"{profile['nodata']:g}"
        ET.SubElement(band, "ColorInterp").text = colours[index - 1].name.capitalize()
        _add_sources(band, path.parent, sources, str(index), west, north, pixel)
    if count == 3:  # COG stores the alpha channel of JPEG as a mask
        band = ET.SubElement(ET.SubElement(root, "MaskBand"), "VRTRasterBand", dataType="Byte")
        _add_sources(band, path.parent, sources, "mask,1", west, north, pixel)
    temporary = path.with_name(f".{path.name}")
    try:
        ET.indent(root)
        ET.ElementTree(root).write(temporary, encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        raise from_os_error(error, path) from None

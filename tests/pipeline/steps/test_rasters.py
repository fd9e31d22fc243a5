"""Rasters: georeference, heights and colours of the mesh, and cloud-optimised GeoTIFFs by GDAL."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.io.geodata import geotiff
from scan2sim.pipeline.steps.rasters import RASTERS, RastersParams
from tests.fakes import synthetic
from tests.fakes.steps import step_params

rasterio = pytest.importorskip("rasterio", reason="rasterio isn't installed")
FEET = Frame("EPSG:2263", (300_000.0, 60_000.0, 10.0), 1200 / 3937)


def made(folder: Path, frame: Frame = synthetic.UTM, **params: object) -> Done:
    """Rasters of the synthetic tile."""
    meshes = {"terrain": synthetic.ground(frame=frame), "building": synthetic.house(frame)}
    inputs = {group: synthetic.textured(folder / group, mesh) for group, mesh in meshes.items()}
    (folder / "out").mkdir()
    return RASTERS.run(inputs, step_params(RastersParams, name="street", pixel=0.1, **params), folder / "out", silent)


def at(file: Path, frame: Frame, x: float, y: float) -> np.ndarray:
    """Values of a raster at a local position, by the geotransform of the file."""
    with rasterio.open(file) as raster:
        e, n, _ = frame.to_crs([x, y, 0.0])
        return next(iter(raster.sample([(e, n)], masked=True)))


@pytest.mark.parametrize("frame", [synthetic.UTM, FEET, Frame("local", (5.0, 6.0, 7.0))])
def test_heights_and_colours_equal_the_mesh_at_their_positions(tmp_path: Path, frame: Frame) -> None:
    done = made(tmp_path, frame)
    files = geotiff.find(done.files["rasters"], "street")
    assert set(files) == set(geotiff.KINDS)
    roof = (4.5 + frame.origin[2]) / frame.unit
    x0, y0 = synthetic.HOUSE
    for x, y in [(-7.3, 4.2), (3.1, -8.8), (9.8, 9.8)]:
        ground = (float(synthetic.height(np.array(x), np.array(y))) + frame.origin[2]) / frame.unit
        for kind in ("dsm", "dtm"):
            assert abs(float(at(files[kind], frame, x, y)[0]) - ground) < 0.02 / frame.unit
    inside, outside = (x0 + 0.06, y0 + 0.06), (x0 - 0.06, y0 - 0.06)  # half a pixel from the roof's corner
    assert abs(float(at(files["dsm"], frame, *inside)[0]) - roof) < 0.001 / frame.unit
    assert float(at(files["dsm"], frame, *outside)[0]) < roof - 3 / frame.unit
    assert float(at(files["dtm"], frame, *inside)[0]) < roof - 3 / frame.unit
    colours = [(-7.5, 5.0, (220, 40, 40)), (-2.5, 5.0, (40, 200, 40)), (-7.5, -5, (40, 40, 220))]
    for x, y, rgb in colours:
        np.testing.assert_allclose(at(files["orthophoto"], frame, x, y).astype(int), rgb, atol=12)
    with rasterio.open(files["dsm"]) as raster:
        assert raster.crs is None if frame.crs == "local" else raster.crs.to_epsg() == int(frame.crs[5:])
    assert bool(done.warnings) == (frame.crs == "local")


def test_gdal_reads_them_as_cloud_optimised(tmp_path: Path) -> None:
    files = geotiff.find(made(tmp_path, texel=0.05).files["rasters"], "street")
    for kind, file in files.items():
        with rasterio.open(file) as raster:
            assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert raster.compression.name.lower() == ("jpeg" if kind == "orthophoto" else "deflate")
            assert raster.res == pytest.approx((0.1, 0.1)) and raster.bounds.left == 689_990


def test_rasters_have_nodata_without_points(tmp_path: Path) -> None:
    ground = synthetic.ground()
    hole = np.abs(ground.corners.mean(axis=1)[:, :2]).max(axis=1) > 4
    inputs = {"terrain": synthetic.textured(tmp_path / "terrain", ground.keep(hole))}
    (tmp_path / "out").mkdir()
    done = RASTERS.run(inputs, step_params(RastersParams, pixel=0.1), tmp_path / "out", silent)
    for file in geotiff.find(done.files["rasters"], "tile").values():
        with rasterio.open(file) as raster:
            valid = raster.dataset_mask() > 0
        assert valid.mean() == pytest.approx(1 - 64 / 400, abs=0.02) and not valid[80:120, 80:120].any()


def test_neighbouring_rasters_join_in_a_virtual_raster(tmp_path: Path) -> None:
    east = Frame(synthetic.UTM.crs, (690_019.97, 5_335_000.0, 510.0))  # its westernmost pixels overlap the other's
    one, two = made(tmp_path / "one"), made(tmp_path / "two", east)
    for kind in geotiff.KINDS:
        files = [geotiff.find(done.files["rasters"], "street")[kind] for done in (one, two)]
        for order in (files, files[::-1]):
            geotiff.write_vrt(tmp_path / f"{kind}.vrt", order)
            with rasterio.open(tmp_path / f"{kind}.vrt") as raster:
                assert raster.width == 400 and raster.crs.to_epsg() == 32632
                assert (raster.dataset_mask()[1:-1, :-1] > 0).all()
            for frame, file in zip((synthetic.UTM, east), files, strict=True):
                whole = at(tmp_path / f"{kind}.vrt", frame, 3.33, 4.44)
                np.testing.assert_array_equal(whole, at(file, frame, 3.33, 4.44))


def test_too_large_raster_is_rejected_with_a_pixel_size_that_fits(tmp_path: Path) -> None:
    corners = np.array([[0, 0, 0], [9e4, 0, 0], [0, 9e4, 0]], np.float32)
    uv, page = np.zeros((1, 3, 2), np.float32), np.zeros(1, np.int16)
    far = Mesh(synthetic.UTM, corners, np.array([[0, 1, 2]], np.int32), uv=uv, page=page)
    with pytest.raises(SettingError, match=r"export.rasters=3\.1 or more"):
        RASTERS.run(
            {"terrain": synthetic.textured(tmp_path / "t", far)},
            step_params(RastersParams, pixel=0.1),
            tmp_path,
            silent,
        )

"""STAC catalogue and virtual point cloud: positions of tiles, and relative paths to their files."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pystac
import pytest
from pystac.validation.stac_validator import JsonSchemaSTACValidator

from scan2sim.pipeline.core.cache import digest
from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.types import Frame, PointCloud
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.geodata import crs, stac
from scan2sim.pipeline.io.geodata.stac import Cloud, TileItem
from scan2sim.pipeline.io.gps_time import from_gps
from tests.fakes import synthetic

DATE = datetime(2024, 5, 17, tzinfo=UTC)
ADJUSTED = 399_970_000.0  # GPS seconds, less a billion: May 2024


def scanned(folder: Path, frame: Frame, name: str = "cloud.laz") -> Cloud:
    """A cloud of 100 points, 20 x 10 x 5 m around the frame's origin."""
    folder.mkdir(parents=True, exist_ok=True)
    xyz = np.random.default_rng(1).uniform(-1, 1, (100, 3)) * [10, 5, 2.5]
    xyz[:2] = [-10, -5, -2.5], [10, 5, 2.5]
    rgb = np.full((100, 3), 90, np.uint8)
    time = np.linspace(ADJUSTED, ADJUSTED + 60, 100)
    cloud = PointCloud(frame, xyz.astype(np.float32), rgb, classification=np.full(100, 2, np.uint8), time=time)
    las.write(folder / name, cloud)
    return Cloud(folder / name, clouds.read_header(folder / name), digest(folder / name))


def item(out: Path, name: str, frame: Frame, **more: Any) -> TileItem:
    """A finished tile: its cloud, and files at the paths of a survey."""
    folder = out / "tiles" / name
    cloud = scanned(folder, frame)
    for file in ("world.sdf", "world.glb", "report.html"):
        (folder / file).write_text(file, encoding="utf-8")
    made = {"world": folder / "world.sdf", "glb": folder / "world.glb", "report": folder / "report.html"}
    return TileItem(name, frame, (cloud,), DATE, **(made | more))


def survey(out: Path, frame: Frame = synthetic.UTM) -> list[TileItem]:
    x, y, z = frame.origin
    return [item(out, f"tile{i}", replace(frame, origin=(x + 18 * i, y, z))) for i in range(3)]


def check(thing: pystac.Item | pystac.Collection) -> None:
    """Validate by the STAC schema; those of extensions would need a download."""
    kind = pystac.STACObjectType.ITEM if isinstance(thing, pystac.Item) else pystac.STACObjectType.COLLECTION
    JsonSchemaSTACValidator().validate_core(thing.to_dict(), kind, "1.1.0")


def read(path: Path) -> tuple[pystac.Collection, list[pystac.Item]]:
    collection = pystac.Collection.from_file(str(path))
    items = sorted(collection.get_items(), key=lambda item: item.id)
    things: list[pystac.Item | pystac.Collection] = [collection, *items]
    for thing in things:
        check(thing)
    return collection, items


def test_catalogue_is_readable_and_refers_to_existing_files(tmp_path: Path) -> None:
    path = stac.write(tmp_path / "out", "town", "A town.", survey(tmp_path / "out"))
    assert path == tmp_path / "out/stac/collection.json"
    moved = (tmp_path / "out").rename(tmp_path / "moved")  # paths are relative
    collection, items = read(moved / "stac/collection.json")
    assert collection.id == "town" and collection.description == "A town."
    assert [one.id for one in items] == ["tile0", "tile1", "tile2"]
    for one in items:
        assert set(one.assets) == {"world", "glb", "report", "data"}
        for asset in one.assets.values():
            assert not Path(asset.href).is_absolute()
            assert Path(asset.get_absolute_href() or "").is_file()
            assert asset.roles and asset.media_type and asset.title
    assert sorted(path.name for path in moved.iterdir()) == ["stac", "tiles"]
    assert str(tmp_path) not in "".join(path.read_text(encoding="utf-8") for path in moved.glob("stac/**/*.json"))


def test_item_has_geometry_and_bounds(tmp_path: Path) -> None:
    tiles = survey(tmp_path)
    collection, items = read(stac.write(tmp_path, "town", "A town.", tiles))
    corners = [crs.to_wgs84(tiles[0].frame, (x, y, 0)) for x in (-10, 10) for y in (-5, 5)]
    lat, lon, _ = np.transpose([corner for corner in corners if corner is not None])
    assert items[0].bbox == pytest.approx([lon.min(), lat.min(), lon.max(), lat.max()], abs=1e-7)
    ring = np.array((items[0].geometry or {})["coordinates"][0])
    assert ring.shape == (5, 2) and np.all(ring[0] == ring[-1])
    x, y = ring.T
    assert np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) > 0  # counter-clockwise
    assert ring[0] == pytest.approx([lon[0], lat[0]], abs=1e-7)
    about = items[0].properties
    assert about["proj:code"] == "EPSG:32632" and "proj:wkt2" not in about
    assert about["proj:bbox"] == pytest.approx([689_990, 5_334_995, 497.5, 690_010, 5_335_005, 502.5], abs=2e-3)
    assert np.shape(about["proj:geometry"]["coordinates"]) == (1, 5, 2)
    box = np.array(collection.extent.spatial.bboxes[0])
    boxes = np.array([one.bbox for one in items])
    assert np.all(box[:2] == boxes[:, :2].min(axis=0)) and np.all(box[2:] == boxes[:, 2:].max(axis=0))


def test_item_has_point_count_software_and_sizes(tmp_path: Path) -> None:
    tiles = survey(tmp_path)
    one = read(stac.write(tmp_path, "town", "A town.", tiles))[1][0]
    about = one.properties
    assert (about["pc:count"], about["pc:type"], about["pc:encoding"]) == (100, "lidar", "laszip")
    assert {"name": "X", "size": 8, "type": "floating"} in about["pc:schemas"]
    names = [schema["name"] for schema in about["pc:schemas"]]
    assert {"Intensity", "Classification", "GpsTime", "Red", "ReturnNumber"} < set(names)
    assert names[:3] == ["X", "Y", "Z"] and names.count("X") == 1
    assert list(about["processing:software"]) == ["scan2sim"] and about["processing:lineage"]
    kinds = ("projection", "pointcloud", "processing", "file")
    assert all(any(f"/{kind}/" in uri for uri in one.stac_extensions) for kind in kinds)
    cloud = one.assets["data"].extra_fields
    assert cloud["file:size"] == tiles[0].clouds[0].path.stat().st_size
    assert cloud["file:checksum"] == "1220" + str(tiles[0].clouds[0].digest)
    assert "file:checksum" not in one.assets["world"].extra_fields
    assert one.assets["data"].media_type == "application/vnd.laszip"


def test_item_lists_its_rasters(tmp_path: Path) -> None:
    out = tmp_path / "out"
    made = item(out, "tile0", synthetic.UTM)
    raster = out / "tiles" / "tile0" / "tile0_dsm.tif"
    raster.write_text("heights", encoding="utf-8")
    _, (one,) = read(stac.write(out, "town", "", [replace(made, rasters={"dsm": raster})]))
    asset = one.assets["dsm"]
    assert asset.media_type == "image/tiff; application=geotiff; profile=cloud-optimized"
    assert asset.title == "Heights of the highest surface" and asset.extra_fields["file:size"] == 7


def test_times_are_those_of_the_points_or_the_given_date(tmp_path: Path) -> None:
    timed = item(tmp_path, "timed", synthetic.UTM, times=(ADJUSTED, ADJUSTED + 60))
    dated = item(tmp_path, "dated", synthetic.UTM, times=(1000.0, 1060.0))  # of an unknown week
    collection, items = read(stac.write(tmp_path, "town", "A town.", [timed, dated]))
    spans = {one.id: (one.common_metadata.start_datetime, one.common_metadata.end_datetime) for one in items}
    assert spans["dated"] == (DATE, DATE)
    start, end = spans["timed"]
    assert start is not None and end is not None
    assert start.date() == datetime(2024, 5, 17).date() and (end - start).total_seconds() == 60
    assert items[1].datetime == start
    assert collection.extent.temporal.intervals == [[DATE, end]]


def test_gps_times_are_converted_to_utc() -> None:
    assert from_gps(211_846_418.0) == datetime(2018, 6, 1, tzinfo=UTC)  # GPS time 1211846418
    early = from_gps(-100_000_000.0)
    assert early is not None and abs((early - datetime(2008, 7, 13, 15, 59, 46, tzinfo=UTC)).total_seconds()) <= 4
    assert from_gps(3600.0) is None and from_gps(1.7e9) is None


def test_crs_without_a_code_is_written_as_wkt(tmp_path: Path) -> None:
    from pyproj import CRS

    own = CRS.from_proj4("+proj=tmerc +lat_0=48 +lon_0=11.5 +x_0=600000 +y_0=5300000 +ellps=GRS80 +units=m").to_wkt()
    one = read(stac.write(tmp_path, "town", "", [item(tmp_path, "a", replace(synthetic.UTM, crs=own))]))[1][0]
    assert one.properties["proj:code"] is None and CRS.from_wkt(one.properties["proj:wkt2"]) == CRS.from_wkt(own)


def test_coordinates_in_feet_are_converted(tmp_path: Path) -> None:
    feet = Frame("EPSG:2263", (300_000.0, 60_000.0, 30.0), 1200 / 3937)  # New York, US survey feet
    one = read(stac.write(tmp_path, "town", "", [item(tmp_path, "a", feet)]))[1][0]
    assert one.bbox is not None and one.bbox[:2] == pytest.approx([-74.0, 40.7], abs=0.1)
    assert one.properties["proj:bbox"][0] == pytest.approx((300_000 - 10) * 3937 / 1200, abs=0.1)


def test_local_survey_has_no_geographic_position(tmp_path: Path) -> None:
    collection, items = read(stac.write(tmp_path, "town", "A town.", survey(tmp_path, Frame())))
    assert all(one.geometry is None and one.bbox is None for one in items)
    assert items[0].properties["proj:code"] is None
    assert items[0].properties["proj:bbox"] == pytest.approx([-10, -5, -2.5, 10, 5, 2.5], abs=2e-3)
    assert collection.extent.spatial.bboxes == [[-180, -90, 180, 90]]


def test_earlier_catalogue_is_replaced_completely(tmp_path: Path) -> None:
    tiles = survey(tmp_path)
    stac.write(tmp_path, "town", "A town.", tiles)
    with pytest.raises(InputError, match=r"none\.sdf"):
        stac.write(tmp_path, "town", "A town.", [replace(tiles[0], world=tmp_path / "none.sdf")])
    assert len(read(tmp_path / "stac/collection.json")[1]) == 3
    stac.write(tmp_path, "town", "A town.", tiles[:1])
    assert sorted(path.name for path in (tmp_path / "stac").iterdir()) == ["collection.json", "tile0"]
    with pytest.raises(DataError):
        stac.write(tmp_path, "town", "A town.", [])


def test_virtual_point_cloud_has_the_fields_that_pdal_and_qgis_read(tmp_path: Path) -> None:
    tiles = survey(tmp_path)
    second = scanned(tmp_path / "tiles/tile0", tiles[0].frame, "second.las")
    tiles[0] = replace(tiles[0], clouds=(*tiles[0].clouds, second))
    path = stac.write_vpc(tmp_path / "town.vpc", tiles)
    body = json.loads(path.read_text(encoding="utf-8"))
    assert body["type"] == "FeatureCollection"
    features = body["features"]
    assert [feature["id"] for feature in features] == ["tile0_0", "tile0_1", "tile1", "tile2"]
    for feature in features:  # as PDAL/wrench's vpc.cpp and QGIS's provider read them
        assert (feature["type"], feature["stac_version"]) == ("Feature", "1.0.0")
        assert feature["geometry"]["type"] == "Polygon" and feature["links"] == []
        href = feature["assets"]["data"]["href"]
        assert href.startswith("./") and (path.parent / href).is_file()
        about = feature["properties"]
        assert about["pc:count"] == 100 and len(about["proj:bbox"]) == 6 and "UTM zone 32N" in about["proj:wkt2"]
        assert np.shape(about["proj:geometry"]["coordinates"]) == (1, 5, 2)
        assert all(set(schema) == {"name", "size", "type"} for schema in about["pc:schemas"])
        pystac.Item.from_dict(feature)
    assert features[1]["properties"]["pc:encoding"] == "las"
    assert len({feature["properties"]["proj:wkt2"] for feature in features}) == 1


def test_virtual_point_cloud_of_a_local_survey_has_an_empty_crs(tmp_path: Path) -> None:
    path = stac.write_vpc(tmp_path / "town.vpc", survey(tmp_path, Frame()))
    feature = json.loads(path.read_text(encoding="utf-8"))["features"][0]
    assert feature["properties"]["proj:wkt2"] == ""  # a string, or wrench stops
    assert feature["geometry"] == feature["properties"]["proj:geometry"]

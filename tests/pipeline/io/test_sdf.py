"""SDF: georeference, tile offset and background of worlds."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import pytest

from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.io.worlds import sdf
from tests.fakes import synthetic
from tests.present import present


def _world(
    path: Path, place: sdf.Georeference | None, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> ET.Element:
    sdf.write_world(path, ["street"], place, offset)
    root = ET.parse(path).getroot()
    assert root.get("version") == "1.9"
    return present(root.find("world"))


def test_spherical_coordinates_equal_those_of_the_origin(tmp_path: Path) -> None:
    from pyproj import Transformer

    world = _world(tmp_path / "a.sdf", sdf.Georeference.of(synthetic.UTM))
    x, y, z = synthetic.UTM.origin
    lon, lat = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True).transform(x, y)
    place = present(world.find("spherical_coordinates"))
    assert float(place.findtext("latitude_deg", "")) == pytest.approx(lat, abs=1e-8)
    assert float(place.findtext("longitude_deg", "")) == pytest.approx(lon, abs=1e-8)
    assert float(place.findtext("elevation", "")) == z
    assert place.findtext("surface_model") == "EARTH_WGS84"
    assert place.findtext("world_frame_orientation") == "ENU"


def test_heading_is_minus_the_convergence(tmp_path: Path) -> None:
    # east of the central meridian, north of the equator, grid north lies east of true north:
    # the world is turned clockwise, which SDF counts as negative
    assert present(sdf.Georeference.of(synthetic.UTM)).heading == pytest.approx(-1.90, abs=0.01)
    west = replace(synthetic.UTM, origin=(310_000.0, 5_335_000.0, 500.0))
    assert present(sdf.Georeference.of(west)).heading == pytest.approx(1.90, abs=0.01)


def test_feet_are_converted_to_metres() -> None:
    feet = Frame("EPSG:2263", (300_000.0, 60_000.0, 30.0), 1200 / 3937)  # New York, US survey feet
    place = present(sdf.Georeference.of(feet))
    assert (place.latitude, place.longitude) == pytest.approx((40.7, -74.0), abs=0.1)
    assert place.elevation == pytest.approx(30.0)


def test_local_frame_has_no_georeference(tmp_path: Path) -> None:
    assert sdf.Georeference.of(Frame()) is None
    assert _world(tmp_path / "a.sdf", None).find("spherical_coordinates") is None


def test_offset_is_written_to_the_pose(tmp_path: Path) -> None:
    world = _world(tmp_path / "a.sdf", None, (100.25, -3.0, 1e-3))
    assert world.findtext("include/uri") == "model://street"
    assert world.findtext("include/pose") == "100.25 -3 0.001 0 0 0"


def test_sensors_of_any_robot_have_their_systems(tmp_path: Path) -> None:
    systems = {
        present(plugin.get("name")).rsplit("::")[-1]: present(plugin.get("filename"))
        for plugin in _world(tmp_path / "a.sdf", None).iter("plugin")
    }
    # names of libraries: gz-sim, src/systems/*/CMakeLists.txt, the same in Fortress 6.16 and in Jetty
    assert systems == {
        "Physics": "gz-sim-physics-system", "UserCommands": "gz-sim-user-commands-system",
        "SceneBroadcaster": "gz-sim-scene-broadcaster-system", "Contact": "gz-sim-contact-system",
        "Imu": "gz-sim-imu-system", "NavSat": "gz-sim-navsat-system", "Magnetometer": "gz-sim-magnetometer-system",
        "Altimeter": "gz-sim-altimeter-system", "AirPressure": "gz-sim-air-pressure-system",
        "ForceTorque": "gz-sim-forcetorque-system", "Sensors": "gz-sim-sensors-system",
    }  # fmt: skip


def test_commands_keep_the_users_own_models(tmp_path: Path) -> None:
    _world(tmp_path / "a.sdf", None)
    text = (tmp_path / "a.sdf").read_text(encoding="utf-8")
    assert "GZ_SIM_RESOURCE_PATH=$PWD/models:$GZ_SIM_RESOURCE_PATH gz sim -r a.sdf" in text
    assert "IGN_GAZEBO_RESOURCE_PATH=$PWD/models:$IGN_GAZEBO_RESOURCE_PATH ign gazebo -r a.sdf" in text


def test_background_is_the_colour_of_the_sky(tmp_path: Path) -> None:
    sdf.write_world(tmp_path / "a.sdf", ["street"], None, (0.0, 0.0, 0.0), sky=(102, 153, 255))
    world = present(ET.parse(tmp_path / "a.sdf").getroot().find("world"))
    assert world.findtext("scene/background") == "0.4 0.6 1 1"

"""Step `roads` on a synthetic road: curved, on a slope, with lane markings and kerbs."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.geodata import opendrive, road_geojson
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.world_formats import opendrive as opendrive_of_scenes
from scan2sim.pipeline.io.worlds.scene import ROADS_FILE as SEEN
from scan2sim.pipeline.roads import model, observed, profile
from scan2sim.pipeline.roads.course import course
from scan2sim.pipeline.roads.lanes import sections
from scan2sim.pipeline.roads.model import Road
from scan2sim.pipeline.steps.roads import ROADS, RoadsParams
from tests.fakes import synthetic as worlds
from tests.fakes.steps import step_params
from tests.pipeline.roads.sample_street import FALL, KERB, Street

STREET = Street()


def run(folder: Path, inputs: dict[str, Path], **params: Any) -> Done:
    out = folder / "out"
    out.mkdir(parents=True)
    return ROADS.run(inputs, step_params(RoadsParams, **params), out, silent)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Done:
    folder = tmp_path_factory.mktemp("road")
    return run(folder, STREET.inputs(folder))


def built_roads(done: Done, frame: Frame = STREET.frame) -> list[Road]:
    ways = [way.moved(-np.asarray(frame.origin)) for way in observed.load(done.files["seen"])]
    return [road for road in map(model.build_road, observed.join(ways)) if road]


def features(done: Done) -> list[dict[str, Any]]:
    return list(json.loads(done.files["geojson"].read_text(encoding="utf-8"))["features"])


def test_lines_are_at_their_true_positions(done: Done) -> None:
    true = {"marking": [STREET.lane, 0.0, -STREET.lane], "edge": [STREET.edge, -STREET.edge], "reference": [0.0]}
    count = dict.fromkeys(true, 0)
    for feature in features(done):
        about = feature["properties"]
        xyz = STREET.frame.to_local(feature["geometry"]["coordinates"])
        s, t = STREET.locate(xyz[:, :2])
        away = np.abs(t[:, None] - true[about["kind"]])
        nearest = int(np.median(away.argmin(axis=1)))
        assert away[:, nearest].max() < 0.06, about
        inside = np.sign(true[about["kind"]][nearest]) * STREET.edge * 0.99
        expected = STREET.height(s, t if about["kind"] != "edge" else np.full(len(t), inside))
        assert np.abs(xyz[:, 2] - expected).max() < 0.03, about
        assert np.ptp(s) > 0.9 * STREET.length or about["kind"] == "marking"
        count[about["kind"]] += 1
        if about["kind"] == "edge":
            assert about["border"] == "kerb" and about["kerb_m"] == pytest.approx(KERB, abs=0.02)
        if about.get("marking") == "broken":
            assert about["dash_m"] == pytest.approx(3, abs=0.15) == about["gap_m"]
            assert about["paint_width_m"] == pytest.approx(0.12, abs=0.03)
    assert count == {"marking": 3, "edge": 2, "reference": 1}
    (road,) = done.metrics["roads"]
    assert road["width_m"] == pytest.approx(2 * STREET.edge, abs=0.1) and road["notes"] == []


def test_lanes_and_cross_slopes_are_those_of_the_road(done: Done) -> None:
    (road,) = built_roads(done)
    assert road.keeps_right and road.reference == "marking"
    (section,) = sections(road)
    assert section.kinds == ("shoulder", "driving", "driving", "shoulder") and section.centre == 2
    assert np.abs([float(fall.at(25.0)) - FALL for fall in road.cross_slopes]).max() < 0.003


def test_opendrive_geometry_is_continuous_with_markings_and_lane_widths(done: Done, tmp_path: Path) -> None:
    roads = built_roads(done)
    assert opendrive.write(tmp_path / "road.xodr", "road", STREET.frame, roads) == 1
    root = ET.parse(tmp_path / "road.xodr").getroot()
    pieces = root.findall("road/planView/geometry")
    ends = [float(p.attrib["s"]) + float(p.attrib["length"]) for p in pieces]
    np.testing.assert_allclose(ends[:-1], [float(p.attrib["s"]) for p in pieces[1:]], atol=1e-6)
    assert float(root.find("road").attrib["length"]) == pytest.approx(ends[-1])  # type: ignore[union-attr]
    marks = {mark.attrib["type"] for mark in root.iter("roadMark")}
    assert {"solid", "broken", "curb"} <= marks
    dash = root.find(".//roadMark[@type='broken']/type/line")
    assert dash is not None and float(dash.attrib["length"]) == pytest.approx(3, abs=0.15)
    for lane in root.iter("lane"):
        assert lane.attrib["id"] == "0" or len(lane.findall("width")) > 0


def test_carla_drives_in_the_true_lanes(done: Done, tmp_path: Path) -> None:
    carla = pytest.importorskip("carla", reason="CARLA's library isn't here (pip install carla==0.9.16)")
    opendrive.write(tmp_path / "road.xodr", "road", STREET.frame, built_roads(done))
    points = carla.Map("road", (tmp_path / "road.xodr").read_text(encoding="utf-8")).generate_waypoints(1.0)
    places = np.array([(p.transform.location.x, -p.transform.location.y, p.transform.location.z) for p in points])
    s, t = STREET.locate(places[:, :2])
    lane = np.array([p.lane_id for p in points])
    assert len(points) > 1.8 * STREET.length * 0.9
    np.testing.assert_allclose(t, np.sign(lane) * STREET.lane / 2, atol=0.05)
    np.testing.assert_allclose(places[:, 2], STREET.height(s, 0 * t), atol=0.1)
    turned = {side: [p.transform.rotation.yaw for p in points if p.lane_id * side > 0] for side in (1, -1)}
    assert np.abs(np.abs(np.subtract(np.mean(turned[1]), np.mean(turned[-1]))) % 360 - 180) < 5


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:2154", "EPSG:6431"])
def test_georeference_of_opendrive_reproduces_surveyed_points(done: Done, tmp_path: Path, crs: str) -> None:
    from pyproj import CRS, Transformer

    unit = CRS(crs).axis_info[0].unit_conversion_factor
    origin = {"EPSG:6431": (950_000.0, 510_000.0, 1600.0)}.get(crs, (690_000.0, 5_335_000.0, 500.0))
    frame = Frame(crs, origin, unit)
    opendrive.write(tmp_path / "road.xodr", "road", frame, built_roads(done))
    header = ET.parse(tmp_path / "road.xodr").getroot().find("header")
    assert header is not None and header.find("offset") is not None
    offset = np.array([float(header.find("offset").attrib[k]) for k in "xyz"])  # type: ignore[union-attr]
    local = np.array([(5000.0, -5000.0, 10.0), (-3000.0, 4000.0, 0.0), (1.0, 2.0, 3.0)])
    degrees = Transformer.from_crs(header.findtext("geoReference", ""), "EPSG:4326", always_xy=True)
    lon, lat = degrees.transform(*(local + offset)[:, :2].T)
    known = Transformer.from_crs(crs, CRS(crs).geodetic_crs, always_xy=True).transform(*frame.to_crs(local)[:, :2].T)
    assert np.abs(np.subtract((lon, lat), known)).max() * 111_000 < 0.01
    np.testing.assert_allclose(local[:, 2] + offset[2], frame.to_crs(local)[:, 2] * unit)


def test_unpainted_roads_have_only_edges(tmp_path: Path) -> None:
    done = run(tmp_path, STREET.inputs(tmp_path, paint=False))
    (road,) = built_roads(done)
    assert road.reference == "middle" and not road.markings
    assert [section.kinds for section in sections(road)] == [("bidirectional",)]
    assert {f["properties"]["kind"] for f in features(done)} == {"reference", "edge"}
    assert any("no painted line" in note for note in done.metrics["roads"][0]["notes"])


def test_edges_are_extracted_without_texture(tmp_path: Path) -> None:
    inputs = STREET.inputs(tmp_path)
    (inputs["textured"] / "mesh.npz").unlink()
    (road,) = built_roads(run(tmp_path, inputs))
    s = np.linspace(0, road.line.length, 50)
    assert np.abs(STREET.locate(road.line.points(s))[1]).max() < 0.05


def test_edge_without_a_kerb_is_where_the_ground_class_changes(tmp_path: Path) -> None:
    cloud = STREET.cloud()
    _, t = STREET.locate(cloud.xyz[:, :2])
    flat = cloud.xyz.copy()
    flat[:, 2] -= np.where(np.abs(t) > STREET.edge, KERB, 0).astype(np.float32)
    done = run(tmp_path, STREET.inputs(tmp_path, cloud=replace(cloud, xyz=flat)))
    edges = [f for f in features(done) if f["properties"]["kind"] == "edge"]
    assert {f["properties"]["border"] for f in edges} == {"other ground"}
    for edge in edges:
        _, t = STREET.locate(STREET.frame.to_local(edge["geometry"]["coordinates"])[:, :2])
        assert np.abs(np.abs(t) - STREET.edge).max() < 0.15


def test_no_edge_at_junctions(tmp_path: Path) -> None:
    cloud = STREET.cloud()
    s, t = STREET.locate(cloud.xyz[:, :2])
    assert cloud.classification is not None
    mouth = (t > STREET.edge) & (np.abs(s) < 6)
    xyz, code = cloud.xyz.copy(), np.where(mouth, CODE["road"], cloud.classification).astype(np.uint8)
    xyz[mouth, 2] -= KERB
    done = run(tmp_path, STREET.inputs(tmp_path, cloud=replace(cloud, xyz=xyz, classification=code)))
    left = [f for f in features(done) if f["properties"].get("side") == "left"]
    assert len(left) == 2
    for part in left:
        s, _ = STREET.locate(STREET.frame.to_local(part["geometry"]["coordinates"])[:, :2])
        assert np.abs(s).min() > 5
    assert any("left edge isn't detected from" in note for note in done.metrics["roads"][0]["notes"])


def test_missing_road_is_reported_with_its_reason(tmp_path: Path) -> None:
    cloud = STREET.cloud()
    grass = replace(cloud, classification=np.full(len(cloud), CODE["terrain"], np.uint8))
    nothing = run(tmp_path / "a", STREET.inputs(tmp_path / "a", cloud=grass))
    assert nothing.metrics["none"] == "no point has a road class" and features(nothing) == []
    s, _ = STREET.locate(cloud.xyz[:, :2])
    short = run(tmp_path / "b", STREET.inputs(tmp_path / "b", cloud=cloud.take(np.abs(s) < 0.5)))
    assert short.metrics["none"] == "no road line was detected" and built_roads(short) == []
    empty = run(tmp_path / "c", STREET.inputs(tmp_path / "c", cloud=cloud.take(np.zeros(len(cloud), bool))))
    assert features(empty) == [] and opendrive.write(tmp_path / "x.xodr", "x", STREET.frame, built_roads(empty)) == 0
    assert not (tmp_path / "x.xodr").exists()


def test_road_without_surface_points_is_skipped_with_a_warning(tmp_path: Path) -> None:
    cloud = STREET.cloud()
    _, t = STREET.locate(cloud.xyz[:, :2])
    done = run(tmp_path, STREET.inputs(tmp_path, cloud=cloud.take(np.abs(t) > model.MAX_SURFACE_DISTANCE_M + 0.2)))
    (warning,) = done.warnings
    assert warning.endswith("is left out: no point of its surface is within 3 m of its line")
    assert features(done) == [] and done.metrics["roads"] == [] and "none" not in done.metrics
    assert not list(done.files["opendrive"].iterdir())
    scene = worlds.scene(tmp_path / "town", STREET.frame, tiles=1)
    (scene.tiles[0].folder / SEEN).write_bytes(done.files["seen"].read_bytes())
    assert opendrive_of_scenes.write_roads(scene, tmp_path) == 0


def test_profile_without_points_is_rejected() -> None:
    with pytest.raises(ValueError, match="at least one value"):
        profile.fit(np.linspace(0, 10, 2), np.zeros(0), np.zeros(0), 0.02, 0.05)
    flat = profile.fit(np.linspace(0, 10, 2), np.array([5.0]), np.array([1.5]), 0.02, 0.05)
    assert float(flat.at(5.0)) == pytest.approx(1.5, abs=1e-3)


def test_opendrive_of_a_tile_equals_that_of_its_world(done: Done, tmp_path: Path) -> None:
    (file,) = done.files["opendrive"].iterdir()
    scene = worlds.scene(tmp_path, STREET.frame, tiles=1)
    (scene.tiles[0].folder / SEEN).write_bytes(done.files["seen"].read_bytes())
    assert file.name == "tile.xodr" and opendrive_of_scenes.write_roads(scene, tmp_path) == 1
    own, whole = (ET.parse(path).getroot().findall("road") for path in (file, tmp_path / "town.xodr"))
    assert [road.attrib for road in own] == [road.attrib for road in whole]


def test_road_across_two_tiles_is_joined(tmp_path: Path) -> None:
    inputs = STREET.inputs(tmp_path)
    x, y, _ = STREET.frame.origin
    seeds = {"east": (x + 14.0, y), "west": (x - 14.0, y)}
    scene = worlds.scene(tmp_path / "town", STREET.frame)
    halves = []
    for tile, own, other in zip(scene.tiles, ("east", "west"), ("west", "east"), strict=True):
        half = run(tmp_path / own, inputs, seed=seeds[own], neighbours={other: seeds[other]})
        length = half.metrics["roads"][0]["length_m"]
        assert length == pytest.approx(STREET.length / 2, abs=3)
        (tile.folder / SEEN).write_bytes(half.files["seen"].read_bytes())
        halves.append(half)
    world_formats.write(scene, ["opendrive"], tmp_path / "export", SceneParams(), silent)
    root = ET.parse(tmp_path / "export" / "town.xodr").getroot()
    (road,) = root.findall("road")
    assert float(road.attrib["length"]) == pytest.approx(STREET.length, abs=3)
    lines = json.loads((tmp_path / "export" / "town_roads.geojson").read_text(encoding="utf-8"))["features"]
    assert {f["properties"]["road"] for f in lines} == {1} and len(lines) == 6
    for line in lines:
        _, t = STREET.locate(STREET.frame.to_local(line["geometry"]["coordinates"])[:, :2])
        assert np.ptp(t) < 0.1


def test_world_without_lanes_has_no_opendrive(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no road of town has detected lanes"):
        world_formats.write(worlds.scene(tmp_path), ["opendrive"], tmp_path / "export", SceneParams(), silent)


def test_notes_report_missing_edges_and_lanes(done: Done) -> None:
    (road,) = built_roads(done)
    assert "left edge isn't detected" in " ".join(road_geojson.notes(replace(road, left=None)))
    bare = replace(road, left=None, right=None, markings=(), reference="way")
    assert "no lanes" in " ".join(road_geojson.notes(bare)) and sections(bare) == []


def test_driving_path_is_the_centre_of_the_ego_lane(done: Done) -> None:
    (road,) = built_roads(done)
    for keeps_right, side in ((True, -1), (False, 1)):
        way = course(replace(road, keeps_right=keeps_right))
        s, t = STREET.locate(way.places[:, :2])
        assert way.by == "lane"
        np.testing.assert_allclose(t, side * STREET.lane / 2, atol=0.06)
        np.testing.assert_allclose(way.places[:, 2], STREET.height(s, t), atol=0.03)
    unmarked = course(replace(road, reference="middle", markings=()))
    assert unmarked.by == "road" and np.abs(STREET.locate(unmarked.places[:, :2])[1]).max() < 0.06

"""Files of recorded traffic, read by ASAM's schemas, scenariogeneration, esmini and Gazebo's libraries."""

from __future__ import annotations

import csv
import importlib.metadata
import os
import subprocess
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import xmlschema

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.geodata import opendrive, track_geojson
from scan2sim.pipeline.io.scenario_formats import openscenario
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import TRACKS_FILE, Scene, read_scene
from scan2sim.pipeline.io.worlds.scene_traffic import scenario_of
from scan2sim.pipeline.scenario.motion_check import impossible_motions
from scan2sim.pipeline.scenario.scenario import Scenario, from_tracks
from scan2sim.pipeline.tracking.tracks import write_tracks
from tests.fakes import synthetic, traffic
from tests.fakes.gazebo.checker import check_world


def schema(name: str) -> Path:
    """An ASAM schema, as scenariogeneration carries it."""
    files = importlib.metadata.files("scenariogeneration") or []
    return Path(str(next(file.locate() for file in files if file.name == name)))


@pytest.fixture(scope="module")
def openscenario_schema() -> xmlschema.XMLSchema:
    return xmlschema.XMLSchema(str(schema("OpenSCENARIO_1_3_1.xsd")))


@pytest.fixture
def recorded() -> Scenario:
    return from_tracks("street", traffic.tracks())


@pytest.fixture
def town(tmp_path: Path) -> Scene:
    """A tile with recorded traffic."""
    scene = synthetic.scene(tmp_path, tiles=1)
    write_tracks(scene.tiles[0].folder / TRACKS_FILE, traffic.tracks(), scene.tiles[0].frame)
    track_geojson.write(scene.tiles[0].folder / "tracks.geojson", traffic.tracks(), scene.tiles[0].frame)
    return read_scene(tmp_path / "world")


def write(scenario: Scenario, folder: Path) -> Path:
    """The scenario and its road."""
    opendrive.write(folder / "street.xodr", "street", synthetic.UTM, [traffic.road()])
    path = folder / f"{scenario.name}.xosc"
    openscenario.write(path, scenario, "street.xodr", {"car_1": "actors/car_1.glb"})
    return path


def test_files_are_valid_by_the_asam_schemas(
    recorded: Scenario, tmp_path: Path, openscenario_schema: xmlschema.XMLSchema
) -> None:
    path = write(recorded, tmp_path)
    openscenario_schema.validate(str(path))
    xmlschema.XMLSchema(str(schema("opendrive_17_core.xsd"))).validate(str(tmp_path / "street.xodr"))
    parked = Scenario("parked", recorded.actors[-1:], None)
    openscenario.write(tmp_path / "parked.xosc", parked, None, {})
    openscenario_schema.validate(str(tmp_path / "parked.xosc"))
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("vehicleCategory", "category"), encoding="utf-8")
    assert not openscenario_schema.is_valid(str(path))  # the schema rejects an invalid file


def test_scenariogeneration_reads_the_actors(recorded: Scenario, tmp_path: Path) -> None:
    from scenariogeneration import xosc

    read = xosc.ParseOpenScenario(str(write(recorded, tmp_path)))
    bodies = {one.name: one.entityobject for one in read.entities.scenario_objects}
    assert list(bodies) == ["ego", "car_1", "van_2", "cyclist_3", "pedestrian_4", "car_6"]
    van = bodies["van_2"]
    assert isinstance(van, xosc.Vehicle) and van.vehicle_type.get_name() == "van"
    box = van.boundingbox.boundingbox
    assert (box.length, box.width, box.height) == (5.2, 2.0, 2.3)
    assert isinstance(bodies["pedestrian_4"], xosc.Pedestrian)


def esmini() -> str:
    program = os.environ.get("SCAN2SIM_ESMINI")
    if not program:
        pytest.skip("no esmini: set SCAN2SIM_ESMINI to its program")
    return program


def played(path: Path, *options: str) -> dict[str, list[dict[str, float]]]:
    """States of each actor while esmini plays a scenario: time, middle of the box, heading, lane and offset in it."""
    command = [
        esmini(),
        "--osc",
        path.name,
        "--headless",
        "--fixed_timestep",
        "0.05",
        "--csv_logger",
        "log.csv",
        *options,
    ]
    result = subprocess.run(command, cwd=path.parent, capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stdout[-2000:]
    found: dict[str, list[dict[str, float]]] = {}
    for row in csv.reader((path.parent / "log.csv").read_text(encoding="utf-8").splitlines()):
        if row and row[0].strip().isdigit():
            time, block = float(row[1]), 31  # columns of each actor
            for start in range(2, len(row) - block, block):
                name, own = row[start].strip(), row[start : start + block]
                if name:
                    x, y, heading = float(own[11]), float(own[12]), float(own[24])
                    length = float(own[5])
                    found.setdefault(name, []).append(
                        {
                            "time": time, "x": x + length * np.cos(heading) - synthetic.UTM.origin[0],
                            "y": y + length * np.sin(heading) - synthetic.UTM.origin[1], "heading": heading,
                            "lane": float(own[22]), "offset": float(own[23]),
                        }
                    )  # fmt: skip
    return found


def test_esmini_plays_actors_at_their_positions_and_times(recorded: Scenario, tmp_path: Path) -> None:
    states = played(write(recorded, tmp_path))
    assert set(states) == {actor.name for actor in recorded.everyone}
    for actor in recorded.everyone:
        times = np.array([one["time"] for one in states[actor.name]])
        if not actor.stays:
            assert times[0] == pytest.approx(actor.begin, abs=0.11) and times[-1] == pytest.approx(actor.end, abs=0.11)
        inside = [one for one in states[actor.name] if actor.begin <= one["time"] <= actor.end] or states[actor.name][
            :1
        ]
        expected = actor.track.at([one["time"] for one in inside])
        at = np.array([(one["x"], one["y"]) for one in inside])
        assert np.linalg.norm(at - expected[:, :2], axis=1).max() < 0.1
        turned = np.array([one["heading"] for one in inside]) - expected[:, 3]
        assert np.abs(np.arctan2(np.sin(turned), np.cos(turned))).max() < 0.01
    for name, lane in (("ego", -1), ("car_1", -1), ("van_2", 1)):
        assert {one["lane"] for one in states[name]} == {lane}
        assert max(abs(one["offset"]) for one in states[name]) < 0.05


def test_ego_waits_for_the_system_under_test_on_request(recorded: Scenario, tmp_path: Path) -> None:
    path = write(recorded, tmp_path)
    text = path.read_text(encoding="utf-8")
    declared = 'name="replay_ego" parameterType="boolean" value="true"'
    assert declared in text
    path.write_text(text.replace(declared, declared.replace("true", "false")), encoding="utf-8")
    ego = played(path)["ego"]
    assert (ego[0]["x"], ego[0]["y"]) == pytest.approx((5.0, -1.75), abs=0.05)
    text = (path.parent / "log.txt").read_text(encoding="utf-8", errors="replace")
    assert (
        "ego_drives standbyState -> startTransition" not in text
        and "car_1_drives standbyState -> startTransition" in text
    )


def test_world_has_the_scenario_and_its_shapes(
    town: Scene, tmp_path: Path, openscenario_schema: xmlschema.XMLSchema
) -> None:
    out = tmp_path / "out"
    world_formats.write(town, ["openscenario"], out, SceneParams(), silent)
    openscenario_schema.validate(str(out / "town.xosc"))
    root = ET.parse(out / "town.xosc").getroot()
    models = {body.get("name"): body.get("model3d") for body in [*root.iter("Vehicle"), *root.iter("Pedestrian")]}
    assert len(models) == 6
    for name, file in models.items():
        mesh = trimesh.load(out / str(file))
        assert mesh.extents[1] > 1.4, name  # y is up
        assert mesh.bounds[0][1] == pytest.approx(0.0, abs=1e-4)
    assert (out / "tracks.geojson").is_file()


def test_gazebo_loads_the_traffic(town: Scene, tmp_path: Path) -> None:
    out = tmp_path / "out"
    world_formats.write(town, ["gazebo"], out, SceneParams(), silent)
    check_world(out / "town.sdf")
    check_world(out / "town_traffic.world")
    actors = {actor.get("name"): actor for actor in ET.parse(out / "town_traffic.world").getroot().iter("actor")}
    assert set(actors) == {"car_1", "van_2", "cyclist_3", "pedestrian_4"}
    points = [
        (float(point.findtext("time", "")), [float(value) for value in point.findtext("pose", "").split()])
        for point in actors["van_2"].iter("waypoint")
    ]
    times = [time for time, _ in points]
    assert times == sorted(times) and times[0] == 0.0 and times[-1] == pytest.approx(5.0, abs=0.1)
    assert all((pose[2] < -100) == (time < 1.0 - 1e-6) for time, pose in points[:-2])  # it appears after one second
    obj: Any = trimesh.load(out / "models" / "van_2" / "meshes" / "van_2.obj", force="mesh")
    assert obj.extents.tolist() == pytest.approx([5.2, 2.0, 2.3], abs=0.01)


def test_a_car_that_two_tiles_saw_drives_on_across_their_border(tmp_path: Path) -> None:
    """The second tile sees it from before the first one loses it, 30 cm to the side; another car is 8 m behind it."""
    scene = synthetic.scene(tmp_path, tiles=2)
    size = (4.2, 1.75, 1.5)
    seen = [
        [traffic.drive(1, "car", size, (0.0, 60.0), -1.75, 0.0, 12.0)],
        [
            traffic.drive(1, "van", size, (48.0, 100.0), -1.45, 4.0, 12.0),
            traffic.drive(2, "car", size, (40.0, 90.0), -1.75, 4.0, 12.0),
        ],
    ]
    for tile, tracks in zip(scene.tiles, seen, strict=True):
        local = [replace(one, poses=one.poses - np.array([*tile.offset, 0.0])) for one in tracks]
        write_tracks(tile.folder / TRACKS_FILE, local, tile.frame)
    scenario = scenario_of(read_scene(tmp_path / "world"))
    first, second = sorted(scenario.actors, key=lambda actor: actor.begin)
    assert (first.begin, first.end) == pytest.approx((0.0, 4.0 + 52 / 12), abs=0.11)
    assert (second.begin, second.end) == pytest.approx((4.0, 4.0 + 50 / 12), abs=0.11)
    x, y = first.track.at([0.0, 4.5, first.end])[:, :2].T
    assert x == pytest.approx([0, 54, 100], abs=1.3) and y[[0, 2]] == pytest.approx([-1.75, -1.45], abs=0.01)
    assert -1.75 < y[1] < -1.45 and not impossible_motions(scenario)


def test_world_without_traffic_has_none(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    world_formats.write(scene, ["gazebo"], tmp_path / "out", SceneParams(), silent)
    assert not list((tmp_path / "out").glob("*_traffic.world"))
    with pytest.raises(DataError, match="no tracks of moving road users"):
        world_formats.write(scene, ["openscenario"], tmp_path / "other", SceneParams(), silent)

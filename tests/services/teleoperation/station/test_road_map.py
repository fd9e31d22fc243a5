"""Map of the driver page: lines of a world's roads in its metres, drawn around the vehicle; none without a position."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
pytest.importorskip("fastapi", reason="the extra bus isn't installed")
pytest.importorskip("websockets", reason="the extra teleop isn't installed")

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Trajectory
from scan2sim.pipeline.io.geodata import geojson
from scan2sim.pipeline.io.worlds.scene import PATH_FILE, Scene
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.station import road_map
from scan2sim.services.teleoperation.station.road_map import ROAD_LINES_FILE, MapLine
from tests.conftest import ROOT
from tests.fakes import synthetic
from tests.fakes.browser import Page, chromium
from tests.services.teleoperation.pages import served

EDGE = np.column_stack([np.arange(0.0, 6.0), np.full(6, 2.0), np.zeros(6)])
"""An edge of a road, world metres."""


@pytest.fixture
def town(tmp_path: Path) -> Scene:
    """Two tiles: one with the lines of a road, one with the path of the recording device only."""
    scene = synthetic.scene(tmp_path, tiles=2)
    lines = [(scene.frame.to_crs(EDGE).tolist(), {"kind": kind}) for kind in ("reference", "edge", "marking")]
    geojson.write_lines(scene.tiles[0].folder / ROAD_LINES_FILE, "local", lines)
    path = np.column_stack([np.linspace(0.0, 8.0, 33), np.full(33, -2.0), np.zeros(33)])
    Trajectory(np.arange(33.0), path).save(scene.tiles[1].folder / PATH_FILE)
    return scene


def world_of(scene: Scene) -> Path:
    return scene.tiles[0].folder.parents[1]


def test_lines_of_roads_and_paths_are_in_metres_of_the_world(town: Scene) -> None:
    edge, marking, path = road_map.read(world_of(town))
    assert (edge.kind, marking.kind, path.kind) == ("edge", "marking", "path")
    assert edge.points == marking.points == ((0.0, 2.0), (2.0, 2.0), (4.0, 2.0), (5.0, 2.0))
    x, y, _ = town.tiles[1].offset
    assert path.points[0] == pytest.approx((x, y - 2)) and path.points[-1] == pytest.approx((x + 8, y - 2))


def test_world_without_roads_has_no_map_and_a_damaged_list_is_reported(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    assert road_map.read(world_of(scene)) == ()
    with pytest.raises(InputError):
        road_map.read(tmp_path / "nothing")
    nowhere = '{"features": [{"properties": {"kind": "edge"}, "geometry": {"coordinates": [[NaN, 0, 0], [1, 0, 0]]}}]}'
    for text in ("", "[]", '{"features": [1]}', nowhere):
        (scene.tiles[0].folder / ROAD_LINES_FILE).write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match="not a list of road lines"):
            road_map.read(world_of(scene))


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium(tmp_path_factory.mktemp("map")) as page:
        yield page


@pytest.fixture(scope="module")
def blank(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A blank page with the map's functions."""
    with chromium(tmp_path_factory.mktemp("blank")) as page:
        page.value((ROOT / "services" / "pages" / "map.js").read_text(encoding="utf-8") + "\n0")
        yield page


def test_direction_of_the_vehicle_is_up(blank: Page) -> None:
    def pixel(ahead: float, left: float, heading: float | None) -> list[float]:
        """Where a point is drawn that lies ahead and to the left of a vehicle at (100, 50) on a map of 120 pixels."""
        angle = math.pi / 2 if heading is None else heading
        x = 100 + ahead * math.cos(angle) - left * math.sin(angle)
        y = 50 + ahead * math.sin(angle) + left * math.cos(angle)
        place = json.dumps({"position": [100, 50], "heading": heading})
        return [float(value) for value in blank.value(f"mapPixel([{x}, {y}], {place}, 120, 120)")]

    for heading in (None, 0.0, 1.0, -2.5):
        assert pixel(0, 0, heading) == pytest.approx([60, 84])
        assert pixel(30, 0, heading) == pytest.approx([60, 54])
        assert pixel(0, 10, heading) == pytest.approx([50, 84])


def test_page_shows_the_map_and_covers_it_without_a_position(browser: Page, tmp_path: Path) -> None:
    lines = (MapLine("edge", ((0.0, -50.0), (0.0, 50.0))),)
    ground = "[...byId('map').getContext('2d').getImageData(10, 10, 1, 1).data]"
    with served(tmp_path, ServerParams(port=0), map_lines=lines) as cockpit:
        cockpit.street.fleet.join("car", "desk", "operator")
        browser.do("Page.navigate", url=cockpit.url)
        browser.until("document.querySelector('figure')?.dataset.shown > 3 && !byId('map').hidden")
        browser.until("byId('map').dataset.place === 'null'")  # this vehicle doesn't report its position
        assert browser.value(ground) == [0, 0, 0, 255]
        browser.value("fresh = freshVehicle; freshVehicle = () => ({position: [0, 0], heading: Math.PI / 2}); 0")
        browser.until("byId('map').dataset.place.includes('[0,0]')")
        edge, beside = (f"[...byId('map').getContext('2d').getImageData({x}, 200, 1, 1).data]" for x in (240, 200))
        assert browser.value(edge) != browser.value(beside) == browser.value(ground) != [0, 0, 0, 255]
        browser.value("freshVehicle = () => undefined; 0")
        browser.until("byId('map').dataset.place === 'null'")
        assert browser.value(ground) == [0, 0, 0, 255]
        browser.do("Page.navigate", url="about:blank")
        assert not browser.errors


def test_page_without_a_world_has_no_map(browser: Page, tmp_path: Path) -> None:
    with served(tmp_path, ServerParams(port=0)) as cockpit:
        browser.do("Page.navigate", url=cockpit.url)
        browser.until("typeof mapLines !== 'undefined' && mapLines?.length === 0")
        assert browser.value("byId('map').hidden")
        browser.do("Page.navigate", url="about:blank")

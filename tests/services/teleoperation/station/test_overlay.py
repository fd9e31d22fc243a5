"""The predicted path: where a vehicle drives from the picture on, and where that is in the picture."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from scan2sim.services.teleoperation.cameras import Mount
from scan2sim.services.teleoperation.control.controls import Controls, Gear
from scan2sim.services.teleoperation.sim.bicycle import STEP_MAX_S, Bicycle, Car
from tests.conftest import ROOT
from tests.fakes.browser import Page, chromium


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A blank page with the overlay's functions."""
    with chromium(tmp_path_factory.mktemp("overlay")) as page:
        scripts = [
            (ROOT / "services" / "pages" / name).read_text(encoding="utf-8") for name in ("ages.js", "overlay.js")
        ]
        page.value("\n".join(scripts) + "\n0")
        yield page


def poses(page: Page, speed: float, steering: float, history: str, latency: float) -> np.ndarray:
    overlay = f"{{speed: {speed}, steering: {steering}, history: {history}, path: {{...PATH, angle: 34.4}}, at: 10000}}"
    return np.array(page.value(f"predictedPath({overlay}, {latency})"))


def test_path_is_that_of_the_simulated_car(page: Page) -> None:
    """Steering was straight until 200 ms ago and is half left since; the picture is 400 ms old."""
    car = Bicycle(Car(steering_rate=1e9, acceleration=0, rolling=0), speed=5.0, gear=Gear.FORWARD)
    driven = [(0.0, 0.0)]
    for step in range(round(2.5 / STEP_MAX_S)):
        steering = 0.0 if step * STEP_MAX_S < 0.2 - 1e-9 else 0.5
        car.step(Controls(steering, gear=Gear.FORWARD), STEP_MAX_S)
        driven.append((car.x, car.y))
    found = poses(page, 5.0, 0.5, "[[9000, 0], [9800, 0.5]]", 400)
    assert found[0].tolist() == [0, 0, 0] and len(found) > 50
    for x, y, _ in found[found[:, 0] < 9]:
        assert np.hypot(*(np.array(driven) - (x, y)).T).min() < 0.15


def test_standing_vehicle_shows_the_present_steering_and_reverse_goes_back(page: Page) -> None:
    straight, left = poses(page, 0, 0, "[]", 100), poses(page, 0, 1, "[]", 100)
    assert straight[-1, 0] == pytest.approx(6) and straight[-1, 1] == 0 and left[-1, 1] > 2
    assert (poses(page, -2, 0, "[]", 100)[1:, 0] < 0).all()


def test_points_are_projected_as_by_the_simulated_camera(page: Page) -> None:
    world, focal = np.linalg.inv(Mount().pose()), 320 / math.tan(math.radians(Mount().field / 2))
    for x, y in ((4, 0), (10, 1.5), (30, -5)):
        point = world @ (x, y, 0, 1)
        pixel = page.value(f"project([{x}, {y}], PATH, 640, 480)")
        assert pixel == pytest.approx([320 + focal * point[0] / point[2], 240 + focal * point[1] / point[2]], abs=0.5)
    assert page.value("project([-3, 0], PATH, 640, 480)") is None

"""Low-poly plants at the listed positions, with size and colour of the scanned ones; trees have solid trunks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.data_samples.make_plants import make
from scan2sim.pipeline.camera import renderer
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.geometry.cylinders import Cylinder
from scan2sim.pipeline.io.worlds import textured_mesh
from scan2sim.pipeline.io.worlds.scene import by_class
from scan2sim.pipeline.simulation.collision_shapes import solids
from scan2sim.pipeline.terrain import low_poly_plants

PLACES = np.array([(0.0, 0.0, 1.0), (9.0, 2.0, 1.5)])
HEIGHT, RADIUS = np.array([8.0, 1.2]), np.array([2.5, 0.8])
COLOUR = np.array([(60, 110, 40), (170, 120, 60)], np.uint8)


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plants")
    low_poly_plants.plant(PLACES, HEIGHT, RADIUS, COLOUR, Frame(), folder)
    return folder


def test_each_plant_has_its_position_size_and_colour(planted: Path) -> None:
    shape = textured_mesh.read(planted)
    assert shape is not None and len(shape) < 400
    seen = renderer.Renderer([renderer.textured(planted)]).above((-4, -4, 0), (12, 6, 10), width=320)
    for place, height, radius, colour in zip(PLACES, HEIGHT, RADIUS, COLOUR, strict=True):
        own = shape.mesh.vertices[np.linalg.norm(shape.mesh.vertices[:, :2] - place[:2], axis=1) < 4]
        assert own[:, 2].max() == pytest.approx(place[2] + height, abs=0.01)
        assert np.linalg.norm(own[:, :2] - place[:2], axis=1).max() == pytest.approx(radius, rel=0.01)
        column, row = int((place[0] + 4) * 20), int((6 - place[1]) * 20)
        near = seen.rgb[row - 6 : row + 6, column - 6 : column + 6].reshape(-1, 3).astype(float)
        assert (np.abs(near.mean(axis=0) / near.mean() - colour / colour.mean()) < 0.15).all()


def test_only_trees_have_solid_trunks(planted: Path) -> None:
    shape = textured_mesh.read(planted)
    assert shape is not None
    names = [surface.name for surface in by_class("vegetation", shape)]
    assert names == ["vegetation", "vegetation_high_vegetation"]
    ((name, trunk),) = [(one.name, one.shape) for one in solids(shape.mesh, 0.9) if isinstance(one.shape, Cylinder)]
    assert name == "trunk_1" and trunk.radius == pytest.approx(low_poly_plants.TRUNK_RADIUS_FRACTION * 8, rel=0.05)
    assert trunk.centre[:2] == pytest.approx((0, 0), abs=0.01) and trunk.length > 4


def test_no_plants_give_an_empty_mesh(tmp_path: Path) -> None:
    low_poly_plants.plant(np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros((0, 3), np.uint8), Frame(), tmp_path)
    assert textured_mesh.read(tmp_path) is None


def test_stored_models_equal_those_of_the_generator(tmp_path: Path) -> None:
    with np.load(make(tmp_path / "plants.npz")) as made, np.load(low_poly_plants.MODELS) as kept:
        assert made.files == kept.files
        for name in made.files:
            np.testing.assert_allclose(made[name], kept[name], atol=1e-4)

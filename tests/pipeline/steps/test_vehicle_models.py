"""Models of parked vehicles: complete, with their position and colour."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.camera import renderer
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.io.worlds import textured_mesh
from scan2sim.pipeline.steps.vehicle_models import VehicleModelsParams, vehicle_models
from scan2sim.pipeline.tracking.tracks import write_tracks
from tests.fakes import synthetic, traffic


def made(tmp_path: Path, **params: object) -> tuple[Path, Mesh]:
    """Models of the parked car of the known traffic and of a red van parked across the road, 8 m north of it."""
    parked = traffic.tracks()[-1]
    van = replace(
        parked, id=7, category="van", size=(5.0, 2.0, 2.2), colour=(200, 20, 20),
        poses=np.array([[60.0, 3.0, traffic.HEIGHT_M, np.pi / 2]]),
    )  # fmt: skip
    write_tracks(tmp_path / "tracks.json", [*traffic.tracks(), van], synthetic.UTM)
    done = vehicle_models(
        {"tracks": tmp_path / "tracks.json"}, VehicleModelsParams.model_validate(params), tmp_path, silent
    )
    return done.files["textured"], Mesh.load(done.files["mesh"])


def test_each_parked_vehicle_is_complete_at_its_position(tmp_path: Path) -> None:
    folder, mesh = made(tmp_path)
    car, van = mesh.keep(mesh.corners[:, :, 1].mean(axis=1) < -2), mesh.keep(mesh.corners[:, :, 1].mean(axis=1) > -2)
    for one, size, middle in ((car, (4.4, 1.8, 1.5), (60.0, -5.0)), (van, (2.0, 5.0, 2.2), (60.0, 3.0))):
        low, high = one.corners.reshape(-1, 3).min(axis=0), one.corners.reshape(-1, 3).max(axis=0)
        assert (high - low).tolist() == pytest.approx(size, abs=0.01)
        assert ((high + low) / 2)[:2].tolist() == pytest.approx(middle, abs=0.01)
        assert low[2] == pytest.approx(traffic.HEIGHT_M, abs=1e-3)
        assert one.classification is not None and set(one.classification.tolist()) == {CODE["vehicle"]}
    assert textured_mesh.read(folder) is not None


def test_colours_are_those_of_the_tracks(tmp_path: Path) -> None:
    folder, _ = made(tmp_path)
    pose = renderer.look_at(
        np.array((52.0, 2.0, traffic.HEIGHT_M + 1.0)), np.array((60.0, 2.0, traffic.HEIGHT_M + 0.6))
    )
    picture = renderer.Renderer([renderer.textured(folder)]).view(renderer.pinhole(200, 120), pose)
    colours, counts = np.unique(picture.rgb[picture.hit], axis=0, return_counts=True)
    red, green, blue = colours[counts.argmax()].astype(int)
    assert 140 <= red <= 200 and max(green, blue) <= 20


def test_vehicles_of_neighbouring_tiles_are_omitted(tmp_path: Path) -> None:
    x, y, _ = synthetic.UTM.origin
    cell = TileCell(name="here", seed=(x + 60.0, y + 10.0), neighbours={"there": (x + 60.0, y - 10.0)})
    _, mesh = made(tmp_path, context=cell)
    assert len(mesh) and mesh.corners[:, :, 1].min() > 0


def test_tracks_without_parked_vehicles_give_an_empty_mesh(tmp_path: Path) -> None:
    write_tracks(tmp_path / "tracks.json", traffic.tracks()[:-1], synthetic.UTM)
    done = vehicle_models({"tracks": tmp_path / "tracks.json"}, VehicleModelsParams(), tmp_path, silent)
    assert len(Mesh.load(done.files["mesh"])) == 0
    assert textured_mesh.read(done.files["textured"]) is None

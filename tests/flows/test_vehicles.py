"""Parked vehicles: removed by default, or a surface of their own; moving ones are always removed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from scan2sim.data_samples.layout import FRAME, lay_out
from scan2sim.data_samples.scene import build
from scan2sim.data_samples.street import generate
from scan2sim.flows.cli import app
from scan2sim.flows.pipelines.graph import Task
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Frame, Mesh, PointCloud
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.split import SPLIT, SplitParams
from tests.conftest import ROOT

KEEP = Settings({"split": {"vehicles": "keep"}})
STREET = ROOT / "data_samples" / "tile"


def test_vehicle_tasks_exist_only_if_vehicles_are_kept() -> None:
    tile = read_tile(STREET)
    plain, kept = ({task.full_name: task for task in build_graph(tile, s)} for s in (Settings(), KEEP))
    assert not any(label.endswith(".vehicle") for label in plain)
    assert {"voxel.vehicle", "poisson.vehicle", "decimate.vehicle", "texture.vehicle"} <= kept.keys()
    assert "vehicle" in kept["export"].inputs and "vehicle" in kept["collision"].inputs
    assert kept["decimate.vehicle"].params.target == 50_000  # type: ignore[attr-defined]
    airborne = {task.full_name for task in build_graph(replace(tile, views=(), trajectory=None), KEEP)}
    assert not any(label.endswith(".vehicle") for label in airborne)


def test_parked_vehicles_that_only_splats_show_are_solid() -> None:
    tile = read_tile(STREET)

    def tasks(vehicles: dict[str, str], splats: dict[str, object]) -> dict[str, Task]:
        settings = Settings({"split": vehicles, "splats": splats})
        return {task.full_name: task for task in build_graph(tile, settings)}

    def solid(vehicles: dict[str, str], **splats: object) -> bool:
        return "instances" in tasks(vehicles, splats)["collision"].inputs

    assert solid({}, when="auto")
    assert not solid({}, when="never") and not solid({}, when="auto", parked=False)
    assert not solid({"vehicles": "keep"}, when="auto")  # they have a surface
    removed = {"vehicles": "remove"}
    assert not solid(removed, when="auto") and solid(removed, when="auto", parked=True)
    assert not tasks(removed, {"when": "auto"})["splats"].params.parked  # type: ignore[attr-defined]


def test_parked_vehicles_are_kept_and_moving_ones_removed(tmp_path: Path) -> None:
    frame = Frame("EPSG:32633", (500_000.0, 5_400_000.0, 200.0))
    random = np.random.default_rng(0)
    positions = {"parked": (0.0, 0.0), "moved": (10.0, 0.0), "alone": (20.0, 0.0)}
    body = random.uniform((-2.2, -0.9, 0.2), (2.2, 0.9, 1.5), (500, 3))
    road = np.column_stack([random.uniform(-5, 25, (500, 2)), np.zeros(500)])
    xyz = np.concatenate([road, *(body + (*xy, 0.0) for xy in positions.values())]).astype(np.float32)
    classification = np.repeat([CODE["road"], CODE["vehicle"]], [500, 1500]).astype(np.uint8)
    PointCloud(frame, xyz, classification=classification).save(tmp_path / "cloud.npz")
    features = [
        {
            "geometry": {
                "coordinates": [
                    (frame.to_crs(np.array([[x + u, y + v, 0] for u, v in ring]))[:, :2]).tolist()
                    for ring in [[(2.2, 0.9), (-2.2, 0.9), (-2.2, -0.9), (2.2, -0.9), (2.2, 0.9)]]
                ]
            },
            "properties": {"kind": "car", "moved": name == "moved", "ground_z": 200.0, "height_m": 1.5},
        }
        for name, (x, y) in positions.items()
        if name != "alone"  # classified as vehicle, but without a detected instance
    ]
    (tmp_path / "instances.geojson").write_text(json.dumps({"features": features}), encoding="utf-8")
    inputs = {"cloud": tmp_path / "cloud.npz", "instances": tmp_path / "instances.geojson"}
    (tmp_path / "out").mkdir()
    done = SPLIT.run(inputs, SplitParams(vehicles="keep"), tmp_path / "out", silent)
    kept = PointCloud.load(done.files["vehicle"]).xyz
    assert len(kept) == 500 and np.abs(kept[:, 0]).max() < 2.3
    assert done.metrics["points"]["rest"] == 1000


@pytest.mark.slow
def test_world_with_parked_cars(tmp_path: Path) -> None:
    """Both worlds of a street: with the cars' surface, textured and in every format, or without any."""
    tile = generate(tmp_path / "tile", length=20, points=400_000, photos=16, seed=3, photo_width=640).parent
    layout = lay_out(20, 3, None)
    parked = build(layout)[1]
    assert layout.parked
    for name in ("remove", "keep"):
        out = tmp_path / name
        result = CliRunner().invoke(app, ["run", str(tile), "--out", str(out), "--set", f"split.vehicles={name}"])
        assert result.exit_code == 0, result.output
    assert not list((tmp_path / "remove").rglob("vehicle.*"))
    (meshes,) = (file.parent for file in (tmp_path / "keep" / "world" / "models").rglob("vehicle.obj"))
    assert {"vehicle.obj", "vehicle.dae", "vehicle.mtl"} <= {f.name for f in meshes.iterdir()}
    assert list(meshes.glob("*_vehicle_0.png"))
    assert "vehicle.obj" in (meshes.parent / "model.sdf").read_text(encoding="utf-8")
    report = json.loads((tmp_path / "keep" / "report.json").read_text(encoding="utf-8"))
    assert 0 < report["geometry"]["triangles"]["vehicle"] <= 50_000
    assert report["texture"]["coverage_by_class"]["vehicle"] > 0.3
    made = Mesh.load(next((tmp_path / "keep" / "steps" / "decimate.vehicle").rglob("mesh.npz")))
    low, high = parked.vertices.min(axis=0)[:2] - 0.5, parked.vertices.max(axis=0)[:2] + 0.5
    positions = made.moved_to(FRAME).vertices[:, :2]
    assert ((positions > low) & (positions < high)).all(), "the moving car is removed"

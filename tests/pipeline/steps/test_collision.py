"""Collision meshes: triangle limit, deviation from the visual surface, solid classes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
import trimesh

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import Mesh, PointCloud
from scan2sim.pipeline.geometry.fitted_boxes import Box, mesh_of
from scan2sim.pipeline.steps.collision import COLLISION, CollisionParams
from tests.fakes import synthetic
from tests.fakes.steps import step_params

NONE = Mesh(synthetic.UTM, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))


def _run(
    folder: Path, meshes: dict[str, Mesh], also: Mapping[str, Path] = MappingProxyType({}), **params: object
) -> tuple[Mesh, Done]:
    inputs = dict(also)
    for group, mesh in meshes.items():
        inputs[group] = folder / f"{group}.npz"
        mesh.save(inputs[group])
    done = COLLISION.run(inputs, step_params(CollisionParams, **params), folder, silent)
    return Mesh.load(done.files["mesh"]), done


def test_triangle_limit_is_met_and_deviation_reported(tmp_path: Path) -> None:
    ground = synthetic.ground(100)
    mesh, done = _run(tmp_path, {"terrain": ground, "building": synthetic.house()}, triangles=1000)
    assert len(mesh) <= 1000 and mesh.uv is None and mesh.frame == synthetic.UTM
    deviation = done.metrics["deviation_m"]
    assert 0 < deviation["mean"] <= deviation["p95"] <= deviation["max"] < 0.05
    # the reported deviation agrees with the formula of the surface
    gap = np.abs(mesh.vertices[:, 2] - synthetic.height(mesh.vertices[:, 0], mesh.vertices[:, 1]))
    on_ground = (mesh.vertices[:, 2] < 0.4) & ~_in_house(mesh.vertices)
    assert np.percentile(gap[on_ground], 95) < 0.03


def test_collision_mesh_of_the_house_keeps_its_height(tmp_path: Path) -> None:
    mesh, _ = _run(tmp_path, {"terrain": synthetic.ground(100), "building": synthetic.house()}, triangles=500)
    inside = _in_house(mesh.vertices)
    assert mesh.vertices[inside, 2].max() == pytest.approx(4.5, abs=0.01)


def test_modelled_boxes_are_not_simplified(tmp_path: Path) -> None:
    """Simplification would change the shape of small furniture in occupancy maps and simulators."""
    made = [Box(0.3 * i, np.array([i, 0, 0.0]), np.array([i + 0.2, 0.2, 0.3])) for i in range(40)]
    vertices, faces = mesh_of(made)
    furniture = Mesh(synthetic.UTM, vertices, faces)
    mesh, _ = _run(tmp_path, {"terrain": synthetic.ground(10), "furniture": furniture})
    assert np.count_nonzero(mesh.classification == CODE["furniture"]) == len(furniture)


@pytest.mark.parametrize("clockwise", [False, True])
def test_parked_vehicles_are_boxes(clockwise: bool, tmp_path: Path) -> None:
    """Those of `instances`, with 4.5 x 2 x 1.5 m; not what moved, and not people."""
    ring = synthetic.UTM.to_crs(np.array([[0, 0, 1], [4.5, 0, 1], [4.5, 2, 1], [0, 2, 1], [0, 0, 1]], float))
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": [ring[:: -1 if clockwise else 1, :2].tolist()]},
            "properties": {"kind": kind, "moved": moved, "height_m": 1.5, "ground_z": ring[0, 2]},
        }
        for kind, moved in (("car", False), ("car", True), ("person", False))
    ]
    (tmp_path / "instances.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    mesh, done = _run(tmp_path, {"terrain": synthetic.ground(10)}, also={"instances": tmp_path / "instances.geojson"})
    box = mesh.keep(np.asarray(mesh.classification) == CODE["vehicle"])
    solid = trimesh.Trimesh(box.vertices, box.faces)
    assert solid.is_watertight and solid.volume == pytest.approx(4.5 * 2 * 1.5, rel=1e-3)
    np.testing.assert_allclose(np.asarray(solid.bounds), [[0.0, 0.0, 1.0], [4.5, 2.0, 2.5]], atol=0.01)
    assert done.metrics["deviation_m"]["max"] < 0.1


def test_fragmented_surface_meets_the_triangle_limit(tmp_path: Path) -> None:
    ground = synthetic.ground(40)
    patches = ground.keep(np.arange(len(ground)) % 3 == 0)  # nearly all of its edges are open
    mesh, done = _run(tmp_path, {"terrain": patches}, triangles=300)
    assert 100 < len(mesh) <= 300 and not done.warnings


def test_plants_are_solid_only_on_request(tmp_path: Path) -> None:
    meshes = {"terrain": synthetic.ground(10), "vegetation": synthetic.house()}
    assert _run(tmp_path, meshes)[0].vertices[:, 2].max() < 1
    assert _run(tmp_path, meshes, vegetation=True)[0].vertices[:, 2].max() > 4


def test_plants_are_solid_without_other_surfaces(tmp_path: Path) -> None:
    mesh, done = _run(tmp_path, {"terrain": NONE, "building": NONE, "vegetation": synthetic.house()})
    assert mesh.vertices[:, 2].max() > 4 and "plants are solid" in done.warnings[0]
    assert mesh.classification is not None and set(mesh.classification.tolist()) == {CODE["high_vegetation"]}


def test_world_without_solid_surfaces_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="terrain, building and vegetation are empty"):
        _run(tmp_path, {"terrain": NONE, "vegetation": NONE})


def test_ground_points_without_a_surface_are_accepted(tmp_path: Path) -> None:
    few = synthetic.ground(3).vertices
    PointCloud(synthetic.UTM, few, classification=np.full(len(few), CODE["road"], np.uint8)).save(
        tmp_path / "cloud.npz"
    )
    inputs = {"terrain": tmp_path / "terrain.npz", "building": tmp_path / "building.npz"}
    NONE.save(inputs["terrain"])
    synthetic.house().save(inputs["building"])
    done = COLLISION.run({**inputs, "cloud": tmp_path / "cloud.npz"}, CollisionParams(), tmp_path, silent)
    assert done.metrics["ground_triangles"] == 0 and done.metrics["ground_m2"] == {} and done.metrics["triangles"] > 0


def _in_house(xyz: np.ndarray) -> np.ndarray:
    x, y = synthetic.HOUSE
    return (abs(xyz[:, 0] - x - 1.5) <= 1.501) & (abs(xyz[:, 1] - y - 1) <= 1.001)

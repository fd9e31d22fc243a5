"""Foliage: leaf cards as transparent to rays as the plant, closed surfaces of dense plants and for collision."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d

from scan2sim.flows.pipelines.graph import Output, TaskId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F64, Bools, Frame, Mesh, PointCloud, Trajectory
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.lidar.cell_rays import Cells, trace
from scan2sim.pipeline.steps.foliage import FOLIAGE
from tests.fakes.steps import step_params

SAMPLE = Path(__file__).parents[3] / "data_samples" / "tile"
LOW, HIGH = np.array([7.0, -2.0, 0.5]), np.array([9.0, 2.0, 3.0])
"""Corners of the box that is filled with leaves."""
WALL_X_M = 14.0


def squares(centre: F64, normal: F64, side: float) -> Mesh:
    """Squares with these centres and normals (N, 3)."""
    across = np.cross(normal, [0.3, 0.5, 0.8])
    across *= side / 2 / np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(normal, across)
    corners = np.stack([centre - across - up, centre + across - up, centre + across + up, centre - across + up], axis=1)
    first = 4 * np.arange(len(centre))[:, None]
    faces = np.concatenate([first + (0, 1, 2), first + (0, 2, 3)])
    return Mesh(Frame(), corners.reshape(-1, 3).astype(np.float32), faces.astype(np.int32))


def crown(leaves: int, seed: int = 0) -> Mesh:
    """Leaves of 8 cm, in random directions, evenly in the box."""
    random = np.random.default_rng(seed)
    normal = random.normal(size=(leaves, 3))
    return squares(random.uniform(LOW, HIGH, (leaves, 3)), normal / np.linalg.norm(normal, axis=1, keepdims=True), 0.08)


def box_surface() -> Mesh:
    """The box's closed surface, of small triangles."""
    box = o3d.geometry.TriangleMesh.create_box(*(HIGH - LOW)).translate(LOW).subdivide_midpoint(4)
    return Mesh(Frame(), np.asarray(box.vertices, np.float32), np.asarray(box.triangles, np.int32))


def cast(mesh: Mesh, start: F64, end: F64) -> F64:
    """Distance (N,) of the mesh along rays from `start` to `end` (N, 3), inf without a hit."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices, mesh.faces.astype(np.uint32))
    way = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    return scene.cast_rays(np.concatenate([start, way], axis=1).astype(np.float32))["t_hit"].numpy().astype(float)


def rays(seed: int, count: int = 60_000) -> tuple[F64, F64, F64]:
    """Starts on a path that passes the box, ends on the wall behind its middle (N, 3), and times (N,)."""
    random = np.random.default_rng(seed)
    time = np.sort(random.uniform(0, 4, count))
    start = np.stack([0 * time, 2 * time - 4, 0 * time + 1.8], axis=1)
    through = random.uniform(LOW + 0.3, HIGH - 0.3, (count, 3))
    return start, start + (through - start) * (WALL_X_M - start[:, :1]) / (through - start)[:, :1], time


def scan(folder: Path, leaves: Mesh, closed: Mesh) -> dict[str, Path]:
    """Inputs of the step: a cloud of first hits of leaves and wall."""
    start, end, time = rays(seed=1)
    distance, length = cast(leaves, start, end), np.linalg.norm(end - start, axis=1)
    on_leaf = distance < length
    xyz = start + (end - start) * (np.minimum(distance, length) / length)[:, None]
    codes = np.where(on_leaf, CODE["high_vegetation"], CODE["building"]).astype(np.uint8)
    closed.save(folder / "mesh.npz")
    PointCloud(Frame(), xyz.astype(np.float32), classification=codes, time=time).save(folder / "cloud.npz")
    at = np.linspace(0, 4, 41)
    Trajectory(at, np.stack([0 * at, 2 * at - 4, 0 * at + 1.8], axis=1)).save(folder / "path.npz")
    return {name: folder / f"{name}.npz" for name in ("mesh", "cloud", "path")}


def run(inputs: dict[str, Path], **given: Any) -> tuple[Mesh, Done]:
    out = inputs["mesh"].parent / f"out{len(list(inputs['mesh'].parent.iterdir()))}"
    out.mkdir()
    done = FOLIAGE.run(inputs, step_params(FOLIAGE.params, **given), out, silent)
    return Mesh.load(done.files["mesh"]), done


def stopped(mesh: Mesh) -> Bools:
    """(N,) whether rays that were not scanned end in a mesh."""
    start, end, _ = rays(seed=2, count=20_000)
    return cast(mesh, start, end) < np.linalg.norm(end - start, axis=1)


def test_cards_are_as_transparent_to_rays_as_the_crown(tmp_path: Path) -> None:
    for leaves in (400, 1_600):
        (tmp_path / str(leaves)).mkdir()
        true = crown(leaves)
        made, done = run(scan(tmp_path / str(leaves), true, box_surface()))
        assert stopped(box_surface()).all(), "the closed surface stops every ray"
        assert abs(stopped(made).mean() - stopped(true).mean()) < 0.1
        assert done.metrics["cards"] > 0 and done.metrics["removed"] > 0
        assert len(made) <= done.metrics["faces_in"] + 80_000
        agree = stopped(made) == stopped(true)
        chance = stopped(true).mean() ** 2 + (1 - stopped(true).mean()) ** 2
        assert agree.mean() > chance + 0.1, "cards are where the leaves are"


def test_hedge_without_passing_rays_stays_closed(tmp_path: Path) -> None:
    made, done = run(scan(tmp_path, box_surface(), box_surface()))
    assert done.metrics["removed"] == done.metrics["cards"] == 0
    np.testing.assert_array_equal(made.corners, box_surface().corners)


def test_modelled_trunks_are_kept_and_get_no_cards(tmp_path: Path) -> None:
    trunk = squares(np.array([[8.0, 0.0, 1.5]]), np.array([[1.0, 0.0, 0.0]]), 0.6)
    closed = Mesh(
        Frame(),
        np.concatenate([box_surface().vertices, trunk.vertices]),
        np.concatenate([box_surface().faces, trunk.faces + len(box_surface().vertices)]).astype(np.int32),
        classification=np.repeat([0, CODE["pole"]], [len(box_surface()), 2]).astype(np.uint8),
    )
    made, _ = run(scan(tmp_path, crown(400), closed))
    assert made.classification is not None and (made.classification > 0).sum() == 2
    cards = made.keep(made.classification == 0)
    near = np.abs(cards.corners.mean(axis=1) - [8.0, 0.0, 1.5]).max(axis=1) < 0.05
    assert not near.any()


def test_no_card_crosses_a_tile_border_where_the_surface_stays_closed(tmp_path: Path) -> None:
    inputs = scan(tmp_path, crown(400), box_surface())
    # the border lies at y = 0.5, the neighbour beyond it
    made, _ = run(inputs, seed=(0.0, -9.5), neighbours={"next": (0.0, 10.5)})
    middle = box_surface().corners.mean(axis=1)[:, 1]
    kept = {tuple(corners) for corners in made.corners.reshape(-1, 9).tolist()}
    closed = {tuple(corners) for corners in box_surface().corners[middle > -0.5].reshape(-1, 9).tolist()}
    assert closed <= kept, "within 1 m of the border, and beyond it"
    every = {tuple(corners) for corners in box_surface().corners.reshape(-1, 9).tolist()}
    cards = np.array(sorted(kept - every)).reshape(-1, 3)
    assert len(cards) and (cards[:, 1] < 0.0).all()


def test_surface_stays_closed_without_times_or_path_with_a_reason(tmp_path: Path) -> None:
    inputs = scan(tmp_path, crown(400), box_surface())
    made, done = run({name: path for name, path in inputs.items() if name != "path"})
    assert len(made) == len(box_surface()) and "no trajectory" in done.warnings[0]
    replace(PointCloud.load(inputs["cloud"]), time=None).save(inputs["cloud"])
    made, done = run(inputs)
    assert len(made) == len(box_surface()) and "no times" in done.metrics["reason"] and "no times" in done.warnings[0]


def test_ray_cells_equal_those_of_dense_sampling() -> None:
    random = np.random.default_rng(0)
    cells = Cells.of(random.uniform(-2, 2, (300, 3)), 0.25)
    start, end = random.uniform(-4, 4, (200, 3)), random.uniform(-4, 4, (200, 3))
    first, ray = trace(cells, start, end)
    found = {(int(c), int(r)) for c in range(len(cells)) for r in ray[first[c] : first[c + 1]]}
    along = np.linspace(0, 1, 4001)[:, None, None]
    at = np.floor((start + along * (end - start)) / 0.25).astype(np.int64)
    number = {tuple(index): c for c, index in enumerate(cells.index.tolist())}
    sampled = {
        (number[tuple(index)], r) for step in at.tolist() for r, index in enumerate(step) if tuple(index) in number
    }
    assert sampled <= found and len(found - sampled) < 0.02 * len(found), "corners may be missed by the samples"


def test_only_collision_uses_the_closed_surface() -> None:
    tile = replace(read_tile(SAMPLE), trajectory=None)
    tasks = {task.id.name: task for task in build_graph(tile, Settings({"foliage": {"when": "auto"}}))}
    cards = Output(TaskId("foliage"), "mesh")
    assert tasks["collision"].inputs["vegetation"] != cards
    assert tasks["foliage"].inputs["mesh"] == tasks["collision"].inputs["vegetation"]
    assert tasks["view_selection.vegetation"].inputs["mesh"] == cards
    assert tasks["visibility"].inputs["mesh.vegetation"] == cards
    assert "foliage" not in {task.step.name for task in build_graph(tile, Settings({"foliage": {"when": "never"}}))}


def test_step_reports_its_reason_for_tiles_without_photos_and_trajectory() -> None:
    tile = replace(read_tile(SAMPLE), trajectory=None, views=())
    tasks = {task.id.name: task for task in build_graph(tile, Settings({"foliage": {"when": "auto"}}))}
    cloud = tasks["foliage"].inputs["cloud"]
    assert isinstance(cloud, Output) and cloud.task.name in tasks and "path" not in tasks["foliage"].inputs

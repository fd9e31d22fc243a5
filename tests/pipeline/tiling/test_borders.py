"""Borders of tiles: meshes made separately are joined to share their border vertices exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE, GROUPS, group_of
from scan2sim.pipeline.core.step import Done, Step, silent
from scan2sim.pipeline.core.types import Frame, Mesh, PointCloud
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.pipeline.decimation import simplify
from scan2sim.pipeline.geometry.boundary_curve import curve
from scan2sim.pipeline.geometry.coordinate_grid import GRID_M, world
from scan2sim.pipeline.geometry.voxel_grid import sample
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.steps.clip import CLIP
from scan2sim.pipeline.steps.collision import COLLISION
from scan2sim.pipeline.steps.decimate import DECIMATE
from scan2sim.pipeline.steps.geometry import GEOMETRY
from scan2sim.pipeline.steps.islands import ISLANDS
from scan2sim.pipeline.steps.join import JOIN
from scan2sim.pipeline.steps.overlap import OVERLAP
from scan2sim.pipeline.steps.plants import PLANTS
from scan2sim.pipeline.steps.poisson import POISSON
from scan2sim.pipeline.steps.trim import TRIM
from scan2sim.pipeline.steps.voxel import VOXEL
from scan2sim.pipeline.tiling.borders.clip import Clipped, clip
from scan2sim.pipeline.tiling.borders.gap import Gap, gap
from scan2sim.pipeline.tiling.borders.join import join
from scan2sim.pipeline.tiling.borders.open_edges import on_border, pulled_inside
from tests.conftest import ROOT
from tests.fakes.steps import step_params
from tests.present import present

X, Y, Z = 500_000.0, 5_400_000.0, 200.0  # centre of the synthetic scenes
WEST = Frame("EPSG:32633", (X - 12, Y + 1, Z))
EAST = Frame("EPSG:32633", (X + 9, Y - 3, Z + 2))
SEEDS = {"east": (X + 5.0, Y + 2.0), "west": (X - 5.0, Y - 2.0)}  # an oblique border; "east" owns it


def cells(seeds: Mapping[str, tuple[float, float]]) -> dict[str, Cell]:
    """Voronoi cells, each a neighbour of all others."""
    return {name: Cell(seeds[name], {k: v for k, v in seeds.items() if k != name}) for name in seeds}


def sheet(u: np.ndarray, v: np.ndarray, place: Any, hole: Any = None) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a surface `place(u, v)` over two rows of parameters, without the cells in a `hole`."""
    a, b = np.meshgrid(u, v, indexing="ij")
    vertices = np.stack(np.broadcast_arrays(*place(a, b)), axis=2).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(len(u) - 1), np.arange(len(v) - 1), indexing="ij")
    if hole is not None:
        kept = ~hole(u[i] / 2 + u[i + 1] / 2, v[j] / 2 + v[j + 1] / 2)
        i, j = i[kept], j[kept]
    p, n = (i * len(v) + j).ravel(), len(v)
    quads = np.stack([p, p + n, p + n + 1, p + 1], axis=1)
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height of the ground, metres."""
    return 0.4 * np.sin(x / 2) * np.cos(y / 3)


def scene(frame: Frame, spacing: float, seed: int, noise: float = 0.02) -> Mesh:
    """Ground, a wall with windows in the north and a box without a floor in the south, all across the border."""

    def row(low: float, high: float) -> np.ndarray:
        return np.linspace(low, high, round((high - low) / spacing) + 1)

    def window(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return (np.abs(u % 1.5 - 0.75) < 0.4) & (v > 0.8) & (v < 2.1)

    def around(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:  # the box: up a side, over, down the other
        return -v, np.clip(u - 1, 0, 1.2) - 6.6, 0.6 + np.clip(u, 0, 1) - np.clip(u - 2.2, 0, 1)

    parts = [
        sheet(row(-3, 3), row(-4, 4), lambda u, v: (u, v, height(u, v))),
        sheet(row(-4, 1), row(0.6, 3), lambda u, v: (u, 0 * u + 6, v), window),
        sheet(row(0, 3.2), row(-4, 2), around),
    ]
    random = np.random.default_rng(seed)
    first = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    vertices = vertices + random.uniform(-noise, noise, vertices.shape)
    faces = np.concatenate([faces + start for (_, faces), start in zip(parts, first[:-1], strict=True)])
    local = vertices + (X, Y, Z) - np.asarray(frame.origin)
    return Mesh(frame, local.astype(np.float32), faces.astype(np.int32))


def outward(mesh: Mesh) -> np.ndarray:
    """(F,) positive for faces of the scene that face up, to the wall's front, or out of the box."""
    middle = world(mesh)[mesh.faces].mean(axis=1) - (X, Y, Z)
    y = middle[:, 1]
    out = np.tile([0.0, 0.0, 1.0], (len(mesh), 1))
    out[y > 5] = 0, -1, 0
    out[y < -5] = (middle - (0, -6, 1.0))[y < -5] * (0, 1, 1)
    return np.einsum("ij,ij->i", mesh.face_normal, out)


def clipped_and_joined(
    meshes: Mapping[str, Mesh], where: Mapping[str, Cell]
) -> tuple[dict[str, Clipped], dict[str, Mesh]]:
    """All meshes clipped, and all joined."""
    clips = {name: clip(mesh, where[name]) for name, mesh in meshes.items()}
    return clips, {name: join(name, clips, 0.3, 0.5).mesh for name in meshes}


def crowded(mesh: Mesh) -> int:
    """Number of edges with more than two faces, or with two in the same direction."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    _, ways = np.unique(edges, axis=0, return_counts=True)
    return int((ways > 1).sum())


def go(step: Step, out: Path, inputs: Mapping[str, Path], **params: Any) -> Done:
    out.mkdir(parents=True, exist_ok=True)
    return step.run(inputs, step_params(step.params, **params), out, silent)


@pytest.fixture(scope="module")
def two() -> tuple[dict[str, Mesh], dict[str, Clipped], dict[str, Mesh]]:
    """The scene in two tiles: meshes, clipped meshes, joined meshes."""
    meshes = {"east": scene(EAST, 0.08, 1), "west": scene(WEST, 0.1, 2)}
    return meshes, *clipped_and_joined(meshes, cells(SEEDS))


def test_clip_keeps_the_own_side_unchanged(two: Any) -> None:
    meshes, clips, _ = two
    area = sum(float(clip.mesh.face_area.sum()) for clip in clips.values())
    assert area == pytest.approx(float(meshes["east"].face_area.sum()), rel=0.1)
    for name, cut in clips.items():
        cell = cells(SEEDS)[name]
        outside = cell.outside(world(cut.mesh)[:, :2])
        (on,) = cut.on.values()
        assert outside.max() < 2e-4 and on.sum() > 100
        assert np.abs(outside[on]).max() < 2e-4
        assert (world(cut.mesh)[on] % GRID_M == 0).all()
        assert crowded(cut.mesh) == 0 and outward(cut.mesh).min() > 0
        assert cut.mesh.face_area.min() > 1e-7, "no degenerate faces"


def test_joined_meshes_have_identical_borders(two: Any) -> None:
    _, clips, joined = two
    cell = cells(SEEDS)["east"]
    before = gap(clips["east"].mesh, clips["west"].mesh, cell, "west")
    assert before.shared == 0 and 0.005 < before.mean_m < 0.03
    after = gap(joined["east"], joined["west"], cell, "west")
    assert after.shared == 1 and after.max_m == 0 and after.crack_m2 == 0 and after.one_sided_m == 0
    assert after.overlap_m < 2e-4
    assert after.length_m == pytest.approx(before.length_m, rel=0.05)
    small = {name: simplify(mesh, 2000) for name, mesh in joined.items()}
    assert max(map(len, small.values())) < 2200
    thin = gap(small["east"], small["west"], cell, "west")
    assert replace(thin, overlap_m=0) == replace(after, overlap_m=0) and thin.overlap_m < 0.005


def test_owner_mesh_is_unchanged_and_the_other_one_valid(two: Any) -> None:
    _, clips, joined = two
    assert np.array_equal(joined["east"].vertices, clips["east"].mesh.vertices)
    assert np.array_equal(joined["east"].faces, clips["east"].mesh.faces)
    mesh = joined["west"]
    assert crowded(mesh) == 0
    assert outward(mesh).min() > 0, "a face is flipped"
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)


def test_joined_surface_ramps_to_the_border(tmp_path: Path) -> None:
    """A border 10 cm below the surface is joined by a ramp of half a metre, not by a step."""
    flat = {
        name: scene(frame, 0.1, 0, noise=0.0).keep(np.arange(len(scene(frame, 0.1, 0))) < 2 * 60 * 80)
        for name, frame in (("east", EAST), ("west", WEST))
    }
    flat["west"] = replace(flat["west"], vertices=flat["west"].vertices - np.array([0, 0, 0.1], np.float32))
    joined = clipped_and_joined(flat, cells(SEEDS))[1]
    xyz = world(joined["west"])
    behind = -cells(SEEDS)["west"].beyond("east", xyz[:, :2])
    lift = xyz[:, 2] - Z - height(xyz[:, 0] - X, xyz[:, 1] - Y) + 0.1
    assert np.abs(lift[behind < 0.001] - 0.1).max() < 0.005 and np.abs(lift[behind > 0.51]).max() < 1e-4
    assert np.corrcoef(behind[behind < 0.5], lift[behind < 0.5])[0, 1] < -0.97


def test_vertices_that_decimation_puts_beyond_a_border_are_moved_onto_it() -> None:
    """In a cell with two oblique borders; what is inside, or on a border but for rounding, stays."""
    frame = Frame("EPSG:32633", (500_000.0, 5_400_000.0, 200.0))
    cell = Cell((500_000.0, 5_400_000.0), {"a": (500_008.0, 5_400_006.0), "b": (500_000.0, 5_400_012.0)})
    ahead = np.array([0.8, 0.6])  # the border with "a" is 5 m away
    plan = np.stack([5.004 * ahead, 5.0002 * ahead, 3 * ahead, (-2.0, 6.01)])
    mesh = Mesh(frame, np.column_stack([plan, [1, 2, 3, 4]]).astype(np.float32), np.array([[0, 1, 2]], np.int32))
    moved = pulled_inside(mesh, cell).vertices
    np.testing.assert_allclose(moved[0], [4, 3, 1], atol=1e-5)
    np.testing.assert_array_equal(moved[1:3], mesh.vertices[1:3])
    np.testing.assert_allclose(moved[3], [-2, 6, 4], atol=1e-5)


def test_four_tiles_meet_in_one_vertex() -> None:
    seeds = {f"{i}{j}": (X + 10.0 * i - 5, Y + 10.0 * j - 5) for i in (0, 1) for j in (0, 1)}
    where = cells(seeds)
    frames = {name: Frame("EPSG:32633", (x + 7 * k, y - 3 * k, Z)) for k, (name, (x, y)) in enumerate(seeds.items())}
    meshes = {name: scene(frames[name], 0.07 + 0.01 * k, k) for k, name in enumerate(seeds)}
    _, joined = clipped_and_joined(meshes, where)
    corners = set()
    for name, mesh in joined.items():
        xyz = world(mesh)
        here = np.hypot(xyz[:, 0] - X, xyz[:, 1] - Y) < 1e-3
        assert here.sum() == 1
        corners.add(tuple(xyz[here][0].tolist()))
        for other in where[name].neighbours:
            between = gap(mesh, joined[other], where[name], other)
            assert between.shared == 1 and between.max_m == 0 and between.overlap_m < 2e-4, (name, other, between)
        assert crowded(mesh) == 0 and outward(mesh).min() > -0.1
    assert len(corners) == 1


def test_three_tiles_meet_where_the_first_has_a_hole() -> None:
    seeds = {"a": (X - 5.0, Y + 1.0), "b": (X + 4.0, Y - 5.0), "c": (X + 4.0, Y + 5.0)}
    where = cells(seeds)
    meshes = {name: scene(EAST, 0.07 + 0.01 * k, k) for k, name in enumerate(seeds)}
    near = np.hypot(*(world(meshes["a"])[meshes["a"].faces].mean(axis=1)[:, :2] - (X - 0.4, Y)).T) < 1
    meshes["a"] = meshes["a"].keep(~near)
    _, joined = clipped_and_joined(meshes, where)
    between = gap(joined["b"], joined["c"], where["b"], "c")
    assert between.shared == 1 and between.max_m == 0


def test_border_to_a_missing_neighbour_stays_as_clipped(two: Any) -> None:
    _, clips, _ = two
    alone = join("west", {"west": clips["west"]}, 0.3, 0.5)
    assert np.array_equal(alone.mesh.vertices, clips["west"].mesh.vertices) and alone.metrics == {}


def test_empty_meshes_are_clipped_and_joined(two: Any) -> None:
    meshes, clips, _ = two
    empty = Mesh(EAST, np.empty((0, 3), np.float32), np.empty((0, 3), np.int32), np.empty(0, np.float32))
    cell = cells(SEEDS)["east"]
    nothing = clip(empty, cell)
    assert len(nothing.mesh) == 0 and list(nothing.on) == ["west"]
    assert len(join("west", {"east": nothing, "west": nothing}, 0.3, 0.5).mesh) == 0
    kept = join("west", {"east": nothing, "west": clips["west"]}, 0.3, 0.5)
    assert np.array_equal(kept.mesh.vertices, clips["west"].mesh.vertices)
    assert len(join("west", {"east": clips["east"], "west": clip(empty, cell)}, 0.3, 0.5).mesh) == 0
    assert gap(empty, empty, cell, "west") == Gap(0, 0, 1, 0, 0, 0, 0, 0)
    one = gap(clips["east"].mesh, empty, cell, "west")
    assert one.shared == 0 and one.one_sided_m == pytest.approx(2 * one.length_m)
    away = clip(meshes["east"], Cell((X + 500, Y), {"west": (X + 100, Y)}))
    assert len(away.mesh) == 0


def test_clip_and_join_steps_pass_the_border(two: Any, tmp_path: Path) -> None:
    meshes, _, joined = two
    clips: dict[str, Path] = {}
    for name, mesh in meshes.items():
        mesh.save(tmp_path / f"{name}.npz")
        cell = cells(SEEDS)[name]
        done = go(CLIP, tmp_path / name, {"mesh": tmp_path / f"{name}.npz"}, seed=cell.seed, neighbours=cell.neighbours)
        clips |= {f"{kind}.{name}": done.files[kind] for kind in ("mesh", "on")}
    cell = cells(SEEDS)["west"]
    inputs = {"mesh": clips["mesh.west"], "on": clips["on.west"]}
    inputs |= {name: path for name, path in clips.items() if name.endswith("east")}
    done = go(JOIN, tmp_path / "join", inputs, name="west", seed=cell.seed, neighbours=cell.neighbours)
    assert np.array_equal(Mesh.load(done.files["mesh"]).vertices, joined["west"].vertices)
    facts = done.metrics["borders"]["east"]
    assert facts["matched"] > 100 and facts["unmatched"] == 0 and 0.005 < facts["mean_m"] < facts["max_m"] < 0.12
    assert facts["followed"] == facts["edges"] and done.metrics["missing"] == []

    thin = go(DECIMATE, tmp_path / "thin", {"mesh": done.files["mesh"]}, target=10_000, keep_border=True)
    assert thin.metrics["border_kept"] and not thin.warnings


def test_joined_borders_meet_and_other_open_edges_are_decimated(two: Any, tmp_path: Path) -> None:
    _, _, joined = two
    solid = {}
    for name, mesh in joined.items():
        cell, out = cells(SEEDS)[name], tmp_path / name
        out.mkdir()
        mesh.save(out / "terrain.npz")
        around = cloud(mesh.frame, seed=3)
        replace(around, xyz=around.xyz + np.array([0, 0, 0.05], np.float32)).save(
            out / "cloud.npz"
        )  # which is fitted to the border
        inputs = {"terrain": out / "terrain.npz", "cloud": out / "cloud.npz"}
        tile_cell = {"name": "a", "seed": cell.seed, "neighbours": cell.neighbours}
        done = go(COLLISION, out, inputs, triangles=1000, context=tile_cell)
        solid[name] = Mesh.load(done.files["mesh"])
        assert len(solid[name]) <= 1000 and not done.warnings
        before, after = (rim_edges(one, cell) for one in (mesh, solid[name]))
        assert before > 300 and after < before / 3
    between = gap(solid["east"], solid["west"], cells(SEEDS)["east"], "west")
    assert between.shared == 1 and between.length_m == pytest.approx(
        gap(joined["east"], joined["west"], cells(SEEDS)["east"], "west").length_m
    )


def test_border_exceeding_the_target_is_kept_with_a_warning(two: Any, tmp_path: Path) -> None:
    _, _, joined = two
    cell = cells(SEEDS)["west"]
    joined["west"].save(tmp_path / "terrain.npz")
    given = {"context": {"name": "a", "seed": cell.seed, "neighbours": cell.neighbours}}
    done = go(COLLISION, tmp_path / "solid", {"terrain": tmp_path / "terrain.npz"}, triangles=100, **given)
    assert done.metrics["triangles"] > 100 and "borders" in done.warnings[0]
    between = gap(joined["east"], Mesh.load(done.files["mesh"]), cells(SEEDS)["east"], "west")
    assert between.shared == 1


def rim_edges(mesh: Mesh, cell: Cell) -> int:
    """Open edges that are not on a border."""
    opened = curve(mesh.faces, np.ones(len(mesh.vertices), bool)).edges
    return int((~on_border(mesh, cell)[opened].all(axis=1)).sum())


def test_decimate_keeps_the_border_on_request(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    corners = random.uniform(0, 50, (12_000, 1, 3)) + random.uniform(-0.1, 0.1, (12_000, 3, 3))
    faces = np.arange(36_000, dtype=np.int32).reshape(-1, 3)
    Mesh(EAST, corners.reshape(-1, 3).astype(np.float32), faces).save(tmp_path / "mesh.npz")
    done = go(DECIMATE, tmp_path / "out", {"mesh": tmp_path / "mesh.npz"}, target=10_000, keep_border=True)
    assert done.metrics["faces"] == 12_000 and done.metrics["border_kept"] and "12,000" in done.warnings[0]


# --- clouds ---


def cloud(frame: Frame, seed: int = 0, n: int = 60_000) -> PointCloud:
    """Ground points around the centre, to the millimetre as in LAS; equal for every frame."""
    random = np.random.default_rng(seed)
    xy = random.uniform(-8, 8, (n, 2))
    xyz = np.column_stack([xy, height(*xy.T)]).round(3) + (X, Y, Z)
    return PointCloud(
        frame,
        (xyz - np.asarray(frame.origin)).astype(np.float32),
        random.integers(0, 255, (n, 3), np.uint8),
        classification=np.full(n, CODE["road"], np.uint8),
        time=np.arange(n, dtype=np.float64),
        intensity=random.integers(0, 65535, n, np.uint16),
    )


def overlapped(seeds: Mapping[str, tuple[float, float]], out: Path, missing: str = "") -> dict[str, PointCloud]:
    """Cloud of each tile after `overlap`, from clouds that extend 2 m beyond the cells, with different classes."""
    where, found = cells(seeds), {}
    for k, (name, cell) in enumerate(where.items()):
        frame = Frame("EPSG:32633", (X + 30.0 * k - 50, Y - 20.0 * k, Z))
        whole = cloud(frame)
        outside = cell.outside(whole.xyz[:, :2] + np.asarray(frame.origin[:2]))
        part = whole.take(np.flatnonzero(outside <= 2.0))
        replace(part, classification=np.full(len(part), 2 + k, np.uint8)).save(out / f"{name}.npz")
    for name, cell in where.items():
        inputs = {"cloud": out / f"{name}.npz"}
        inputs |= {f"cloud.{other}": out / f"{other}.npz" for other in where if other not in (name, missing)}
        params = {"name": name, "seed": cell.seed, "neighbours": cell.neighbours, "buffer": 2.0}
        found[name] = PointCloud.load(go(OVERLAP, out / name, inputs, **params).files["cloud"])
    return found


def times(points: PointCloud, mask: np.ndarray | None = None) -> np.ndarray:
    assert points.time is not None
    return np.sort(points.time if mask is None else points.time[mask])


def everywhere(points: PointCloud) -> np.ndarray:
    return points.xyz.astype(np.float64) + np.asarray(points.frame.origin)


@pytest.mark.parametrize("count", [2, 4])
def test_overlap_neither_loses_nor_duplicates_points(count: int, tmp_path: Path) -> None:
    seeds = dict(list({"a": (X - 4.0, Y), "b": (X + 4.0, Y), "c": (X, Y + 6.0), "d": (X, Y - 6.0)}.items())[:count])
    where, found = cells(seeds), overlapped(seeds, tmp_path)
    labels = {name: 2 + k for k, name in enumerate(seeds)}
    whole = cloud(WEST)
    for name, points in found.items():
        outside = where[name].outside(everywhere(whole)[:, :2])
        sure = np.abs(outside - 2) > 0.001  # points at the rim may be in either
        inside = np.isin(times(whole), times(points))
        assert (inside == (outside <= 2))[sure].all()
        assert len(np.unique(times(points))) == len(points), "duplicate points"
        own = where[name].outside(everywhere(points)[:, :2]) <= -0.001
        classification = present(points.classification)
        assert (classification[own] == labels[name]).all() and len(set(classification.tolist())) > 1
    taken = [times(found[name], present(found[name].classification) == labels[name]) for name in seeds]
    assert np.array_equal(np.sort(np.concatenate(taken)), times(whole)), "each point belongs to one tile"


def test_overlap_skips_missing_neighbours(tmp_path: Path) -> None:
    seeds = {"a": (X - 4.0, Y), "b": (X + 4.0, Y), "c": (X, Y + 6.0)}
    found = overlapped(seeds, tmp_path, missing="c")["a"]
    assert sorted(set(present(found.classification).tolist())) == [2, 3]
    assert np.array_equal(times(found), times(PointCloud.load(tmp_path / "a.npz")))


def test_points_on_a_border_belong_to_the_first_tile(tmp_path: Path) -> None:
    seeds = {"a": (X - 4.0, Y), "b": (X + 4.0, Y)}
    for k, name in enumerate(seeds):
        frame = Frame("EPSG:32633", (X - k, Y, Z))
        xyz = np.array([[k, y, 0] for y in np.linspace(-1, 1, 50)], np.float32)
        PointCloud(frame, xyz, classification=np.full(50, 2 + k, np.uint8)).save(tmp_path / f"{name}.npz")
    for name, other in (("a", "b"), ("b", "a")):
        cell = cells(seeds)[name]
        inputs = {"cloud": tmp_path / f"{name}.npz", f"cloud.{other}": tmp_path / f"{other}.npz"}
        done = go(OVERLAP, tmp_path / name, inputs, name=name, seed=cell.seed, neighbours=cell.neighbours)
        assert np.all(PointCloud.load(done.files["cloud"]).classification == 2) and done.metrics["points"] == {
            "a": 50,
            "b": 0,
        }


def test_voxels_of_two_tiles_are_identical_in_their_overlap(tmp_path: Path) -> None:
    seeds = {"a": (X - 4.0, Y + 1), "b": (X + 4.0, Y - 1)}
    where = cells(seeds)
    rows = {}
    for name, points in overlapped(seeds, tmp_path).items():
        thin = sample(points, 0.1)
        xyz = everywhere(thin)
        both = np.abs(where["a"].beyond("b", xyz[:, :2])) < 1.8
        assert both.sum() > 1000
        columns = (xyz, thin.rgb, thin.classification, thin.time, thin.intensity)
        rows[name] = np.column_stack([column[both] for column in columns if column is not None])
    assert np.array_equal(rows["a"], rows["b"])


def test_plants_are_listed_by_the_tile_that_contains_them(tmp_path: Path) -> None:
    seeds = {"a": (X - 5.0, Y), "b": (X + 5.0, Y)}
    random = np.random.default_rng(0)
    balls = [random.normal(size=(3000, 3)) for _ in range(5)]
    trees = [b / np.linalg.norm(b, axis=1, keepdims=True) + (x, 3 * i, 3) for i, (b, x) in enumerate(
        zip(balls, (-3.0, -0.4, 0.4, 3.0, 0.0), strict=True))]  # fmt: skip
    xyz = np.concatenate(trees) + (X, Y, Z)
    flat = np.column_stack([random.uniform(-6, 15, (4000, 2)), np.zeros(4000)]) + (X, Y, Z)
    rows = []
    for frame, (name, cell) in zip((WEST, EAST), cells(seeds).items(), strict=True):
        for kind, points in (("vegetation", xyz), ("terrain", flat)):
            local = (points - np.asarray(frame.origin)).astype(np.float32)
            PointCloud(frame, local).save(tmp_path / f"{kind}.npz")
        inputs = {kind: tmp_path / f"{kind}.npz" for kind in ("vegetation", "terrain")}
        done = go(PLANTS, tmp_path / name, inputs, seed=cell.seed, neighbours=cell.neighbours)
        rows.append(np.loadtxt(done.files["csv"], delimiter=",", skiprows=1, ndmin=2))
        assert (cell.outside(rows[-1][:, :2]) <= 0.001).all()
    assert sum(map(len, rows)) == 5


def test_geometry_uses_only_points_of_the_own_cell(two: Any, tmp_path: Path) -> None:
    _, _, joined = two
    joined["west"].save(tmp_path / "mesh.npz")
    cloud(WEST).save(tmp_path / "cloud.npz")
    inputs = {"mesh.terrain": tmp_path / "mesh.npz", "cloud.terrain": tmp_path / "cloud.npz"}
    cell = Cell((X - 1.0, Y - 0.4), {"east": (X + 1.0, Y + 0.4), "far": (X - 3.0, Y - 0.4)})
    whole = go(GEOMETRY, tmp_path / "whole", inputs)
    own = go(GEOMETRY, tmp_path / "own", inputs, seed=cell.seed, neighbours=cell.neighbours)
    assert whole.metrics["terrain"]["cloud_to_mesh_p95_m"] > 5 > own.metrics["terrain"]["cloud_to_mesh_p95_m"]


# --- complete reconstruction ---


def test_reconstruction_of_a_street_in_two_tiles_is_joined(tmp_path: Path) -> None:
    frame = Frame("EPSG:32633", (391_204.0, 5_820_376.0, 33.0))
    whole = las.read(ROOT / "data_samples" / "tile" / "cloud.laz", frame)
    assert whole.classification is not None
    whole = whole.take(np.flatnonzero(group_of()[whole.classification] == GROUPS.index("terrain")))
    along = np.array([-0.6, 0.8])  # along the street
    middle = np.array(frame.origin[:2])
    seeds = {name: tuple((middle + way * along).tolist()) for name, way in (("a", -10), ("b", 10))}
    where, raw = cells(seeds), {}
    for name, cell in where.items():
        origin = tuple(np.floor((*cell.seed, 33.0)).tolist())
        xyz = everywhere(whole)
        part = replace(whole, frame=replace(frame, origin=origin), xyz=(xyz - origin).astype(np.float32))
        raw[name] = tmp_path / f"{name}.npz"
        part.take(np.flatnonzero(cell.outside(xyz[:, :2]) <= 5)).save(raw[name])
    meshes = {}
    for name, cell in where.items():
        out, other = tmp_path / name, "b" if name == "a" else "a"
        known = {"name": name, "seed": cell.seed, "neighbours": cell.neighbours}
        points = go(OVERLAP, out / "0", {"cloud": raw[name], f"cloud.{other}": raw[other]}, **known).files["cloud"]
        thin = go(VOXEL, out / "1", {"cloud": points}).files["cloud"]
        surface = go(POISSON, out / "2", {"cloud": thin}).files["mesh"]
        surface = go(TRIM, out / "3", {"mesh": surface, "cloud": thin}, **TRIM.class_defaults["terrain"]).files["mesh"]
        meshes[name] = Mesh.load(go(ISLANDS, out / "4", {"mesh": surface}).files["mesh"])
    clips, joined = clipped_and_joined(meshes, where)
    before = gap(clips["a"].mesh, clips["b"].mesh, where["a"], "b")
    assert before.shared < 0.1 and before.mean_m > 0.0005 and before.length_m > 20
    small = {name: simplify(mesh, 10_000) for name, mesh in joined.items()}
    after = gap(small["a"], small["b"], where["a"], "b")
    assert after.shared > 0.99 and after.p99_m == 0 and after.one_sided_m == 0 and after.overlap_m < 0.005
    assert join("b", clips, 0.3, 0.5).turned == 0 and crowded(joined["b"]) <= crowded(clips["b"].mesh)

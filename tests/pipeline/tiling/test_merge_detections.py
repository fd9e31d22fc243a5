"""Street furniture at tile borders: listed once, with one mesh in one tile, and removed from both tiles identically."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, Step, silent
from scan2sim.pipeline.core.types import F64, Frame, Mesh, PointCloud, Trajectory
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.pipeline.furniture.classify import Detection
from scan2sim.pipeline.geometry.coordinate_grid import snap_to_grid, world
from scan2sim.pipeline.steps.clip import CLIP
from scan2sim.pipeline.steps.collision import COLLISION
from scan2sim.pipeline.steps.decimate import DECIMATE
from scan2sim.pipeline.steps.detect_furniture import DETECT_FURNITURE
from scan2sim.pipeline.steps.furniture import FURNITURE
from scan2sim.pipeline.steps.islands import ISLANDS
from scan2sim.pipeline.steps.join import JOIN
from scan2sim.pipeline.steps.overlap import OVERLAP
from scan2sim.pipeline.steps.poisson import POISSON
from scan2sim.pipeline.steps.split import SPLIT
from scan2sim.pipeline.steps.trim import TRIM
from scan2sim.pipeline.steps.voxel import VOXEL
from scan2sim.pipeline.tiling.borders.gap import gap
from scan2sim.pipeline.tiling.borders.merge_detections import merged_detections
from tests.fakes.steps import step_params
from tests.present import present

X, Y, Z = 500_000.0, 5_400_000.0, 200.0
SEEDS = {"east": (X + 5.0, Y), "west": (X - 5.0, Y)}
FRAMES = {"east": Frame("EPSG:32633", (X + 9, Y - 3, Z + 2)), "west": Frame("EPSG:32633", (X - 12, Y + 1, Z))}
OTHER = {"east": "west", "west": "east"}
BUFFER = 3.0
SIGN, LAMP, TRUNK, BEHIND = (0.02, 2.4), (-1.0, -2.0), (-0.01, -4.5), (1.5, 0.0)
"""Feet of a sign whose plate is half beyond the border, a lamp whose arm ends beyond it, a trunk on it, and a pole."""
WALL = 3.0
"""Metres north of the middle."""


def cell(name: str) -> Cell:
    return Cell(SEEDS[name], {OTHER[name]: SEEDS[OTHER[name]]}, BUFFER)


def street() -> tuple[F64, Any]:
    """World positions (N, 3) and classes (N,) of points of a street."""
    random = np.random.default_rng(0)

    def box(count: int, low: Any, high: Any) -> F64:
        return random.uniform(low, high, (count, 3))

    def tube(foot: tuple[float, float], radius: float, top: float) -> F64:
        n = int(top * 800)
        angle = random.uniform(0, 2 * np.pi, n)
        around = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(n)])
        return around + np.column_stack([np.full(n, foot[0]), np.full(n, foot[1]), random.uniform(0, top, n)])

    x, y = SIGN
    parts = {
        "terrain": [box(60_000, (-8, -7, 0), (8, 5, 0))],
        "building": [box(40_000, (-8, WALL, 0), (8, WALL, 4))],
        "pole": [
            tube(SIGN, 0.03, 2.6), tube(LAMP, 0.06, 5.0), tube(BEHIND, 0.03, 2.0),
            box(2500, (-1, -2.03, 4.9), (1.0, -1.97, 4.96)), box(1500, (0.6, -2.15, 4.85), (1.2, -1.85, 4.95)),
        ],
        "road_sign": [box(3000, (x - 0.3, y - 0.06, 2.0), (x + 0.3, y - 0.06, 2.6))],
        "high_vegetation": [tube(TRUNK, 0.14, 2.4), random.normal((*TRUNK, 3.6), (0.6, 0.6, 0.3), (6000, 3))],
    }  # fmt: skip
    xyz = np.concatenate([np.concatenate(places) for places in parts.values()])
    xyz += random.normal(0, 0.004, xyz.shape)
    codes = [np.full(sum(map(len, places)), CODE[name], np.uint8) for name, places in parts.items()]
    return snap_to_grid(xyz + (X, Y, Z)), np.concatenate(codes)


def go(step: Step, out: Path, inputs: Mapping[str, Path], **params: Any) -> Done:
    out.mkdir(parents=True, exist_ok=True)
    return step.run(inputs, step_params(step.params, **params), out, silent)


def known(name: str) -> dict[str, Any]:
    return {"seed": SEEDS[name], "neighbours": cell(name).neighbours}


@dataclass(frozen=True)
class Tile:
    """Results of a tile."""

    cloud: PointCloud
    found: Path
    furniture: Done
    split: Done

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Listed furniture, with position `at` relative to the centre."""
        features = json.loads(self.furniture.files["geojson"].read_text(encoding="utf-8"))["features"]
        return [f["properties"] | {"at": np.array(f["geometry"]["coordinates"]) - (X, Y, Z)} for f in features]

    @property
    def furniture_xyz(self) -> F64:
        """(N, 3) world positions of points that belong to furniture."""
        index = np.load(self.furniture.files["furniture_points"])["index"]
        return self.cloud.xyz[index].astype(np.float64) + self.cloud.frame.origin

    def mesh(self, group: str) -> Mesh:
        """Furniture mesh of a group."""
        return Mesh.load(self.furniture.files[group])


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Clouds of the tiles, with their overlap."""
    folder = tmp_path_factory.mktemp("clouds")
    xyz, codes = street()
    for name, frame in FRAMES.items():
        near = cell(name).outside(xyz[:, :2]) <= BUFFER
        local = (xyz[near] - frame.origin).astype(np.float32)
        PointCloud(frame, local, classification=codes[near]).save(folder / f"{name}.npz")
        drive = np.column_stack([np.linspace(-8, 8, 20), np.full(20, -1.0), np.full(20, 2.0)])
        Trajectory(np.arange(20.0), drive + (X, Y, Z) - frame.origin).save(folder / f"{name}.path.npz")
    files = {}
    for name in FRAMES:
        inputs = {"cloud": folder / f"{name}.npz", f"cloud.{OTHER[name]}": folder / f"{OTHER[name]}.npz"}
        files[name] = go(OVERLAP, folder / name, inputs, name=name, buffer=BUFFER, **known(name)).files["cloud"]
        files[f"{name}.path"] = folder / f"{name}.path.npz"
    return files


def furnish(clouds: Mapping[str, Path], found: Mapping[str, Path], name: str, out: Path) -> Tile:
    """Results of a tile with the detections of the given tiles."""
    detections = {"detections" if tile == name else f"detections.{tile}": path for tile, path in found.items()}
    done = go(FURNITURE, out / "furniture", {"cloud": clouds[name], **detections}, name=name, **known(name))
    split = go(SPLIT, out / "split", {"cloud": clouds[name], "furniture_points": done.files["furniture_points"]})
    return Tile(PointCloud.load(clouds[name]), found[name], done, split)


@pytest.fixture(scope="module")
def tiles(clouds: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Tile]:
    """Results of both tiles."""
    folder = tmp_path_factory.mktemp("tiles")
    found = {}
    for name in FRAMES:
        inputs = {"cloud": clouds[name], "path": clouds[f"{name}.path"]}
        found[name] = go(DETECT_FURNITURE, folder / name, inputs, **known(name)).files["detections"]
    return {name: furnish(clouds, found, name, folder / name) for name in FRAMES}


def test_furniture_at_a_border_is_listed_once_at_its_position(tiles: dict[str, Tile]) -> None:
    places = {"sign": SIGN, "lamp": LAMP, "trunk": TRUNK, "pole": BEHIND}
    rows = {name: tile.rows for name, tile in tiles.items()}
    assert sorted(row["kind"] for name in rows for row in rows[name]) == sorted(places)
    for name, listed in rows.items():
        for row in listed:
            place = places[row["kind"]]
            assert row["at"][:2] == pytest.approx(place, abs=0.03)
            assert cell(name).outside(row["at"][None, :2] + (X, Y))[0] <= 0
            if row["kind"] in ("lamp", "pole"):
                assert name == ("east" if place[0] > 0 else "west")


def test_furniture_mesh_is_complete_in_one_tile(tiles: dict[str, Tile]) -> None:
    corners = {name: world(tile.mesh("building")) - (X, Y, Z) for name, tile in tiles.items()}
    codes = {name: present(tile.mesh("building").classification) for name, tile in tiles.items()}
    (owner,) = [name for name in codes if (codes[name] == CODE["road_sign"]).any()]
    plate = world(tiles[owner].mesh("building").keep(codes[owner] == CODE["road_sign"])) - (X, Y, Z)
    assert plate[:, 0].min() == pytest.approx(SIGN[0] - 0.3, abs=0.04)  # also beyond the border
    assert plate[:, 0].max() == pytest.approx(SIGN[0] + 0.3, abs=0.04)
    lamp = corners["west"][np.abs(corners["west"][:, 1] - LAMP[1]) < 0.5]
    assert lamp[:, 0].max() > 1.0 and lamp[:, 2].max() > 4.9
    assert not (np.abs(corners["east"][:, 1] - LAMP[1]) < 0.5).any()
    assert sorted(len(tile.mesh("vegetation")) > 0 for tile in tiles.values()) == [False, True]


def test_furniture_points_are_removed_from_surfaces(tiles: dict[str, Tile]) -> None:
    for tile in tiles.values():
        left = PointCloud.load(tile.split.files["building"])
        xyz = left.xyz + np.asarray(tile.cloud.frame.origin) - (X, Y, Z)
        beside = xyz[xyz[:, 1] < WALL - 0.1]
        assert len(beside) < 0.01 * len(tile.furniture_xyz)


def test_both_tiles_remove_the_same_points(tiles: dict[str, Tile]) -> None:
    east, west = ({tuple(p) for p in tile.furniture_xyz.tolist() if abs(p[0] - X) <= BUFFER} for tile in tiles.values())
    assert east == west and len(east) > 5000
    for tile in tiles.values():  # furniture of the neighbour occludes, but gives no colour
        own = np.load(tile.furniture.files["furniture_points"])["own"]
        assert len(PointCloud.load(tile.split.files["furniture"])) == own.sum() > 0
        assert len(PointCloud.load(tile.split.files["rest"])) == (~own).sum() > 0


def test_surfaces_meet_vertex_for_vertex(tiles: dict[str, Tile], clouds: dict[str, Path], tmp_path: Path) -> None:
    surfaces, clips = {}, {}
    for name, tile in tiles.items():
        out = tmp_path / name
        seen = {"cloud": tile.split.files["building"], "path": clouds[f"{name}.path"]}
        thin = go(VOXEL, out / "1", seen).files["cloud"]
        raw = go(POISSON, out / "2", {"cloud": thin}, seed=(0, 0)).files["mesh"]
        trimmed = go(TRIM, out / "3", {"mesh": raw, "cloud": thin}).files["mesh"]
        kept = go(ISLANDS, out / "4", {"mesh": trimmed}).files["mesh"]
        clips[name] = go(CLIP, out / "5", {"mesh": kept}, **known(name)).files
    for name, tile in tiles.items():
        inputs = dict(clips[name])
        if name == "west":
            inputs |= {f"{k}.east": path for k, path in clips["east"].items()}
        joined = go(JOIN, tmp_path / name / "6", inputs, name=name, **known(name)).files["mesh"]
        things = {"mesh": joined, "furniture": tile.furniture.files["building"]}
        done = go(DECIMATE, tmp_path / name / "7", things, target=10_000, keep_border=True)
        surfaces[name] = Mesh.load(done.files["mesh"])
    free = {name: mesh.keep(present(mesh.classification) == 0) for name, mesh in surfaces.items()}
    between = gap(free["west"], free["east"], cell("west"), "east")
    assert between.length_m > 3 and between.shared == 1 and between.one_sided_m == 0 and between.overlap_m < 1e-3
    for mesh in free.values():  # no surface of furniture
        assert (np.abs(world(mesh)[:, 1] - (Y + WALL)) < 0.15).all()
    # the collision mesh of the sign extends across the border, in the tile that lists it
    (owner,) = [n for n, mesh in surfaces.items() if (present(mesh.classification) == CODE["road_sign"]).any()]
    file = tmp_path / owner / "7" / "mesh.npz"
    done = go(
        COLLISION,
        tmp_path / "solid",
        {"building": file},
        context={"name": owner, "seed": SEEDS[owner], "neighbours": cell(owner).neighbours},
    )
    solid = Mesh.load(done.files["mesh"])
    plate = world(solid.keep(present(solid.classification) == CODE["road_sign"]))
    assert plate[:, 0].min() < X - 0.2 and plate[:, 0].max() > X + 0.2


@pytest.mark.parametrize("silent_one", ["east", "west"])
def test_furniture_detected_by_one_tile_is_removed_from_both(
    silent_one: str, tiles: dict[str, Tile], clouds: dict[str, Path], tmp_path: Path
) -> None:
    nothing = go(
        DETECT_FURNITURE, tmp_path / "nothing", {"cloud": clouds[silent_one]}, **known(silent_one)
    )  # this tile has no path
    found = {name: tile.found for name, tile in tiles.items()} | {silent_one: nothing.files["detections"]}
    made = {name: furnish(clouds, found, name, tmp_path / name) for name in FRAMES}
    east, west = ({tuple(p) for p in tile.furniture_xyz.tolist() if abs(p[0] - X) <= BUFFER} for tile in made.values())
    assert east == west
    kinds = {row["kind"] for tile in made.values() for row in tile.rows}
    assert kinds == {"sign", "trunk", "pole" if silent_one == "west" else "lamp"}  # the other tile lists the rest
    assert sum(len(tile.rows) for tile in made.values()) == 3


def test_tile_with_a_missing_neighbour_keeps_its_detections(
    tiles: dict[str, Tile], clouds: dict[str, Path], tmp_path: Path
) -> None:
    for name, tile in tiles.items():
        alone = furnish(clouds, {name: tile.found}, name, tmp_path / name)
        assert [row["kind"] for row in alone.rows] == [row["kind"] for row in tile.rows]


def test_merge_is_independent_of_tile_order(tiles: dict[str, Tile]) -> None:
    finds = {
        name: [Detection.from_json(row) for row in json.loads(tile.found.read_text(encoding="utf-8"))]
        for name, tile in tiles.items()
    }
    assert all(len(known) >= 3 for known in finds.values())  # both have the objects at the border
    backwards = {name: finds[name] for name in reversed(finds)}
    one, other = (
        merged_detections(finds, SEEDS),
        merged_detections(backwards, {name: SEEDS[name] for name in reversed(SEEDS)}),
    )
    assert len(one) == 4
    assert [(name, t.to_json()) for name, t in one] == [(name, t.to_json()) for name, t in other]


def test_adjacent_poles_on_a_border_are_not_merged(tiles: dict[str, Tile]) -> None:
    detections = [Detection.from_json(row) for row in json.loads(tiles["west"].found.read_text(encoding="utf-8"))]
    (sign,) = [thing for thing in detections if thing.kind == "sign"]
    beside = sign.moved(np.array([-0.3, 0.0, 0.0]))
    jitter = np.array([0.02, -0.01, 0.0])
    both = {"west": [sign, beside], "east": [sign.moved(jitter), beside.moved(jitter)]}
    assert sorted(name for name, _ in merged_detections(both, SEEDS)) == ["east", "west"]

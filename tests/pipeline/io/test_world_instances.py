"""Instances of a world: which faces are one building, pole or tree, by lists and by what touches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import I32, U8, Mesh
from scan2sim.pipeline.io.geodata import geojson
from scan2sim.pipeline.io.worlds.instances import TILE_IDS, Instance, instances_of
from scan2sim.pipeline.io.worlds.scene import SceneTile
from tests.fakes import synthetic

Solid = tuple[float, float, float, float, float, float, str]
"""Corners x, y, z and class of a box."""
FACES = synthetic.house().faces
POLES: list[Solid] = [(0, 0, 0, 0.1, 0.1, 3, "pole"), (0.1, 0, 2.8, 3, 0.1, 3, "pole"), (2, 0, 0, 2.1, 0.1, 2, "pole")]
"""A lamp, its arm of 3 m, and a pole below the arm."""
PANEL: Solid = (2, -0.1, 1.6, 2.6, 0, 2, "road_sign")
FEET = [((0.05, 0.05, 0.0), {"kind": "lamp"}), ((2.05, 0.05, 0.0), {"kind": "sign"})]


@pytest.fixture
def tile(tmp_path: Path) -> SceneTile:
    return synthetic.scene(tmp_path).tiles[1]


def boxes(*solids: Solid) -> tuple[Mesh, U8]:
    """A mesh of boxes without floors, and the class of each of its faces."""
    vertices = [
        (x, y, z) for x0, y0, z0, x1, y1, z1, _ in solids
        for z in (z0, z1) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
    ]  # fmt: skip
    faces = np.concatenate([FACES + 8 * k for k in range(len(solids))])
    codes = np.repeat([CODE[solid[-1]] for solid in solids], len(FACES)).astype(np.uint8)
    return Mesh(synthetic.UTM, np.array(vertices, np.float32), faces.astype(np.int32)), codes


def list_furniture(tile: SceneTile) -> None:
    """Write `furniture.geojson` with `FEET`, which are in world metres."""
    rows = [
        (tile.frame.to_crs(np.subtract(foot, tile.offset)).tolist(), properties | {"height_m": 3.0})
        for foot, properties in FEET
    ]
    geojson.write_points(tile.folder / "furniture.geojson", tile.frame.crs, rows)


def found(tile: SceneTile, *solids: Solid) -> tuple[tuple[Instance, ...], I32]:
    """The tile's instances, and the id of each box."""
    made = instances_of(tile, 1, {"building": boxes(*solids)})
    ids = made.faces["building"].reshape(len(solids), len(FACES))
    assert (ids == ids[:, :1]).all(), "a box is not divided"
    return made.table, ids[:, 0]


def test_poles_arms_and_panels_belong_to_the_object_whose_foot_they_stand_on(tile: SceneTile) -> None:
    list_furniture(tile)
    table, ids = found(tile, *POLES, PANEL)
    assert [one.kind for one in table] == ["lamp", "sign"] and [one.code for one in table] == [65, 64]
    assert [one.id for one in table] == [TILE_IDS + 1, TILE_IDS + 2], "in the order of the list"
    assert ids.tolist() == [TILE_IDS + 1, TILE_IDS + 1, TILE_IDS + 2, TILE_IDS + 2]
    assert table[1].position_m == pytest.approx((2.05, 0.05, 0.0), abs=0.01)


def test_houses_apart_are_two_and_those_that_touch_are_one(tile: SceneTile) -> None:
    apart, beside = (20, 0, 0, 30, 8, 6, "building"), (10.3, 0, 0, 16, 8, 5, "building")
    table, ids = found(tile, (0, 0, 0, 10, 8, 6, "building"), beside, apart)
    assert [one.kind for one in table] == ["building", "building"]
    assert ids[0] == ids[1] != ids[2]
    assert table[0].position_m == (8.0, 4.0, 0.0)


def test_crowns_that_grow_together_are_divided_between_their_trunks(tile: SceneTile) -> None:
    rows = [(tile.frame.to_crs(np.subtract((x, 0.5, 0), tile.offset)).tolist(), {"kind": "trunk"}) for x in (1, 9)]
    geojson.write_points(tile.folder / "furniture.geojson", tile.frame.crs, rows)
    crown = synthetic.ground(10)
    mesh = Mesh(crown.frame, crown.vertices + np.array((5, 0, 4), np.float32), crown.faces)
    hedge, low = boxes((30, 0, 0, 34, 1, 2, "mid_vegetation"), (40, 0, 0, 44, 1, 0.3, "low_vegetation"))
    codes = np.full(len(mesh), CODE["high_vegetation"], np.uint8)
    made = instances_of(tile, 1, {"vegetation": (mesh, codes), "building": (hedge, low)})
    x = mesh.corners[..., 0].mean(axis=1)
    trees = [one.id for one in made.table if one.kind == "tree"]
    assert np.array_equal(made.faces["vegetation"], np.where(x < 5, *trees))
    own = made.faces["building"].reshape(2, -1)
    assert {one.id: one.kind for one in made.table}[own[0, 0]] == "vegetation" and not own[1].any()


def test_a_damaged_list_is_named(tile: SceneTile) -> None:
    (tile.folder / "furniture.geojson").write_text('{"features": [{"geometry": null}]}', encoding="utf-8")
    with pytest.raises(InputError, match=r"furniture\.geojson"):
        found(tile, *POLES)

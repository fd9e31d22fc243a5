"""Completion of airborne scans, compared with a known house."""

from __future__ import annotations

import json
import sqlite3
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.step import Done, Step, silent
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import Frame, Mesh, PointCloud
from scan2sim.pipeline.geometry.height_map import Raster
from scan2sim.pipeline.geometry.surface_distance import distances
from scan2sim.pipeline.io.geodata import footprints
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.geometry import GEOMETRY
from scan2sim.pipeline.steps.ground import GROUND, merge_neighbours
from scan2sim.pipeline.steps.poisson import POISSON
from scan2sim.pipeline.steps.trim import TRIM
from scan2sim.pipeline.steps.voxel import VOXEL
from scan2sim.pipeline.steps.walls import WALLS
from tests.fakes.steps import step_params

FRAME = Frame("EPSG:32633", (500000.0, 5400000.0, 200.0))
HOUSE, ANNEX = (-6.0, -4.0, 4.0, 4.0, 6.0), (4.0, -4.0, 9.0, 4.0, 3.0)  # x0, y0, x1, y1, height of the roof
SAMPLE = Path(__file__).resolve().parents[3] / "data_samples" / "tile"


def go(step: Step, out: Path, inputs: dict[str, Path], **params: Any) -> Done:
    out.mkdir(parents=True, exist_ok=True)
    return step.run(inputs, step_params(step.params, **params), out, silent)


def floor(xy: np.ndarray) -> np.ndarray:
    """Height of the true ground, which slopes."""
    return 0.03 * xy[:, 0]


def within(xy: np.ndarray, box: tuple[float, ...]) -> np.ndarray:
    return (xy[:, 0] > box[0]) & (xy[:, 0] < box[2]) & (xy[:, 1] > box[1]) & (xy[:, 1] < box[3])


def scanned(name: str, rgb: tuple[int, int, int], seed: int = 0) -> PointCloud:
    """Points of a class seen from above: about 16 per square metre, with 2 cm of noise."""
    random = np.random.default_rng(seed)
    xy = random.uniform(-15, 15, (16 * 900, 2))
    z = floor(xy)
    for box in (HOUSE, ANNEX):
        z[within(xy, box)] = box[4]
    roof = within(xy, HOUSE) | within(xy, ANNEX)
    chosen = roof if name == "building" else ~roof
    xyz = np.column_stack([xy, z + random.normal(0, 0.02, len(xy))])[chosen].astype(np.float32)
    colour = np.tile(np.array(rgb, np.uint8), (len(xyz), 1))
    return PointCloud(FRAME, xyz, colour, classification=np.full(len(xyz), CODE[name], np.uint8))


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Voxels of ground and roofs, and the ground and walls synthesized from them."""
    out = tmp_path_factory.mktemp("house")
    files: dict[str, Path] = {}
    for part in ("terrain", "building"):
        scanned(part, (90, 120, 60)).save(out / f"{part}.npz")
        files[part] = go(VOXEL, out / f"voxel_{part}", {"cloud": out / f"{part}.npz"}).files["cloud"]
    empty = PointCloud(FRAME, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros((0, 3), np.float32))
    for part in ("vegetation", "rest"):
        empty.save(out / f"{part}.npz")
        files[part] = out / f"{part}.npz"
    files["ground"] = go(GROUND, out / "ground", files).files["synthesized"]
    roofs = {name: files[name] for name in ("building", "terrain", "ground")}
    files["walls"] = go(WALLS, out / "walls", roofs).files["synthesized"]
    return files


def test_ground_under_roofs_follows_the_slope(house: dict[str, Path]) -> None:
    made = PointCloud.load(house["ground"])
    below = within(made.xyz[:, :2], HOUSE) | within(made.xyz[:, :2], ANNEX)
    assert below.mean() > 0.9  # nothing is synthesized elsewhere
    x, y = np.meshgrid(np.arange(-5.5, 9, 0.5), np.arange(-3.5, 4, 0.5))
    places = np.column_stack([x.ravel(), y.ravel(), floor(np.column_stack([x.ravel(), y.ravel()]))])
    gaps = np.linalg.norm(places[:, None] - made.xyz[None], axis=2).min(axis=1)
    assert gaps.max() < 0.4
    assert np.abs(made.xyz[:, 2] - floor(made.xyz[:, :2])).max() < 0.1
    assert made.rgb is not None and (np.abs(made.rgb.astype(int) - [90, 120, 60]) <= 1).all()
    assert made.normal is not None and (made.normal[:, 2] > 0.95).all()


def test_walls_are_at_their_true_positions(house: dict[str, Path]) -> None:
    made = PointCloud.load(house["walls"])
    x, y, z = made.xyz.T
    to_side = np.min([abs(x - side) for side in (-6, 4, 9)] + [abs(y - side) for side in (-4, 4)], axis=0)
    assert np.percentile(to_side, 95) < 0.2 and to_side.max() < 0.5
    # each side of the outline, and the step between the roofs, from below to above
    sides = {
        "west": (abs(x + 6) < 0.4, 6.0, -0.18),
        "east": (abs(x - 9) < 0.4, 3.0, 0.27),
        "between": ((abs(x - 4) < 0.4) & (abs(y) < 3), 6.0, 3.0),
        "north": ((abs(y - 4) < 0.4) & (x < 3), 6.0, 0.0),
        "south, lower": ((abs(y + 4) < 0.4) & (x > 5), 3.0, 0.2),
    }
    for name, (at, top, bottom) in sides.items():
        assert top - 0.6 < z[at].max() < top + 0.15, name
        assert bottom - 0.8 < z[at].min() < bottom + 0.2, name
    assert made.normal is not None
    outward = np.einsum("ij,ij->i", made.normal[:, :2], made.xyz[:, :2] - np.array([1.5, 0], np.float32))
    between = sides["between"][0]
    assert (outward[~between] > 0).all() and (made.normal[between][:, 0] > 0.9).all()


def test_surface_of_the_house_is_closed_and_keeps_its_roof(house: dict[str, Path], tmp_path: Path) -> None:
    borne = {"cloud": house["building"], "synthesized": house["walls"]}
    raw = go(POISSON, tmp_path / "poisson", borne).files["mesh"]

    mesh = Mesh.load(go(TRIM, tmp_path / "trim", {"mesh": raw, **borne}).files["mesh"])
    t = np.linspace(0.3, 0.7, 5)
    walls = [(-6, 8 * (s - 0.5), 6 * h) for s in t for h in t] + [(9, 8 * (s - 0.5), 3 * h) for s in t for h in t]
    walls += [(10 * (s - 0.6), y, 6 * h) for s in t for h in t for y in (-4, 4)] + [(4, 0, 4.5)]
    assert distances(np.array(walls, np.float32), mesh).max() < 0.3
    roof = [(-3, 0, 6), (2, 3, 6), (6.5, 0, 3), (8, -3, 3)]
    assert distances(np.array(roof, np.float32), mesh).max() < 0.1
    inside = [(-1, 0, 3), (6.5, 0, 1.5)]
    assert distances(np.array(inside, np.float32), mesh).min() > 1.0


def test_scanned_walls_are_not_synthesized(house: dict[str, Path], tmp_path: Path) -> None:
    building = PointCloud.load(house["building"])
    y, z = (a.ravel() for a in np.meshgrid(np.arange(-4, 4, 0.25), np.arange(-0.2, 6, 0.25)))
    seen = np.column_stack([np.full(len(y), -6.0), y, z]).astype(np.float32)
    wall = PointCloud(
        FRAME, seen, np.full((len(seen), 3), 200, np.uint8), np.tile(np.array([-1, 0, 0], np.float32), (len(seen), 1)),
        np.full(len(seen), CODE["building"], np.uint8),
    )  # fmt: skip
    PointCloud.join([building, wall]).save(tmp_path / "building.npz")
    inputs = {"building": tmp_path / "building.npz", "terrain": house["terrain"], "ground": house["ground"]}
    x, y, z = PointCloud.load(go(WALLS, tmp_path / "walls", inputs).files["synthesized"]).xyz.T
    assert not ((abs(x + 6) < 0.2) & (abs(y) < 3.8) & (z > 0.3)).any()
    assert (abs(x - 9) < 0.4).sum() > 200


def test_footprints_determine_wall_positions(house: dict[str, Path], tmp_path: Path) -> None:
    ring = np.array([(-5.5, -3.5), (8.5, -3.5), (8.5, 3.5), (-5.5, 3.5), (-5.5, -3.5)]) + FRAME.origin[:2]
    file = tmp_path / "houses.geojson"
    file.write_text(
        json.dumps(polygon(ring) | {"crs": {"type": "name", "properties": {"name": "EPSG:32633"}}}), encoding="utf-8"
    )
    inputs = {name: house[name] for name in ("building", "terrain", "ground")} | {"footprints": file}
    done = go(WALLS, tmp_path / "walls", inputs)
    x, y, _ = PointCloud.load(done.files["synthesized"]).xyz.T
    outer = (abs(x - 4) > 1) | (abs(y) > 3)
    to_side = np.min([abs(x - side) for side in (-5.5, 8.5)] + [abs(y - side) for side in (-3.5, 3.5)], axis=0)
    assert done.metrics["footprints"] == 1
    assert to_side[outer].max() < 0.01
    assert (~outer).sum() > 100  # the step between the roofs


def polygon(ring: np.ndarray) -> dict[str, Any]:
    return {"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring.tolist()]}}
    ]}  # fmt: skip


def geopackage(path: Path, ring: np.ndarray, code: int) -> None:
    """One multipolygon, as GDAL writes it."""
    points = b"".join(struct.pack("<2d", *corner) for corner in ring)
    part = struct.pack("<BIII", 1, 3, 1, len(ring)) + points
    blob = b"GP\x00\x01" + struct.pack("<i", code) + struct.pack("<BII", 1, 6, 1) + part
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE gpkg_spatial_ref_sys(srs_id, organization, organization_coordsys_id, definition)")
        base.execute("CREATE TABLE gpkg_geometry_columns(table_name, column_name, srs_id)")
        base.execute("CREATE TABLE houses(fid, geom)")
        base.execute("INSERT INTO gpkg_spatial_ref_sys VALUES(?, 'EPSG', ?, 'WKT')", (code, code))
        base.execute("INSERT INTO gpkg_geometry_columns VALUES('houses', 'geom', ?)", (code,))
        base.execute("INSERT INTO houses VALUES(1, ?)", (blob,))
    base.close()


@pytest.mark.parametrize("kind", ["degrees", "geojson", "gpkg", "gpkg of degrees"])
def test_footprints_are_converted_to_tile_coordinates(kind: str, tmp_path: Path) -> None:
    from pyproj import Transformer

    ring = np.array([(0.0, 0.0), (0.0, 8.0), (12.0, 8.0), (12.0, 0.0), (0.0, 0.0)]) + FRAME.origin[:2]  # clockwise
    if "degrees" in kind:
        ring = np.column_stack(Transformer.from_crs(32633, 4326, always_xy=True).transform(*ring.T))
    file = tmp_path / ("houses.gpkg" if "gpkg" in kind else "houses.geojson")
    if "gpkg" in kind:
        geopackage(file, ring, 4326 if "degrees" in kind else 32633)
    else:
        file.write_text(json.dumps(polygon(ring)), encoding="utf-8")
    (found,) = footprints.read(file, FRAME)
    assert found[np.lexsort(found.T)] == pytest.approx(np.array([(0, 0), (12, 0), (0, 8), (12, 8)]), abs=1e-3)
    x, y = (found - found[0]).T
    assert np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2 == pytest.approx(96, abs=0.1)


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.geojson", b"{"), ("a.geojson", b'{"type": "Point", "coordinates": [1, 2]}'), ("a.gpkg", b"no database"),
     ("a.shp", b""), ("a.geojson", b'{"type": "Polygon", "coordinates": [[[1, "x"]]]}'),
     ("a.geojson", b'{"type": "Polygon", "coordinates": [[[1' + 400 * b"0" + b", 2]]]}")],
)  # fmt: skip
def test_invalid_footprints_are_rejected(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        footprints.read(tmp_path / name, FRAME)


def test_neighbours_fill_a_hole_on_their_border_identically(house: dict[str, Path], tmp_path: Path) -> None:
    """The house stands on the border; the cloud of each tile extends only 2 m beyond it."""
    seeds = {"a": (499_990.0, 5_400_000.0), "b": (500_010.0, 5_400_000.0)}
    made = {}
    for own, other in (("a", "b"), ("b", "a")):
        inputs = {}
        for part in ("terrain", "building", "vegetation", "rest"):
            cloud = PointCloud.load(house[part])
            for name, key in ((own, part), (other, f"{part}.{other}")):
                side = cloud.xyz[:, 0] * (1 if name == "b" else -1) > -2
                file = tmp_path / f"{own}_{key}.npz"
                cloud.take(side).save(file)
                inputs[key] = file
        cell = {"seed": seeds[own], "neighbours": {other: seeds[other]}, "name": own, "buffer": 2.0}
        cloud = PointCloud.load(go(GROUND, tmp_path / own, inputs, **cell).files["synthesized"])
        assert len(merge_neighbours(inputs, TileCell(**cell), "terrain")) == len(PointCloud.load(house["terrain"]))
        made[own] = {tuple(xyz) for xyz in cloud.xyz.tolist() if abs(xyz[0]) < 2}
    assert len(made["a"]) > 300
    assert made["a"] == made["b"]


def test_only_airborne_clouds_are_completed(tmp_path: Path) -> None:
    tile = read_tile(SAMPLE)
    tasks = {task.step.name: task for task in build_graph(tile, Settings())}
    assert "walls" not in tasks and "instances" in tasks["ground"].inputs  # of a street with vehicles

    bare = replace(tile, views=(), trajectory=None)
    assert {"ground", "walls"} <= {task.step.name for task in build_graph(bare, Settings())}
    off = Settings({"ground": {"when": "never"}, "walls": {"when": "never"}})
    assert {"ground", "walls"}.isdisjoint(task.step.name for task in build_graph(bare, off))


def test_points_far_from_the_mesh_and_synthesized_area_are_reported(house: dict[str, Path], tmp_path: Path) -> None:
    x0, y0, x1, y1, top = HOUSE
    roof = np.array([(x0, y0, top), (x1, y0, top), (x1, y1, top), (x0, y1, top)], np.float32)
    mesh = Mesh(FRAME, np.concatenate([roof, roof - np.array([0, 0, 3], np.float32)]),
                np.array([(0, 1, 2), (0, 2, 3), (4, 0, 7), (0, 3, 7)], np.int32))  # fmt: skip
    mesh.save(tmp_path / "mesh.npz")
    inputs = {"mesh.building": tmp_path / "mesh.npz", "cloud.building": house["building"]}
    done = go(GEOMETRY, tmp_path / "geometry", inputs | {"synthesized.building": house["walls"]})
    assert done.metrics["building"]["cloud_to_mesh_p95_m"] > 2  # the annex is missing
    assert len(done.warnings) == 1 and "building" in done.warnings[0]
    west = 8 * 3 / (8 * 3 + 10 * 8)
    assert done.metrics["building"]["synthesized"] == pytest.approx(west, abs=0.06)


def test_ground_scan_without_a_path_is_not_completed(house: dict[str, Path], tmp_path: Path) -> None:
    building = PointCloud.load(house["building"])
    y, z = (a.ravel() for a in np.meshgrid(np.arange(-4, 4, 0.1), np.arange(0, 6, 0.1)))
    wall = np.column_stack([np.full(len(y), -6.0), y, z]).astype(np.float32)
    seen = PointCloud(FRAME, wall, normal=np.tile(np.array([-1, 0, 0], np.float32), (len(wall), 1)),
                      classification=np.full(len(wall), CODE["building"], np.uint8))  # fmt: skip
    ledge = building.take(np.flatnonzero(building.xyz[:, 0] < -5))
    PointCloud.join([ledge, seen]).save(tmp_path / "building.npz")
    inputs = {name: house[name] for name in ("terrain", "vegetation", "rest")} | {"building": tmp_path / "building.npz"}
    for step in (GROUND, WALLS):
        assert go(step, tmp_path / step.name, inputs).metrics["points"] == 0
        assert go(step, tmp_path / f"{step.name}_asked", inputs, when="always").metrics["points"] > 0


def test_points_without_a_surface_are_reported(house: dict[str, Path], tmp_path: Path) -> None:
    nothing = Mesh(FRAME, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    nothing.save(tmp_path / "none.npz")
    done = go(GEOMETRY, tmp_path, {"mesh.building": tmp_path / "none.npz", "cloud.building": house["building"]})
    assert done.metrics == {} and "the world has no building" in done.warnings[0]


def test_raster_exceeding_memory_is_rejected() -> None:
    corners = np.array([[0, 0, 0], [5000, 5000, 0]], np.float32)
    assert Raster.over(0.5, [corners]).shape[0] > 10_000
    with pytest.raises(DataError, match="too many"):
        Raster.over(0.1, [corners])

"""Requirements on all scene formats: all surfaces with their positions, colours and labels."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import DataError, InputError, ScanError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams, carla, gazebo
from scan2sim.pipeline.io.worlds import readme
from scan2sim.pipeline.io.worlds.scene import Level, Scene, read_scene
from tests.fakes import synthetic
from tests.fakes.scene_readers import READERS, Shown, fbx, image, survey_error

WITHOUT_MESHES = {"opendrive", "openscenario", "splats", "splats_tiles3d"}
each = pytest.mark.parametrize("name", READERS)
LABELS = {"terrain": 2, "building": 6, "road_sign": 64}


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return synthetic.scene(tmp_path_factory.mktemp("town"))


@pytest.fixture(scope="module")
def exported(town: Scene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {name: tmp_path_factory.mktemp(name) for name in world_formats.format_names()}


def test_every_format_has_a_reader() -> None:
    assert set(world_formats.format_names()) == READERS.keys() | WITHOUT_MESHES


def written(scene: Scene, name: str, folder: Path, **params: Any) -> Path:
    """An export; the test is skipped where it can't be written here."""
    missing = plugins.missing(world_formats.PACKAGE, name)
    if missing:
        pytest.skip(f"{missing} is not installed")
    world_formats.write(scene, [name], folder, SceneParams(**params), silent)
    return folder


def expected(scene: Scene) -> list[Shown]:
    """Surfaces of a scene, from its files."""
    shown = []
    for tile in scene.tiles:
        for surface in tile.surfaces():
            for page in surface.shape.used_pages:
                part = surface.shape.on_page(page)
                assert part.mesh.uv is not None
                corners = part.mesh.corners + np.array(tile.offset)
                shown.append(Shown(surface.code, corners, part.mesh.uv, image(part.pages[page])))
    return shown


def faces(shown: list[Shown]) -> np.ndarray:
    """Faces of all meshes (F, 16): class, centre, corners, colour at the centre; sorted."""
    rows = []
    for one in shown:
        label = one.label if isinstance(one.label, int) else CODE[one.label]
        first = np.lexsort(np.round(one.corners, 2).transpose(2, 0, 1)[::-1], axis=-1)[:, 0]
        turned = np.take_along_axis(one.corners, ((first[:, None] + np.arange(3)) % 3)[..., None], axis=1)
        height, width = one.image.shape[:2]
        u, v = one.uv.mean(axis=1).T
        column = (u * width).astype(int).clip(0, width - 1)
        row = ((1 - v) * height).astype(int).clip(0, height - 1)
        colour = one.image[row, column].astype(float)
        rows.append(np.column_stack([np.full(len(turned), label), turned.reshape(-1, 9), colour]))
    every = np.concatenate(rows)
    return every[np.lexsort(np.round(every[:, :10], 2).T[::-1])]


@each
def test_all_surfaces_have_their_positions_and_colours(town: Scene, exported: dict[str, Path], name: str) -> None:
    written(town, name, exported[name])
    for path in exported[name].rglob("*"):
        assert path.name.isascii() and " " not in path.name
    own, seen = faces(expected(town)), faces(list(READERS[name](exported[name], town)))
    assert len(seen) == len(own)
    np.testing.assert_array_equal(seen[:, 0], own[:, 0])
    np.testing.assert_allclose(seen[:, 1:10], own[:, 1:10], atol=1e-3)
    assert np.abs(seen[:, 10:] - own[:, 10:]).mean() < 3 and np.percentile(np.abs(seen[:, 10:] - own[:, 10:]), 95) < 20


FLAGGED = ("glb", "tiles3d", "usd")
"""Formats with a flag for surfaces that are seen from both sides."""


@pytest.fixture
def facade(tmp_path: Path) -> Scene:
    """The town's first tile, whose house is a facade: what a car sees of it."""
    scene = synthetic.scene(tmp_path, tiles=1)
    folder = scene.tiles[0].folder / "building"
    house = Mesh.load(folder / "mesh.npz")
    front = house.face_normal[:, 1] < -0.9
    house.keep(front).save(folder / "mesh.npz")
    np.save(folder / "photo.npy", np.load(folder / "photo.npy")[front])
    np.save(folder / "reflectance.npy", np.load(folder / "reflectance.npy")[np.unique(house.faces[front])])
    return read_scene(tmp_path / "world")


@each
@pytest.mark.parametrize("both", [True, False])
def test_a_wall_scanned_from_one_side_is_seen_from_both(facade: Scene, tmp_path: Path, name: str, both: bool) -> None:
    seen = [
        (corners, uv)
        for one in READERS[name](written(facade, name, tmp_path / "out", double_sided=both), facade)
        if one.label in (CODE["building"], "building")
        for corners, uv in zip(np.round(one.corners, 3).tolist(), np.round(one.uv, 4).tolist(), strict=True)
    ]
    assert len(seen) == (4 if both and name not in FLAGGED else 2)
    if len(seen) == 4:  # each triangle and its reverse, with the same place in the texture
        turned = [{*map(str, zip(*face, strict=True))} for face in seen]
        assert all(turned.count(corners) == 2 for corners in turned)
        normals = [np.cross(np.subtract(b, a), np.subtract(c, a)) for (a, b, c), _ in seen]
        assert sorted(np.sign(normal[1]) for normal in normals) == [-1, -1, 1, 1]


@pytest.mark.parametrize("both", [True, False])
def test_formats_with_a_flag_use_it_for_all_but_the_backdrop(facade: Scene, tmp_path: Path, both: bool) -> None:
    import trimesh

    for name, file in (("glb", "tile0.glb"), ("tiles3d", "tiles3d/tile0.glb")):
        folder = written(facade, name, tmp_path / name, double_sided=both)
        shapes = trimesh.load_scene(folder / file, process=False).geometry.values()
        assert {bool(shape.visual.material.doubleSided) for shape in shapes} == {both}
    folder = written(facade, "usd", tmp_path / "usd", double_sided=both)
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(folder / "usd" / "tile0.usdc"))
    assert UsdGeom.Mesh(stage.GetPrimAtPath("/tile0/Visual/building")).GetDoubleSidedAttr().Get() == both


def test_usd_has_the_reflectance_of_vertices(town: Scene, tmp_path: Path) -> None:
    folder = written(town, "usd", tmp_path)
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(folder / "usd" / "tile0.usdc"))
    found = {}
    for name in ("terrain", "building"):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/tile0/Visual/{name}"))
        primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("reflectance")
        assert primvar.GetInterpolation() == UsdGeom.Tokens.vertex
        assert len(primvar.Get()) == len(mesh.GetPointsAttr().Get())
        found[name] = float(np.median(primvar.Get()))
    assert found == pytest.approx(synthetic.REFLECTANCE)
    written(town, "usd", tmp_path / "without", reflectance=False)
    stage = Usd.Stage.Open(str(tmp_path / "without" / "usd" / "tile0.usdc"))
    assert not UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/tile0/Visual/terrain")).HasPrimvar("reflectance")


@each
def test_scene_without_a_crs_has_no_georeference(tmp_path: Path, name: str) -> None:
    scene = synthetic.scene(tmp_path, Frame(), tiles=1)
    written(scene, name, tmp_path / "out")
    assert faces(list(READERS[name](tmp_path / "out", scene))).shape == faces(expected(scene)).shape
    assert json.loads((tmp_path / "out" / "metadata.json").read_text(encoding="utf-8"))["wgs84"] is None


@each
def test_scene_without_ground_contains_the_other_surfaces(tmp_path: Path, name: str) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    (tile,) = scene.tiles
    solid = tile.solid()
    assert solid.classification is not None
    solid.keep(solid.classification != CODE["terrain"]).save(tile.folder / "collision.npz")
    bare = replace(scene, tiles=(replace(tile, groups={"building": tile.groups["building"]}),))
    folder = written(bare, name, tmp_path / "out")
    assert faces(list(READERS[name](folder, bare))).shape == faces(expected(bare)).shape


@each
def test_surveyed_points_are_accurate_to_1_cm_at_5_km(tmp_path: Path, name: str) -> None:
    scene = synthetic.scene(tmp_path, tiles=2, apart=5000.0)
    folder = written(scene, name, tmp_path / "out")
    assert json.loads((folder / "metadata.json").read_text(encoding="utf-8"))["crs"] == "EPSG:32632"
    assert survey_error(folder, scene, name) < 0.01


def test_scene_is_read_from_a_run_or_its_world(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path)
    assert read_scene(tmp_path) == read_scene(tmp_path / "world") == scene
    assert [tile.offset for tile in scene.tiles] == [(0, 0, 0), (25, 3, -1)]
    assert {surface.label for surface in scene.tiles[0].surfaces()} == set(LABELS)


def test_background_is_the_median_of_the_tiles_and_stored(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=3)
    assert scene.sky is None and "sky_rgb" not in world_formats.metadata(scene, {})
    for tile, level in zip(scene.tiles, (100, 250, 110), strict=True):
        file = tile.folder / "tile.json"
        body = json.loads(file.read_text(encoding="utf-8"))
        file.write_text(json.dumps(body | {"sky_rgb": [level, 0, 0]}), encoding="utf-8")
    again = read_scene(tmp_path)
    assert again.sky == (110, 0, 0) and world_formats.metadata(again, {})["sky_rgb"] == [110, 0, 0]
    world_formats.write(again, ["gazebo", "mujoco"], tmp_path / "out", SceneParams(), silent)
    assert "<background>0.431 0 0 1</background>" in (tmp_path / "out" / "town.sdf").read_text(encoding="utf-8")
    assert 'builtin="flat" rgb1="0.431 0 0"' in (tmp_path / "out" / "town.xml").read_text(encoding="utf-8")


def test_worlds_without_a_scene_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="contains no world"):
        read_scene(tmp_path)
    world = synthetic.world(tmp_path).files["world"]
    about = world / "scene" / "scene.json"
    about.write_text(about.read_text(encoding="utf-8").replace('"version": 1', '"version": 9'), encoding="utf-8")
    with pytest.raises(InputError, match=r"version 9.*run.*again"):
        read_scene(world)
    about.unlink()
    with pytest.raises(InputError, match=r"earlier version.*run.*again"):
        read_scene(world)
    about.write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=r"can't be read.*run.*again"):
        read_scene(world)


def test_bounding_volumes_contain_their_level_and_finer_ones(tmp_path: Path) -> None:
    import trimesh

    town = synthetic.scene(tmp_path)
    fine = tuple(Level(tile) for tile in town.tiles)
    written(replace(town, coarse=Level(town.tiles[0], 1, 0.5, 0.1, fine)), "tiles3d", tmp_path / "out")
    root = json.loads((tmp_path / "out" / "tileset.json").read_text(encoding="utf-8"))["root"]
    assert root["geometricError"] == 1.6 and root["extras"] == {"error_m": 0.5, "texel_m": 0.1}  # 16 texels

    def check(node: dict[str, Any]) -> np.ndarray:
        """Vertices of the content at and below a node, in metres of the node."""
        read = trimesh.load_scene(tmp_path / "out" / node["content"]["uri"], process=False)
        shown = [v[:, [0, 2, 1]] * (1, -1, 1) for v in (mesh.vertices for mesh in read.geometry.values())]
        for child in node.get("children", ()):
            place = np.reshape(child["transform"], (4, 4)).T
            shown.append(check(child) @ place[:3, :3].T + place[:3, 3])
        every, box = np.concatenate(shown), np.array(node["boundingVolume"]["box"])
        assert (np.abs(every - box[:3]) < np.diag(box[3:].reshape(3, 3)) + 1e-3).all()
        return every

    apart = np.ptp(check(root), axis=0)
    assert apart[0] == pytest.approx(45, abs=0.1)  # two tiles of 20 m, 25 m apart


def test_carla_names_carry_semantic_tags(tmp_path: Path) -> None:
    town = synthetic.scene(tmp_path, tiles=1)
    solid = town.tiles[0].solid()
    assert solid.classification is not None
    east = (solid.classification == CODE["terrain"]) & (solid.corners.mean(axis=1)[:, 0] > 0)
    codes = np.where(east, CODE["road"], solid.classification).astype(np.uint8)
    replace(solid, classification=codes).save(town.tiles[0].folder / "collision.npz")
    written(town, "carla", tmp_path / "out")
    meshes = {name: corners for name, corners, *_ in fbx(tmp_path / "out" / "carla" / "town" / "town.fbx")}
    assert meshes.keys() == {"town_Road_Road_tile0_1", "town_Terrain_tile0_0"}  # a page for each half
    assert meshes["town_Road_Road_tile0_1"][..., 0].min() > -1e-6
    about = json.loads((tmp_path / "out" / "carla" / "town.json").read_text(encoding="utf-8"))
    assert {prop["name"]: prop["tag"] for prop in about["props"]} == {
        "town_tile0_building": "Building", "town_tile0_building_road_sign": "TrafficSign",
    }  # fmt: skip


def test_no_two_textures_of_gazebos_world_have_the_same_file_name(tmp_path: Path) -> None:
    # gz-rendering #139: the second would show the first
    written(synthetic.scene(tmp_path), "gazebo", tmp_path / "out")
    names = [path.name for path in (tmp_path / "out").rglob("*.png")]
    assert len(names) == len(set(names)) and len(names) >= 8  # two tiles, two surfaces, two pages


def test_worlds_of_reserved_names_are_rejected(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    for renamed in (replace(scene, name="world"), replace(scene, tiles=(replace(scene.tiles[0], name="world"),))):
        with pytest.raises(DataError, match="reserved by simulators"):
            world_formats.write(renamed, ["glb"], tmp_path / "out", SceneParams(), silent)
    assert not (tmp_path / "out").exists()


def test_carla_knows_the_tags() -> None:
    # ATagger::GetLabelByFolderName of CARLA 0.9.15; a folder with another name has no label
    labels = {
        "Building", "Fence", "Pedestrian", "Pole", "Other", "Road", "RoadLine", "SideWalk", "TrafficSign", "Vegetation",
        "Car", "Wall", "Sky", "Ground", "Bridge", "RailTrack", "GuardRail", "TrafficLight", "Static", "Dynamic",
        "Water", "Terrain", "Truck", "Motorcycle", "Bicycle", "Bus", "Rider", "Train",
    }  # fmt: skip
    assert {*carla.PROP_TAGS.values(), carla.DEFAULT_TAG} <= labels
    assert carla.PROP_TAGS[CODE["vehicle"]] == "Car"


def test_large_ground_is_split_into_carla_map_tiles_from_the_north_west(tmp_path: Path) -> None:
    town = synthetic.scene(tmp_path, apart=3000.0)
    written(town, "carla", tmp_path / "out")
    folder = tmp_path / "out" / "carla"
    package, props = (json.loads((folder / f"{name}.json").read_text("utf-8")) for name in ("town", "town_props"))
    # Import.py makes vertices of all files of a package with tiles relative to their tile
    assert not package["props"] and len(props["props"]) == 4 and not props["maps"]
    (about,) = package["maps"]
    assert about["tiles"] == ["./town/town_Tile_0_0.fbx", "./town/town_Tile_1_0.fbx"]
    (name, corners, _, picture), *_ = fbx(tmp_path / "out" / "carla" / "town" / "town_Tile_1_0.fbx")
    assert name.startswith("town_Terrain_tile1") and corners[..., 0].min() == pytest.approx(2990, abs=0.01)
    assert picture.parent.name == "town_Tile_1_0.fbm" and picture.is_file()


def test_usd_files_have_a_version_that_isaac_sim_4_reads(tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed")
    code = (
        "from pathlib import Path; from scan2sim.pipeline.io.world_formats import usd; "
        "stage = usd._stage(Path('a.usdc')); stage.GetRootLayer().Save()"
    )
    mine = {name: value for name, value in os.environ.items() if not name.startswith("USD_")}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, env=mine)  # OpenUSD reads its settings once
    head = (tmp_path / "a.usdc").read_bytes()
    assert head[:8] == b"PXR-USDC" and tuple(head[8:11]) <= (0, 9, 0)


def test_usd_contains_photo_and_distance_of_each_face(town: Scene, exported: dict[str, Path]) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom

    written(town, "usd", exported["usd"])
    stage = Usd.Stage.Open(str(exported["usd"] / "town.usdc"))
    tile = town.tiles[0]
    root = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/tile0"))
    assert list(root.GetPrimvar("scan2sim:photos").Get()) == ["front"]
    assert list(root.GetPrimvar("scan2sim:taken").Get()) == ["2018-06-01T00:00:00+00:00"]
    ground = next(surface for surface in tile.surfaces() if surface.name == "terrain")
    mesh = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/tile0/Visual/terrain"))
    far = np.linalg.norm(ground.shape.mesh.corners.mean(axis=1) - tile.views()[0].centre, axis=1)
    np.testing.assert_allclose(mesh.GetPrimvar("scan2sim:distance").Get(), far, atol=1e-3)
    assert set(mesh.GetPrimvar("scan2sim:photo").Get()) == {0} and set(mesh.GetPrimvar("scan2sim:seen").Get()) == {255}


@each
def test_any_folder_name_and_tiles_without_a_class_are_exported(tmp_path: Path, name: str) -> None:
    scene = synthetic.scene(tmp_path / "Straße mit Bäumen")
    bare = replace(scene.tiles[1], groups={"terrain": scene.tiles[1].groups["terrain"]})
    scene = replace(scene, tiles=(scene.tiles[0], bare))
    written(scene, name, tmp_path / "out")
    own, seen = faces(expected(scene)), faces(list(READERS[name](tmp_path / "out", scene)))
    np.testing.assert_array_equal(seen[:, 0], own[:, 0])
    for path in (tmp_path / "out").rglob("*"):
        assert path.name.isascii() and " " not in path.name


def test_failing_parts_of_a_world_cost_only_themselves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("a bug")

    scene, failed = synthetic.scene(tmp_path, tiles=1), dict[str, ScanError]()
    monkeypatch.setattr(world_formats, "default_pose", broken)
    monkeypatch.setattr(gazebo, "write_traffic", broken)
    monkeypatch.setattr(readme, "write", broken)
    world_formats.write(scene, ["gazebo"], tmp_path / "out", SceneParams(), silent, failed=failed)
    assert failed.keys() == {"spawn", "traffic", "readme"} and all("a bug" in one.cause for one in failed.values())
    assert (tmp_path / "out" / f"{scene.name}.sdf").is_file() and not (tmp_path / "out" / "README.md").exists()
    assert "spawn" not in json.loads((tmp_path / "out" / "metadata.json").read_text(encoding="utf-8"))
    with pytest.raises(ZeroDivisionError):
        world_formats.write(scene, ["gazebo"], tmp_path / "strict", SceneParams(), silent)

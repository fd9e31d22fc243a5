"""3D Tiles of splats: structure of the tileset, its boxes, its contents, and its image in Cesium."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gsply", reason="the extra splats isn't installed")

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Camera
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.geodata import crs
from scan2sim.pipeline.io.world_formats import SceneParams, splats_tiles3d
from scan2sim.pipeline.io.worlds import splat_levels
from scan2sim.pipeline.io.worlds.scene import Scene
from tests.fakes import cesium, splat_scenes, synthetic
from tests.fakes.consumers import cesium_splats, gltf_validator
from tests.fakes.splat_tiles import content, leaves, nodes, tileset

COUNT = 3000


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Two tiles with splats."""
    made = synthetic.scene(tmp_path_factory.mktemp("town"))
    for seed, tile in enumerate(made.tiles, start=1):
        splat_scenes.add(tile, seed, COUNT)
    return made


@pytest.fixture(scope="module")
def export(town: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(splat_levels.levels, "__defaults__", (500,))
        world_formats.write(town, ["splats_tiles3d"], folder, SceneParams(), silent)
    return folder


def test_leaves_hold_all_splats_at_their_place_on_the_earth(town: Scene, export: Path) -> None:
    found = [splats.xyz @ matrix[:3, :3].T + matrix[:3, 3] for splats, matrix in leaves(export)]
    expected = []
    for tile in town.tiles:
        layer = tile.splats()
        assert layer is not None
        expected.append(crs.to_ecef(tile.frame, layer.splats.xyz))
    own, seen = np.concatenate(expected), np.concatenate(found)
    assert len(seen) == len(own) == 2 * COUNT
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(seen).query(own)
    assert distance.max() < 1e-3 and len(np.unique(nearest)) == len(own)


def test_levels_are_smaller_than_their_children_and_boxes_contain_them(export: Path) -> None:
    parents = 0
    for node, _ in nodes(tileset(export)["root"]):
        if "content" not in node:
            continue
        tree, splats = content(export / node["content"]["uri"])
        box = np.array(node["boundingVolume"]["box"])
        half = np.diag(box[3:].reshape(3, 3))
        reach = 2.8 * np.sqrt(np.diagonal(splats.covariance, axis1=1, axis2=2))  # SPZ rounds sizes
        assert (np.abs(splats.xyz - box[:3]) + reach <= half + 2e-3).all()
        assert tree["accessors"][0]["count"] == len(splats) and tree["meshes"][0]["primitives"][0]["mode"] == 0
        if "children" in node:
            parents += 1
            assert node["refine"] == "REPLACE" and node["extras"]["spacing_m"] > 0
            below = [content(export / one["content"]["uri"])[1] for one in node["children"]]
            assert len(splats) < sum(map(len, below))
            assert node["geometricError"] > max(one["geometricError"] for one in node["children"])
        else:
            assert node["geometricError"] == 0
    assert parents > 2


def test_contents_and_tileset_declare_the_extensions_of_splats(export: Path) -> None:
    given = tileset(export)
    declared = given["extensions"]["3DTILES_content_gltf"]
    assert given["extensionsUsed"] == ["3DTILES_content_gltf"] and given["asset"] == {"version": "1.1"}
    for path in export.rglob("*.glb"):
        tree, _ = content(path)
        assert tree["extensionsRequired"] == declared["extensionsRequired"] == splats_tiles3d.EXTENSIONS
        extension = tree["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
        assert extension["extensions"]["KHR_gaussian_splatting_compression_spz_2"] == {"bufferView": 0}
    assert not list(export.rglob("*.spz"))


def test_tiles_without_splats_are_left_out(town: Scene, tmp_path: Path) -> None:
    made = synthetic.scene(tmp_path / "town")
    splat_scenes.add(made.tiles[1], 1, 50)
    world_formats.write(made, ["splats_tiles3d"], tmp_path / "export", SceneParams(), silent)
    (child,) = tileset(tmp_path / "export")["root"]["children"]
    assert child["content"]["uri"] == f"splats3d/{made.tiles[1].name}/level.glb"


def test_a_world_without_splats_is_rejected_as_by_the_format_splats(tmp_path: Path) -> None:
    bare = synthetic.scene(tmp_path / "town")
    for name in ("splats", "splats_tiles3d"):
        with pytest.raises(DataError, match=r"has no splats.*splats\.when=auto"):
            world_formats.write(bare, [name], tmp_path / name, SceneParams(), silent)


def test_both_tilesets_can_be_in_one_folder(town: Scene, tmp_path: Path) -> None:
    world_formats.write(town, ["tiles3d", "splats_tiles3d"], tmp_path, SceneParams(), silent)
    assert (tmp_path / "tileset.json").is_file() and (tmp_path / splats_tiles3d.FILE).is_file()


def test_khronos_validator_finds_nothing_but_unknown_extensions(export: Path) -> None:
    if reason := gltf_validator.missing():
        pytest.skip(reason)
    path = next(export.rglob("*.glb"))
    found = [one for one in gltf_validator.issues(path)["messages"] if one["severity"] <= 1]
    assert not [one for one in found if "KHR_gaussian_splatting" not in one["pointer"]], found


def test_cesium_draws_the_splats_as_the_camera_in_python(town: Scene, export: Path, tmp_path: Path) -> None:
    """All of both tiles near by; from far away, fewer splats."""
    if reason := cesium.missing():
        pytest.skip(reason)
    ahead = np.eye(4)
    ahead[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    ahead[:3, 3] = (-25, 0, 2.5)
    camera = Camera("pinhole", 480, 360, 300.0, 300.0, 239.5, 179.5)
    with cesium_splats.viewer(export, tmp_path, camera) as view:
        seen = view.drawn(ahead, whole=True)
        assert view.count() == 2 * COUNT
        own = cesium_splats.drawn_in_python(export, camera, ahead)
        assert (own != cesium.SKY).any(axis=2).mean() > 0.1 and cesium_splats.psnr(own, seen) > 35
        ahead[0, 3] = -500
        far = view.drawn(ahead)
        assert (far != cesium.SKY).any() and view.count() < COUNT

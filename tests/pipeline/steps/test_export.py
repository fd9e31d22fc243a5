"""Export: files and metadata of a world's folder."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scan2sim.pipeline.core.errors import DataError, InputError, SettingError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.simulation import ground_origin
from scan2sim.pipeline.steps.export import EXPORT, ExportParams
from tests.fakes import synthetic
from tests.present import present


def _files(world: Path) -> set[str]:
    return {path.relative_to(world).as_posix() for path in world.rglob("*") if path.is_file()}


def _inputs(folder: Path, **meshes: Mesh) -> dict[str, Path]:
    solid = folder / "collision.npz"
    Mesh(synthetic.UTM, synthetic.house().vertices, synthetic.house().faces).save(solid)
    return {group: synthetic.textured(folder / group, mesh) for group, mesh in meshes.items()} | {"collision": solid}


def test_world_folder_contains_the_documented_files(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path).files["world"]
    meshes = "models/street/meshes"
    groups = {f"{meshes}/{group}{end}" for group in ("terrain", "building") for end in (".obj", ".mtl", ".dae")} | {
        f"{meshes}/street_{group}_{page}.png" for group in ("terrain", "building") for page in (0, 1)
    }
    kept = ("mesh.npz", "page_0.png", "page_1.png", "page_0_seen.png", "page_1_seen.png")
    assert _files(world) == groups | {
        "street.sdf",
        "street.glb",
        "scene/scene.json",
        "scene/street/tile.json",
        "scene/street/collision.npz",
        *(f"scene/street/{group}/{file}" for group in ("terrain", "building") for file in kept),
        "metadata.json",
        "README.md",
        "models/street/model.sdf",
        "models/street/model.config",
        f"{meshes}/collision_terrain.obj",
        f"{meshes}/collision_building.obj",
    }


def test_model_refers_to_existing_files(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path, friction=0.7).files["world"]
    model = present(ET.parse(world / "models/street/model.sdf").getroot().find("model"))
    assert model.findtext("static") == "true"
    uris = [present(uri.text) for uri in model.iter("uri")]
    assert len(uris) == 4
    for uri in uris:
        assert (world / uri.replace("model://", "models/")).is_file()
    friction = present(model.find("link/collision/surface/friction"))
    assert {value.text for value in friction.iter() if value.tag.startswith(("mu", "friction")) and not len(value)} == {
        "0.7"
    }
    config = ET.parse(world / "models/street/model.config").getroot()
    assert config.findtext("name") == "street" and config.findtext("sdf") == "model.sdf"


def test_large_group_is_split_without_losing_triangles(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path, max_visual_triangles=1000).files["world"]
    counts = json.loads((world / "metadata.json").read_text(encoding="utf-8"))["triangles_by_file"]
    for suffix in (".obj", ".dae"):
        parts = [n for file, n in counts.items() if "terrain_part" in file and file.endswith(suffix)]
        assert len(parts) == 4 and max(parts) <= 1000 and sum(parts) == 3200
    model = ET.parse(world / "models/street/model.sdf").getroot()
    names = [visual.get("name") for visual in model.iter("visual")]
    assert names == ["terrain_part1", "terrain_part2", "terrain_part3", "terrain_part4", "building"]
    assert len(list(world.rglob("street_terrain_*.png"))) == 2  # pages are shared by the parts


def test_metadata_contains_the_georeference(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path).files["world"]
    metadata = json.loads((world / "metadata.json").read_text(encoding="utf-8"))
    assert metadata["crs"] == "EPSG:32632" and metadata["unit_m"] == 1.0
    assert metadata["origin_m"] == list(synthetic.UTM.origin)
    assert metadata["wgs84"]["latitude_deg"] == pytest.approx(48.13986, abs=1e-5)
    assert metadata["wgs84"]["longitude_deg"] == pytest.approx(11.55407, abs=1e-5)
    assert metadata["groups"]["terrain"]["triangles"] == 3200
    assert metadata["groups"]["building"]["high_m"] == [7.0, 4.0, 4.5]


def test_world_is_placed_with_the_ground_of_its_origin_at_zero(tmp_path: Path) -> None:
    x, y, z = synthetic.UTM.origin
    house = synthetic.house()
    inputs = _inputs(tmp_path, terrain=synthetic.ground(), building=house)
    ground_origin.save(tmp_path / "origin.json", (x, y, z + 0.75))
    done = EXPORT.run({**inputs, "origin": tmp_path / "origin.json"}, ExportParams(), tmp_path / "out", silent)
    world = done.files["world"]
    metadata = json.loads((world / "metadata.json").read_text(encoding="utf-8"))
    assert metadata["world_origin_m"] == [x, y, z + 0.75] and metadata["origin_m"] == [x, y, z]
    assert ET.parse(next(world.glob("*.sdf"))).getroot().findtext("world/include/pose") == "0 0 -0.75 0 0 0"
    chosen = EXPORT.run(
        {**inputs, "origin": tmp_path / "origin.json"}, ExportParams(world_origin=(x, y, z)), tmp_path / "b", silent
    )
    assert json.loads((chosen.files["world"] / "metadata.json").read_text("utf-8"))["world_origin_m"] == [x, y, z]


def test_tiles_share_a_georeference_by_the_model_pose_alone(tmp_path: Path) -> None:
    x, y, z = synthetic.UTM.origin
    alone = synthetic.world(tmp_path / "a").files["world"]
    placed = synthetic.world(tmp_path / "b", world_origin=(x - 100, y + 50, z)).files["world"]
    assert ET.parse(placed / "street.sdf").getroot().findtext("world/include/pose") == "100 -50 0 0 0 0"
    meshes = "models/street/meshes"
    assert (alone / meshes / "terrain.obj").read_bytes() == (placed / meshes / "terrain.obj").read_bytes()
    latitude = [
        float(ET.parse(w / "street.sdf").getroot().findtext("world/spherical_coordinates/latitude_deg", ""))
        for w in (alone, placed)
    ]
    assert latitude[1] > latitude[0]


def test_local_tile_has_no_georeference(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path, frame=Frame()).files["world"]
    assert "spherical_coordinates" not in (world / "street.sdf").read_text(encoding="utf-8")
    metadata = json.loads((world / "metadata.json").read_text(encoding="utf-8"))
    assert metadata["crs"] == "local" and metadata["wgs84"] is None


def test_only_selected_formats_are_written(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path, formats=("gazebo",), meshes=("collada",)).files["world"]
    assert not list(world.rglob("*.glb")) and all(p.name.startswith("collision_") for p in world.rglob("*.obj"))
    assert "terrain.dae" in (world / "models/street/model.sdf").read_text(encoding="utf-8")
    with pytest.raises(SettingError, match=r"export.meshes: has no format that Gazebo can show"):
        EXPORT.run({}, ExportParams(meshes=()), tmp_path, silent)


def test_empty_group_is_omitted_and_empty_world_rejected(tmp_path: Path) -> None:
    house = synthetic.house()
    none = replace(house, faces=house.faces[:0], uv=None, page=None)
    inputs = _inputs(tmp_path, terrain=none, building=house)
    done = EXPORT.run(inputs, ExportParams(), tmp_path / "out", silent)
    assert set(done.metrics["triangles"]) == {"building"}
    del inputs["building"]
    with pytest.raises(DataError, match="all surfaces are empty"):
        EXPORT.run(inputs, ExportParams(), tmp_path / "none", silent)


def test_lists_of_plants_are_copied_to_the_world(tmp_path: Path) -> None:
    inputs = _inputs(tmp_path, building=synthetic.house())
    for key, file in {"plants": "a.geojson", "plants_csv": "b.csv"}.items():
        inputs[key] = tmp_path / file
        inputs[key].write_text(key, encoding="utf-8")
    world = EXPORT.run(inputs, ExportParams(), tmp_path / "out", silent).files["world"]
    assert (world / "plants.geojson").read_text(encoding="utf-8") == "plants"
    assert (world / "plants.csv").read_text(encoding="utf-8") == "plants_csv"


def test_inconsistent_inputs_are_rejected(tmp_path: Path) -> None:
    inputs = _inputs(tmp_path, building=synthetic.house(Frame("EPSG:32632", (1.0, 2.0, 3.0))))
    with pytest.raises(InputError, match="origin"):
        EXPORT.run(inputs, ExportParams(), tmp_path / "a", silent)
    inputs = _inputs(tmp_path, terrain=synthetic.ground())
    (inputs["terrain"] / "page_1.png").unlink()
    with pytest.raises(InputError, match=r"page_1.png: file not found"):
        EXPORT.run(inputs, ExportParams(), tmp_path / "b", silent)
    bare = replace(synthetic.house(), uv=None, page=None)
    bare.save(inputs["terrain"] / "mesh.npz")
    with pytest.raises(InputError, match="no texture coordinates"):
        EXPORT.run(inputs, ExportParams(), tmp_path / "c", silent)


def test_export_is_deterministic(tmp_path: Path) -> None:
    a, b = (synthetic.world(tmp_path / name).files["world"] for name in "ab")
    for file in _files(a) - {f for f in _files(a) if f.endswith(".dae")}:  # Collada contains the time of writing
        assert (a / file).read_bytes() == (b / file).read_bytes(), file


def test_texture_pages_are_copied_unchanged(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path).files["world"]
    for page in (0, 1):
        copy = world / f"models/street/meshes/street_terrain_{page}.png"
        assert copy.read_bytes() == (tmp_path / f"terrain/page_{page}.png").read_bytes()
        assert copy.stat().st_ino != (tmp_path / f"terrain/page_{page}.png").stat().st_ino  # may be edited freely


def test_texture_pages_are_converted_to_jpeg(tmp_path: Path) -> None:
    world = synthetic.world(tmp_path, pages="jpeg").files["world"]
    meshes = world / "models/street/meshes"
    assert not list(meshes.glob("*.png"))
    for file in ("terrain.mtl", "terrain.dae"):
        assert "street_terrain_0.jpg" in (meshes / file).read_text(encoding="utf-8")
    with Image.open(meshes / "street_terrain_0.jpg") as copy, Image.open(tmp_path / "terrain/page_0.png") as page:
        assert copy.format == "JPEG" and copy.size == page.size


def test_normals_and_uv_have_no_nan(tmp_path: Path) -> None:
    house = synthetic.house()
    faces, uv = np.concatenate([house.faces, [[0, 0, 1]]]).astype(np.int32), present(house.uv)
    flat = replace(
        house, faces=faces, uv=np.concatenate([uv, uv[:1]]), page=np.append(present(house.page), np.int16(0))
    )
    EXPORT.run(_inputs(tmp_path, building=flat), ExportParams(), tmp_path / "out", silent)
    assert not [p for p in (tmp_path / "out").rglob("*.obj") if "nan" in p.read_text(encoding="utf-8")]

"""World of a survey: every tile at its position in a separate level; replaced only when complete."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import DataError, InputError, ScanError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams, gazebo
from scan2sim.pipeline.io.worlds import merge, readme, sdf
from scan2sim.pipeline.io.worlds.merge import TileWorld, assemble
from scan2sim.pipeline.io.worlds.scene import read_scene
from tests.fakes import synthetic

EAST = 25.0  # metres from one tile to the next


def tiles(folder: Path, count: int = 3) -> list[TileWorld]:
    """Synthetic tiles in a row, eastwards."""
    x, y, z = synthetic.UTM.origin
    made = []
    for i in range(count):
        frame = replace(synthetic.UTM, origin=(x + EAST * i, y + 3, z - i))
        world = synthetic.world(folder / f"tile{i}", frame=frame, name=f"tile{i}").files["world"]
        made.append(TileWorld(f"tile{i}", world, frame))
    return made


@pytest.fixture(scope="module")
def row(tmp_path_factory: pytest.TempPathFactory) -> list[TileWorld]:
    return tiles(tmp_path_factory.mktemp("tiles"))


def _root(path: Path) -> ET.Element:
    world = ET.parse(path).getroot().find("world")
    assert world is not None
    return world


def _vector(element: ET.Element, path: str) -> np.ndarray:
    return np.array(element.findtext(path, "").split(), float)


def _snapshot(folder: Path) -> dict[str, int]:
    return {path.relative_to(folder).as_posix(): path.stat().st_mtime_ns for path in folder.rglob("*")}


def test_all_tiles_are_included_at_their_positions(tmp_path: Path, row: Sequence[TileWorld]) -> None:
    path = assemble(tmp_path, "town", row)
    world = _root(path)
    assert path == tmp_path / "world" / "town.sdf" and world.get("name") == "town"
    poses = {i.findtext("uri"): i.findtext("pose") for i in world.iter("include")}
    assert poses == {  # the origin is that of the tile in the middle
        "model://tile0": "-25 0 1 0 0 0",
        "model://tile1": "0 0 0 0 0 0",
        "model://tile2": "25 0 -1 0 0 0",
    }
    place = sdf.Georeference.of(row[1].frame)
    assert place is not None
    assert float(world.findtext("spherical_coordinates/latitude_deg", "")) == pytest.approx(place.latitude, abs=1e-8)
    for name in ("tile0", "tile1", "tile2"):
        own = tmp_path / "world" / "models" / name
        for uri in ET.parse(own / "model.sdf").getroot().iter("uri"):
            assert (tmp_path / "world" / str(uri.text).replace("model://", "models/")).is_file()
    assert not list((tmp_path / "world").rglob("*.glb"))


def test_levels_contain_their_models(tmp_path: Path, row: Sequence[TileWorld]) -> None:
    path = assemble(tmp_path, "town", row, buffer=30, performer="cart")
    plugin = next(p for p in _root(path).iter("plugin") if p.get("name") == "gz::sim")
    assert plugin.findtext("performer/ref") == "cart"
    levels = plugin.findall("level")
    assert [level.findtext("ref") for level in levels] == ["tile0", "tile1", "tile2"]
    assert len({level.get("name") for level in levels}) == 3
    metadata = json.loads((path.parent / "metadata.json").read_text(encoding="utf-8"))
    for level in levels:
        centre, size = _vector(level, "pose")[:3], _vector(level, "geometry/box/size")
        tile = metadata["tiles"][level.findtext("ref")]
        low, high = (np.add(tile[key], tile["offset_m"]) for key in ("low_m", "high_m"))
        assert np.all(centre - size / 2 < low) and np.all(high < centre + size / 2)
        assert centre[:2] - size[:2] / 2 == pytest.approx(low[:2] - 30)
        assert level.findtext("buffer") == "30"
        assert tile["low_m"] == pytest.approx([-10, -10, -0.5]) and tile["high_m"] == pytest.approx([10, 10, 4.5])


def test_metadata_lists_all_files_and_positions(tmp_path: Path, row: Sequence[TileWorld]) -> None:
    folder = assemble(tmp_path, "town", row).parent
    metadata = json.loads((folder / "metadata.json").read_text(encoding="utf-8"))
    assert metadata["world_origin_m"] == list(row[1].frame.origin) and metadata["crs"] == "EPSG:32632"
    assert metadata["wgs84"]["latitude_deg"] == pytest.approx(48.1399, abs=1e-4)
    assert metadata["tiles"]["tile2"]["origin_m"] == list(row[2].frame.origin)
    x, y, _ = metadata["spawn"]["position_m"]
    assert max(abs(x), abs(y)) <= 1  # on the ground of the tile in the middle
    counted = metadata["triangles_by_file"]
    assert set(counted) == {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.suffix in (".obj", ".dae")}
    assert counted["models/tile2/meshes/terrain.obj"] == 3200


def test_editable_files_are_copied_and_others_linked(tmp_path: Path, row: Sequence[TileWorld]) -> None:
    folder = assemble(tmp_path, "town", row).parent
    for tile in row:
        for path in (path for path in tile.model.rglob("*") if path.is_file()):
            twin = folder / "models" / tile.name / path.relative_to(tile.model)
            assert path.samefile(twin) == (path.suffix not in merge.USER_EDITABLE_SUFFIXES), path.name
            assert path.read_bytes() == twin.read_bytes()


def test_world_of_a_survey_can_be_exported(tmp_path: Path, row: Sequence[TileWorld]) -> None:
    folder = assemble(tmp_path, "town", row).parent
    scene = read_scene(tmp_path)
    assert (scene.name, [tile.offset for tile in scene.tiles]) == ("town", [(-25, 0, 1), (0, 0, 0), (25, 0, -1)])
    world_formats.write(scene, ["gazebo"], tmp_path / "out", SceneParams(), silent)
    assert (tmp_path / "out" / "town.sdf").read_text(encoding="utf-8") == (folder / "town.sdf").read_text(
        encoding="utf-8"
    )
    for path in (path for path in (folder / "models").rglob("*") if path.is_file()):
        assert (tmp_path / "out" / path.relative_to(folder)).read_bytes() == path.read_bytes(), path.name


def test_unchanged_world_is_not_merged_again(tmp_path: Path) -> None:
    row = tiles(tmp_path, 2)
    folder = assemble(tmp_path, "town", row).parent
    edited = folder / "models/tile0/model.sdf"
    edited.write_text(edited.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    before = _snapshot(folder)
    warned: list[str] = []
    assemble(tmp_path, "town", row, warn=warned.append)
    assert _snapshot(folder) == before  # an edit by the user is kept
    assert len(warned) == 1 and "tile0/model.sdf was changed since it was written" in warned[0]
    assemble(tmp_path, "town", row, buffer=5)
    assert _snapshot(folder) != before and _root(folder / "town.sdf").findtext(".//level/buffer") == "5"
    (folder / "models/tile1/meshes/collision_terrain.obj").unlink()
    assemble(tmp_path, "town", row, buffer=5)
    assert (folder / "models/tile1/meshes/collision_terrain.obj").is_file()
    damaged = folder / "models/tile1/meshes/collision_terrain.obj"
    whole = damaged.read_bytes()
    damaged.unlink()
    damaged.write_bytes(b"x" * len(whole))  # of the same size
    assemble(tmp_path, "town", row, buffer=5)
    assert damaged.read_bytes() == whole
    source = row[0].model / "meshes/terrain.obj"
    text = source.read_text(encoding="utf-8")
    source.unlink()  # a rebuilt result is a new file with a new inode
    source.write_text("# new\n" + text, encoding="utf-8")
    assemble(tmp_path, "town", row, buffer=5)
    assert (folder / "models/tile0/meshes/terrain.obj").read_text(encoding="utf-8").startswith("# new")


def test_earlier_world_is_replaced_only_when_the_new_one_is_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = tiles(tmp_path, 2)
    folder = assemble(tmp_path, "town", row).parent
    before = _snapshot(folder)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device", str(tmp_path))

    with monkeypatch.context() as broken:
        broken.setattr(sdf, "write_levels", full)
        with pytest.raises(Exception, match="no space left"):
            assemble(tmp_path, "town", row[:1])
    assert _snapshot(folder) == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["tile0", "tile1", "world"]
    assemble(tmp_path, "town", row[:1])
    assert [p.name for p in (folder / "models").iterdir()] == ["tile0"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["tile0", "tile1", "world"]


def test_incompatible_tiles_are_rejected(tmp_path: Path, row: Sequence[TileWorld]) -> None:
    one, other = row[:2]
    away = replace(other, frame=Frame("EPSG:32633", other.frame.origin))
    with pytest.raises(InputError, match="EPSG:32633.*but tile0 is in EPSG:32632"):
        assemble(tmp_path, "town", [one, away])
    with pytest.raises(InputError, match="second tile named tile0"):
        assemble(tmp_path, "town", [one, one])
    with pytest.raises(InputError, match="file not found"):
        assemble(tmp_path, "town", [one, replace(other, world=tmp_path / "none")])
    with pytest.raises(DataError, match="no tile"):
        assemble(tmp_path, "town", [])
    assert not list(tmp_path.iterdir())


def test_crs_as_code_and_as_wkt_are_equal(tmp_path: Path, row: Sequence[TileWorld]) -> None:
    from pyproj import CRS

    wkt = CRS.from_user_input("EPSG:32632").to_wkt("WKT1_GDAL")
    other = replace(row[1], frame=replace(row[1].frame, crs=wkt))
    assert assemble(tmp_path, "town", [row[0], other]).is_file()


def test_local_survey_has_no_georeference(tmp_path: Path) -> None:
    frames = [Frame(origin=(20.0 * i, 0.0, 0.0)) for i in range(2)]
    made = [synthetic.world(tmp_path / f"t{i}", frame=f, name=f"t{i}").files["world"] for i, f in enumerate(frames)]
    path = assemble(tmp_path, "town", [TileWorld(f"t{i}", made[i], frames[i]) for i in range(2)])
    assert _root(path).find("spherical_coordinates") is None
    assert json.loads((path.parent / "metadata.json").read_text(encoding="utf-8"))["wgs84"] is None


def test_failing_parts_cost_only_themselves_and_are_retried(
    tmp_path: Path, row: Sequence[TileWorld], monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(*arguments: object) -> None:
        for folder in arguments:
            if isinstance(folder, Path):
                folder.mkdir(parents=True, exist_ok=True)
                (folder / "half.txt").touch()
        raise ZeroDivisionError("a bug")

    whole = _snapshot(assemble(tmp_path / "whole", "town", row).parent).keys()
    failed: dict[str, ScanError] = {}
    with monkeypatch.context() as patch:
        patch.setattr(merge, "default_pose", half)
        patch.setattr(gazebo, "write_traffic", half)
        patch.setattr(readme, "write", half)
        path = assemble(tmp_path / "part", "town", row, dome=half, failed=failed)
        with pytest.raises(ZeroDivisionError):
            assemble(tmp_path / "strict", "town", row, dome=half)
    assert failed.keys() == {"sky_dome", "spawn", "traffic", "readme"}
    assert all("a bug" in error.cause and "half" in "".join(error.__notes__) for error in failed.values())
    assert not list((tmp_path / "part").rglob("half.txt")) and not (tmp_path / "strict" / "world").exists()
    assert [i.findtext("uri") for i in _root(path).iter("include")] == [f"model://{tile.name}" for tile in row]
    assert "spawn" not in json.loads((path.parent / "metadata.json").read_text(encoding="utf-8"))
    assert whole - _snapshot(path.parent).keys() == {"README.md", ".dome"}

    failed.clear()
    assemble(tmp_path / "part", "town", row, failed=failed)
    assert not failed and _snapshot(path.parent).keys() == whole
    assert "spawn" in json.loads((path.parent / "metadata.json").read_text(encoding="utf-8"))
    written = _snapshot(path.parent)
    assemble(tmp_path / "part", "town", row, failed=failed)
    assert _snapshot(path.parent) == written

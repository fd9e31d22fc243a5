"""Command `survey`: borders of tiles, the common world, repeated runs, failing tiles."""

from __future__ import annotations

import json
import shutil
import time
import xml.etree.ElementTree as ET
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from scan2sim.flows.commands import unchanged
from scan2sim.pipeline.core.classes import GROUPS, group_of
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.tiling.cut_corridor import CutParams, cut_survey
from tests.fakes.gazebo.checker import check_world
from tests.flows.command import assert_fails, in_process, stdout_of
from tests.flows.inline_steps import inline_steps

FAST = [f"--set={name}" for name in (
    "unwrap.texel=0.05", "decimate.target=10000", "pictures.width=160", "pictures.compared=1", "backdrop.when=never")
]  # fmt: skip


def survey_command(*arguments: object) -> CompletedProcess[str]:
    """Run `scan2sim survey` and its steps in this process."""
    with inline_steps():
        return in_process("survey", *arguments)


@pytest.fixture(scope="module")
def survey(small_street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small street cut into two tiles."""
    folder = tmp_path_factory.mktemp("survey")
    shutil.copytree(small_street, folder / "corridor")
    context = 3.0  # metres of overlap, for crowns and planes near the border
    cut_survey(folder / "corridor", folder / "tiles", CutParams(length=6.0, buffer=context))
    return folder / "tiles"


@pytest.fixture(scope="module")
def failed(survey: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of a run while the cloud of the second tile was damaged; failed.json next to it is its report."""
    out = tmp_path_factory.mktemp("made") / "out"
    cloud = sorted(survey.glob("*/cloud.laz"))[1]
    whole = cloud.read_bytes()
    cloud.write_bytes(whole[: len(whole) // 2])
    assert_fails(survey_command(survey, "--out", out, *FAST), 5, "1 of 2 tiles failed", "truncated or damaged")
    shutil.copyfile(out / "survey.json", out.parent / "failed.json")
    cloud.write_bytes(whole)
    time.sleep(unchanged.SETTLED_NS / 1e9)  # the next run would not record the status of newer files
    return out


@pytest.fixture(scope="module")
def made(survey: Path, failed: Path) -> Path:
    """Output folder of the next run, with the cloud repaired."""
    stdout_of(survey_command(survey, "--out", failed, *FAST))
    assert (failed / unchanged.RECORD).is_file()
    return failed


def report_of(out: Path) -> dict[str, Any]:
    return json.loads((out / "survey.json").read_text(encoding="utf-8"))


def test_meshes_of_neighbouring_tiles_share_their_borders(made: Path) -> None:
    (border,) = report_of(made)["borders"]
    assert border["length_m"] > 10
    assert border["gap_m"] < 0.3 and border["gap_p99_m"] == 0 and border["overlap_m"] < 1e-3
    assert border["shared"] > 0.99
    assert border["one_sided_m"] < 0.02 * border["length_m"]
    assert border["colour_step"] < 2


def test_furniture_is_listed_once_by_the_tile_of_its_cell(made: Path, survey: Path) -> None:
    feet = []
    for path in sorted(survey.glob("*/tile.toml")):
        tile = read_tile(path)
        listed = json.loads((made / "tiles" / tile.name / "world" / "furniture.geojson").read_text(encoding="utf-8"))
        places = [f["geometry"]["coordinates"][:2] for f in listed["features"]]
        assert tile.cell is not None and (tile.cell.outside(np.array(places).reshape(-1, 2)) <= 0).all()
        feet += places
    apart = cKDTree(feet).query(feet, k=2)[0][:, 1]
    assert len(feet) >= 3 and apart.min() > 0.5


def test_roads_of_both_tiles_are_connected(made: Path) -> None:
    (network,) = (made / "world").glob("*.xodr")
    roads = ET.parse(network).getroot().findall("road")
    assert [float(road.attrib["length"]) for road in roads] == [pytest.approx(12.0, abs=1.5)]
    assert (made / "world" / f"{network.stem}_roads.geojson").is_file()


def test_surfaces_of_ground_and_walls_meet_without_holes(made: Path, survey: Path) -> None:
    """Rays from above, between a ground point and a nearby point of a wall's foot, hit a surface."""
    import open3d as o3d

    for path in survey.glob("*/tile.toml"):
        tile = read_tile(path)
        assert tile.cell is not None
        cloud = las.read(tile.clouds[0], tile.frame)
        group = group_of()[cloud.classification]
        xyz = cloud.xyz[tile.cell.outside(cloud.xyz[:, :2] + np.asarray(tile.frame.origin)[:2]) < -0.2]
        group = group[tile.cell.outside(cloud.xyz[:, :2] + np.asarray(tile.frame.origin)[:2]) < -0.2]
        ground, wall = xyz[group == GROUPS.index("terrain")], xyz[group == GROUPS.index("building")]
        distance, nearest = cKDTree(wall).query(ground, distance_upper_bound=0.15)
        beside = np.isfinite(distance)
        assert beside.sum() > 100
        middle = (ground[beside] + wall[nearest[beside]]) / 2
        scene = o3d.t.geometry.RaycastingScene()
        for file in made.glob(f"steps/{path.parent.name}/decimate.*/*/mesh.npz"):
            mesh = Mesh.load(file)
            scene.add_triangles(mesh.vertices, mesh.faces.astype(np.uint32))
        down = np.tile(np.array([0, 0, -1], np.float32), (len(middle), 1))
        rays = np.concatenate([middle + np.array([0, 0, 0.4], np.float32), down], axis=1)
        deep = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        assert (deep < 0.8).mean() > 0.995


def test_gazebo_loads_all_tiles_as_one_world(made: Path) -> None:
    (world,) = (made / "world").glob("*.sdf")
    tiles = json.loads((made / "world" / "metadata.json").read_text(encoding="utf-8"))["tiles"]
    assert len(tiles) == 2
    seen = check_world(world, ("box", (0, 0, 2)))
    (box,) = seen["bodies"]
    assert abs(box["rest"][2]) < 5 and box["speed"] < 0.1


def test_unchanged_survey_is_not_rebuilt(survey: Path, made: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in (made / "steps").rglob("manifest.json")}
    printed = stdout_of(survey_command(survey, "--out", made, *FAST))
    assert (
        "nothing to do" in printed
        and f"World:  {made / 'world'}" in printed
        and f"Report: {made / 'survey.html'}" in printed
    )
    assert {path: path.stat().st_mtime_ns for path in (made / "steps").rglob("manifest.json")} == before
    (made / "steps" / "unchanged.json").unlink()  # compare all cache keys
    assert "nothing to do" in stdout_of(survey_command(survey, "--out", made, *FAST))
    assert {path: path.stat().st_mtime_ns for path in (made / "steps").rglob("manifest.json")} == before
    assert {tile["state"] for tile in report_of(made)["tiles"].values()} == {"cached"}


def test_failed_tile_is_reported_and_the_others_are_built(survey: Path, failed: Path) -> None:
    tiles = json.loads((failed.parent / "failed.json").read_text(encoding="utf-8"))["tiles"]
    assert tiles.keys() == {tile.parent.name for tile in survey.glob("*/tile.toml")}
    first, second = tiles.values()
    assert first["state"] == "done" and second["state"] == "failed"
    assert "truncated or damaged" in second["reason"] and "cloud.laz" in second["reason"]


@pytest.mark.slow
def test_results_depend_neither_on_earlier_failures_nor_on_folder_names(
    survey: Path, made: Path, tmp_path: Path
) -> None:  # fmt: skip
    other = renamed(survey, tmp_path / "tiles")
    for tile in other.glob("*/tile.toml"):
        tile.write_text(
            tile.read_text(encoding="utf-8").replace('"../../corridor', f'"{survey.parent}/corridor'), encoding="utf-8"
        )
    stdout_of(survey_command(other, "--out", tmp_path / "out", *FAST))
    assert contents(tmp_path / "out") == contents(made)


def renamed(survey: Path, to: Path) -> Path:
    """A copy of the survey in which the folders have other names than the tiles."""
    shutil.copytree(survey, to)
    for i, tile in enumerate(sorted(to.glob("*/tile.toml"))):
        listing = to / "survey.toml"
        listing.write_text(
            listing.read_text(encoding="utf-8").replace(tile.parent.name, f"folder-{i}"), encoding="utf-8"
        )
        tile.parent.rename(to / f"folder-{i}")
    return to


def contents(out: Path) -> dict[str, str]:
    """Digests of all results, by tile and step."""
    manifests = [json.loads(path.read_text(encoding="utf-8")) for path in (out / "steps").glob("*/*/*/manifest.json")]
    return {manifest["label"]: manifest["content"] for manifest in manifests}


def test_second_run_of_a_survey_is_a_busy_error(survey: Path, made: Path) -> None:
    from scan2sim.flows.engine.lock import locked

    with locked(made):
        assert_fails(survey_command(survey, "--out", made, *FAST), 8, "another run")


def test_folder_without_survey_is_an_input_error(tmp_path: Path) -> None:
    assert_fails(survey_command(tmp_path, "--out", tmp_path / "out"), 3, "no survey found", "survey.toml")


def test_invalid_memory_is_a_setting_error(survey: Path, tmp_path: Path) -> None:
    assert_fails(survey_command(survey, "--out", tmp_path, "--memory", "lots"), 2, "--memory", "Write for example 20GB")

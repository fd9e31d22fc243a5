"""Failing side products (roads, images, reports, ...) never prevent the world of a tile or survey."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.flows.commands import run as run_command
from scan2sim.flows.pipelines import tile as tile_pipeline
from scan2sim.flows.pipelines.graph import Output, Task, TaskId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.survey import build_survey_graph
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.flows.reports import finish, publish
from scan2sim.pipeline.core.types import RobotMap
from scan2sim.pipeline.io.geodata import stac
from scan2sim.pipeline.io.survey import read_survey
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.io.world_formats import gazebo
from scan2sim.pipeline.io.worlds import merge, readme
from scan2sim.pipeline.tiling.cut_corridor import CutParams, cut_survey
from scan2sim.texturing.backdrop import dome
from tests.flows.inline_steps import inline_steps
from tests.flows.tiny import COARSE, loaded, tiny
from tests.flows.tiny import scan2sim as run_scan2sim

SETTINGS = COARSE | {
    "navigation": {"when": "always"}, "split": {"vegetation": "locations", "vehicles": "assets"},
    "splats": {"when": "auto", "epochs": [1, 0, 0]},
}  # fmt: skip
FINE = SETTINGS | {"unwrap": {"texel": 0.05}}
"""With texels that show lane markings, which a survey's road network needs."""
SIDE_PRODUCTS = tuple(step.name for step in tile_pipeline.SIDE_PRODUCTS)
BORDER_SIDE_PRODUCT = "borders"
"""Runs only for tiles with neighbours."""
MAP_SIDE_PRODUCT = "ghosts"
"""Runs only for robots' maps."""
TILE_SIDE_PRODUCTS = tuple(name for name in SIDE_PRODUCTS if name not in (BORDER_SIDE_PRODUCT, MAP_SIDE_PRODUCT))
SURVEY_SIDE_PRODUCTS = tuple(name for name in SIDE_PRODUCTS if name not in ("navigation", MAP_SIDE_PRODUCT))
"""Those of tiles of a survey."""
EXPORT_PARTS = ("export.glb", "export.lists", "export.navigation", "export.spawn", "export.traffic", "export.readme")
"""Optional parts of the step `export`."""
ALL = (*SIDE_PRODUCTS, *EXPORT_PARTS)
DEPENDENTS = {
    "tracks": {"vehicle_models"}, "detect_furniture": {"furniture", "signs"}, "furniture": {"signs"},
}  # fmt: skip
"""Side products that can't be made without another one."""
INDEPENDENT = (
    ("tracks", "plants", "sky_colour", "reflectance", "rasters", "geometry"),
    ("vehicle_models", "backdrop", "splats", "pictures", "preview"),
    ("roads", "navigation", "score", "lidar_score"),
)
"""Side products that don't depend on each other, not even by way of other steps. Most steps depend on the others
(furniture and signs), and nearly all would run again without them."""
SURVEY_PRODUCTS: dict[str, tuple[Any, str]] = {
    "report": (finish, "write_survey_report"),
    "TILE/report": (finish, "write_report"),
    "sky_dome": (dome, "of_survey"),
    "spawn": (merge, "default_pose"),
    "traffic": (gazebo, "write_traffic"),
    "readme": (readme, "write"),
    "roads": (merge, "add_roads"),
    "catalogue": (stac, "write"),
}
"""Side products written after the tiles of a survey: module and function that write them."""
INCOMPLETE = 10
"""Exit code of a run with a finished world and failed side products."""
FAILED_TEXT = "failed; the world is made without it"

for_groups_and_single_side_products = pytest.mark.parametrize(
    "failing",
    [*INDEPENDENT, *(pytest.param((name,), marks=pytest.mark.slow) for name in TILE_SIDE_PRODUCTS)],
    ids=",".join,
)


def scan2sim(
    *arguments: object, failing: Collection[str] = (), settings: dict[str, dict[str, Any]] = SETTINGS
) -> tuple[int, str]:
    """Run the command and its steps in this process; returns its exit code and output."""
    with inline_steps():
        return run_scan2sim(*arguments, failing=failing, settings=settings)


@pytest.fixture(scope="module")
def street(small_street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny(small_street, tmp_path_factory.mktemp("tiny") / "tile", photo_scale=0.5, truth=False)


@pytest.fixture(scope="module")
def survey(street: Path) -> Path:
    """The tiny street cut into two tiles."""
    cut_survey(street, street.parent / "survey", CutParams(length=6.0, buffer=3.0))
    return street.parent / "survey"


@pytest.fixture(scope="module")
def failing_run(street: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, str]:
    """A first run, with steps in processes, in which all side products fail: its folder, exit code and output."""
    out = tmp_path_factory.mktemp("failing_run") / "out"
    return out, *run_scan2sim("run", street, "--out", out, failing=ALL, settings=SETTINGS)


@pytest.fixture(scope="module")
def completed_run(street: Path, failing_run: tuple[Path, int, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of that run, repeated without failures."""
    out = shutil.copytree(failing_run[0], tmp_path_factory.mktemp("completed_run") / "out")
    code, printed = scan2sim("run", street, "--out", out)
    assert code == 0 and "failed" not in printed
    return out


@pytest.fixture(scope="module")
def failing_survey(survey: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, str]:
    """Like `failing_run`, for the survey."""
    out = tmp_path_factory.mktemp("failing_run") / "out"
    return out, *scan2sim("survey", survey, "--out", out, failing=ALL)


@pytest.fixture(scope="module")
def completed_survey(
    survey: Path, failing_survey: tuple[Path, int, str], tmp_path_factory: pytest.TempPathFactory
) -> Path:  # fmt: skip
    """Like `completed_run`, for the survey, with fine texels."""
    out = shutil.copytree(failing_survey[0], tmp_path_factory.mktemp("completed_run") / "out")
    code, printed = scan2sim("survey", survey, "--out", out, settings=FINE)
    assert code == 0 and "failed" not in printed
    return out


def read(file: Path) -> dict[str, Any]:
    return dict(json.loads(file.read_text(encoding="utf-8")))


def raising(*_: object, **__: object) -> None:
    raise ZeroDivisionError("a bug")


def names(tasks: list[Task]) -> set[TaskId]:
    return {task.id for task in tasks}


def is_topologically_sorted(tasks: list[Task]) -> bool:
    """Whether each task comes after those that it reads."""
    known = set[TaskId]()
    for task in tasks:
        if not {source.task for source in task.inputs.values() if isinstance(source, Output)} <= known:
            return False
        known.add(task.id)
    return True


@pytest.mark.parametrize("name", SIDE_PRODUCTS)
def test_graph_without_a_side_product_has_all_main_steps(street: Path, survey: Path, name: str) -> None:
    tile, settings = read_tile(street), Settings(SETTINGS)
    whole = build_graph(tile, settings)
    rest = build_graph(tile, settings, without=[TaskId(name)])
    lost = names(whole) - names(rest)
    assert is_topologically_sorted(rest) and names(rest) <= names(whole) and TaskId(name) not in names(rest)
    made = {task.step for task in names(whole)}
    assert {task.step for task in lost} == {name, *DEPENDENTS.get(name, ())} & made <= set(SIDE_PRODUCTS)

    tiles = [read_tile(path) for path in read_survey(survey / "survey.toml").tiles.values()]
    first, second = (one.name for one in tiles)
    whole = build_survey_graph(tiles, settings)
    rest = build_survey_graph(tiles, settings, [TaskId(name, tile=first)])
    lost = names(whole) - names(rest)
    assert is_topologically_sorted(rest) and TaskId(name, tile=first) not in names(rest)
    assert {task.step for task in lost} <= set(SIDE_PRODUCTS) and {task.tile for task in lost} <= {first}
    assert {task.id for task in rest if task.tile == second} == {task.id for task in whole if task.tile == second}


def test_graph_of_a_robot_map_without_a_side_product_has_all_main_steps(street: Path) -> None:
    tile = replace(read_tile(street), robot_map=RobotMap("outdoor", 0.1, 1.0, np.eye(4)))
    whole = build_graph(tile, Settings(SETTINGS))
    assert TaskId(MAP_SIDE_PRODUCT) in names(whole)
    for name in SIDE_PRODUCTS:
        rest = build_graph(tile, Settings(SETTINGS), without=[TaskId(name)])
        assert is_topologically_sorted(rest) and {task.step for task in names(whole) - names(rest)} <= set(
            SIDE_PRODUCTS
        )


def test_tile_is_built_if_all_side_products_fail(failing_run: tuple[Path, int, str]) -> None:
    out, code, printed = failing_run
    assert code == INCOMPLETE
    loaded(out)
    report, log = read(out / "report.json"), (out / "run.log").read_text(encoding="utf-8")
    missing = {"furniture", "signs", "vehicle_models"}  # they need the outputs of failed steps
    expected = {*TILE_SIDE_PRODUCTS, *EXPORT_PARTS} - missing
    assert report["failed"].keys() == expected
    for name in expected:
        assert f"warning: {name}: {FAILED_TEXT}: failed unexpectedly (ZeroDivisionError: a bug)" in printed
        assert ("poor", name) in [(one["level"], one["about"]) for one in report["findings"]]
        assert not list((out / "steps").glob(f"{name}/*"))
    assert not list(out.rglob("half.txt")) and not list((out / "world").glob("*.glb")), "nothing is half-written"
    assert "Traceback" not in printed and printed.count(f"(details: {out / 'run.log'})") == len(expected)
    assert log.count('raise ZeroDivisionError("a bug")') == len(expected)
    assert f"the world is finished, but {len(expected)} side products failed: " in printed
    assert FAILED_TEXT in (out / "report.html").read_text(encoding="utf-8")


def test_next_run_retries_failed_side_products(completed_run: Path) -> None:
    loaded(completed_run)
    assert read(completed_run / "report.json")["failed"] == {}
    assert (completed_run / "world" / "roads.geojson").is_file() and list((completed_run / "rasters").glob("*.tif"))
    assert (completed_run / "report_files" / "world.js").is_file() and list((completed_run / "world").glob("*.glb"))


@for_groups_and_single_side_products
def test_failing_side_product_affects_only_itself(
    street: Path, completed_run: Path, tmp_path: Path, failing: tuple[str, ...]
) -> None:
    out = shutil.copytree(completed_run, tmp_path / "out")
    for name in failing:
        shutil.rmtree(out / "steps" / name)
    code, printed = scan2sim("run", street, "--out", out, failing=failing)
    what = "a side product failed" if len(failing) == 1 else f"{len(failing)} side products failed"
    listed = printed.partition(f"the world is finished, but {what}: ")[2].replace(",", "").split()
    assert code == INCOMPLETE and {*listed[: len(failing)]} == {*failing}
    loaded(out)
    report = read(out / "report.json")
    assert report["failed"].keys() == {*failing}
    assert all("a bug" in report["failed"][name]["cause"] for name in failing)
    missing = {*failing}.union(*(DEPENDENTS.get(name, ()) for name in failing))
    assert {name for name in TILE_SIDE_PRODUCTS if not list((out / "steps").glob(f"{name}/*"))} == missing
    products = {"roads": "world/roads.geojson", "preview": "report_files/world.js", "plants": "world/plants.csv"}
    products |= {"furniture": "world/furniture.csv", "rasters": "rasters/street_dsm.tif"}
    assert {one for one, file in products.items() if not (out / file).is_file()} == missing & products.keys()


def test_failing_report_affects_only_itself(
    street: Path, completed_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = shutil.copytree(completed_run, tmp_path / "out")
    with monkeypatch.context() as patch:
        patch.setattr(run_command, "write_report", raising)
        code, printed = scan2sim("run", street, "--out", out)
    assert (
        code == INCOMPLETE
        and "warning: report: failed" in printed
        and "a bug" in (out / "run.log").read_text(encoding="utf-8")
    )
    assert not list(out.glob("report.*")), "reports of an earlier world are deleted"
    loaded(out)
    assert scan2sim("run", street, "--out", out)[0] == 0 and (out / "report.html").is_file()


def test_failing_copies_and_damaged_reports_affect_only_themselves(
    street: Path, completed_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = shutil.copytree(completed_run, tmp_path / "out")
    for name in ("rasters", "exposure.json"):
        shutil.rmtree(out / name) if (out / name).is_dir() else (out / name).unlink()
    copy = publish._publish
    with monkeypatch.context() as patch:
        patch.setattr(publish, "_publish", lambda *args: raising() if args[1].name == "rasters" else copy(*args))
        patch.setattr(publish, "PAGE_SCRIPTS", ("missing.js",))
        patch.setattr(publish, "versions", raising)
        code, printed = scan2sim("run", street, "--out", out)
    assert code == INCOMPLETE and "Traceback" not in printed
    assert read(out / "report.json")["failed"].keys() == {"rasters", "preview", "config.json"}
    loaded(out)
    assert (out / "exposure.json").is_file() and not (out / "config.json").exists()
    assert scan2sim("run", street, "--out", out)[0] == 0 and (out / "rasters" / "street_dsm.tif").is_file()


def test_failing_main_step_fails_the_run(street: Path, completed_run: Path, tmp_path: Path) -> None:
    out = shutil.copytree(completed_run, tmp_path / "out")
    for name in ("export", "roads"):
        shutil.rmtree(out / "steps" / name)
    code, printed = scan2sim("run", street, "--out", out, failing=["roads", "export"])
    assert code == 5 and "error: export: failed unexpectedly" in printed
    loaded(out)  # the earlier world


def test_forced_steps_run_once_if_a_side_product_fails(street: Path, completed_run: Path, tmp_path: Path) -> None:
    out = shutil.copytree(completed_run, tmp_path / "out")
    (out / "run.log").unlink()
    code, _ = scan2sim("run", street, "--out", out, "--from", "export", failing=["roads"])
    assert code == 0, "its cached result is used"
    code, _ = scan2sim("run", street, "--out", out, "--from", "roads", failing=["roads"])
    assert code == INCOMPLETE
    log = (out / "run.log").read_text(encoding="utf-8")
    assert log.count("roads: start") == 1 and log.count("export: start") == 2


def test_survey_is_built_if_all_side_products_fail(failing_survey: tuple[Path, int, str]) -> None:
    out, code, printed = failing_survey
    assert code == INCOMPLETE and "Traceback" not in printed
    first, second = (tile.name for tile in loaded(out).tiles)
    tiles, log = read(out / "survey.json")["tiles"], (out / "run.log").read_text(encoding="utf-8")
    for tile in (first, second):
        loaded(out / "tiles" / tile)
        expected = {*SURVEY_SIDE_PRODUCTS, *EXPORT_PARTS} - {"furniture", "signs", "vehicle_models"}
        assert tiles[tile]["state"] == "done"
        assert read(out / "tiles" / tile / "report.json")["failed"].keys() == expected
        for name in expected:
            assert f"warning: {tile}/{name}: {FAILED_TEXT}" in printed
            assert any(text.startswith(f"{name}: failed") for text in tiles[tile]["warnings"])
            assert f"{tile}/{name}: failed" in log
    assert "ZeroDivisionError: a bug" in log and FAILED_TEXT in (out / "survey.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "names", [[*SURVEY_PRODUCTS], *(pytest.param([name], marks=pytest.mark.slow) for name in SURVEY_PRODUCTS)]
)
def test_failing_survey_product_affects_only_itself(
    survey: Path,
    failing_survey: tuple[Path, int, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    names: list[str],
) -> None:
    out = shutil.copytree(failing_survey[0], tmp_path / "out")
    tile = next(iter(read(out / "survey.json")["tiles"]))
    reports = {"report": out / "survey.html", "TILE/report": out / "tiles" / tile / "report.html"}
    shutil.rmtree(out / "world")
    reports["TILE/report"].unlink()
    with monkeypatch.context() as patch:
        for name in names:
            patch.setattr(*SURVEY_PRODUCTS[name], raising)
        code, printed = scan2sim("survey", survey, "--out", out, failing=ALL)
    assert code == INCOMPLETE
    assert {name for name in SURVEY_PRODUCTS if f"warning: {name.replace('TILE', tile)}: {FAILED_TEXT}" in printed} == {
        *names
    }
    assert {name for name, file in reports.items() if not file.is_file()} == {*names} & reports.keys()
    loaded(out)
    if "report" not in names:
        assert read(out / "survey.json")["failed"].keys() == {*names} - reports.keys()
    code, printed = scan2sim("survey", survey, "--out", out, failing=ALL)
    assert code == INCOMPLETE, "steps still fail"
    assert not any(f"warning: {name.replace('TILE', tile)}: failed" in printed for name in names), "it is retried"
    assert all(file.is_file() for file in reports.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", SURVEY_SIDE_PRODUCTS)
def test_failing_side_product_of_a_survey_tile_affects_only_itself(
    survey: Path, completed_survey: Path, tmp_path: Path, name: str
) -> None:
    out = shutil.copytree(completed_survey, tmp_path / "out")
    second = sorted(read(out / "survey.json")["tiles"])[1]
    shutil.rmtree(out / "steps" / second / name)
    code, printed = scan2sim("survey", survey, "--out", out, failing=[name], settings=FINE)
    assert code == INCOMPLETE and f"a side product failed: {second}/{name}" in printed
    assert len(loaded(out).tiles) == 2
    tiles = read(out / "survey.json")["tiles"]
    assert [any(": failed" in text for text in tile["warnings"]) for tile in tiles.values()] == [False, True]
    assert read(out / "tiles" / second / "report.json")["failed"].keys() == {name}
    assert scan2sim("survey", survey, "--out", out, settings=FINE)[0] == 0
    tiles = read(out / "survey.json")["tiles"]
    assert not any(": failed" in text for tile in tiles.values() for text in tile["warnings"])


@pytest.mark.slow
def test_next_run_of_a_survey_retries_failed_side_products(completed_survey: Path) -> None:
    loaded(completed_survey)
    assert list((completed_survey / "world").glob("*.xodr"))
    for tile in (completed_survey / "tiles").iterdir():
        assert read(tile / "report.json")["failed"] == {} and (tile / "picture.jpg").is_file()

"""Side products (roads, pictures, reports, ...) that fail never cost the world, in a tile and in a survey."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from scan2sim.flows.commands import run as run_command
from scan2sim.flows.pipelines.graph import Node, NodeId, Output
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.survey import survey_recipe
from scan2sim.flows.pipelines.tile import STEPS, recipe
from scan2sim.flows.reports import finish
from scan2sim.pipeline.io.geodata import stac
from scan2sim.pipeline.io.survey import read_survey
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.io.worlds import merge
from scan2sim.pipeline.tiling.cut_corridor import CutParams, cut_survey
from tests.flows.tiny import COARSE, loaded, scan2sim, tiny

SIDE = tuple(step.name for step in STEPS if step.side_product)
AT_BORDERS = "borders"
"""Measured only where tiles meet."""
OF_TILES = tuple(name for name in SIDE if name != AT_BORDERS)
EARLY = ("finds", "furniture", "signs")
"""Side products that most other steps depend on: without them nearly all is made again."""
AFTER: dict[str, tuple[Any, str]] = {
    "report": (finish, "write_survey_report"),
    "TILE/report": (finish, "write_report"),
    "roads": (merge, "add_roads"),
    "catalogue": (stac, "write"),
}
"""What is written after a survey's tiles, and by which function."""
INCOMPLETE = 10
"""Exit code of a run whose world is finished without side products that failed."""
FAILED = "failed, and the world is made without it"

in_turn = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in EARLY else name for name in OF_TILES]
)


@pytest.fixture(scope="module")
def street(small_street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny(small_street, tmp_path_factory.mktemp("tiny") / "tile")


@pytest.fixture(scope="module")
def survey(street: Path) -> Path:
    """The tiny street in two tiles."""
    cut_survey(street, street.parent / "survey", CutParams(length=6.0, buffer=3.0))
    return street.parent / "survey"


@pytest.fixture(scope="module")
def bare(street: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, str]:
    """A first run in which all side products fail: its folder, exit code and output."""
    out = tmp_path_factory.mktemp("bare") / "out"
    return out, *scan2sim("run", street, "--out", out, failing=SIDE)


@pytest.fixture(scope="module")
def made(street: Path, bare: tuple[Path, int, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of that run, continued once nothing fails any more."""
    out = shutil.copytree(bare[0], tmp_path_factory.mktemp("made") / "out")
    code, printed = scan2sim("run", street, "--out", out)
    assert code == 0 and "failed" not in printed
    return out


@pytest.fixture(scope="module")
def bare_survey(survey: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, str]:
    """As `bare`, of the survey."""
    out = tmp_path_factory.mktemp("bare") / "out"
    return out, *scan2sim("survey", survey, "--out", out, failing=SIDE)


@pytest.fixture(scope="module")
def made_survey(
    survey: Path, bare_survey: tuple[Path, int, str], tmp_path_factory: pytest.TempPathFactory
) -> Path:  # fmt: skip
    """As `made`, of the survey."""
    out = shutil.copytree(bare_survey[0], tmp_path_factory.mktemp("made") / "out")
    code, printed = scan2sim("survey", survey, "--out", out)
    assert code == 0 and "failed" not in printed
    return out


def read(file: Path) -> dict[str, Any]:
    return dict(json.loads(file.read_text(encoding="utf-8")))


def raising(*_: object, **__: object) -> None:
    raise ZeroDivisionError("a bug")


def names(nodes: list[Node]) -> set[NodeId]:
    return {node.id for node in nodes}


def closed(nodes: list[Node]) -> bool:
    """Whether each node comes after those that it reads."""
    known = set[NodeId]()
    for node in nodes:
        if not {source.node for source in node.inputs.values() if isinstance(source, Output)} <= known:
            return False
        known.add(node.id)
    return True


@pytest.mark.parametrize("name", SIDE)
def test_a_graph_without_a_side_product_holds_all_main_steps(street: Path, survey: Path, name: str) -> None:
    tile, settings = read_tile(street), Settings(COARSE)
    whole = recipe(tile, settings)
    rest = recipe(tile, settings, without=[NodeId(name)])
    lost = names(whole) - names(rest)
    assert closed(rest) and names(rest) <= names(whole) and NodeId(name) not in names(rest)
    assert {node.step for node in lost} <= set(SIDE)

    tiles = [read_tile(path) for path in read_survey(survey / "survey.toml").tiles.values()]
    first, second = (one.name for one in tiles)
    whole = survey_recipe(tiles, settings)
    rest = survey_recipe(tiles, settings, [NodeId(name, tile=first)])
    lost = names(whole) - names(rest)
    assert closed(rest) and NodeId(name, tile=first) not in names(rest)
    assert {node.step for node in lost} <= set(SIDE) and {node.tile for node in lost} <= {first}
    assert {node.id for node in rest if node.tile == second} == {node.id for node in whole if node.tile == second}


def test_a_tile_whose_side_products_all_fail_is_a_world(bare: tuple[Path, int, str]) -> None:
    out, code, printed = bare
    assert code == INCOMPLETE
    loaded(out)
    report, log = read(out / "report.json"), (out / "run.log").read_text(encoding="utf-8")
    expected = set(OF_TILES) - {"furniture", "signs"}  # they read what the failed `finds` would have found
    assert report["failed"].keys() == expected
    for name in expected:
        assert f"warning: {name}: {FAILED}: failed unexpectedly (ZeroDivisionError: a bug)" in printed
        assert ("poor", name) in [(one["level"], one["about"]) for one in report["findings"]]
        assert not list((out / "steps").glob(f"{name}/*"))
    assert "Traceback" not in printed and printed.count(f"(details: {out / 'run.log'})") == len(expected)
    assert log.count('raise ZeroDivisionError("a bug")') == len(expected)
    assert f"the world is finished, but {len(expected)} side products failed: " in printed
    assert FAILED in (out / "report.html").read_text(encoding="utf-8")


def test_the_next_run_retries_what_failed(made: Path) -> None:
    loaded(made)
    assert read(made / "report.json")["failed"] == {}
    assert (made / "world" / "roads.geojson").is_file() and list((made / "rasters").glob("*.tif"))
    assert (made / "report_files" / "world.js").is_file()


@in_turn
def test_a_side_product_that_fails_costs_itself_alone(street: Path, made: Path, tmp_path: Path, name: str) -> None:
    out = shutil.copytree(made, tmp_path / "out")
    shutil.rmtree(out / "steps" / name)
    code, printed = scan2sim("run", street, "--out", out, failing=[name])
    assert code == INCOMPLETE and f"a side product failed: {name}" in printed
    loaded(out)
    report = read(out / "report.json")
    assert report["failed"].keys() == {name} and "a bug" in report["failed"][name]["cause"]
    products = {"roads": "world/roads.geojson", "preview": "report_files/world.js", "plants": "world/plants.csv"}
    products |= {"furniture": "world/furniture.csv", "rasters": "rasters/street_dsm.tif"}
    missing = {"furniture"} if name in ("finds", "furniture") else {name}
    assert {one for one, file in products.items() if not (out / file).is_file()} == missing & products.keys()


def test_a_report_that_fails_costs_itself_alone(
    street: Path, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = shutil.copytree(made, tmp_path / "out")
    with monkeypatch.context() as patch:
        patch.setattr(run_command, "write_report", raising)
        code, printed = scan2sim("run", street, "--out", out)
    assert (
        code == INCOMPLETE
        and "warning: report: failed" in printed
        and "a bug" in (out / "run.log").read_text(encoding="utf-8")
    )
    assert not list(out.glob("report.*")), "no report of an earlier world is left"
    loaded(out)
    assert scan2sim("run", street, "--out", out)[0] == 0 and (out / "report.html").is_file()


def test_a_main_step_that_fails_still_fails_the_run(street: Path, made: Path, tmp_path: Path) -> None:
    out = shutil.copytree(made, tmp_path / "out")
    for name in ("export", "roads"):
        shutil.rmtree(out / "steps" / name)
    code, printed = scan2sim("run", street, "--out", out, failing=["roads", "export"])
    assert code == 5 and "error: export: failed unexpectedly" in printed
    loaded(out)  # the earlier world


def test_forced_steps_run_once_though_a_side_product_fails(street: Path, made: Path, tmp_path: Path) -> None:
    out = shutil.copytree(made, tmp_path / "out")
    (out / "run.log").unlink()
    code, _ = scan2sim("run", street, "--out", out, "--from", "export", failing=["roads"])
    assert code == 0, "its result is kept"
    code, _ = scan2sim("run", street, "--out", out, "--from", "roads", failing=["roads"])
    assert code == INCOMPLETE
    log = (out / "run.log").read_text(encoding="utf-8")
    assert log.count("roads: start") == 1 and log.count("export: start") == 2


def test_a_survey_whose_side_products_all_fail_is_a_world(bare_survey: tuple[Path, int, str]) -> None:
    out, code, printed = bare_survey
    assert code == INCOMPLETE and "Traceback" not in printed
    first, second = (tile.name for tile in loaded(out).tiles)
    tiles, log = read(out / "survey.json")["tiles"], (out / "run.log").read_text(encoding="utf-8")
    for tile in (first, second):
        loaded(out / "tiles" / tile)
        expected = set(SIDE) - {"furniture", "signs"}
        assert tiles[tile]["state"] == "done"
        assert read(out / "tiles" / tile / "report.json")["failed"].keys() == expected
        for name in expected:
            assert f"warning: {tile}/{name}: {FAILED}" in printed
            assert any(text.startswith(f"{name}: failed") for text in tiles[tile]["warnings"])
            assert f"{tile}/{name}: failed: " in log
    assert "ZeroDivisionError: a bug" in log and FAILED in (out / "survey.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("names", [[*AFTER], *(pytest.param([name], marks=pytest.mark.slow) for name in AFTER)])
def test_what_is_written_after_a_surveys_tiles_costs_itself_alone(
    survey: Path, bare_survey: tuple[Path, int, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, names: list[str]
) -> None:
    out = shutil.copytree(bare_survey[0], tmp_path / "out")
    tile = next(iter(read(out / "survey.json")["tiles"]))
    reports = {"report": out / "survey.html", "TILE/report": out / "tiles" / tile / "report.html"}
    shutil.rmtree(out / "world")
    reports["TILE/report"].unlink()
    with monkeypatch.context() as patch:
        for name in names:
            patch.setattr(*AFTER[name], raising)
        code, printed = scan2sim("survey", survey, "--out", out, failing=SIDE)
    assert code == INCOMPLETE
    assert {name for name in AFTER if f"warning: {name.replace('TILE', tile)}: {FAILED}" in printed} == {*names}
    assert {name for name, file in reports.items() if not file.is_file()} == {*names} & reports.keys()
    loaded(out)
    if "report" not in names:
        assert read(out / "survey.json")["failed"].keys() == {*names} & {"roads", "catalogue"}
    code, printed = scan2sim("survey", survey, "--out", out, failing=SIDE)
    assert code == INCOMPLETE, "steps fail as before"
    assert not any(f"warning: {name.replace('TILE', tile)}: failed" in printed for name in names), "it is retried"
    assert all(file.is_file() for file in reports.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", SIDE)
def test_a_side_product_of_a_surveys_tile_costs_itself_alone(
    survey: Path, made_survey: Path, tmp_path: Path, name: str
) -> None:
    out = shutil.copytree(made_survey, tmp_path / "out")
    second = sorted(read(out / "survey.json")["tiles"])[1]
    shutil.rmtree(out / "steps" / second / name)
    code, printed = scan2sim("survey", survey, "--out", out, failing=[name])
    assert code == INCOMPLETE and f"a side product failed: {second}/{name}" in printed
    assert len(loaded(out).tiles) == 2
    tiles = read(out / "survey.json")["tiles"]
    assert [any(": failed" in text for text in tile["warnings"]) for tile in tiles.values()] == [False, True]
    assert read(out / "tiles" / second / "report.json")["failed"].keys() == {name}
    assert scan2sim("survey", survey, "--out", out)[0] == 0
    tiles = read(out / "survey.json")["tiles"]
    assert not any(": failed" in text for tile in tiles.values() for text in tile["warnings"])


@pytest.mark.slow
def test_the_next_run_of_a_survey_retries_what_failed(made_survey: Path) -> None:
    loaded(made_survey)
    assert list((made_survey / "world").glob("*.xodr"))
    for tile in (made_survey / "tiles").iterdir():
        assert read(tile / "report.json")["failed"] == {} and (tile / "picture.jpg").is_file()

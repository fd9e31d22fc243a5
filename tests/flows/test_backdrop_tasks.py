"""The backdrop is for cameras: no step that measures surfaces, or that bodies and lidars depend on, reads it."""

import shutil
from pathlib import Path

from scan2sim.flows.pipelines.graph import Output
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.survey import build_survey_graph
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.tiling.cut_corridor import CutParams, cut_survey


def readers(tile: Path, *settings: str) -> set[str]:
    """Steps that read the backdrop."""
    tasks = build_graph(read_tile(tile), Settings.read(None, settings))
    return {
        task.step.name
        for task in tasks
        if any(isinstance(source, Output) and source.task.step == "backdrop" for source in task.inputs.values())
    }


def test_only_the_export_and_the_score_of_photos_read_it(small_street: Path) -> None:
    assert readers(small_street) == {"export", "score"}


def test_one_setting_switches_it_off(small_street: Path) -> None:
    assert readers(small_street, "backdrop.when=never") == set()
    names = {
        task.step.name for task in build_graph(read_tile(small_street), Settings.read(None, ["backdrop.when=never"]))
    }
    assert "backdrop" not in names and {"export", "score"} <= names


def test_in_a_survey_nothing_of_other_tiles_reads_it(small_street: Path, tmp_path: Path) -> None:
    shutil.copytree(small_street, tmp_path / "corridor")
    cut_survey(tmp_path / "corridor", tmp_path / "tiles", CutParams(length=6.0, buffer=3.0))
    tiles = [read_tile(path) for path in sorted(tmp_path.glob("tiles/*/tile.toml"))]
    found = [
        (source.task.tile, task.id.tile, task.step.name)
        for task in build_survey_graph(tiles, Settings.read(None, []))
        for source in task.inputs.values()
        if isinstance(source, Output) and source.task.step == "backdrop"
    ]
    assert {(made, read) for made, read, _ in found} == {(tile.name, tile.name) for tile in tiles}
    assert {step for *_, step in found} == {"export", "score"}

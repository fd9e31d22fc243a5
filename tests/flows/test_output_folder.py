"""Files of the user in output folders are not replaced; those of earlier runs are."""

from __future__ import annotations

from pathlib import Path

import pytest

from scan2sim.flows.commands.run import RESULTS, run_tile
from scan2sim.flows.commands.slam import OUTPUTS
from scan2sim.flows.commands.survey import SURVEY_RESULTS
from scan2sim.flows.engine.output_folder import check_own
from scan2sim.flows.engine.planning import STORE
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.io.worlds.merge import STAMP_FILE


@pytest.mark.parametrize(
    ("name", "results"), [("world", RESULTS), ("world", SURVEY_RESULTS), ("colmap", OUTPUTS), ("mine.txt", None)]
)
def test_only_results_of_earlier_runs_are_replaced(name: str, results: tuple[str, ...] | None, tmp_path: Path) -> None:
    out = tmp_path / "out"
    check_own(out, results)
    (out / name).mkdir(parents=True)
    (out / "run.log").touch()
    with pytest.raises(SettingError, match=f"{name}: isn't from an earlier run"):
        check_own(out, results)
    (out / STORE).mkdir()
    check_own(out, results)


def test_a_world_without_its_cached_results_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "world").mkdir()
    (tmp_path / "world" / STAMP_FILE).touch()
    check_own(tmp_path, RESULTS)


def test_other_files_of_the_user_are_no_obstacle(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    check_own(tmp_path, RESULTS)


def test_a_run_beside_a_foreign_world_changes_nothing(small_street: Path, tmp_path: Path) -> None:
    (tmp_path / "world").mkdir()
    (tmp_path / "world" / "mine.sdf").write_text("mine", encoding="utf-8")
    with pytest.raises(SettingError, match="world: isn't from an earlier run"):
        run_tile(small_street, tmp_path, Settings.of({}))
    assert [path.name for path in tmp_path.rglob("*")] == ["world", "mine.sdf"]

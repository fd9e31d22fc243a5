"""Any class of the cloud may be empty, even the ground: the world is built from the others."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE, GROUPS, group_of
from scan2sim.pipeline.core.types import Bools
from scan2sim.pipeline.io.survey import read_survey
from scan2sim.pipeline.tiling.cut_corridor import CutParams, cut_survey
from tests.flows.inline_steps import inline_steps
from tests.flows.tiny import COARSE, keep_points, loaded, points, tiny
from tests.flows.tiny import scan2sim as run_scan2sim

ALL_SURFACES = COARSE | {"split": {"vegetation": "both", "vehicles": "keep"}}
CLASSES: dict[str, np.ndarray] = {name: np.flatnonzero(group_of() == number) for number, name in enumerate(GROUPS)}
CLASSES |= {"vehicle": np.array([CODE["vehicle"]]), "furniture": np.array([CODE["road_sign"], CODE["pole"]])}
FEW_POINTS = 34
"""Number of points that is too small for a surface; a SLAM map had as many on the ground."""
DATA_ERROR = 4
"""Exit code if no world can be built."""
FAST_CASES = {("without", "terrain", "street"), ("alone", "vegetation", "map"), ("few", "terrain", "map")}


def scan2sim(*arguments: object, settings: object) -> tuple[int, str]:
    """Run the command and its steps in this process; returns its exit code and output."""
    with inline_steps():
        return run_scan2sim(*arguments, settings=settings)


@pytest.fixture(scope="module", params=["street", "map"])
def tile(request: pytest.FixtureRequest, small_street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny street, and the same street like a SLAM map: without photos and trajectory."""
    is_map = request.param == "map"
    made = tiny(small_street, tmp_path_factory.mktemp("tiny") / "tile", photos=0 if is_map else 2)
    if is_map:
        lines = (made / "tile.toml").read_text(encoding="utf-8").splitlines(keepends=True)
        text = "".join(line for line in lines if not line.startswith("trajectory"))
        (made / "tile.toml").write_text(text, encoding="utf-8")
    return made


def thinned(how: str, classification: np.ndarray, name: str) -> Bools:
    """Mask (N,) of the points to keep: all but a class, only the class, or all with few points of the class."""
    own = np.isin(classification, CLASSES[name])
    if how == "alone":
        return own
    few = np.zeros(len(own), bool)
    if how == "few":
        few[np.flatnonzero(own)[:: max(1, own.sum() // FEW_POINTS)][:FEW_POINTS]] = True
    return np.asarray(~own | few)


@pytest.mark.parametrize(
    ("how", "name", "tile"),
    [
        pytest.param(how, name, kind, marks=() if (how, name, kind) in FAST_CASES else pytest.mark.slow)
        for kind in ("street", "map")
        for how in ("without", "alone", "few")
        for name in CLASSES
    ],
    indirect=["tile"],
)
def test_world_is_built_from_the_remaining_classes(tile: Path, tmp_path: Path, how: str, name: str) -> None:
    copy = shutil.copytree(tile, tmp_path / "tile")
    cloud = points(copy)
    assert cloud.classification is not None
    keep_points(copy, thinned(how, cloud.classification, name))
    code, printed = scan2sim("run", copy, "--out", tmp_path / "out", settings=ALL_SURFACES)
    if how == "alone" and name in ("vehicle", "furniture"):
        assert code == DATA_ERROR and ("no point belongs to terrain" in printed or "points in all" in printed)
        return
    assert code == 0, printed
    (made,) = loaded(tmp_path / "out").tiles
    if name in GROUPS:
        assert (name in made.groups) == (how == "alone")


@pytest.mark.slow
@pytest.mark.parametrize("name", CLASSES)
@pytest.mark.parametrize("how", ["without", "alone", "few"])
def test_survey_is_built_if_a_class_is_missing_in_a_tile(
    small_street: Path, tmp_path: Path, how: str, name: str
) -> None:
    corridor = tiny(small_street, tmp_path / "corridor")
    cut_survey(corridor, tmp_path / "survey", CutParams(length=6.0, buffer=3.0))
    last = [*read_survey(tmp_path / "survey" / "survey.toml").tiles.values()][-1].parent
    cloud = points(last)
    assert cloud.classification is not None
    kept = thinned(how, cloud.classification, name)
    keep_points(last, kept)
    code, printed = scan2sim("survey", tmp_path / "survey", "--out", tmp_path / "out", settings=ALL_SURFACES)
    if (
        how == "alone" and name == "furniture"
    ):  # with only vehicles, the neighbour's points at the border suffice for a world
        assert code == 5 and "1 of 2 tiles failed" in printed and "points in all" in printed
        assert len(loaded(tmp_path / "out").tiles) == 1
    else:
        assert code == 0, printed
        assert len(loaded(tmp_path / "out").tiles) == 2


@pytest.mark.slow
def test_slam_map_with_34_ground_points_becomes_a_world(real_data: Path, tmp_path: Path) -> None:
    cloud = real_data / "slam_maps" / "hdl501.pcd"
    assert scan2sim("import", "clouds", cloud, "--crs", "local", "--out", tmp_path / "tile", settings={})[0] == 0
    code, printed = scan2sim("run", tmp_path / "tile", "--out", tmp_path / "out", settings=COARSE)
    assert code == 0, printed
    assert "terrain" not in loaded(tmp_path / "out").tiles[0].groups

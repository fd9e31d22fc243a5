"""Built-in requirements contain all tables of D3.2, and invalid files are rejected."""

from __future__ import annotations

from pathlib import Path

import pytest

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.services.qos import requirements
from scan2sim.services.qos.requirements import Bound, Environment, read

GOOD = 'title = "t"\ndescription = "d"\nsource = "s"\n[edge]\n'


def test_all_tables_of_d32_are_built_in() -> None:
    sources = {read(name).source.rpartition(" ")[2] for name in requirements.names()}
    assert sources == {"3", "6", "7", "8", "10", "11"}


def test_values_are_those_of_the_tables() -> None:
    detect = read("detect")
    assert detect.edge and detect.edge.response_time == Bound(kind="<", value=2000)
    assert detect.edge.loss_rate == Bound(kind="<", value=0.0001) and detect.edge.slice == "eMBB"
    assert detect.robot and detect.robot.delay is None and detect.robot.cpu_cores == Bound(kind=">", value=4)
    tele = read("teleoperation")
    assert tele.cloud and tele.cloud.bandwidth == Bound(kind=">", value=20)
    with pytest.raises(SettingError, match="cloud"):
        read("traffic").of(Environment.ROBOT)


def test_bounds_include_their_value() -> None:
    assert Bound(kind="<", value=5).met(5) and not Bound(kind="<", value=5).met(6)
    assert Bound(kind=">", value=5).met(6) and not Bound(kind=">", value=5).met(4.9)


@pytest.mark.parametrize(
    ("text", "about"),
    [
        (GOOD + 'delay = "soon"', "edge.delay"),
        (GOOD + 'dealy = "< 5"', "edge.dealy"),
        (GOOD + 'slice = "fast"', "edge.slice"),
        ("title = ", "TOML"),
        ('title = "t"', "description"),
    ],
)
def test_errors_name_the_file_and_the_field(tmp_path: Path, text: str, about: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=about) as caught:
        read(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_lists_built_in_requirements(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="classify, detect"):
        read(tmp_path / "nowhere.toml")

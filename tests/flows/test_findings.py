"""What a run says is wrong with its world: made-up bad worlds, and a good one that nothing is said of."""

from __future__ import annotations

from typing import Any

import pytest

from scan2sim.flows.commands.run_with_progress import WORST, show_findings
from scan2sim.flows.reports.findings import findings
from scan2sim.pipeline.core.cache import Manifest

GOOD: dict[str, dict[str, Any]] = {
    "views": {"usable": 10},
    "carve": {"moving_share": 0.004},
    "segment": {"moving_share": 0.0},
    "agreement": {"photos": 8, "left_out": []},
    "texture.terrain": {"area_m2": 100.0, "seen_m2": 85.0},
    "score": {
        "photos": {f"photo{i}": {"psnr_gain_db": 20.0 + i, "coverage": 0.95} for i in range(4)},
        "cameras": {"count": 10, "near_m": {}},
    },
}


def run_of(warnings: dict[str, list[str]] | None = None, /, **changed: dict[str, Any]) -> dict[str, Manifest]:
    """Manifests of the good run, with facts of steps changed, and warnings."""
    facts = {step: GOOD.get(step, {}) | changed.get(step, {}) for step in GOOD | changed}
    return {
        step: Manifest(step, 1, {}, {}, "", "", {}, {}, {}, about, (warnings or {}).get(step, []), 1.0, 1.0)
        for step, about in facts.items()
    }


def scored(*db: float, coverage: float = 0.9) -> dict[str, Any]:
    return {"photos": {f"photo{i}": {"psnr_gain_db": value, "coverage": coverage} for i, value in enumerate(db)}}


def test_nothing_is_said_of_a_good_world() -> None:
    assert findings(run_of()) == []


def test_cameras_in_a_wall_make_a_world_unusable() -> None:
    near = {"count": 10, "near_m": {"photo3": 0.01, "photo4": 0.3}}
    (one,) = findings(run_of(score={"cameras": near}))
    assert one.level == "unusable" and "2 of 10 photos" in one.text and "photo3: 0.01 m" in one.text


def test_one_camera_of_many_beside_a_surface_is_no_reason_to_throw_the_world_away() -> None:
    (one,) = findings(run_of(score={"cameras": {"count": 100, "near_m": {"photo3": 0.9}}}))
    assert one.level == "poor" and "1 of 100 photos is" in one.text


@pytest.mark.parametrize(("db", "level"), [((20, 14, 21, 22), "poor"), ((20, 11, 12), "unusable")])
def test_held_out_photos_that_the_world_does_not_look_like(db: tuple[float, ...], level: str) -> None:
    (one,) = findings(run_of(score=scored(*db)))
    assert one.level == level and "less than 15 dB" in one.text and "photo1" in one.text and "photo0" not in one.text


def test_held_out_photos_of_what_no_other_saw() -> None:
    (one,) = findings(run_of(score=scored(21, 22, coverage=0.0)))
    assert one.level == "poor" and "2 of 2" in one.text


@pytest.mark.parametrize(("seen", "levels"), [(70.0, []), (40.0, ["note"]), (14.0, ["poor"])])
def test_surface_that_no_photo_saw(seen: float, levels: list[str]) -> None:
    found = findings(run_of(**{"texture.terrain": {"seen_m2": seen}}))
    assert [one.level for one in found] == levels
    assert all(f"{1 - seen / 100:.0%} of the surface" in one.text for one in found)


def test_a_tile_without_photos_is_not_told_that_none_saw_it() -> None:
    assert not findings(run_of(views={"usable": 0}, **{"texture.terrain": {"seen_m2": 0.0}}))


def test_vehicles_that_are_not_wholly_gone() -> None:
    assert not findings(run_of(score={"remains_m2": [0.0, 0.3]}))
    (one,) = findings(run_of(score={"remains_m2": [0.0, 2.53, 10.2]}))
    assert one.level == "poor" and "2 of 3 vehicles" in one.text and "10.2 m2" in one.text


def test_photos_that_disagree() -> None:
    (one,) = findings(run_of(agreement={"left_out": ["a", "b", "c"]}))
    assert one.level == "unusable" and "3 of 8 photos" in one.text and "a, b, c" in one.text


def test_the_worst_three_are_shown_and_the_rest_counted(capsys: pytest.CaptureFixture[str]) -> None:
    run = run_of(
        {"ingest": ["no colours"], "views": ["a photo is missing"]},
        ingest={},
        score={"cameras": {"count": 10, "near_m": {"photo3": 0.01}}, **scored(20, 14, 21, 22)},
        **{"texture.terrain": {"seen_m2": 30.0}},
    )
    assert [one.level for one in findings(run)] == ["unusable", "poor", "note", "note", "note"]
    show_findings(run)
    shown = capsys.readouterr().out
    assert shown.index("can't be used") < shown.index("a metre of") < shown.index("15 dB") < shown.index("70%")
    assert shown.count("warning:") == WORST and "2 more in the report" in shown and "no colours" not in shown

"""Quality findings of synthetic good and bad worlds."""

from __future__ import annotations

from typing import Any

import pytest

from scan2sim.flows.commands.run_with_progress import MAX_FINDINGS, show_findings
from scan2sim.flows.reports.findings import findings
from scan2sim.pipeline.core.cache import Manifest

GOOD: dict[str, dict[str, Any]] = {
    "views": {"usable": 10},
    "dynamic_objects": {"moving_share": 0.004},
    "segment": {"moving_share": 0.0},
    "photo_consistency": {"photos": 8, "left_out": []},
    "texture.terrain": {"area_m2": 100.0, "seen_m2": 85.0},
    "score": {
        "photos": {f"photo{i}": {"psnr_gain_db": 20.0 + i, "coverage": 0.95} for i in range(4)},
        "cameras": {"count": 10, "near_m": {}},
    },
}


def run_of(warnings: dict[str, list[str]] | None = None, /, **changed: dict[str, Any]) -> dict[str, Manifest]:
    """Manifests of the good run, with changed metrics of steps, and warnings."""
    facts = {step: GOOD.get(step, {}) | changed.get(step, {}) for step in GOOD | changed}
    return {
        step: Manifest(step, 1, {}, {}, "", "", {}, {}, {}, about, (warnings or {}).get(step, []), 1.0, 1.0)
        for step, about in facts.items()
    }


def scored(*db: float, coverage: float = 0.9) -> dict[str, Any]:
    return {"photos": {f"photo{i}": {"psnr_gain_db": value, "coverage": coverage} for i, value in enumerate(db)}}


def test_good_world_has_no_findings() -> None:
    assert findings(run_of()) == []


def test_many_cameras_inside_surfaces_make_a_world_unusable() -> None:
    near = {"count": 10, "near_m": {"photo3": 0.01, "photo4": 0.3}}
    (one,) = findings(run_of(score={"cameras": near}))
    assert one.level == "unusable" and "2 of 10 photos" in one.text and "photo3: 0.01 m" in one.text


def test_single_camera_close_to_a_surface_makes_a_world_poor() -> None:
    (one,) = findings(run_of(score={"cameras": {"count": 100, "near_m": {"photo3": 0.9}}}))
    assert one.level == "poor" and "1 of 100 photos is" in one.text


@pytest.mark.parametrize(("db", "level"), [((20, 14, 21, 22), "poor"), ((20, 11, 12), "unusable")])
def test_held_out_photos_with_low_psnr(db: tuple[float, ...], level: str) -> None:
    (one,) = findings(run_of(score=scored(*db)))
    assert one.level == level and "less than 15 dB" in one.text and "photo1" in one.text and "photo0" not in one.text


def test_clearly_different_lenses_are_noted() -> None:
    def lens(change: float) -> dict[str, float]:
        return {"focal_change_percent": change, "k1_change": 0.01, "k2_change": 0.0}

    (one,) = findings(run_of(pose_refinement={"cameras": {"left": lens(-0.9), "right": lens(0.1)}}))
    assert one.level == "note" and one.text.startswith("left: ") and "0.9 % shorter" in one.text


def test_held_out_photos_of_unseen_surfaces() -> None:
    (one,) = findings(run_of(score=scored(21, 22, coverage=0.0)))
    assert one.level == "poor" and "2 of 2" in one.text


@pytest.mark.parametrize(("seen", "levels"), [(70.0, []), (40.0, ["note"]), (14.0, ["poor"])])
def test_share_of_unseen_surface(seen: float, levels: list[str]) -> None:
    found = findings(run_of(**{"texture.terrain": {"seen_m2": seen}}))
    assert [one.level for one in found] == levels
    assert all(f"{1 - seen / 100:.0%} of the surface" in one.text for one in found)


def test_tile_without_photos_has_no_finding_about_unseen_surface() -> None:
    assert not findings(run_of(views={"usable": 0}, **{"texture.terrain": {"seen_m2": 0.0}}))


def test_remains_of_removed_vehicles() -> None:
    assert not findings(run_of(score={"residue_m2": [0.0, 0.3]}))
    (one,) = findings(run_of(score={"residue_m2": [0.0, 2.53, 10.2]}))
    assert one.level == "poor" and "2 of 3 vehicles" in one.text and "10.2 m2" in one.text


def test_rejected_photos() -> None:
    (one,) = findings(run_of(photo_consistency={"left_out": ["a", "b", "c"]}))
    assert one.level == "unusable" and "3 of 8 photos" in one.text and "a, b, c" in one.text


def test_worst_findings_are_printed_and_the_others_counted(capsys: pytest.CaptureFixture[str]) -> None:
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
    assert (
        shown.count("warning:") == MAX_FINDINGS
        and "2 more findings in the report" in shown
        and "no colours" not in shown
    )

"""The report: what of the steps' metrics and pictures reaches the page and the table of figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.flows.engine.planning import PlannedTask
from scan2sim.flows.pipelines.graph import Task
from scan2sim.flows.reports.tile import representative, write_report
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.step import Done, Params, Step
from scan2sim.pipeline.core.types import Frame, Tile
from scan2sim.pipeline.io.images import image

PART = {"psnr_db": 20.12, "psnr_gain_db": 23.4, "ssim": 0.71, "pixels": 300}
NOTHING = {"psnr_db": None, "psnr_gain_db": None, "ssim": None, "pixels": 0}
SCORED: dict[str, Any] = {
    "held_out": 5,
    "psnr_db": 20.5,
    "psnr_gain_db": 23.5,
    "ssim": 0.7,
    "sharpness": 0.83,
    "photos": {f"photo{i}": {"psnr_gain_db": 20.0 + (i * 3) % 5} for i in range(5)},
    "by_class": {"terrain": PART, "building": NOTHING},
    "by_distance": {"0-5 m": PART, "5-10 m": NOTHING},
    "truth_psnr_db": 24.0,
    "truth_psnr_near_db": 29.3,
}
UNSCORED = {
    **SCORED, "held_out": 0, "psnr_db": None, "psnr_gain_db": None, "ssim": None, "sharpness": None, "photos": {},
    "by_class": {"terrain": NOTHING}, "by_distance": {"0-5 m": NOTHING},
}  # fmt: skip
FACTS: dict[str, dict[str, Any]] = {
    "ingest": {"points": 1000},
    "views": {"usable": 7},
    "texture.terrain": {"area_m2": 50.0, "seen_m2": 40.0, "coloured_m2": 7.0, "filled_m2": 3.0, "coverage": 0.8},
    "texture.building": {"area_m2": 0.0, "seen_m2": 0.0, "coverage": 0.0, "pages": 0},
    "geometry": {},
    "export": {"triangles": {"terrain": 12}},
}


@pytest.fixture
def report(tmp_path: Path) -> Any:
    """Write a report of synthetic results; returns the content of report.json and the page."""

    def write(scored: dict[str, Any]) -> tuple[dict[str, Any], str]:
        store, done, planned = Store(tmp_path / "steps"), dict[str, Manifest](), []
        for task, metrics in {**FACTS, "score": scored}.items():
            folder = store.begin(task)
            files = {"error": album(folder, list(scored["photos"]))} if task == "score" else {}
            about = {"version": 1, "params": {}, "inputs": {}, "inputs_digest": "", "seconds": 1.0, "peak_mb": 100.0}
            done[task] = store.commit(task, "key", folder, Done(files, metrics), about)
            planned.append(PlannedTask(Task(Step(task, 1, no_step), Params(), {}), "key", {}, None))
        tile = Tile(tmp_path / "tile.toml", "made_up", Frame(), ())
        page = write_report(tile, planned, done, store, tmp_path, seconds=1.0).read_text(encoding="utf-8")
        return json.loads((tmp_path / "report.json").read_text(encoding="utf-8")), page

    return write


def no_step(*_: Any) -> Done:
    raise AssertionError("no step runs here")


def album(folder: Path, titles: list[str]) -> Path:
    (folder / "error").mkdir()
    entries = [{"file": f"{t}.jpg", "role": "error", "title": t, "caption": "23 dB."} for t in titles]
    for entry in entries:
        image.write(folder / "error" / entry["file"], np.zeros((8, 24, 3), np.uint8))
    (folder / "error" / "index.json").write_text(json.dumps(entries), encoding="utf-8")
    return folder / "error"


def test_texture_metrics(report: Any) -> None:
    texture = report(SCORED)[0]["texture"]
    assert texture["sharpness"] == 0.83 and texture["by_class"]["terrain"] == PART
    assert texture["area_by_class"]["terrain"] == {
        "area_m2": 50.0, "seen_m2": 40.0, "coloured_m2": 7.0, "filled_m2": 3.0,
    }  # fmt: skip
    assert texture["area_by_class"]["building"]["filled_m2"] == 0


def test_page_shows_tables_and_worst_median_and_best_images(report: Any) -> None:
    page = report(SCORED)[1].split("<main>")[1]
    assert page.count("data:image/jpeg") == 3
    assert all(f"({rank} of 5)" in page for rank in ("worst", "median", "best"))
    assert "sharpness 83 % of theirs" in page and "29.3 dB near photos" in page
    assert page.count("20.1</td>") == 2 and "–</td>" in page and "100.0 %</td>" in page
    assert "7 m²" in page and "None" not in page.split("<h2>Steps")[0]


def test_photo_names_are_escaped(report: Any) -> None:
    name = "<img src=x onerror=alert(1)>"
    page = report({**SCORED, "photos": {name: {"psnr_gain_db": 20.0}}})[1]
    assert name not in page and "&lt;img" in page


def test_page_without_held_out_photos(report: Any) -> None:
    page = report(UNSCORED)[1]
    assert "--hold-out 8" in page and "Differences from held-out photos" not in page and "24.0 dB" in page


def test_representative_images_are_worst_median_and_best() -> None:
    entries = [{"title": str(i), "caption": ""} for i in range(5)]
    scores = {str(i): {"psnr_gain_db": float(value)} for i, value in enumerate([3, 1, 4, 5, 2])}
    assert [entry["title"] for entry in representative(entries, scores)] == ["1", "0", "3"]
    assert [entry["title"] for entry in representative(entries[:2], scores)] == ["1", "0"]

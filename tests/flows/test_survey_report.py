"""Report of a survey: map and tables with all tiles, whatever metrics are known."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.flows.reports.survey import DATA, PAGE, TileState, overview, rows, write_survey_report
from scan2sim.pipeline.core.errors import SpaceError
from scan2sim.pipeline.core.voronoi_cell import cells, outline
from scan2sim.pipeline.io.images import image

METRICS: dict[str, Any] = {
    "points": 4_000_000, "photos": 30, "coverage": 0.8, "psnr_db": 22.0, "cloud_to_mesh_m": {"terrain": 0.011},
    "triangles": 300_000, "bytes": 90_000_000, "bytes_written": 2_000_000_000, "seconds": 600.0, "peak_mb": 2048.0,
}  # fmt: skip
ORIGIN = np.array([690_000.0, 5_335_000.0])


def tiles(count: int = 6, length: float = 50.0) -> list[TileState]:
    """Tiles in a row: the second failed, the last is waiting, the third is up to date and has no PSNR."""
    seeds = {f"town_{i}": tuple((ORIGIN + [length * i, 0]).tolist()) for i in range(count)}
    made = []
    for i, (name, cell) in enumerate(cells(seeds, 3 * length).items()):
        state = {1: "failed", 2: "cached", count - 1: "waiting"}.get(i, "done")
        borders = [{"neighbour": n, "gap_m": 0.001 * i, "colour_step": 2.0} for n in cell.neighbours]
        known = state in ("done", "cached")
        made.append(
            TileState(
                name,
                outline(cell, np.subtract(cell.seed, length / 2), np.add(cell.seed, length / 2)),
                state,  # type: ignore[arg-type]
                reason="cloud.laz: is <truncated>" if state == "failed" else None,
                figures=METRICS | {"psnr_db": None if i == 2 else 20.0 + i} if known else {},
                report=f"tiles/{name}/report.html" if known else None,
                warnings=["views: 3 photos have no pose"] if known else [],
                borders=borders if known else [],
            )
        )
    return made


def written(out: Path, made: list[TileState], **more: Any) -> tuple[dict[str, Any], str]:
    """Write the reports; returns survey.json and survey.html."""
    page = write_survey_report(out, "town", made, **more)
    return json.loads((out / "survey.json").read_text(encoding="utf-8")), page.read_text(encoding="utf-8")


def drawn(page: str) -> ET.Element:
    found = re.search(r"<svg.*?</svg>", page, re.S)
    assert found is not None
    return ET.fromstring(found[0])


def test_totals_include_all_tiles(tmp_path: Path) -> None:
    body, page = written(tmp_path, tiles(), path=ORIGIN + np.column_stack([np.linspace(0, 300, 3001), np.zeros(3001)]))
    totals = body["totals"]
    assert [totals[s] for s in ("tiles", "done", "cached", "failed", "waiting")] == [6, 3, 1, 1, 1]
    assert totals["points"] == 16_000_000 and totals["photos"] == 120 and totals["seconds"] == 2400
    assert totals["peak_mb"] == 2048 and totals["psnr_db"] == pytest.approx((20 + 23 + 24) / 3)
    assert totals["length_m"] == pytest.approx(300) and totals["area_m2"] == pytest.approx(6 * 50 * 50)
    head = page.split("<main>")[1].split("<h2>")[0]
    assert all(text in head for text in ("0.30 km", "16.0 M", "40 min", "8.0 GB", "peak 2.0 GB", "22.3 dB"))
    assert "of 6 tiles done, 1 were up to date" in head


def test_map_shows_every_tile_with_metrics_and_link(tmp_path: Path) -> None:
    made = tiles()
    svg = drawn(written(tmp_path, made, path=np.stack([ORIGIN, ORIGIN + [250, 0]]))[1])
    polygons = {str(p.findtext("title")).split(":")[0].strip(): p for p in svg.iter("polygon")}
    assert set(polygons) == {tile.name for tile in made}
    assert "is <truncated>" in str(polygons["town_1"].findtext("title")) and polygons["town_1"].get("class") == "failed"
    assert "4.0 M points, 30 photos" in str(polygons["town_0"].findtext("title"))
    assert [a.get("href") for a in svg.iter("a")] == [tile.report for tile in (made[2], made[0], made[3], made[4])]
    assert "--q:#" in str(polygons["town_0"].get("style")) and "--q" not in str(polygons["town_2"].get("style"))
    assert polygons["town_5"].get("style") is None
    x = [float(corner.split(",")[0]) for corner in str(polygons["town_3"].get("points")).split()]
    wide, high = (float(value) for value in str(svg.get("viewBox")).split()[2:])
    assert 0.45 * wide < min(x) < max(x) < 0.7 * wide and high < wide
    assert len(svg.findall("polyline")) == 1
    labels = [str(text.text).strip() for text in svg.findall("text")]
    assert {"0", "1 ✕", "5"} < set(labels) and "50 m, north is up" in labels


def test_failures_come_first_with_their_reason(tmp_path: Path) -> None:
    page = written(tmp_path, tiles())[1]
    assert "cloud.laz: is &lt;truncated&gt;" in page and "<truncated>" not in page
    assert page.index("<h2>Failed") < page.index("<h2>Map") < page.index("<h2>Borders") < page.index("<h2>Tiles")
    table = page.split("<h2>Tiles")[1]
    order = [table.index(f"town_{i}<") for i in (1, 5, 0, 2, 3, 4)]
    assert order == sorted(order)
    assert "1.1 cm" in table and "None" not in page and "3 photos have no pose <small>(4 tiles)" in page


def test_borders_are_listed_once_worst_first(tmp_path: Path) -> None:
    body, page = written(tmp_path, tiles())
    assert [b["tiles"] for b in body["borders"]] == [
        ["town_3", "town_4"], ["town_4", "town_5"], ["town_2", "town_3"], ["town_1", "town_2"], ["town_0", "town_1"],
    ]  # fmt: skip
    assert body["borders"][0]["gap_m"] == pytest.approx(0.004) and "neighbour" not in body["borders"][0]
    assert "town_3 – town_4" in page and "0.4 cm" in page


def test_rows_and_overview(tmp_path: Path) -> None:
    assert rows(tmp_path) == [] and overview(tmp_path) == "No tile is finished yet."
    written(tmp_path, tiles())
    lines = rows(tmp_path)
    assert lines[0] == {"tile": "town_0", "state": "done"} | {
        k: v for k, v in (METRICS | {"psnr_db": 20.0}).items() if k != "cloud_to_mesh_m"
    }
    assert lines[1] == {"tile": "town_1", "state": "failed"}
    assert overview(tmp_path).splitlines() == [
        "**town**: 1 failed, 1 waiting, 3 done, 1 cached",
        "- town_1: cloud.laz: is <truncated>",
    ]


def test_report_without_any_metrics(tmp_path: Path) -> None:
    page = written(tmp_path, [TileState("a", np.zeros((0, 2)), "waiting")])[1]
    assert "<h2>Map" not in page and "<h2>Borders" not in page and "waiting" in page
    page = written(tmp_path, [TileState("a", ORIGIN + [[0, 0], [9, 0], [9, 9]], "waiting")])[1]
    assert "unknown" in page and len(list(drawn(page).iter("polygon"))) == 1
    assert "<h2>Map" not in written(tmp_path, [])[1]


def test_map_shows_coverage_if_there_is_no_psnr(tmp_path: Path) -> None:
    made = [TileState("a", ORIGIN + [[0, 0], [9, 0], [9, 9]], "done", figures={"coverage": 0.7})]
    page = written(tmp_path, made)[1]
    assert "seen by a photo:" in page and "PSNR against" not in page
    assert "--q:#" in page and "--c:" not in drawn(page)[0][0].get("style", "")


def test_thumbnails_are_small_and_embedded(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (720, 1280, 3), dtype=np.uint8)
    image.write(tmp_path / "hero.jpg", noise)
    ring = ORIGIN + [[0, 0], [9, 0], [9, 9]]
    made = [TileState(n, ring, "done", thumbnail=tmp_path / f"{n}.jpg") for n in ("hero", "absent")]
    page = written(tmp_path, made)[1]
    assert page.count("data:image/jpeg") == 1 and len(page) < 40_000
    assert "src=" not in page.replace('src="data:', "") and "http" not in page  # no external resources


def test_report_of_a_thousand_tiles_stays_small(tmp_path: Path) -> None:
    body, page = written(tmp_path, tiles(1000))
    assert len(page) < 2_000_000 and len(body["borders"]) == 999
    svg = drawn(page)
    assert len(list(svg.iter("polygon"))) == 1000 and svg.get("class") == "tiny" and len(svg.findall("text")) == 1
    assert "the first 40 of 999" in page
    path = ORIGIN + np.cumsum(np.full((200_000, 2), 0.05), axis=0)
    line = drawn(written(tmp_path, tiles(), path=path)[1]).find("polyline")
    assert line is not None and len(str(line.get("points")).split()) < 2000


def test_page_is_written_atomically(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written(tmp_path, tiles())
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(SpaceError):
        write_survey_report(tmp_path, "town", tiles(3))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert PAGE in before and DATA in before

"""The report: what of the steps' metrics and pictures reaches the page and the table of figures."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.flows.engine.planning import PlannedTask
from scan2sim.flows.pipelines.graph import Task
from scan2sim.flows.reports.publish import PAGE_SCRIPTS
from scan2sim.flows.reports.tile import PAGES, SCRIPTS, representative, write_report
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.step import Done, Params, Step, silent
from scan2sim.pipeline.core.types import Frame, Tile
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.steps.preview import PREVIEW, PreviewParams
from tests.fakes import splat_scenes, synthetic
from tests.fakes.browser import Page, chromium
from tests.waiting import until

PART = {"psnr_db": 20.12, "psnr_gain_db": 23.4, "ssim": 0.71, "pixels": 300}
NOTHING = {"psnr_db": None, "psnr_gain_db": None, "ssim": None, "pixels": 0}
SCORED: dict[str, Any] = {
    "held_out": 5,
    "psnr_db": 20.5,
    "psnr_gain_db": 23.5,
    "ssim": 0.7,
    "sharpness": 0.83,
    "photos": {f"photo{i}": {"psnr_gain_db": 20.0 + (i * 3) % 5} for i in range(5)},
    "frame": {
        "psnr_db": 11.5,
        "psnr_gain_db": 12.34,
        "ssim": 0.61,
        "ms_ssim": 0.57,
        "excluded": 0.123,
        "by_class": {"terrain": PART, "no surface: sky": NOTHING},
        "by_distance": {"0-5 m": PART},
    },
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


RANGES = {
    "rays": 700, "median_m": 0.0812, "p90_m": 0.4, "early_20cm": 0.123, "early_50cm": 0.03, "late_50cm": 0.01,
    "missing": 0.204, "near_surface": 0.7,
}  # fmt: skip
MEASURES = {"depth_rmse_m": 4.321, "depth_median_m": 0.12, "chamfer_m2": 1.234, "f_score": 0.84}
PHANTOMS: dict[str, Any] = {
    "rays": 4321, "ground": 0.612, "surface": 0.02, "phantom": 0.034, "without_return": 0.0087,
    "by_surface": {"terrain": 0.0, "building": 0.011}, "by_distance": {"0-10 m": 0.0087}, "reason": "",
}  # fmt: skip
LIDAR: dict[str, Any] = {
    "rays": 700, "excluded": 0.1, "all": RANGES, "by_surface": {"terrain": RANGES, "building": {**RANGES, "rays": 0}},
    "by_distance": {"0-10 m": RANGES}, "phantoms": PHANTOMS, "range_image": MEASURES,
    "sweeps": {f"Sweep {i}.": {**MEASURES, "f_score": 0.1 * i} for i in range(5)},
}  # fmt: skip


@pytest.fixture
def report(tmp_path: Path) -> Any:
    """Write a report of synthetic results; returns the content of report.json and the page."""

    def write(
        scored: dict[str, Any], more: Mapping[str, dict[str, Any]] = {}, preview: Path | None = None
    ) -> tuple[dict[str, Any], str]:
        store, done, planned = Store(tmp_path / "steps"), dict[str, Manifest](), []
        for task, metrics in {**FACTS, "score": scored, **more}.items():
            folder = store.begin(task)
            photos = list(scored["photos"])
            files = {name: album(folder, name, photos) for name in ("error", "frames")} if task == "score" else {}
            files |= {"images": album(folder, "images", list(metrics["sweeps"]))} if task == "lidar_score" else {}
            if task == "preview" and preview is not None:
                files |= {"preview": Path(shutil.copytree(preview, folder / "preview"))}
            about = {"version": 1, "params": {}, "inputs": {}, "inputs_digest": "", "seconds": 1.0, "peak_mb": 100.0}
            done[task] = store.commit(task, "key", folder, Done(files, metrics), about)
            planned.append(PlannedTask(Task(Step(task, 1, no_step), Params(), {}), "key", {}, None))
        tile = Tile(tmp_path / "tile.toml", "example", Frame(), ())
        page = write_report(tile, planned, done, store, tmp_path, seconds=1.0).read_text(encoding="utf-8")
        return json.loads((tmp_path / "report.json").read_text(encoding="utf-8")), page

    return write


def no_step(*_: Any) -> Done:
    raise AssertionError("no step runs here")


def album(folder: Path, name: str, titles: list[str]) -> Path:
    (folder / name).mkdir()
    role = {"error": "error", "frames": "frame", "images": "lidar"}[name]
    entries = [{"file": f"{t}.jpg", "role": role, "title": t, "caption": "23 dB."} for t in titles]
    for entry in entries:
        image.write(folder / name / entry["file"], np.zeros((8, 24, 3), np.uint8))
    (folder / name / "index.json").write_text(json.dumps(entries), encoding="utf-8")
    return folder / name


def test_texture_metrics(report: Any) -> None:
    texture = report(SCORED)[0]["texture"]
    assert texture["sharpness"] == 0.83 and texture["by_class"]["terrain"] == PART
    assert texture["area_by_class"]["terrain"] == {
        "area_m2": 50.0, "seen_m2": 40.0, "coloured_m2": 7.0, "filled_m2": 3.0,
    }  # fmt: skip
    assert texture["area_by_class"]["building"]["filled_m2"] == 0


def test_page_shows_tables_and_worst_median_and_best_images(report: Any) -> None:
    page = report(SCORED)[1].split("<main>")[1]
    assert page.count("data:image/jpeg") == 3 + 5  # of the differences, and all whole frames
    assert all(f"({rank} of 5)" in page for rank in ("worst", "median", "best"))
    assert "sharpness 83 % of theirs" in page and "29.3 dB near photos" in page
    assert page.count("20.1</td>") == 4 and "–</td>" in page and "100.0 %</td>" in page
    assert "7 m²" in page and "None" not in page.split("<h2>Steps")[0]


def test_page_shows_whole_frames(report: Any) -> None:
    data, page = report(SCORED)
    section = page.split("<h2>Whole frames</h2>")[1].split("<h2>")[0]
    assert data["texture"]["frame"]["ms_ssim"] == 0.57
    assert "12.3 dB" in section and "11.5 dB without" in section and "MS-SSIM 0.57" in section and "12.3 %" in section
    assert "no surface: sky" in section and section.count("data:image/jpeg") == 5 and "is shown" not in section


def test_page_shows_frames_evenly_if_there_are_many(report: Any) -> None:
    many = {f"photo{i:03d}": {"psnr_gain_db": 20.0} for i in range(100)}
    section = report({**SCORED, "held_out": 100, "photos": many})[1].split("<h2>Whole frames</h2>")[1].split("<h2>")[0]
    assert section.count("data:image/jpeg") == 20 and "(every 5th is shown)" in section
    assert "photo000" in section and "photo095" in section


def test_photo_names_are_escaped(report: Any) -> None:
    name = "<img src=x onerror=alert(1)>"
    page = report({**SCORED, "photos": {name: {"psnr_gain_db": 20.0}}})[1]
    assert name not in page and "&lt;img" in page


def test_page_without_held_out_photos(report: Any) -> None:
    page = report(UNSCORED)[1]
    assert "--hold-out 8" in page and "Differences from held-out photos" not in page and "24.0 dB" in page


def test_page_shows_what_a_lidar_finds(report: Any) -> None:
    """Tables by surface and distance, the literature's measures, and the worst, median and best range images."""
    found = {"sweeps": 17, "scored": 5, "held_out": 5, "reason": ""}
    reflectance = {"no_return_m2": {"terrain": 1.5, "building": 0.8}}
    body, page = report(UNSCORED, {"sweeps": found, "lidar_score": LIDAR, "reflectance": reflectance})
    assert body["lidar"]["no_return_m2"] == 2.3 and "2.3 m² of the surface gave no return" in page
    assert body["lidar"]["held_out"] == 5 and body["lidar"]["by_surface"]["terrain"] == RANGES
    section = page.split("What a lidar finds")[1].split("<h2>")[0]
    assert "8.1 cm" in section and "12.3 %" in section and "20.4 %" in section and "70.0 %" in section
    assert "<td>building" not in section  # no ray hit it
    assert "4.32 m" in section and "1.234 m²" in section and "0.840 at 22 cm" in section
    assert "3.4 %" in section and "0.9 %: building 1.1 %)" in section and "4,321" in section and "61.2 %" in section
    assert "held out of the cloud" in section and section.count("data:image/jpeg") == 3
    assert [rank for rank in ("worst", "median", "best") if f"({rank} of 5)" in section] == ["worst", "median", "best"]
    page = report(UNSCORED, {"sweeps": {**found, "held_out": 0}, "lidar_score": LIDAR})[1]
    assert "from which the world was made" in page.split("What a lidar finds")[1].split("<h2>")[0]


def test_page_lists_removed_objects_with_place_size_and_reason(report: Any) -> None:
    car = {"kind": "car", "x": 391208.86, "y": 5820377.68, "length_m": 4.39, "width_m": 1.63, "height_m": 1.44}
    parked = car | {"points": 8647, "moved": False, "why": "is a vehicle with probability 0.96"}
    passing = car | {"kind": "passing", "points": 120, "moved": True, "why": "1.2 sweeps saw it, rays of 3.0 passed"}
    facts = {"instances": {"removed": [parked, passing]}}
    body, page = report(UNSCORED, facts)
    section = page.split("Removed objects")[1].split("<h2>")[0]
    assert body["removed"] == [parked, passing] and "leaves out 2 objects" in section
    assert "391208.9, 5820377.7" in section and "4.4 x 1.6 x 1.4 m" in section and "8,647" in section
    assert "probability 0.96" in section and "rays of 3.0 passed" in section
    kept = report(UNSCORED, facts | {"split": {"points": {"vehicle": 8647}}})[0]
    assert kept["removed"] == [passing], "parked vehicles are in the world"
    assert "Removed objects" not in report(UNSCORED)[1]


def test_page_says_why_phantom_returns_are_not_known(report: Any) -> None:
    unknown = {**PHANTOMS, "phantom": None, "reason": "no rings"}
    page = report(UNSCORED, {"sweeps": {"held_out": 0}, "lidar_score": {**LIDAR, "phantoms": unknown}})[1]
    assert "Phantom returns aren&#39;t known: no rings." in page.replace("aren't", "aren&#39;t")


def test_page_says_why_nothing_is_known_of_a_lidar(report: Any) -> None:
    body, page = report(UNSCORED)
    assert "no trajectory" in body["lidar"]["reason"] and body["lidar"]["reason"] in page.replace("&#39;", "'")
    airborne = {"sweeps": 0, "scored": 0, "held_out": 0, "reason": "the points have no times"}
    empty = {**LIDAR, "rays": 0, "sweeps": {}}
    assert report(UNSCORED, {"sweeps": airborne, "lidar_score": empty})[0]["lidar"] == {
        "reason": "the points have no times"
    }
    assert "lidar_score" in report(UNSCORED, {"sweeps": airborne})[0]["lidar"]["reason"]


def test_representative_images_are_worst_median_and_best() -> None:
    entries = [{"title": str(i), "caption": ""} for i in range(5)]
    scores = {str(i): {"psnr_gain_db": float(value)} for i, value in enumerate([3, 1, 4, 5, 2])}
    assert [entry["title"] for entry in representative(entries, scores)] == ["1", "0", "3"]
    assert [entry["title"] for entry in representative(entries[:2], scores)] == ["1", "0"]


NEXT_FRAME_DRAWN = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"


def published_preview(folder: Path, *, splats: bool) -> Done:
    """The preview of the synthetic tile, with the page's scripts beside its data in `folder`/`SCRIPTS`."""
    meshes = {"terrain": synthetic.ground(), "building": synthetic.house()}
    inputs = {group: synthetic.textured(folder / group, mesh) for group, mesh in meshes.items()}
    if splats:
        inputs["splats"] = folder / "splats.npz"
        splat_scenes.layer().save(inputs["splats"])
    (folder / "made").mkdir()
    done = PREVIEW.run(inputs, PreviewParams(), folder / "made", silent)
    published = Path(shutil.copytree(done.files["preview"], folder / SCRIPTS))
    for script in PAGE_SCRIPTS:
        shutil.copyfile(PAGES / script, published / script)
    return done


def header(page: Page) -> np.ndarray:
    page.until(NEXT_FRAME_DRAWN)
    return page.screenshot()[:400].astype(int)


def test_page_walks_through_splats_and_surfaces(report: Any, tmp_path: Path) -> None:
    done = published_preview(tmp_path, splats=True)
    report(UNSCORED, {"preview": done.metrics}, done.files["preview"])
    with chromium(tmp_path) as page:
        page.open(tmp_path / "report.html")
        page.click("[data-open]")
        page.until("document.querySelector('header').dataset.splats === 'loaded'")
        page.click("[data-show=surfaces]")
        surfaces = header(page)
        page.click("[data-show=splats]")
        page.until("document.querySelector('[data-show=splats]').ariaPressed === 'true'")
        until(lambda: np.abs(header(page) - surfaces).mean() > 20, what="the splats")
        page.click("[data-show=surfaces]")
        until(lambda: np.array_equal(header(page), surfaces), what="the surfaces")
        (tmp_path / SCRIPTS / "splats_data.js").unlink()
        page.open(tmp_path / "report.html")
        page.click("[data-open]")
        page.until("document.querySelector('[role=status]').textContent.includes(\"splats can't be shown\")")
        assert page.value("document.querySelector('header').dataset.state") == "open" and page.errors == []


def test_page_without_splats_has_no_buttons_for_them(report: Any, tmp_path: Path) -> None:
    done = published_preview(tmp_path, splats=False)
    page = report(UNSCORED, {"preview": done.metrics}, done.files["preview"])[1]
    assert "data-open" in page and "data-show=" not in page.split("<main>")[0].split("</style>")[1]

"""Report of a tile: metrics as `report.json`, a web page as `report.html`."""

from __future__ import annotations

import base64
import json
import mimetypes
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scan2sim.flows.engine.planning import PlannedTask
from scan2sim.flows.engine.versions import versions
from scan2sim.flows.reports import gazebo
from scan2sim.flows.reports.findings import findings
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.errors import ScanError
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.io.geodata import crs

TEMPLATE = "tile.html.j2"
PAGE, DATA = "report.html", "report.json"
PAGES = Path(__file__).parent / "pages"
SCRIPTS = "report_files"
"""Folder next to the page with the scripts and data of its 3D view."""
AREAS = ("area_m2", "seen_m2", "coloured_m2", "filled_m2")
Picture = dict[str, Any]
"""An image in the index.json of an album: `file`, `role`, `title`, `caption`, and optionally `other`."""


def write_report(
    tile: Tile,
    planned: Sequence[PlannedTask],
    done: Mapping[str, Manifest],
    store: Store,
    out: Path,
    *,
    seconds: float,
    failed: Mapping[str, ScanError] | None = None,
) -> Path:
    """Write both reports into `out`; returns the path of the page.

    Args:
        tile: the tile.
        planned, done: its tasks, and results by task name.
        store: cache of the results.
        out: output folder.
        seconds: duration of this run.
        failed: errors of side products by name.
    """
    body = figures(tile, done, failed) | {"seconds_this_run": round(seconds, 2)}
    write_atomically(out / DATA, json.dumps(body, indent=1))
    keys = {p.task.id.name: p.key for p in planned}
    pictures: list[Picture] = []
    for task, name in (("pictures", "pictures"), ("score", "error")):
        if task in done:
            folder = store.folder(task, keys[task]) / done[task].files[name]
            entries = json.loads((folder / "index.json").read_text(encoding="utf-8"))
            shown = representative(entries, done[task].metrics["photos"]) if name == "error" else entries
            pictures += [_with_pixels(entry, folder) for entry in shown]
    page = out / PAGE
    view = done["preview"].metrics if "preview" in done and done["preview"].files else None
    write_atomically(page, _render(body, pictures, view, gazebo.commands(out / "world" / f"{tile.name}.sdf")))
    return page


def failed_before(out: Path) -> set[str]:
    """Names of the failed side products according to the report in `out`."""
    return set(json.loads((out / DATA).read_text(encoding="utf-8")).get("failed", {}))


def figures(tile: Tile, done: Mapping[str, Manifest], failed: Mapping[str, ScanError] | None = None) -> dict[str, Any]:
    """All metrics of a run as a JSON document; docs/reference/formats.md describes the keys."""
    facts = {task: manifest.metrics for task, manifest in done.items()}
    geometry: dict[str, dict[str, float]] = {}
    for group, values in facts.get("geometry", {}).items():
        for name, value in values.items():
            geometry.setdefault(name, {})[group] = value
    seen = {g: facts[f"texture.{g}"] for g in SURFACES if f"texture.{g}" in facts}
    area = sum(s.get("area_m2", 0.0) for s in seen.values())
    texture: dict[str, Any] = {
        "coverage": round(sum(s.get("seen_m2", 0.0) for s in seen.values()) / area, 4) if area else 0.0,
        "coverage_by_class": {g: s.get("coverage", 0.0) for g, s in seen.items()},
        "area_by_class": {g: {name: s.get(name, 0.0) for name in AREAS} for g, s in seen.items()},
    }
    return {
        "tile": tile.name,
        "crs": crs.name(tile.frame.crs),
        "origin": list(tile.frame.origin),
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "versions": versions(),
        "seconds": round(sum(m.seconds for m in done.values()), 2),
        "peak_mb": max(m.peak_mb for m in done.values()),
        "findings": [{"level": one.level, "about": one.about, "text": one.text} for one in findings(done, failed)],
        "failed": {name: {"cause": error.cause, "remedy": error.remedy} for name, error in (failed or {}).items()},
        "geometry": geometry,
        "texture": texture | facts.get("score", {}),
        "world": facts["export"],
        "steps": {
            task: {"seconds": m.seconds, "peak_mb": m.peak_mb, "metrics": m.metrics, "warnings": m.warnings}
            for task, m in done.items()
        },
    }


def representative(entries: Sequence[Picture], scores: Mapping[str, Mapping[str, float]]) -> list[Picture]:
    """The worst, the median and the best error image by `psnr_gain_db`, which `scores` has by title."""
    ordered = sorted(entries, key=lambda entry: scores[entry["title"]]["psnr_gain_db"])
    if len(ordered) < 3:
        return ordered
    chosen = {"worst": ordered[0], "median": ordered[len(ordered) // 2], "best": ordered[-1]}
    return [entry | {"caption": f"({rank} of {len(ordered)}) {entry['caption']}"} for rank, entry in chosen.items()]


def _with_pixels(entry: Picture, folder: Path) -> Picture:
    """The image with its data URIs: `src`, and `other_src` if there is another image to compare with."""
    other = {"other_src": _embedded(folder / entry["other"])} if "other" in entry else {}
    return entry | {"src": _embedded(folder / entry["file"])} | other


def _render(
    body: Mapping[str, Any], pictures: Sequence[Picture], view: Mapping[str, Any] | None, opened: Mapping[str, str]
) -> str:
    from jinja2 import Environment, FileSystemLoader
    from markupsafe import Markup

    environment = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True)
    return environment.get_template(TEMPLATE).render(
        body=body,
        pictures=pictures,
        groups=SURFACES,
        gazebo=opened,
        view=view and {**view, "folder": SCRIPTS, "about": {name: view[name] for name in ("start", "walk", "turn")}},
        script=Markup((PAGES / "walk.js").read_text(encoding="utf-8")),
    )


def _embedded(path: Path) -> str:
    """The image as a data URI, so that the page is a single file."""
    kind = mimetypes.guess_type(path.name)[0]
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def write_atomically(path: Path, text: str) -> None:
    """Write a text file atomically."""
    fresh = path.with_name(f".{path.name}")
    fresh.write_text(text, encoding="utf-8")
    fresh.replace(path)

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
from scan2sim.flows.reports.findings import Finding, findings
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.errors import ScanError
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.io import trajectory_check
from scan2sim.pipeline.io.geodata import crs
from scan2sim.pipeline.pose_check.check import read_check

TEMPLATE = "tile.html.j2"
PAGE, DATA = "report.html", "report.json"
PAGES = Path(__file__).parent / "pages"
SCRIPTS = "report_files"
"""Folder next to the page with the scripts and data of its 3D view."""
AREAS = ("area_m2", "seen_m2", "coloured_m2", "filled_m2")
ALBUMS = (
    ("pictures", "pictures", "", ""),
    ("score", "frames", "", ""),
    ("score", "splat_frames", "", ""),
    ("score", "error", "photos", "psnr_gain_db"),
    ("lidar_score", "images", "sweeps", "f_score"),
)
"""Steps with images: step, output, and, if only the worst, median and best image is shown, the metric with the figures
of each image, and the figure by which they are ordered."""
WHOLE_FRAMES = ("frames", "splat_frames")
FRAMES_MAX = 24
"""Whole frames that the page shows, evenly over the held-out photos; all are in the results of the step `score`."""
REMOVED_MAX = 40
"""Removed objects that the page lists; report.json has all."""
NO_SWEEPS = "the tile has no trajectory of a scanner, so it isn't known along which rays its points were measured"
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
    for task, name, scores, key in ALBUMS:
        if task in done and name in done[task].files:
            folder = store.folder(task, keys[task]) / done[task].files[name]
            entries = json.loads((folder / "index.json").read_text(encoding="utf-8"))
            shown = representative(entries, done[task].metrics[scores], key) if scores else entries
            shown = evenly(shown, FRAMES_MAX) if name in WHOLE_FRAMES else shown
            pictures += [_with_pixels(entry, folder) for entry in shown]
    page = out / PAGE
    view = done["preview"].metrics if "preview" in done and done["preview"].files else None
    write_atomically(page, _render(body, pictures, view, gazebo.commands(out / "world" / f"{tile.name}.sdf")))
    return page


def failed_before(out: Path) -> set[str]:
    """Names of the failed side products according to the report in `out`; the report itself if it is damaged."""
    try:
        return set(json.loads((out / DATA).read_text(encoding="utf-8"))["failed"])
    except (ValueError, KeyError, TypeError):
        return {"report"}


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
    problems = findings(done, failed)
    check = trajectory_check.read(tile.path.parent)
    if check is not None:
        problems += [Finding("note", "trajectory", str(text)) for text in check.get("warnings", [])]
    photo_check = read_check(tile.path.parent)
    if photo_check is not None:
        problems += [Finding("note", "photos", str(text)) for text in photo_check.get("warnings", [])]
    return {
        "tile": tile.name,
        "crs": crs.name(tile.frame.crs),
        "origin": list(tile.frame.origin),
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "versions": versions(),
        "seconds": round(sum(m.seconds for m in done.values()), 2),
        "peak_mb": max(m.peak_mb for m in done.values()),
        "findings": [{"level": one.level, "about": one.about, "text": one.text} for one in problems],
        "trajectory_check": check,
        "photo_check": photo_check,
        "failed": {name: {"cause": error.cause, "remedy": error.remedy} for name, error in (failed or {}).items()},
        "geometry": geometry,
        "texture": texture | facts.get("score", {}),
        "lidar": _lidar(facts),
        "removed": _removed(facts),
        "world": facts["export"],
        "steps": {
            task: {"seconds": m.seconds, "peak_mb": m.peak_mb, "metrics": m.metrics, "warnings": m.warnings}
            for task, m in done.items()
        },
    }


def _removed(facts: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """What step `instances` found and the world leaves out; parked vehicles aren't, if they are kept."""
    kept = "vehicle" in facts.get("split", {}).get("points", {})
    found = facts.get("instances", {}).get("removed", [])
    return [one for one in found if one["moved"] or one["kind"] == "person" or not kept]


def _lidar(facts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Score by sweeps: metrics of `lidar_score`; `held_out`, a number of sweeps; and `no_return_m2` of `reflectance`.

    Or `reason`, why there is none.
    """
    scored, found = facts.get("lidar_score"), facts.get("sweeps")
    if found is None or scored is None:
        return {"reason": NO_SWEEPS if found is None else "the step lidar_score failed"}
    if not scored["rays"]:
        return {"reason": found["reason"] or "no return of its sweeps lies within the tile and 80 m of the scanner"}
    unreturned: dict[str, float] | None = facts.get("reflectance", {}).get("no_return_m2")
    known = {} if unreturned is None else {"no_return_m2": round(sum(unreturned.values()), 2)}
    return {"held_out": found["held_out"], **scored, **known}


def representative(
    entries: Sequence[Picture], scores: Mapping[str, Mapping[str, float | None]], key: str = "psnr_gain_db"
) -> list[Picture]:
    """The worst, the median and the best image by `key`, which `scores` has by title."""
    ordered = sorted(entries, key=lambda entry: scores[entry["title"]][key] or 0.0)
    if len(ordered) < 3:
        return ordered
    chosen = {"worst": ordered[0], "median": ordered[len(ordered) // 2], "best": ordered[-1]}
    return [entry | {"caption": f"({rank} of {len(ordered)}) {entry['caption']}"} for rank, entry in chosen.items()]


def evenly(entries: Sequence[Picture], count: int) -> list[Picture]:
    """At most `count` of the entries, evenly over all of them."""
    return list(entries[:: -(-len(entries) // count)]) if entries else []


def _with_pixels(entry: Picture, folder: Path) -> Picture:
    """The image with its data URIs: `src`, and `other_src` if there is another image to compare with."""
    other = {"other_src": _embedded(folder / entry["other"])} if "other" in entry else {}
    return entry | {"src": _embedded(folder / entry["file"])} | other


def _render(
    body: Mapping[str, Any], pictures: Sequence[Picture], view: Mapping[str, Any] | None, opened: Mapping[str, str]
) -> str:
    from jinja2 import Environment, FileSystemLoader
    from markupsafe import Markup

    sky = body["steps"].get("sky_colour", {}).get("metrics", {}).get("rgb")
    environment = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True)
    return environment.get_template(TEMPLATE).render(
        body=body,
        pictures=pictures,
        groups=SURFACES,
        removed_max=REMOVED_MAX,
        gazebo=opened,
        view=view
        and {
            **view,
            "folder": SCRIPTS,
            "about": {name: view[name] for name in ("start", "walk", "turn", "splats")} | {"sky": sky},
        },
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

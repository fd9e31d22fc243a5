"""Report of a survey: metrics as `survey.json`, a web page with a map of all tiles as `survey.html`."""

from __future__ import annotations

import base64
import functools
import itertools
import json
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from scan2sim.flows.engine.versions import versions
from scan2sim.flows.reports import gazebo
from scan2sim.flows.reports.tile import write_atomically
from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.errors import ScanError, from_os_error
from scan2sim.pipeline.core.types import F64

State = Literal["done", "cached", "failed", "waiting"]
STATES: tuple[State, ...] = ("failed", "waiting", "done", "cached")
TEMPLATE = "survey.html.j2"
PAGE, DATA = "survey.html", "survey.json"
MAP_WIDTH_PX, MAP_HEIGHT_PX, MAP_MARGIN_PX = 1100.0, 600.0, 24.0
"""Maximum size of the map, and the margin around it."""
MAX_LABELLED_TILES = 60
"""Number of tiles up to which the map shows their names."""
MIN_TILE_PX = 10.0
"""Size on the map below which tiles are drawn larger than they are, to be visible."""
THUMBNAIL_WIDTH_PX = 96
"""Width of a tile's thumbnail; about three kilobytes per tile."""
MAX_SHOWN = 40
"""Number of borders and warnings on the page; survey.json has all."""
COLOUR_SCALES = {  # colours from low to high; distinguishable with colour blindness, on light and dark backgrounds
    "quality": ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725"),
    "cost": ("#cfe3ef", "#8fb9d9", "#5287bd", "#3d5a9b", "#33276b"),
}


@dataclass(frozen=True)
class TileState:
    """State and metrics of a tile of a survey.

    Attributes:
        name: unique in the survey.
        outline: (K, 2) outline of its cell in world metres; empty if unknown.
        state: "done" in this run, "cached" (up to date before), "failed", or "waiting".
        reason: why it failed.
        figures: known ones of `points`, `photos`, `coverage` (share of the surface seen by a photo), `psnr_db` (None
            without held-out photos), `cloud_to_mesh_m` (mean, by class), `triangles`, `bytes` of its world,
            `bytes_written` in total, `seconds` of computing time, `peak_mb`.
        report: path of its page, relative to that of the survey, or None.
        thumbnail: path of an image, or None.
        warnings: of its steps.
        borders: known metrics of the border with each `neighbour`: `gap_m`, `colour_step` (grey levels) and
            `one_sided_m` (metres of border where only one of the tiles has a surface).
    """

    name: str
    outline: F64
    state: State
    reason: str | None = None
    figures: Mapping[str, Any] = field(default_factory=dict)
    report: str | None = None
    thumbnail: Path | None = None
    warnings: Sequence[str] = ()
    borders: Sequence[Mapping[str, Any]] = ()


def write_survey_report(
    out: Path,
    name: str,
    tiles: Sequence[TileState],
    *,
    path: npt.ArrayLike | None = None,
    failed: Mapping[str, ScanError] | None = None,
) -> Path:
    """Write both reports into `out`, each atomically; returns the path of the page.

    Args:
        out: output folder of the survey.
        name: of the survey.
        tiles: all tiles, in the order of the list.
        path: (N, 2) or (N, 3) positions along the drive in world metres, or None.
        failed: errors of side products of the whole survey by name.

    Raises:
        SpaceError: the disk is full or not writable.
    """
    drive = np.zeros((0, 2)) if path is None else np.asarray(path, np.float64)[:, :2]
    try:
        out.mkdir(parents=True, exist_ok=True)
        body = summary(name, tiles, drive, failed)
        write_atomically(out / DATA, json.dumps(body, indent=1))
        world = out / "world" / f"{name}.sdf"
        write_atomically(out / PAGE, _render(body, tiles, drive, gazebo.commands(world)))
    except OSError as error:
        raise from_os_error(error, out) from None
    return out / PAGE


def summary(
    name: str, tiles: Sequence[TileState], path: F64, failed: Mapping[str, ScanError] | None = None
) -> dict[str, Any]:
    """All metrics as a JSON document; docs/reference/formats.md describes the keys."""
    return {
        "survey": name,
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "versions": versions(),
        "totals": _totals(tiles, path),
        "tiles": {
            tile.name: {
                "state": tile.state,
                "reason": tile.reason,
                "report": tile.report,
                "outline_m": np.round(tile.outline, 2).tolist(),
                "figures": dict(tile.figures),
                "warnings": list(tile.warnings),
            }
            for tile in tiles
        },
        "borders": _borders(tiles),
        "failed": {name: {"cause": error.cause, "remedy": error.remedy} for name, error in (failed or {}).items()},
    }


def overview(out: Path) -> str:
    """Summary of a survey as Markdown, from its `survey.json`."""
    body = _read(out)
    if body is None:
        return "No tile is finished yet."
    totals = body["totals"]
    lines = [f"**{body['survey']}**: " + ", ".join(f"{totals[state]} {state}" for state in STATES)]
    lines += [f"- {name}: {tile['reason']}" for name, tile in body["tiles"].items() if tile["state"] == "failed"]
    lines += [f"- {name}: failed; the world is made without it: {one['cause']}" for name, one in body["failed"].items()]
    return "\n".join(lines)


def rows(out: Path) -> list[dict[str, Any]]:
    """Table with the name, state and metrics of each tile, from the survey's `survey.json`."""
    body = _read(out)
    if body is None:
        return []
    plain = [(name, tile["state"], tile["figures"]) for name, tile in body["tiles"].items()]
    return [
        {"tile": name, "state": state} | {k: v for k, v in figures.items() if not isinstance(v, dict)}
        for name, state, figures in plain
    ]


def _read(out: Path) -> dict[str, Any] | None:
    try:
        return dict(json.loads((out / DATA).read_text(encoding="utf-8")))
    except OSError:
        return None


def _totals(tiles: Sequence[TileState], path: F64) -> dict[str, Any]:
    def known(key: str) -> list[float]:
        return [value for tile in tiles if (value := tile.figures.get(key)) is not None]

    def mean(key: str) -> float | None:
        return float(np.mean(known(key))) if known(key) else None

    states = Counter(tile.state for tile in tiles)
    return (
        {"tiles": len(tiles)}
        | {state: states[state] for state in STATES}
        | {key: sum(known(key)) for key in ("points", "photos", "triangles", "bytes", "bytes_written", "seconds")}
        | {"peak_mb": max(known("peak_mb"), default=0.0)}
        | {key: mean(key) for key in ("coverage", "psnr_db")}
        | {
            "area_m2": round(sum(_area(tile.outline) for tile in tiles), 1),
            "length_m": round(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()), 1) if len(path) else None,
            "warnings": sum(len(tile.warnings) for tile in tiles),
        }
    )


def _area(outline: F64) -> float:
    if len(outline) < 3:
        return 0.0
    x, y = (outline - outline[0]).T
    return abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))) / 2


def _borders(tiles: Sequence[TileState]) -> list[dict[str, Any]]:
    """Each border once, worst first; if both of its tiles have metrics, the worse of each."""
    found: dict[tuple[str, ...], dict[str, Any]] = {}
    for tile in tiles:
        for border in tile.borders:
            pair = tuple(sorted((tile.name, border["neighbour"])))
            worst = found.setdefault(pair, {"tiles": list(pair)})
            for key, value in border.items():
                if key != "neighbour" and value is not None:
                    worst[key] = max(worst.get(key, value), value)
    return sorted(found.values(), key=lambda b: (b.get("gap_m", 0), b.get("colour_step", 0)), reverse=True)


# --- the page ---


def _render(body: Mapping[str, Any], tiles: Sequence[TileState], path: F64, opened: Mapping[str, str]) -> str:
    from jinja2 import Environment, FileSystemLoader

    environment = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True)
    ordered = sorted(tiles, key=lambda tile: STATES.index(tile.state) if tile.state in STATES[:2] else len(STATES))
    warnings = Counter(text for tile in tiles for text in set(tile.warnings))
    return environment.get_template(TEMPLATE).render(
        body=body,
        tiles=ordered,
        map=_map(tiles, path),
        warnings=sorted(warnings.items(), key=lambda item: (-item[1], item[0])),
        thumbnails={tile.name: _thumbnail(tile.thumbnail) for tile in tiles if tile.thumbnail},
        groups=SURFACES,
        gazebo=opened,
        shown=MAX_SHOWN,
    )


def _map(tiles: Sequence[TileState], path: F64) -> dict[str, Any] | None:
    """Data of the map: polygons with their colours, the path, a scale bar; None if no tile has an outline."""
    drawn = sorted((t for t in tiles if len(t.outline) >= 3), key=lambda t: -STATES.index(t.state))  # failed on top
    if not drawn:
        return None
    positions = np.concatenate([tile.outline for tile in drawn] + [path])
    low, high = positions.min(axis=0), positions.max(axis=0)
    scale = float(min((MAP_WIDTH_PX, MAP_HEIGHT_PX) / np.maximum(high - low, 1e-9)))  # pixels per metre
    quality = "psnr_db" if any(tile.figures.get("psnr_db") is not None for tile in drawn) else "coverage"
    colours, legends = {}, {}
    for attribute, key in (("quality", quality), ("cost", "seconds")):
        colours[attribute], legends[attribute] = _colours(attribute, [tile.figures.get(key) for tile in drawn])

    def pixels(xy: F64) -> F64:
        return np.column_stack([xy[:, 0] - low[0], high[1] - xy[:, 1]]) * scale + MAP_MARGIN_PX

    prefix = _prefix([tile.name for tile in drawn])
    width, height = ((high - low) * scale + 2 * MAP_MARGIN_PX).tolist()
    return {
        "width": round(width, 1),
        "height": round(height + 20, 1),  # space for the scale bar
        "tiny": float(np.median([np.ptp(tile.outline, axis=0).max() for tile in drawn])) * scale < MIN_TILE_PX,
        "quality": quality,
        "legends": legends,
        "tiles": [
            {
                "tile": tile,
                "points": _points(pixels(tile.outline)),
                "middle": pixels(tile.outline).mean(axis=0).round(1).tolist(),
                "label": tile.name[len(prefix) :] if len(drawn) <= MAX_LABELLED_TILES else None,
                "quality": colours["quality"][i],
                "cost": colours["cost"][i],
            }
            for i, tile in enumerate(drawn)
        ],
        "path": _points(_thinned(pixels(path))) if len(path) else None,
        "bar": _bar(scale),
    }


def _colours(
    attribute: str, values: Sequence[float | None]
) -> tuple[list[str | None], tuple[float, float, str] | None]:
    """The colour of each value, and the legend: lowest value, highest value, colours of the gradient in CSS."""
    known = [value for value in values if value is not None]
    if not known:
        return [None] * len(values), None
    low, high = min(known), max(known)
    stops = np.array([[int(stop[i : i + 2], 16) for i in (1, 3, 5)] for stop in COLOUR_SCALES[attribute]], float)
    at = np.linspace(0, 1, len(stops))

    def colour(value: float | None) -> str | None:
        if value is None:
            return None
        share = (value - low) / (high - low) if high > low else 1.0
        return "#" + "".join(f"{round(float(np.interp(share, at, stops[:, c]))):02x}" for c in range(3))

    return [colour(value) for value in values], (low, high, ", ".join(COLOUR_SCALES[attribute]))


def _points(xy: F64) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in xy)


def _thinned(xy: F64) -> F64:
    """Points at least a pixel apart along the line: a drive has up to a million."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    _, first = np.unique(np.floor(along), return_index=True)
    return xy[first]


def _prefix(names: Sequence[str]) -> str:
    """Common prefix of all names, which labels on the map omit; leaves at least one character of each name."""
    equal = itertools.takewhile(lambda pair: pair[0] == pair[1], zip(min(names), max(names), strict=False))
    return min(names)[: min(len(list(equal)), min(map(len, names)) - 1)]


def _bar(scale: float) -> dict[str, Any]:
    """A scale bar of a round length, at most a sixth of the map's width."""
    longest = MAP_WIDTH_PX / 6 / scale
    power = 10.0 ** np.floor(np.log10(longest))
    metres = next(float(f * power) for f in (5, 2, 1) if f * power <= longest)
    return {"pixels": round(metres * scale, 1), "text": f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"}


def _thumbnail(path: Path) -> str | None:
    """A thumbnail of an image as a data URI; None if it can't be read."""
    try:
        return _small(path, path.stat().st_mtime_ns)
    except OSError:
        return None


@functools.lru_cache(maxsize=4096)  # the page is written after every tile
def _small(path: Path, changed: int) -> str | None:
    import cv2

    picture = cv2.imread(str(path), cv2.IMREAD_REDUCED_COLOR_4)
    if picture is None:
        return None
    height = max(1, round(picture.shape[0] * THUMBNAIL_WIDTH_PX / picture.shape[1]))
    small = cv2.resize(picture, (THUMBNAIL_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"

"""Extracted roads compared with the truth of synthetic streets.

`python -m bench.roads [--seeds 0 1] [--length 60 --points 3e6 --photos 24] [--tile 30] [--out bench-out/roads]
[--pictures]` builds each street's world with `scan2sim run`, including photos, and reads its GeoJSON and OpenDRIVE.

- `road_centre_p95_m`: distance from points on the reference line to the street's axis, where the centre line is
  painted; `road_width_p95_m`: error of the width between the edges at each of these points.
- `lane_edge_p95_m`: distance from points on markings and edges to the nearest true one.
- `height_p95_m`: height error of all these points relative to the true ground.
- `extracted`: share of the length of the street's lines (three markings, two kerbs) that was extracted.
- `carla_lane_p95_m`, `carla_off_lane`: waypoints of `carla.Map` for the OpenDRIVE, a metre apart: distance from the
  centres of the true lanes, and share that is nearer to another lane; null without the package `carla`.
- with `--tile METRES` each street is cut into tiles of this length and built as a survey, with the same metrics.

`--pictures` draws the roads into an orthophoto, `roads.png` beside each world. Ends with `RESULT {json}`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from bench.paths import ROOT
from scan2sim.data_samples.layout import FRAME, Layout, lay_out
from scan2sim.pipeline.camera.renderer import Renderer, textured
from scan2sim.pipeline.core.types import F64, Bools

LINE_INSET_M = 0.21
"""Distance from the carriageway's edge to the centre of its line (`data_samples/materials.py`)."""
PIXEL_M = 0.04
COLOURS = {"reference": (255, 0, 255), "edge": (255, 0, 0), "solid": (0, 160, 255), "broken": (0, 255, 0)}


def main() -> None:
    """Evaluate the streets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--length", type=float, default=60.0)
    parser.add_argument("--points", type=float, default=3e6)
    parser.add_argument("--photos", type=int, default=24)
    parser.add_argument("--tile", type=float)
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "roads")
    parser.add_argument("--pictures", action="store_true")
    arguments = parser.parse_args()
    found: dict[str, list[F64]] = {}
    scan2sim = str(Path(sys.executable).parent / "scan2sim")
    for seed in arguments.seeds:
        street = arguments.out / f"street_{arguments.length:g}_{arguments.points:g}_{arguments.photos}_{seed}"
        if not (street / "tile.toml").is_file():
            sizes = [f"--{k}={getattr(arguments, k):g}" for k in ("length", "points", "photos")]
            subprocess.run([scan2sim, "sample", *sizes, f"--seed={seed}", str(street)], check=True)
        run = street.with_name(f"{street.name}_run" if arguments.tile is None else f"{street.name}_survey")
        made = [scan2sim, "run", str(street), "--out", str(run)]
        if arguments.tile is not None:
            cut = street.with_name(f"{street.name}_cut")
            command = [scan2sim, "tile", str(street), "--out", str(cut), f"--length={arguments.tile}"]
            subprocess.run([*command, "--overwrite"], check=True, stdout=subprocess.DEVNULL)
            made = [scan2sim, "survey", str(cut), "--out", str(run)]
        subprocess.run(made, check=True, stdout=subprocess.DEVNULL)
        errors = line_errors(run / "world", lay_out(arguments.length, seed))
        print(f"seed {seed}: " + json.dumps(summary(errors)), flush=True)
        for name, values in errors.items():
            found.setdefault(name, []).append(values)
        if arguments.pictures and arguments.tile is None:
            draw(run)
    print("RESULT " + json.dumps(summary({name: np.concatenate(values) for name, values in found.items()})))


def line_errors(world: Path, layout: Layout) -> dict[str, F64]:
    """Errors in metres of all points on lines, by the names of the module's docstring."""
    features = json.loads(next(world.glob("*roads.geojson")).read_text(encoding="utf-8"))["features"]
    kinds = [f["properties"]["kind"] for f in features]
    lines = [layout_coordinates(layout, f["geometry"]["coordinates"]) for f in features]
    painted = np.array([layout.lane - LINE_INSET_M, 0.0, LINE_INSET_M - layout.lane])
    kerbs = np.array([layout.kerb(1), -layout.kerb(-1)])
    s = np.arange(0.5, layout.axis.length, 1.0)
    found: dict[str, list[F64]] = {"centre": [], "lane_edge": [], "height": []}
    extracted: dict[float, Bools] = {t: np.zeros(len(s), bool) for t in (*painted, *kerbs)}
    for kind, line in zip(kinds, lines, strict=True):
        found["height"].append(np.abs(line[:, 2]))
        if kind == "reference":
            found["centre"].append(np.abs(line[:, 1]))
            continue
        true = painted if kind == "marking" else kerbs
        away = np.abs(line[:, 1:2] - true)
        found["lane_edge"].append(away.min(axis=1))
        extracted[true[int(np.median(away.argmin(axis=1)))]] |= (s >= line[:, 0].min()) & (s <= line[:, 0].max())
    errors = {name: np.concatenate([np.zeros(0), *values]) for name, values in found.items()}
    sides = [f["properties"].get("side") for f in features]
    left, right = (
        _across(np.concatenate([line for line, own in zip(lines, sides, strict=True) if own == side]), s)
        for side in ("left", "right")
    )
    width = np.abs(np.abs(left - right) - (layout.kerb(1) + layout.kerb(-1)))
    errors["width"] = width[np.isfinite(width)]
    errors["extracted"] = np.concatenate(list(extracted.values())).astype(float)
    return errors | carla_errors(next(world.glob("*.xodr")), layout)


def _across(line: F64, s: F64) -> F64:
    """(N,) offsets of a line (M, 3) at chainages; NaN outside of it."""
    line = line[np.argsort(line[:, 0])]
    return np.interp(s, line[:, 0], line[:, 1], left=np.nan, right=np.nan)


def layout_coordinates(layout: Layout, positions: Any) -> F64:
    """(N, 3) chainage, offset and height above the true ground of points (N, 3) in the CRS."""
    xyz = FRAME.to_local(np.asarray(positions, np.float64))
    s, t = layout.axis.locate(xyz[:, :2])
    on = np.sign(t) * np.minimum(np.abs(t), np.where(t > 0, layout.kerb(1), layout.kerb(-1)) - 1e-3)
    return np.column_stack([s, t, xyz[:, 2] - layout.height(s, on)])


def carla_errors(xodr: Path, layout: Layout) -> dict[str, F64]:
    """Errors of `carla.Map`'s waypoints of driving lanes; empty without the package."""
    try:
        import carla
    except ImportError:
        return {}
    import xml.etree.ElementTree as ET

    text = xodr.read_text(encoding="utf-8")
    offset = ET.fromstring(text).find("header/offset")
    assert offset is not None
    origin = np.array([float(offset.attrib[k]) for k in "xyz"])
    points = carla.Map("road", text).generate_waypoints(1.0)
    positions = np.array([(p.transform.location.x, -p.transform.location.y, p.transform.location.z) for p in points])
    coordinates = layout_coordinates(layout, positions + origin)
    middles = np.array([1, -1]) * (layout.lane - LINE_INSET_M) / 2
    away = np.abs(coordinates[:, 1:2] - middles)
    side = away.argmin(axis=1) == [int(p.lane_id > 0) for p in points]  # all alike, whatever the line's direction
    return {
        "carla_lane": away.min(axis=1),
        "carla_off_lane": np.minimum(side.mean(), 1 - side.mean()) * np.ones(len(side)),
    }


def summary(errors: dict[str, F64]) -> dict[str, float | None]:
    """Metrics of the module's docstring."""
    names = {"centre": "road_centre", "width": "road_width", "lane_edge": "lane_edge", "height": "height"}
    names |= {"carla_lane": "carla_lane"}
    found: dict[str, float | None] = {
        f"{to}_p95_m": round(float(np.percentile(errors[name], 95)), 3) if len(errors.get(name, ())) else None
        for name, to in names.items()
    }
    found["extracted"] = round(float(errors["extracted"].mean()), 3)
    found["carla_off_lane"] = float(errors["carla_off_lane"].sum()) if "carla_off_lane" in errors else None
    return found


def draw(run: Path) -> None:
    """Draw the extracted roads into an orthophoto of the ground: `roads.png`."""
    import cv2

    folder = max((run / "steps" / "texture.terrain").glob("*/textured"), key=lambda path: path.stat().st_mtime)
    body = textured(folder)
    low, high = body.mesh.vertices.min(axis=0).astype(float), body.mesh.vertices.max(axis=0).astype(float)
    orthophoto = Renderer([body]).above(low, high, width=int((high[0] - low[0]) / PIXEL_M)).rgb.copy()
    for feature in json.loads((run / "world" / "roads.geojson").read_text(encoding="utf-8"))["features"]:
        about = feature["properties"]
        line = body.mesh.frame.to_local(feature["geometry"]["coordinates"])[:, :2] - low[:2]
        pixels = np.column_stack([line[:, 0], high[1] - low[1] - line[:, 1]]) / PIXEL_M
        colour = COLOURS[about.get("marking") or about["kind"]]
        cv2.polylines(orthophoto, [np.rint(pixels).astype(np.int32)], False, colour, 2, cv2.LINE_AA)
    cv2.imwrite(str(run / "roads.png"), orthophoto[..., ::-1])


if __name__ == "__main__":
    main()

"""Lists of street furniture: CSV and GeoJSON files, and their columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from scan2sim.pipeline.furniture.sign_panels import SignPanel

CSV_COLUMNS = ("x", "y", "z", "kind", "height_m", "radius_m", "heading_deg", "shape", "panel_width_m", "panel_height_m")


def write_lists(out: Path, crs: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Path]:
    """Write `furniture.csv` and `furniture.geojson`; `x`, `y` and `z` of each row are in the CRS."""
    from scan2sim.pipeline.io.geodata import geojson

    files = {"csv": out / "furniture.csv", "geojson": out / "furniture.geojson"}
    text = "\n".join([",".join(CSV_COLUMNS), *(",".join(str(row.get(c, "")) for c in CSV_COLUMNS) for row in rows)])
    files["csv"].write_text(text + "\n", encoding="utf-8")
    features = [((r["x"], r["y"], r["z"]), {k: v for k, v in r.items() if k not in "xyz"}) for r in rows]
    geojson.write_points(files["geojson"], crs, features)
    return files


def sign_panel_columns(panel: SignPanel) -> dict[str, Any]:
    """Columns of a sign panel in the CSV and GeoJSON lists."""
    heading = float(np.degrees(np.arctan2(panel.normal[0], panel.normal[1]))) % 360
    size = {"panel_width_m": round(panel.width, 2), "panel_height_m": round(panel.height, 2)}
    return {"heading_deg": round(heading, 1), "shape": panel.shape, **size}

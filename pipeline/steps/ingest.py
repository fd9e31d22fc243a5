"""Ingest: reads and joins the tile's clouds, in local coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core import classes
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.parameters import Coordinate
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Frame, PointCloud
from scan2sim.pipeline.io import label_sets
from scan2sim.pipeline.io.tile import MIN_POINTS

MAX_EXTENT_M = 5000.0
"""Maximum extent of a tile: float32 still resolves half a millimetre there, and surfaces fit into memory."""


class TileFrame(Context):
    """Frame of the tile, and mapping of its class codes."""

    crs: str = "local"
    origin: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    unit: float = Field(1.0, ge=1e-6, le=1000)
    classes: dict[int, int] = Field(default_factory=dict)


class IngestParams(Params):
    """No settings."""

    context: TileFrame = TileFrame()


def ingest(inputs: Inputs, params: IngestParams, out: Path, report: Report) -> Done:
    """Read all clouds (`inputs` in order of name), remove points with non-finite coordinates, and join them.

    The result has the colours, classes and intensities that any of the clouds has: grey, "unclassified" and 0 where
    they are missing. Times are dropped unless all clouds have them.

    Raises:
        DataError: fewer than 1000 points in total, or an extent above 5 km.
    """
    from scan2sim.pipeline.io import clouds
    from scan2sim.pipeline.io.geodata import area_of_use, crs

    frame = Frame(params.context.crs, params.context.origin, params.context.unit)
    parts: list[PointCloud] = []
    warnings = []
    for i, name in enumerate(sorted(inputs)):
        report(i / len(inputs), f"reading {inputs[name].name}")
        header = clouds.read_header(inputs[name])
        cloud = clouds.read(inputs[name], frame)
        notes = (*header.notes, clouds.left_out(header.count, len(cloud)), crs.contradiction(header.crs, frame.crs))
        warnings += [f"{inputs[name].name}: {note}" for note in notes if note]
        if cloud.classification is not None and len(cloud):
            table = clouds.code_table(inputs[name], params.context.classes)
            unmapped = label_sets.codes_warning(np.bincount(cloud.classification, minlength=256), table)
            warnings += [f"{inputs[name].name}: {unmapped}"] if unmapped else []
            cloud = replace(cloud, classification=table[cloud.classification])
        finite = np.atleast_1d(np.isfinite(cloud.xyz).all(axis=1))
        if not finite.all():
            warnings.append(f"{inputs[name].name}: {np.count_nonzero(~finite):,} points with NaN coordinates removed")
            cloud = cloud.take(finite)
        parts.append(cloud)
    warnings += _missing_attributes(parts, [path.name for _, path in sorted(inputs.items())])
    if any(part.intensity is not None for part in parts):
        parts = [
            part if part.intensity is not None else replace(part, intensity=np.zeros(len(part), np.uint16))
            for part in parts
        ]
    cloud = PointCloud.join(parts)
    if len(cloud) < MIN_POINTS:
        names = ", ".join(str(path) for path in inputs.values())
        raise DataError(names, f"only {len(cloud):,} points in all", f"A tile needs at least {MIN_POINTS:,} points")
    low, high = cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)
    if (high - low).max() > MAX_EXTENT_M:
        most = np.ptp(np.percentile(cloud.xyz, (1, 99), axis=0), axis=0).max()
        raise DataError(
            ", ".join(str(path) for path in inputs.values()),
            f"points are up to {(high - low).max() / 1000:,.1f} km apart (98 % of them within {most:,.0f} m), "
            f"the limit of a tile is {MAX_EXTENT_M / 1000:g} km",
            "Remove outliers and check the unit of the CRS, or cut the cloud into tiles with `scan2sim tile`",
        )
    wrong = area_of_use.misfit(frame.crs, frame.to_crs(low), frame.to_crs(high))
    warnings += [] if wrong is None else [str(wrong)]
    report(0.9, "writing")
    cloud.save(out / "cloud.npz")
    metrics = {
        "points": len(cloud),
        "extent_m": (high - low).round(2).tolist(),
        "coloured": cloud.rgb is not None,
        "classified": bool(cloud.classification is not None and classes.classified_codes()[cloud.classification].any()),
        "timed": cloud.time is not None,
    }
    return Done({"cloud": out / "cloud.npz"}, metrics, warnings)


def _missing_attributes(parts: Sequence[PointCloud], names: Sequence[str]) -> list[str]:
    """Warnings about attributes that only some of the clouds have."""
    effects = {
        "rgb": ("colours", "its points are grey until photos or neighbours colour them"),
        "classification": ("classes", "its points are unclassified"),
        "intensity": ("intensities", "they are taken as 0"),
        "time": ("times", "the times of the other clouds are not used"),
    }
    found = []
    for attribute, (what, effect) in effects.items():
        missing = [i for i, part in enumerate(parts) if getattr(part, attribute) is None]
        if 0 < len(missing) < len(parts):
            found += [f"{names[i]}: no {what}, unlike others ({len(parts[i]):,} points): {effect}" for i in missing]
    return found


INGEST = Step("ingest", 4, ingest, IngestParams, memory=(0.4, 12))

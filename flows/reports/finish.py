"""Final products of a survey: reports of the tiles, the common world, a STAC catalogue, the survey report."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.flows.engine.planning import PlannedTask
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.reports.findings import findings
from scan2sim.flows.reports.publish import publish, published, to_read
from scan2sim.flows.reports.side_products import SideProducts
from scan2sim.flows.reports.survey import DATA as SURVEY_DATA
from scan2sim.flows.reports.survey import PAGE as SURVEY_PAGE
from scan2sim.flows.reports.survey import TileState, write_survey_report
from scan2sim.flows.reports.tile import DATA, PAGE, failed_before, figures, write_report
from scan2sim.pipeline.core.cache import Digests, Manifest, Store
from scan2sim.pipeline.core.errors import ScanError
from scan2sim.pipeline.core.types import Tile
from scan2sim.pipeline.core.voronoi_cell import outline
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.geodata import geotiff, stac
from scan2sim.pipeline.io.survey import Survey
from scan2sim.pipeline.io.worlds import merge
from scan2sim.texturing.backdrop import dome

TILES, PICTURE = "tiles", "picture.jpg"
Warn = Callable[[str], None]


@dataclass(frozen=True)
class TileResult:
    """A tile of a survey after a run.

    Attributes:
        tile: None if it can't be read.
        planned, done: its tasks, and results by name within the tile.
        changed: whether any result differs from the one before.
        error: why it failed, or None.
    """

    name: str
    tile: Tile | None
    planned: Sequence[PlannedTask] = ()
    done: Mapping[str, Manifest] | None = None
    changed: bool = False
    error: ScanError | None = None

    @property
    def up_to_date(self) -> bool:
        """Whether nothing that the tile depends on has changed."""
        return all(item.reason is None for item in self.planned)


def finish(
    survey: Survey,
    results: Sequence[TileResult],
    store: Store,
    out: Path,
    settings: Settings,
    digests: Digests,
    side: SideProducts,
    warn: Warn,
) -> Path | None:
    """Write the results of each tile and of the survey; returns the path of the survey's page, None if it failed.

    Args:
        survey: the survey.
        results: its tiles after the run.
        store: cache of their results.
        out: output folder.
        settings, digests: of the run.
        side: records failed side products: reports, roads of all tiles, the catalogue.
        warn: receives warnings about files that the user has edited.

    Raises:
        ScanError: see `pipeline.core.errors`; earlier results stay.
    """
    finished = [result for result in results if result.done is not None]
    for result in finished:
        _finish_tile(result, store.within(result.name), out / TILES / result.name, settings, side, warn)
    if finished:
        _assemble(survey, finished, out, digests, side, warn)
    with side.attempt("report", out / SURVEY_PAGE, out / SURVEY_DATA):
        return write_survey_report(
            out, survey.name, [_state(result, out, side) for result in results], failed=side.of_tile("")
        )
    return None


def _finish_tile(
    result: TileResult, store: Store, out: Path, settings: Settings, side: SideProducts, warn: Warn
) -> None:
    """Write the folder of a tile like `scan2sim run` does, and delete outdated results from the store."""
    assert result.tile is not None and result.done is not None
    planned, done = list(result.planned), dict(result.done)
    keys = {item.task.id.name: item.key for item in planned}
    out.mkdir(parents=True, exist_ok=True)
    same_failed = (out / DATA).is_file() and failed_before(out) == side.of_tile(result.name).keys()
    if not (result.up_to_date and is_finished(store, planned, out) and same_failed):
        for task in keys.keys() & to_read(store, planned, out):
            store.read(task, keys[task])
        for warning in publish(store, planned, done, out, result.tile, settings, side, f"{result.name}/"):
            warn(warning)
        seconds = sum(done[item.task.id.name].seconds for item in planned if item.reason is not None)
        (out / PICTURE).unlink(missing_ok=True)
        with side.attempt(f"{result.name}/report", out / PAGE, out / DATA):
            if "pictures" in done:
                album = store.folder("pictures", keys["pictures"]) / done["pictures"].files["pictures"]
                shutil.copyfile(album / "hero.jpg", out / PICTURE)
            write_report(result.tile, planned, done, store, out, seconds=seconds, failed=side.of_tile(result.name))
    store.sweep(keys)


def is_finished(store: Store, planned: Sequence[PlannedTask], out: Path) -> bool:
    """Whether the folder of a tile already has the reports and files of its cached results."""
    return (out / DATA).is_file() and (out / PAGE).is_file() and published(store, planned, out)


def _assemble(
    survey: Survey, done: Sequence[TileResult], out: Path, digests: Digests, side: SideProducts, warn: Warn
) -> None:
    """Write the common world of all tiles with their roads, the STAC catalogue, the virtual point cloud and rasters."""
    tiles = [merge.TileWorld(one.name, out / TILES / one.name / "world", one.tile.frame) for one in done if one.tile]
    failed = dict[str, ScanError]()
    merge.assemble(out, survey.name, tiles, dome=dome.of_survey, warn=warn, failed=failed)
    side.failed |= failed
    with side.attempt("roads"):
        merge.add_roads(out)
    with side.attempt("catalogue"):
        _catalogue(survey, done, out, digests)


def _catalogue(survey: Survey, done: Sequence[TileResult], out: Path, digests: Digests) -> None:
    """Write the STAC catalogue, the virtual point cloud and the rasters of all tiles."""
    items = []
    for one in done:
        assert one.tile is not None
        place = out / TILES / one.name
        sources = tuple(stac.Cloud(path, clouds.read_header(path), digests(path)) for path in one.tile.clouds)
        times = one.tile.trajectory.times if one.tile.trajectory is not None else None
        scanned = datetime.fromtimestamp(max(path.stat().st_mtime for path in one.tile.clouds), UTC)
        items.append(
            stac.TileItem(
                one.name, one.tile.frame, sources, scanned,
                None if times is None or not np.isfinite(times).all() else (float(times[0]), float(times[-1])),
                _existing(place / "world" / f"{one.name}.sdf"), _existing(place / "world" / f"{one.name}.glb"),
                _existing(place / PAGE), _existing(place / PICTURE), geotiff.find(place / "rasters", one.name),
            )
        )  # fmt: skip
    stac.write(out, survey.name, f"{len(items)} tiles of {survey.name}, made by scan2sim", items)
    stac.write_vpc(out / f"{survey.name}.vpc", items)
    for kind in geotiff.KINDS:
        whole = out / f"{survey.name}_{kind}.vrt"
        whole.unlink(missing_ok=True)
        if found := [item.rasters[kind] for item in items if kind in item.rasters]:
            geotiff.write_vrt(whole, found)


def _existing(path: Path) -> Path | None:
    return path if path.is_file() else None


def _state(one: TileResult, out: Path, side: SideProducts) -> TileState:
    """State of a tile for the survey's page."""
    cell = one.tile.cell if one.tile else None
    ring = np.zeros((0, 2)) if one.tile is None or cell is None else outline(cell, *_bounds(one.tile))
    done, place = one.done or {}, out / TILES / one.name
    return TileState(
        name=one.name,
        outline=ring,
        state="failed" if one.error else ("done" if one.changed else "cached"),
        reason=str(one.error) if one.error else None,
        figures=_figures(one.tile, done) if one.tile and done else {},
        report=f"{TILES}/{one.name}/{PAGE}" if done and (place / PAGE).is_file() else None,
        thumbnail=_existing(place / PICTURE),
        warnings=[f"{one.about}: {one.text}" for one in findings(done, side.of_tile(one.name))],
        borders=_borders(done),
    )


def _bounds(tile: Tile) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner (2,) of a tile's clouds, world metres."""
    headers = [clouds.read_header(path) for path in tile.clouds]
    low, high = np.min([h.low for h in headers], axis=0), np.max([h.high for h in headers], axis=0)
    return low[:2] * tile.frame.unit, high[:2] * tile.frame.unit


def _figures(tile: Tile, done: Mapping[str, Manifest]) -> dict[str, Any]:
    """Metrics of a tile for the survey report."""
    body = figures(tile, done)
    return {
        "seconds": body["seconds"],
        "peak_mb": body["peak_mb"],
        "points": done["ingest"].metrics["points"],
        "photos": len(tile.views),
        "coverage": body["texture"]["coverage"],
        "psnr_db": body["texture"].get("psnr_db"),
        "cloud_to_mesh_m": body["geometry"].get("cloud_to_mesh_mean_m", {}),
        "triangles": sum(body["world"]["triangles"].values()),
        "bytes": body["world"]["bytes"],
        "bytes_written": sum(sum(manifest.sizes.values()) for manifest in done.values()),
    }


def _borders(done: Mapping[str, Manifest]) -> list[dict[str, Any]]:
    """Metrics of a tile's borders with the neighbours that own them, over all classes."""
    found = done["borders"].metrics["neighbours"] if "borders" in done else {}
    rows = []
    for name, classes in found.items():
        values = list(classes.values())
        length = sum(v["length_m"] for v in values)
        rows.append(
            {
                "neighbour": name,
                "length_m": round(length, 2),
                "gap_m": max(v["gap_m"] for v in values),
                "gap_p99_m": round(sum(v["gap_p99_m"] * v["length_m"] for v in values) / max(length, 1e-9), 6),
                "one_sided_m": round(sum(v["one_sided_m"] for v in values), 2),
                "shared": round(sum(v["shared"] * v["length_m"] for v in values) / max(length, 1e-9), 4),
                "overlap_m": max(v["overlap_m"] for v in values),
                "colour_step": round(sum(v["colour_step"] * v["length_m"] for v in values) / max(length, 1e-9), 3),
            }
        )
    return rows

"""What is made of a survey's tiles once they are done: their pages, one world, a catalogue, one report."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.flows.engine.planning import Planned
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
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.geodata import geotiff, stac
from scan2sim.pipeline.io.survey import Survey
from scan2sim.pipeline.io.worlds import merge
from scan2sim.pipeline.tiling.voronoi_cell import outline

TILES, PICTURE = "tiles", "picture.jpg"
Warn = Callable[[str], None]


@dataclass(frozen=True)
class Made:
    """A tile of a survey after a run.

    Attributes:
        tile: None if it can't be read.
        planned, done: its nodes and results, by their names within the tile.
        anew: whether any result has come out otherwise than before.
        error: why it failed, or None.
    """

    name: str
    tile: Tile | None
    planned: Sequence[Planned] = ()
    done: Mapping[str, Manifest] | None = None
    anew: bool = False
    error: ScanError | None = None

    @property
    def kept(self) -> bool:
        """Whether nothing that it depends on has changed."""
        return all(item.reason is None for item in self.planned)


def finish(
    survey: Survey,
    made: Sequence[Made],
    store: Store,
    out: Path,
    settings: Settings,
    digests: Digests,
    side: SideProducts,
    warn: Warn,
) -> Path | None:
    """Write all that users look at below `out`; returns the survey's page, None if it failed.

    Args:
        survey: that was made.
        made: its tiles.
        store: that keeps their results.
        out: the survey's folder.
        settings, digests: of the run.
        side: records the side products that fail: reports, roads of all tiles, the catalogue.
        warn: gets warnings of files that were edited.

    Raises:
        ScanError: see `pipeline.core.errors`; what was there stays.
    """
    whole = [one for one in made if one.done is not None]
    for one in whole:
        _finish_tile(one, store.within(one.name), out / TILES / one.name, settings, side, warn)
    if whole:
        _together(survey, whole, out, digests, side, warn)
    with side.attempt("report", out / SURVEY_PAGE, out / SURVEY_DATA):
        return write_survey_report(out, survey.name, [_state(one, out, side) for one in made], failed=side.of_tile(""))
    return None


def _finish_tile(one: Made, store: Store, out: Path, settings: Settings, side: SideProducts, warn: Warn) -> None:
    """A tile's folder, as `scan2sim run` leaves it; what is no longer of use is removed from the store."""
    assert one.tile is not None and one.done is not None
    planned, done = list(one.planned), dict(one.done)
    keys = {item.node.id.name: item.key for item in planned}
    out.mkdir(parents=True, exist_ok=True)
    failed = side.of_tile(one.name)
    if not (one.kept and is_finished(store, planned, out) and failed_before(out) == failed.keys()):
        for node in keys.keys() & to_read(store, planned, out):
            store.read(node, keys[node])
        for warning in publish(store, planned, done, out, one.tile, settings):
            warn(warning)
        seconds = sum(done[item.node.id.name].seconds for item in planned if item.reason is not None)
        (out / PICTURE).unlink(missing_ok=True)
        with side.attempt(f"{one.name}/report", out / PAGE, out / DATA):
            if "pictures" in done:
                album = store.folder("pictures", keys["pictures"]) / done["pictures"].files["pictures"]
                shutil.copyfile(album / "hero.jpg", out / PICTURE)
            write_report(one.tile, planned, done, store, out, seconds=seconds, failed=failed)
    store.sweep(keys)


def is_finished(store: Store, planned: Sequence[Planned], out: Path) -> bool:
    """Whether a tile's folder shows its kept results already."""
    return (out / DATA).is_file() and (out / PAGE).is_file() and published(store, planned, out)


def _together(
    survey: Survey, done: Sequence[Made], out: Path, digests: Digests, side: SideProducts, warn: Warn
) -> None:
    """The world of all tiles, their roads, the STAC catalogue, the virtual point cloud and rasters."""
    tiles = [merge.TileWorld(one.name, out / TILES / one.name / "world", one.tile.frame) for one in done if one.tile]
    merge.assemble(out, survey.name, tiles, warn=warn)
    with side.attempt("roads"):
        merge.add_roads(out)
    with side.attempt("catalogue"):
        _catalogue(survey, done, out, digests)


def _catalogue(survey: Survey, done: Sequence[Made], out: Path, digests: Digests) -> None:
    """The STAC catalogue, the virtual point cloud and rasters of all tiles."""
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
                _there(place / "world" / f"{one.name}.sdf"), _there(place / "world" / f"{one.name}.glb"),
                _there(place / PAGE), _there(place / PICTURE), geotiff.find(place / "rasters", one.name),
            )
        )  # fmt: skip
    stac.write(out, survey.name, f"{len(items)} tiles of {survey.name}, made by scan2sim", items)
    stac.write_vpc(out / f"{survey.name}.vpc", items)
    for kind in geotiff.KINDS:
        whole = out / f"{survey.name}_{kind}.vrt"
        whole.unlink(missing_ok=True)
        if found := [item.rasters[kind] for item in items if kind in item.rasters]:
            geotiff.write_vrt(whole, found)


def _there(path: Path) -> Path | None:
    return path if path.is_file() else None


def _state(one: Made, out: Path, side: SideProducts) -> TileState:
    """What the survey's page tells of a tile."""
    cell = one.tile.cell if one.tile else None
    ring = np.zeros((0, 2)) if one.tile is None or cell is None else outline(cell, *_bounds(one.tile))
    done, place = one.done or {}, out / TILES / one.name
    return TileState(
        name=one.name,
        outline=ring,
        state="failed" if one.error else ("done" if one.anew else "kept"),
        reason=str(one.error) if one.error else None,
        figures=_figures(one.tile, done) if one.tile and done else {},
        report=f"{TILES}/{one.name}/{PAGE}" if done and (place / PAGE).is_file() else None,
        thumbnail=_there(place / PICTURE),
        warnings=[f"{one.about}: {one.text}" for one in findings(done, side.of_tile(one.name))],
        borders=_borders(done),
    )


def _bounds(tile: Tile) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner (2,) of a tile's clouds, world metres."""
    headers = [clouds.read_header(path) for path in tile.clouds]
    low, high = np.min([h.low for h in headers], axis=0), np.max([h.high for h in headers], axis=0)
    return low[:2] * tile.frame.unit, high[:2] * tile.frame.unit


def _figures(tile: Tile, done: Mapping[str, Manifest]) -> dict[str, Any]:
    """The figures of a tile that surveys are compared by."""
    body = figures(tile, done)
    return {
        "seconds": body["seconds"],
        "peak_mb": body["peak_mb"],
        "points": done["ingest"].facts["points"],
        "photos": len(tile.views),
        "coverage": body["texture"]["coverage"],
        "psnr_db": body["texture"].get("psnr_db"),
        "cloud_to_mesh_m": body["geometry"].get("cloud_to_mesh_mean_m", {}),
        "triangles": sum(body["world"]["triangles"].values()),
        "bytes": body["world"]["bytes"],
        "bytes_written": sum(sum(manifest.sizes.values()) for manifest in done.values()),
    }


def _borders(done: Mapping[str, Manifest]) -> list[dict[str, Any]]:
    """A tile's borders with the neighbours before it: over all classes, the widest gap and the mean colour step."""
    found = done["borders"].facts["neighbours"] if "borders" in done else {}
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

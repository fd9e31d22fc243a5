"""The study of compression: how resolution, bit rate and frame rate of a video change the error (D3.2, tables 4, 5).

Each cell of the tables encodes the source anew (libx264, superfast, a target bit rate), follows it, and compares the
trajectory with the truth. Cells run in processes of their own, and each leaves a file, so that a study that was ended,
however rudely, goes on where it was: `out/cells/h1024_b10_f15.json`. At the end stand `table.md`, `table.csv` and
`plot.png`. What can't be measured is N/A, with the reason.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import multiprocessing
import os
import time as clock
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.errors import InputError, ScanError, SettingError, SpaceError, from_os_error
from scan2sim.pipeline.extras import need
from scan2sim.pipeline.io.trajectory import replacing
from scan2sim.pipeline.io.video import Encoder
from scan2sim.pipeline.step import Report, silent
from scan2sim.pipeline.store import digest
from scan2sim.pipeline.types import U8, Camera, GpsTrack, Trajectory
from scan2sim.slam import solvers
from scan2sim.slam.evaluate import SEGMENT, evaluate, way
from scan2sim.slam.finish import finish
from scan2sim.slam.gps import smooth
from scan2sim.slam.mapped import Mapped
from scan2sim.slam.odometry import Odometry, OdometryParams
from scan2sim.slam.track import VERSION as TRACK_VERSION
from scan2sim.slam.track import camera_of, track
from scan2sim.slam.video import Video, _files, open_video

HEIGHTS = (512, 768, 1024, 1536)
"""Pixels, vertical resolutions of D3.2's tables 4 and 5."""
BITRATES = (1.0, 2.0, 5.0, 10.0, 20.0, 40.0)
"""Mbit/s, likewise."""
RATES = (30.0, 15.0)
"""Frames a second, likewise."""
LOST = 0.5
"""Of the way: where more was bridged than this, a cell is N/A."""
ROOM = 1.2
"""The truth must be this many times as long as a segment, or else shorter segments are taken."""
SHORTER = (200.0, 100.0, 50.0, 20.0, 10.0)
VERSION = 1
"""Of how a cell is measured; raised when it changes, so that older cells are run again."""


@dataclass(frozen=True)
class Cell:
    """A video to make and to follow: `height` in pixels, `bitrate` in Mbit/s, `rate` in frames a second."""

    height: int
    bitrate: float
    rate: float

    @property
    def name(self) -> str:
        return f"h{self.height}_b{self.bitrate:g}_f{self.rate:g}"


@dataclass(frozen=True)
class Source:
    """What all cells share.

    Attributes:
        video: the source.
        camera: of its frames.
        truth: to compare with, in the frames' times.
        gps: that ties the scale, or None.
        mask: (H, W), 0 where the car itself is seen, or None.
        params: of the odometry.
        backend: of `slam.solvers`.
        segment: metres, of the local error.
        keep: keep the cells' videos.
    """

    video: Video
    camera: Camera
    truth: Trajectory | GpsTrack
    gps: GpsTrack | None
    mask: U8 | None
    params: OdometryParams
    backend: str
    segment: float
    keep: bool


@dataclass(frozen=True)
class Result:
    """Of a cell: figures by name, and why they are N/A if they are."""

    figures: dict[str, Any] = field(default_factory=dict)
    reason: str | None = None


def study(
    source: Path,
    truth: Trajectory | GpsTrack,
    out: Path,
    *,
    params: OdometryParams,
    gps: GpsTrack | None = None,
    mask: U8 | None = None,
    heights: Sequence[int] = HEIGHTS,
    bitrates: Sequence[float] = BITRATES,
    rates: Sequence[float] = RATES,
    camera: Camera | None = None,
    backend: str = "lm",
    jobs: int = 1,
    keep: bool = False,
    report: Report = silent,
) -> Path:
    """Run the cells that no earlier run has finished; returns `out/table.md`, which holds them all.

    Args:
        source: a video, or the folder of a drive that holds `frames/` (pictures) or `video.mp4`.
        truth: z-up, in the frames' times (seconds from the first).
        out: folder.
        params: of the odometry.
        gps: in the frames' times, smoothed; its distances tie the scale. Places stay the camera's own.
        mask: (H, W), 0 where the car itself is seen.
        heights: pixels, even; widths follow.
        bitrates: Mbit/s.
        rates: frames a second.
        camera: of the source; by default a 360-degree one.
        backend: of `slam.solvers`.
        jobs: cells at a time.
        keep: keep the cells' videos beside their results.
        report: progress.

    Raises:
        UnavailableError: PyAV or matplotlib isn't installed, or what the backend needs.
        SettingError: numbers that make no sense.
        InputError: the source can't be read, or has another size than its mask.
        SpaceError: the disk is full or may not be written to.
    """
    need("slam study", "av", "matplotlib")
    solvers.named(backend)
    _check(heights, bitrates, rates, jobs)
    video = _open(source)
    if mask is not None and mask.shape != (video.height, video.width):
        size = f"{mask.shape[1]}x{mask.shape[0]}"
        raise InputError(source, f"is {video.width}x{video.height}, its mask {size}", "Give a mask of the frames' size")
    camera = camera or camera_of(video, "auto", None, None)
    shared = Source(
        video, camera, truth, gps, mask, params, backend, _segment(video, truth), keep
    )  # fmt: skip
    cells = [
        Cell(int(h), float(b), float(r)) for r, h, b in product(sorted(rates)[::-1], *map(sorted, (heights, bitrates)))
    ]
    folder = out / "cells"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for rest in folder.glob(".*.part.mp4"):
            if not _alive(rest.name.split(".")[-3]):
                rest.unlink()
    except OSError as error:
        raise from_os_error(error, folder) from error
    same = _identity(shared)
    results = {cell: found for cell in cells if (found := _kept(folder, cell, same)) is not None}
    for cell in cells:
        refused = _refused(cell, video)
        if cell not in results and refused is not None:
            results[cell] = Result(reason=refused)
    missing = [cell for cell in cells if cell not in results]
    _tables(out, shared, cells, results)
    for cell, result in _run(missing, shared, folder, same, jobs, _progress(report, len(cells), len(results))):
        results[cell] = result
        _tables(out, shared, cells, results)
    plot(out / "plot.png", shared.segment, cells, results)
    report(1.0, "done")
    return out / "table.md"


def _check(heights: Sequence[int], bitrates: Sequence[float], rates: Sequence[float], jobs: int) -> None:
    for name, values, least in (("heights", heights, 64), ("bitrates", bitrates, 0.01), ("rates", rates, 0.5)):
        odd = [value for value in values if not (math.isfinite(value) and value >= least)]
        if odd or not values:
            told = f"{odd[0]:g} is less than {least:g}" if odd else "there are none"
            raise SettingError(name, told, f"Give some of {least:g} or more")
    if any(height % 2 for height in heights):
        raise SettingError("heights", "H.264 needs even ones", "Give even heights")
    if jobs < 1:
        raise SettingError("jobs", f"{jobs} is less than 1", "Give the number of cells that run at a time")


def _open(source: Path) -> Video:
    """The video of a file, of a folder of pictures, or of a drive; pictures without loss are preferred."""
    file = source / "video.mp4"
    if source.is_dir() and file.is_file():
        video = open_video(file)
        if (source / "frames").is_dir():
            return open_video(source / "frames", fps=video.fps)
        return video
    return open_video(source)


def _segment(video: Video, truth: Trajectory | GpsTrack) -> float:
    """D3.2's 400 m, or less where the truth is too short while the video lasts."""
    times = truth.times
    if video.count:
        times = times[(times >= 0) & (times <= video.count / video.fps)]
    track_ = smooth(truth, 2.0) if isinstance(truth, GpsTrack) else truth
    places = track_.at(times)
    places = places[np.isfinite(places).all(axis=1)]
    length = float(way(places[:, :2])[-1]) if len(places) else 0.0
    return next((s for s in (SEGMENT, *SHORTER) if length >= ROOM * s), SHORTER[-1])


def _refused(cell: Cell, video: Video) -> str | None:
    """Why a cell can't be made of a video: nothing is scaled up, no frame shown twice."""
    if cell.height > video.height:
        return f"the source has only {video.height} px"
    if cell.rate > 1.02 * video.fps:
        return f"the source has only {video.fps:.4g} fps"
    return None


# --- what an earlier run has finished


def _identity(shared: Source) -> dict[str, Any]:
    """What must be the same for a result to hold, JSON-able."""

    def mark(value: Any) -> str:
        return hashlib.sha256(repr(value).encode()).hexdigest()[:16]

    return {
        "version": [VERSION, TRACK_VERSION],
        "source": digest(shared.video.path),
        "truth": mark(_plain(shared.truth)),
        "gps": mark(_plain(shared.gps)),
        "mask": mark(_plain(shared.mask)),
        "camera": asdict(shared.camera) | {"distortion": list(shared.camera.distortion)},
        "params": shared.params.model_dump(mode="json"),
        "backend": shared.backend,
        "segment_m": shared.segment,
    }


def _plain(value: Any) -> Any:
    """What reads the same whenever its numbers are the same."""
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
    if hasattr(value, "__dataclass_fields__"):
        return [_plain(getattr(value, name)) for name in value.__dataclass_fields__]
    return value


def _kept(folder: Path, cell: Cell, same: dict[str, Any]) -> Result | None:
    try:
        found = json.loads((folder / f"{cell.name}.json").read_text(encoding="utf-8"))
        return Result(found["figures"], found["reason"]) if found["of"] == same else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _alive(process: str) -> bool:
    try:
        os.kill(int(process), 0)
    except (ValueError, ProcessLookupError):
        return False
    except OSError:
        return True
    return True


# --- cells, each in a process of its own: one that is killed for want of memory takes no other with it


def _progress(report: Report, total: int, done: int) -> Callable[[int, list[str]], None]:
    def tell(more: int, running: list[str]) -> None:
        report((done + more) / total, f"{done + more} of {total} cells, at {', '.join(running) or 'the last'}")

    return tell


def _run(
    cells: Sequence[Cell],
    shared: Source,
    folder: Path,
    same: dict[str, Any],
    jobs: int,
    tell: Callable[[int, list[str]], None],
) -> Iterator[tuple[Cell, Result]]:
    context = multiprocessing.get_context("spawn")
    waiting, running, done = list(cells), dict[Any, tuple[Cell, Any]](), 0
    share = max(1, (os.cpu_count() or 1) // jobs)
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                cell = waiting.pop(0)
                process = context.Process(target=_child, args=(cell, shared, folder, same, share), daemon=True)
                process.start()
                running[process.sentinel] = cell, process
            tell(done, [cell.name for cell, _ in running.values()])
            for sentinel in wait(list(running)):
                cell, process = running.pop(sentinel)
                process.join()
                result = _kept(folder, cell, same)
                if result is None:  # nothing was written: run again next time
                    if process.exitcode == FULL:
                        raise SpaceError(folder, "can't be written to", "Free some space; finished cells are kept")
                    result = Result(reason=f"its process died (exit status {process.exitcode}), perhaps out of memory")
                done += 1
                yield cell, result
    finally:
        for _, process in running.values():
            process.kill()
            process.join()


FULL = 66
"""Exit status of a cell that couldn't write its result."""


def _child(cell: Cell, shared: Source, folder: Path, same: dict[str, Any], threads: int) -> None:
    """Body of a cell's process."""
    import signal
    import threading

    import cv2
    import numba

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the study is interrupted, and ends its cells
    threading.Thread(target=_end_with_the_study, daemon=True).start()
    cv2.setNumThreads(threads)
    numba.set_num_threads(min(threads, numba.get_num_threads()))
    part = folder / f".{cell.name}.{os.getpid()}.part.mp4"
    began = clock.perf_counter()
    try:
        try:
            result = measure(cell, shared, part, threads)
        except SpaceError:
            raise
        except ScanError as error:
            result = Result(reason=f"{error.cause}" if error.where == "trajectory" else f"{error.where}: {error.cause}")
        except MemoryError:
            result = Result(reason="out of memory")
        except Exception as error:
            result = Result(reason=f"unexpected {type(error).__name__}: {error}"[:300])
        result = replace(result, figures=result.figures | {"seconds": round(clock.perf_counter() - began, 1)})
        if shared.keep and part.is_file():
            part.replace(folder / f"{cell.name}.mp4")
        body = {"cell": asdict(cell), "figures": result.figures, "reason": result.reason, "of": same}
        with replacing(folder / f"{cell.name}.json") as fresh:
            fresh.write_text(json.dumps(body, indent=1) + "\n", encoding="utf-8")
    except (SpaceError, OSError):
        os._exit(FULL)
    finally:
        part.unlink(missing_ok=True)


def _end_with_the_study() -> None:
    """Wait for the death of the process that runs the study, and follow it."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def measure(cell: Cell, shared: Source, file: Path, threads: int = 0) -> Result:
    """Make a cell's video (`file`), follow it, and compare.

    Raises:
        ScanError: it can't be followed, or not be compared.
    """
    import cv2

    camera = _scaled(shared.camera, cell.height)
    kept = _encode(shared.video, file, cell, (camera.width, camera.height), threads)
    made = open_video(file)
    mask = shared.mask
    if mask is not None:
        free = np.where(mask > 0, np.uint8(255), np.uint8(0))
        free = cv2.resize(free, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        mask = np.where(free == 255, np.uint8(255), np.uint8(0))
    run = track(
        made,
        lambda warn: Odometry(camera, shared.params, mask=mask, gps=shared.gps, backend=shared.backend, warn=warn),
    )
    trajectory, _ = finish(Mapped.of(run.odometry, run.names), shared.gps, georeference=False)
    lost = _lost(trajectory, shared.truth)
    figures: dict[str, Any] = {
        "width": camera.width,
        "mbit_s": round(8e-6 * file.stat().st_size / kept, 4),
        "lost_share": round(lost, 4),
        **run.facts(),
    }
    if lost > LOST:
        return Result(figures, f"lost for {100 * lost:.0f} % of the way")
    compared = evaluate(trajectory, shared.truth, segment=shared.segment)
    return Result(figures | compared.figures())


def _scaled(camera: Camera, height: int) -> Camera:
    """The camera of frames scaled to a height, and to an even width."""
    width = 2 * round(height * camera.width / camera.height / 2)
    return camera.resized(width, height)


def _lost(estimate: Trajectory, truth: Trajectory | GpsTrack) -> float:
    """The share of the true way on which poses were bridged."""
    assert estimate.unsure is not None
    places = truth.at(estimate.times)[:, :2]
    known = np.isfinite(places).all(axis=1)
    steps = np.linalg.norm(np.diff(places[known], axis=0), axis=1)
    whole = float(steps.sum())
    return float(steps[estimate.unsure[known][1:]].sum()) / whole if whole > 0 else 1.0


# --- videos


def _encode(video: Video, file: Path, cell: Cell, size: tuple[int, int], threads: int) -> float:
    """Write the source scaled down, at a lower rate, compressed; returns its seconds."""
    chosen, last, start = -1, 0.0, 0.0
    with Encoder(
        file, size, cell.rate, bitrate=1e6 * cell.bitrate, preset="superfast", threads=str(threads)
    ) as encoder:  # fmt: skip
        for time, picture in _pictures(video, size):
            # a frame whenever the slower clock ticks: times stay those of the source
            tick = math.floor((time + 0.25 / video.fps) * cell.rate)
            if tick > chosen or cell.rate > 0.98 * video.fps:
                start = time if chosen < 0 else start
                chosen, last = tick, time
                encoder.add(picture(), time)
    if encoder.count < 2:
        raise InputError(video.path, f"has {encoder.count} frames", "Give a longer video")
    return (last - start) * encoder.count / (encoder.count - 1)


def _pictures(video: Video, size: tuple[int, int]) -> Iterator[tuple[float, Callable[[], U8]]]:
    """Times from the first frame, and what makes the frame as planar YUV (H * 3 / 2, W), scaled."""
    if video.path.is_dir():
        times = np.arange(video.count or 0) / video.fps if video.times is None else video.times
        for time, path in zip(times.tolist(), _files(video.path), strict=True):
            yield time, lambda path=path: _of_picture(path, size)  # type: ignore[misc]
        return
    import av

    with av.open(str(video.path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        first: float | None = None
        try:
            for number, frame in enumerate(container.decode(stream)):
                time = number / video.fps if frame.time is None else frame.time
                first = time if first is None else first

                def picture(frame: Any = frame) -> U8:
                    if frame.format.name not in ("yuv420p", "yuvj420p"):
                        frame = frame.reformat(format="yuv420p")
                    planes = [_plane(plane) for plane in frame.planes]
                    return _planar(planes[0], planes[1], planes[2], size)

                yield time - first, picture
        except av.error.FFmpegError:
            return  # what could be read is what there is; `track` tells of it


def _plane(plane: Any) -> U8:
    return np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height, : plane.width]


def _of_picture(path: Path, size: tuple[int, int]) -> U8:
    import cv2

    from scan2sim.pipeline.io.image import read_rgb

    rgb = read_rgb(path)
    if rgb is None:
        raise InputError(path, "is no readable picture", "Copy it again, or take it out of the folder")
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small, cv2.COLOR_RGB2YUV_I420)  # type: ignore[return-value]


def _planar(y: U8, u: U8, v: U8, size: tuple[int, int]) -> U8:
    """(H * 3 / 2, W) of planes of any size."""
    import cv2

    width, height = size
    out = np.empty((height * 3 // 2, width), np.uint8)
    out[:height] = y if y.shape == (height, width) else cv2.resize(y, size, interpolation=cv2.INTER_AREA)
    half = (width // 2, height // 2)
    colour = [p if p.shape == half[::-1] else cv2.resize(p, half, interpolation=cv2.INTER_AREA) for p in (u, v)]
    out[height:] = np.concatenate([np.ascontiguousarray(p).reshape(-1) for p in colour]).reshape(-1, width)
    return out


# --- tables


def _tables(out: Path, shared: Source, cells: Sequence[Cell], results: dict[Cell, Result]) -> None:
    for name, text in (("table.md", _markdown(shared, cells, results)), ("table.csv", _csv(cells, results))):
        with replacing(out / name) as fresh:
            fresh.write_text(text, encoding="utf-8")


def _errors(segment: float) -> tuple[tuple[str, str], ...]:
    """Keys and titles of the two errors."""
    return ("global_mean_m", "Global mean error"), (f"local_median_{segment:g}_m", f"Local median error {segment:g}")


def _markdown(shared: Source, cells: Sequence[Cell], results: dict[Cell, Result]) -> str:
    """The mission's layout: rows are bit rates, columns resolutions, blocks frame rates and the two errors."""
    heights, bitrates, rates = _axes(cells)
    errors = _errors(shared.segment)
    video = shared.video
    lines = [
        "# Influence of vertical resolution, bit rate and frame rate",
        "",
        f"Source: `{video.path}`, {video.width}x{video.height}, {video.fps:.4g} fps. Errors in metres, in the ground "
        "plane, after rotation, scale and translation onto the truth (D3.2, section 4.1); "
        + (f"scale along the way by GPS; backend {shared.backend}." if shared.gps else f"backend {shared.backend}."),
    ]
    if shared.segment != SEGMENT:
        lines.append(f"The truth is too short for segments of {SEGMENT:g} m: they are of {shared.segment:g} m.")
    titles = [f"{title.split(' ')[0].lower()}, {height} px" for _, title in errors for height in heights]
    lines += [
        "",
        f"Left: {errors[0][1].lower()} [m]. Right: {errors[1][1].lower()} [m].",
        "",
        f"| fps | Mbit/s | {' | '.join(titles)} |",
        f"| ---: | ---: |{' ---: |' * len(titles)}",
    ]
    for rate in rates:
        for bitrate in bitrates:
            row = [results.get(Cell(height, bitrate, rate)) for height in heights]
            told = [_told(result, key) for key, _ in errors for result in row]
            lines.append(f"| {rate:g} | {bitrate:g} | {' | '.join(told)} |")
    reasons: dict[str, list[str]] = {}
    for cell in cells:
        if cell in results and results[cell].reason:
            where = f"{cell.height} px {cell.bitrate:g} Mbit/s {cell.rate:g} fps"
            reasons.setdefault(str(results[cell].reason), []).append(where)
    if reasons:
        lines += ["", "N/A:", "", *(f"- {reason}: {', '.join(where)}" for reason, where in reasons.items())]
    off = [
        f"{cell.height} px {cell.bitrate:g} Mbit/s {cell.rate:g} fps: {result.figures['mbit_s']:.3g}"
        for cell, result in ((cell, results[cell]) for cell in cells if cell in results)
        if result.figures.get("mbit_s") and abs(result.figures["mbit_s"] / cell.bitrate - 1) > 0.1
    ]
    if off:
        lines += [
            "",
            "Bit rates that came out more than 10 % off what was asked, Mbit/s:",
            "",
            *(f"- {o}" for o in off),
        ]
    missing = sum(cell not in results for cell in cells)
    if missing:
        lines += ["", f"{missing} of {len(cells)} cells are still to be run (…)."]
    return "\n".join(lines) + "\n"


def _axes(cells: Sequence[Cell]) -> tuple[list[int], list[float], list[float]]:
    """Heights and bit rates ascending, rates descending, as in the mission's tables."""
    heights, bitrates = sorted({c.height for c in cells}), sorted({c.bitrate for c in cells})
    return heights, bitrates, sorted({c.rate for c in cells}, reverse=True)


def _told(result: Result | None, key: str) -> str:
    if result is None:
        return "…"
    value = None if result.reason else result.figures.get(key)
    return "N/A" if value is None else f"{value:.2f}"


def _csv(cells: Sequence[Cell], results: dict[Cell, Result]) -> str:
    """A row a cell, with all figures."""
    names = list(dict.fromkeys(name for cell in cells if cell in results for name in results[cell].figures))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["height", "bitrate_mbit_s", "rate_fps", *names, "reason"])
    for cell in cells:
        if cell in results:
            result = results[cell]
            values = [result.figures.get(name) for name in names]
            table.writerow([cell.height, f"{cell.bitrate:g}", f"{cell.rate:g}", *values, result.reason])
    return text.getvalue()


def plot(file: Path, segment: float, cells: Sequence[Cell], results: dict[Cell, Result]) -> None:
    """Write a PNG: errors against bit rate, a line a resolution, a row of charts a frame rate."""
    from matplotlib.figure import Figure

    heights, bitrates, rates = _axes(cells)
    figure = Figure(figsize=(12, 1 + 4 * len(rates)), dpi=110, layout="constrained")
    charts = figure.subplots(len(rates), 2, squeeze=False, sharex=True, sharey="col")
    colours = ["#9cc4e4", "#3f8fd2", "#1f5fbf", "#0b2f6b", "#c2410c", "#f0a818"]
    for rate, row in zip(rates, charts, strict=True):
        for (key, title), axes in zip(_errors(segment), row, strict=True):
            for k, height in enumerate(heights):
                found = [(b, results.get(Cell(height, b, rate))) for b in bitrates]
                points = [
                    (b, r.figures[key]) for b, r in found if r and not r.reason and r.figures.get(key) is not None
                ]
                label = f"{height} px" + ("" if points else " (N/A)")
                x, y = zip(*points, strict=True) if points else ((), ())
                axes.plot(x, y, "o-", color=colours[k % len(colours)], linewidth=1.6, markersize=4, label=label)
            axes.set_xscale("log")
            axes.set_xticks(bitrates, [f"{b:g}" for b in bitrates])
            axes.minorticks_off()
            axes.set(title=f"{title}{' m' * title[-1:].isdigit()}, {rate:g} fps", ylabel="m")
            axes.set_xlim(min(bitrates) / 1.2, max(bitrates) * 1.2)
            axes.grid(alpha=0.3)
            axes.legend()
    for axes in charts[-1]:
        axes.set_xlabel("Mbit/s asked for")
        axes.set_ylim(bottom=0)  # all that share this axis have drawn
    with replacing(file) as fresh:
        figure.savefig(fresh, format="png")

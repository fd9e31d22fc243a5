"""`scan2sim slam`: a video to a trajectory, figures against a truth, and the study of compression."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated, TypeVar, get_args

import numpy as np
import typer

from scan2sim.flows.commands.app import App, Config, Sets, settings_of
from scan2sim.flows.commands.display import console, progress
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.recipes.settings import Settings
from scan2sim.pipeline.errors import InputError, SettingError
from scan2sim.pipeline.extras import need
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.image import read_rgb
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.store import digest
from scan2sim.pipeline.types import Camera, GpsTrack, Trajectory
from scan2sim.slam import output, solvers
from scan2sim.slam.adjust import adjust
from scan2sim.slam.charts import Charts
from scan2sim.slam.evaluate import AlignmentKind, Evaluation, evaluate, plot
from scan2sim.slam.gps import smooth
from scan2sim.slam.loops import Places
from scan2sim.slam.loops import close as close_loops
from scan2sim.slam.odometry import Odometry, OdometryParams
from scan2sim.slam.sparse import sparse_map
from scan2sim.slam.track import VERSION, Tracked, camera_of, track
from scan2sim.slam.trackers import Tracker, named
from scan2sim.slam.video import Video, open_video

T = TypeVar("T", int, float)


@dataclass(frozen=True)
class Options:
    """What the command was asked, besides parameters.

    Attributes:
        gps: file of the track.
        gps_offset: seconds added to the track's times, first frame at 0; None: as the files' clocks say.
        georeference: place the trajectory where GPS says.
        mask: picture, 0 where the car is.
        camera: "auto", "pinhole", "equirectangular".
        focal: pixels.
        centre: pixels.
        tile: whose camera it is, and
        tile_camera: the name of a photo of that camera there.
        fps, times: of a folder of pictures.
        every: take every so manieth frame.
        until: seconds of the video to take; None: all.
        backend: of `slam.solvers`.
        features: "corners", or a backend of `slam.features`, with
        matcher: one of `slam.matchers`, and
        weights, matcher_weights: files of theirs, where they need any.
        colmap: write the map as a COLMAP model, too.
        loops: recognise places that were passed before.
        adjust: adjust all keyframes at once in the end.
        view: record a video of what is tracked.
    """

    gps: Path | None = None
    gps_offset: float | None = None
    georeference: bool = True
    mask: Path | None = None
    camera: str = "auto"
    focal: float | None = None
    centre: tuple[float, float] | None = None
    tile: Path | None = None
    fps: float = 10.0
    times: Path | None = None
    every: int = 1
    until: float | None = None
    backend: str = "lm"
    features: str = "corners"
    matcher: str = "nearest"
    weights: Path | None = None
    matcher_weights: Path | None = None
    colmap: bool = False
    loops: bool = False
    adjust: bool = False
    view: bool = False


app = App("Where the camera of a video went: `slam VIDEO --out DIR`.", first=True)


@app.command("video")
def slam_a_video(
    video: Annotated[Path, typer.Argument(metavar="VIDEO", help="A video file, or a folder of pictures.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the trajectory.")],
    gps: Annotated[
        Path | None, typer.Option(help="GPX, NMEA, CSV, or a GoPro video: ties the scale, and places it.")
    ] = None,
    gps_offset: Annotated[float | None, typer.Option(help="Seconds to add to its times; first frame at 0.")] = None,
    local: Annotated[bool, typer.Option("--local", help="Don't place it where GPS says: scale alone.")] = False,
    mask: Annotated[Path | None, typer.Option(help="Picture: 0 where the car itself is seen.")] = None,
    camera: Annotated[str, typer.Option(help="auto, equirectangular or pinhole.")] = "auto",
    focal: Annotated[float | None, typer.Option(help="Pixels, of a pinhole camera.")] = None,
    centre: Annotated[tuple[float, float] | None, typer.Option(help="Pixels; default: the middle.")] = None,
    tile: Annotated[Path | None, typer.Option(help="Take the camera of this tile that has the video's size.")] = None,
    fps: Annotated[float, typer.Option(help="Of a folder of pictures.")] = 10.0,
    times: Annotated[Path | None, typer.Option(help="Of a folder's pictures: seconds, one a line.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Take every Nth frame.")] = 1,
    until: Annotated[float, typer.Option(help="Seconds of the video; 0: all.")] = 0.0,
    backend: Annotated[str, typer.Option(help="lm, or adam: the mission's.")] = "lm",
    features: Annotated[str, typer.Option(help="corners (tracked), orb, rootsift, superpoint, aliked.")] = "corners",
    matcher: Annotated[str, typer.Option(help="nearest, superglue, lightglue.")] = "nearest",
    weights: Annotated[Path | None, typer.Option(help="Your file of the features' weights.")] = None,
    matcher_weights: Annotated[Path | None, typer.Option(help="Your file of the matcher's.")] = None,
    colmap: Annotated[bool, typer.Option("--colmap", help="Write the map as a COLMAP model, too.")] = False,
    loops: Annotated[bool, typer.Option("--loops", help="Recognise places that were passed before.")] = False,
    adjust: Annotated[bool, typer.Option("--adjust", help="Adjust all keyframes at once in the end.")] = False,
    view: Annotated[bool, typer.Option("--view", help="Record what is tracked, and where: view.mp4.")] = False,
    set_: Sets = None,
    config: Config = None,
) -> None:
    """Poses of a video's frames: TUM, KITTI, CSV, GeoJSON."""
    options = Options(
        gps=gps, gps_offset=gps_offset, georeference=not local, mask=mask, camera=camera, focal=focal, centre=centre,
        tile=tile, fps=fps, times=times, every=every, until=until or None, backend=backend,
        features=features, matcher=matcher, weights=weights, matcher_weights=matcher_weights,
        colmap=colmap, loops=loops, adjust=adjust, view=view,
    )  # fmt: skip
    slam_video(video, out, options, settings_of(set_, config))


@app.command("evaluate")
def slam_evaluate(
    trajectory: Annotated[Path, typer.Argument(help="CSV, TUM or KITTI file.")],
    truth: Annotated[Path, typer.Argument(help="Another, or a GPS track.")],
    segment: Annotated[float, typer.Option(help="Metres of the local error's segments.")] = 400.0,
    alignment: Annotated[str, typer.Option(help="similarity2d, rigid2d or similarity3d.")] = "similarity2d",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="PNG of path and errors.")] = None,
) -> None:
    """Print how far a trajectory is from the truth: D3.2's errors, ATE, RPE, drift."""
    evaluate_trajectory(trajectory, truth, segment=segment, alignment=alignment, out=out)


@app.command("study")
def slam_study(
    source: Annotated[Path, typer.Argument(metavar="DRIVE", help="A drive's folder, a video, or its frames.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of cells, tables and plots.")],
    truth: Annotated[Path | None, typer.Option(help="Trajectory or GPS track; default: the drive's.")] = None,
    gps: Annotated[Path | None, typer.Option(help="Track for the scale; default: the drive's.")] = None,
    mask: Annotated[Path | None, typer.Option(help="Picture: 0 where the car is; default: the drive's.")] = None,
    heights: Annotated[str, typer.Option(help="Pixels.")] = "512,768,1024,1536",
    bitrates: Annotated[str, typer.Option(help="Mbit/s.")] = "1,2,5,10,20,40",
    rates: Annotated[str, typer.Option(help="Frames a second.")] = "30,15",
    jobs: Annotated[int, typer.Option(min=1, help="Cells at a time.")] = 1,
    backend: Annotated[str, typer.Option(help="lm, or adam: the mission's.")] = "lm",
    set_: Sets = None,
    config: Config = None,
) -> None:
    """What resolution, bit rate and frame rate of the video cost: D3.2's tables 4 and 5."""
    study_compression(
        source, out, truth=truth, gps=gps, mask=mask, heights=heights, bitrates=bitrates, rates=rates, jobs=jobs,
        backend=backend, settings=settings_of(set_, config),
    )  # fmt: skip


def slam_video(path: Path, out: Path, options: Options, settings: Settings) -> Tracked:
    """Write the trajectory of the camera that took a video, in all formats, and `slam.json`.

    Raises:
        ScanError: see `pipeline.errors`; earlier results stay.
    """
    params = odometry_params(settings)
    _need(options)
    video = open_video(path, fps=options.fps, times=options.times)
    camera, gps, mask = _camera(video, options), _gps(video, options), _mask(video, options)
    with locked(out), progress("slam") as report:
        state = out / f"state-{_mark(path, camera, options, params)}.npz"
        watch = None
        if options.view:
            from scan2sim.slam.view import Recorder

            watch = Recorder(out / "view.mp4", fps=video.fps / options.every)
        places = Places(Charts(camera)) if options.loops else None
        after: list[Callable[[Odometry], dict[str, float]]] = [adjust] if options.adjust else []
        if places is not None:
            after.append(partial(close_loops, places=places))
        keep = options.colmap or options.adjust

        def start(warn: Callable[[str], None]) -> Odometry:
            return Odometry(
                camera, params, mask=mask, gps=gps, backend=options.backend, keep=keep, remember=places, warn=warn,
                tracker=_tracker(camera, mask, params.features, options),
            )  # fmt: skip

        tracked = track(
            video, start, gps=gps, georeference=options.georeference, every=options.every, until=options.until,
            state=state, watch=watch, after=after, report=report,
        )  # fmt: skip
        if watch is not None:
            watch.close()
        sparse = sparse_map(tracked.odometry, tracked.placing, tracked.trajectory) if options.colmap else None
        output.write(out, tracked.trajectory, tracked.frame, camera=camera, names=tracked.names, sparse=sparse)
        if tracked.alone is not None:
            trajectory_io.write(out / "odometry.csv", tracked.alone, tracked.frame)
        (out / "slam.json").write_text(json.dumps(tracked.facts | {"warnings": tracked.warnings}, indent=1) + "\n")
        for left in out.glob("state-*"):  # those of other options, too: what they were to become is replaced
            left.unlink()
    for warning in tracked.warnings[:20]:
        console.print(f"[yellow]warning:[/] {warning}", highlight=False, soft_wrap=True)
    console.print(json.dumps(tracked.facts, indent=1), highlight=False, markup=False)
    console.print(f"Trajectory: {out / 'trajectory.csv'}", highlight=False, soft_wrap=True, markup=False)
    return tracked


def _need(options: Options) -> None:
    """Refuse at once what would fail for want of a package in the end.

    Raises:
        UnavailableError: naming it.
    """
    if options.adjust:
        need("--adjust", "pycolmap")
    solvers.named(options.backend)
    if options.view:
        need("--view", "av")


def _mark(path: Path, camera: Camera, options: Options, params: OdometryParams) -> str:
    """Of all that a run depends on: the code's version, the contents of files, options and parameters."""
    given = {f.name: getattr(options, f.name) for f in fields(options) if f.name != "tile"}  # which gave the camera
    asked = {name: digest(value) if isinstance(value, Path) else value for name, value in given.items()}
    whole = [VERSION, digest(path), asdict(camera), asked, params.model_dump(mode="json")]
    return hashlib.sha256(json.dumps(whole).encode()).hexdigest()[:12]


def odometry_params(settings: Settings) -> OdometryParams:
    """Of `--set slam.param=value`.

    Raises:
        SettingError: unknown, or out of range.
    """
    for name in settings.values:
        if name != "slam":
            raise SettingError(name, "there is no such step here", "Write --set slam.param=value")
    values = settings.values.get("slam", {})
    if not isinstance(values, Mapping):
        raise SettingError("slam", "must be a table of parameters", "Write --set slam.param=value")
    return OdometryParams.of("slam", values, remedy="docs/slam.md lists them")


def _tracker(camera: Camera, mask: np.ndarray | None, count: int, options: Options) -> Tracker:
    """What follows features: corners by Lucas-Kanade, or descriptors from frame to frame (D3.2)."""
    if options.features == "corners":
        return named("corners", Charts(camera), mask, count)
    from scan2sim.slam import features, matchers

    detector = features.named(options.features, options.weights)
    matcher = matchers.named(options.matcher, options.matcher_weights)
    matchers.check(detector, matcher)
    for part in (detector, matcher):
        console.print(part.describe(), highlight=False, markup=False, soft_wrap=True)
    return named("descriptors", Charts(camera), mask, count, detector, matcher)


def _camera(video: Video, options: Options) -> Camera:
    if options.tile is None:
        return camera_of(video, options.camera, options.focal, options.centre)
    for view in read_tile(options.tile).views:
        if (view.camera.width, view.camera.height) == (video.width, video.height):
            return view.camera
    raise InputError(options.tile, f"has no camera of {video.width}x{video.height}", "Give --camera and --focal")


def _gps(video: Video, options: Options) -> GpsTrack | None:
    """The track in the frames' times, smoothed."""
    if options.gps is None:
        return None
    track_ = gps_io.read(options.gps)
    absolute = track_.times[0] > 1e8
    if options.gps_offset is not None:
        track_ = track_.shifted(options.gps_offset)
    elif absolute and video.start is not None and abs(video.start - track_.times[0]) < 3600:
        track_ = track_.shifted(-video.start)
    elif absolute:
        console.print("[yellow]warning:[/] no clock of the video's: its first frame is taken to be at the first fix")
        track_ = track_.shifted(-float(track_.times[0]))
    return smooth(track_)


def _mask(video: Video, options: Options) -> np.ndarray | None:
    if options.mask is None:
        return None
    import cv2

    rgb = read_rgb(options.mask) if options.mask.is_file() else None
    if rgb is None:
        raise InputError(options.mask, "is no readable picture", "Give a mask: 0 where the car itself is seen")
    return cv2.resize(rgb[..., 0], (video.width, video.height), interpolation=cv2.INTER_NEAREST)


def evaluate_trajectory(estimate: Path, truth: Path, *, segment: float, alignment: str, out: Path | None) -> Evaluation:
    """Print how far a trajectory is from the truth: a trajectory, or a GPS track."""
    kinds: tuple[AlignmentKind, ...] = get_args(AlignmentKind)
    kind = next((k for k in kinds if k == alignment), None)
    if kind is None:
        raise SettingError("--alignment", f"there is no `{alignment}`", f"Choose one of {', '.join(kinds)}")
    path = trajectory_io.read(estimate)
    known = _truth(truth)
    result = evaluate(path, known, segment=segment, alignment=kind)
    for name, value in result.figures().items():
        console.print(f"{name:<24}{'-' if value is None else f'{value:.4f}':>14}", highlight=False, markup=False)
    if out is not None:
        plot(result, out)
        console.print(f"Plot: {out}", highlight=False, soft_wrap=True, markup=False)
    return result


def _truth(path: Path) -> Trajectory | GpsTrack:
    if path.suffix.lower() in (".gpx", ".nmea", ".mp4"):
        return gps_io.read(path)
    if path.suffix.lower() == ".csv" and "lat" in path.read_text(encoding="utf-8", errors="replace")[:200]:
        return gps_io.read(path)
    return trajectory_io.read(path)


def study_compression(
    source: Path, out: Path, *, truth: Path | None, gps: Path | None, mask: Path | None, heights: str, bitrates: str,
    rates: str, jobs: int, backend: str, settings: Settings,
) -> Path:  # fmt: skip
    """Print the table of what compression costs; in a drive's folder, what isn't named is found by its name.

    Raises:
        ScanError: see `pipeline.errors`.
    """
    from scan2sim.slam.study import study

    def found(given: Path | None, name: str) -> Path | None:
        beside = source / name
        return given or (beside if source.is_dir() and beside.is_file() else None)

    known = found(truth, "truth.csv")
    if known is None:
        raise SettingError("--truth", "is missing", "Give a trajectory, or a GPS track, to compare with")
    video = open_video(source / "video.mp4" if (source / "video.mp4").is_file() else source)
    options = Options(gps=found(gps, "gps.csv"), gps_offset=0.0, mask=found(mask, "mask.png"))
    with progress("study") as report:
        table = study(
            source, _truth(known), out, params=odometry_params(settings), gps=_gps(video, options),
            mask=_mask(video, options), heights=_numbers("--heights", heights, int), jobs=jobs, backend=backend,
            bitrates=_numbers("--bitrates", bitrates, float), rates=_numbers("--rates", rates, float), report=report,
        )  # fmt: skip
    console.print(table.read_text(encoding="utf-8"), highlight=False, markup=False, soft_wrap=True)
    console.print(f"Table: {table}", highlight=False, soft_wrap=True, markup=False)
    return table


def _numbers(option: str, text: str, kind: type[T]) -> list[T]:
    try:
        return [kind(part) for part in text.split(",")]  # type: ignore[call-arg]
    except ValueError:
        raise SettingError(option, f"`{text}` isn't a list of numbers", "Write 512,1024") from None

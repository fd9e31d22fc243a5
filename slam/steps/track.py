"""Step `track`: visual odometry over a video, resumed from a checkpoint if it was interrupted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from scan2sim.pipeline.camera.lens import GIVEN_SIGMA, LENS_MODELS
from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.blas_threads import one_blas_thread
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.parameters import Focal, Pixels, Rate, Shift
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import U8, Camera, GpsTrack
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io.calibration import read_camera
from scan2sim.pipeline.io.images import image
from scan2sim.slam import features, lens, matchers, solvers, trackers
from scan2sim.slam.calibration import calibrate
from scan2sim.slam.calibration.camera import EstimatedCamera, camera_of, estimated_camera
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.odometry.track_log import RecordingTracker, Replay, TrackLog, record_tracks
from scan2sim.slam.odometry.video_odometry import VERSION, Run, track
from scan2sim.slam.trackers import Tracker
from scan2sim.slam.trajectory.gps import ABSOLUTE_S, smooth, video_clock
from scan2sim.slam.video import Video, open_video
from scan2sim.slam.virtual_cameras import VirtualViews

REFINEMENTS_MAX = 3
"""Greatest number of times odometry is repeated with a refined lens, over the features tracked the first time. Drives
that fit their lens aren't repeated, others once; more if the lens is so wrong that many features seemed to be outliers.
"""


class Filmed(Params):
    """Camera, timing and backends of a video's odometry."""

    camera: str = Field(
        "auto",
        description="Camera model: equirectangular, pinhole, or auto (by the aspect ratio); or a file: TOML as in a "
        "tile, or the calibration of another program (docs/inputs.md).",
    )
    focal: Focal | None = Field(
        None, description="Focal length of a pinhole camera in pixels; default: from EXIF, or self-calibration."
    )
    centre: tuple[Pixels, Pixels] | None = Field(
        None, description="Principal point of a pinhole camera in pixels; default: the image centre."
    )
    k1: Annotated[float, Field(ge=-1, le=1)] | None = Field(
        None, description="Radial distortion k1 of a pinhole camera (OpenCV model); default: none."
    )
    k2: Annotated[float, Field(ge=-1, le=1)] | None = Field(
        None, description="Radial distortion k2 of a pinhole camera (OpenCV model); default: none."
    )
    calibrate: bool = Field(
        False, description="Estimate focal length, principal point, k1 and k2 by self-calibration over the whole video."
    )
    fixed_lens: bool = Field(
        False, description="Keep the given intrinsics even if the video clearly contradicts them; default: refine them."
    )
    fps: Rate = Field(10.0, description="Frames per second of a folder of images without times.")
    every: Annotated[int, Field(ge=1, le=1_000_000)] = Field(1, description="Process every Nth frame.")
    until: Annotated[float, Field(ge=0, le=1e7)] = Field(
        0.0, description="Process only this many seconds of the video; 0: all of it."
    )
    gps_offset: Shift | None = Field(
        None,
        description="Seconds to add to GPS times, so that they count from the first frame; default: by the clocks.",
    )
    backend: str = Field(
        "lm", description="Solver: lm (Levenberg-Marquardt), or adam (gradient descent by torch, slower)."
    )
    features: str = Field(
        "corners", description="Features: corners (optical flow), orb, rootsift, superpoint or aliked."
    )
    matcher: str = Field("nearest", description="Matcher of features: nearest, superglue or lightglue.")


class TrackContext(Context):
    """What the video's other steps need.

    Attributes:
        cameras: cameras of a tile, of which the one with the video's image size is used.
        keep: keep all points and observations, for loop closure, global adjustment and COLMAP.
    """

    cameras: tuple[dict[str, Any], ...] = ()
    keep: bool = False


class TrackParams(OdometryParams, Filmed):
    """Settings of the step: those of `Filmed` and `OdometryParams`."""

    context: TrackContext = TrackContext()


@one_blas_thread()
def track_video(inputs: Inputs, params: TrackParams, out: Path, report: Report, checkpoint: Path) -> Done:
    """Visual odometry over `video` (a file, or a folder of images with `times`).

    Optional inputs: `gps`, `mask`, `camera` (a file of cameras), weights.

    Raises:
        InputError: an input can't be read, or the camera is unknown.
        DataError: the video is too short.
    """
    video = open_video(inputs["video"], fps=params.fps, times=inputs.get("times"))
    mask = read_mask(video, inputs.get("mask"))

    def track_log() -> TrackLog:
        return record_tracks(video, mask, every=params.every, until=params.until or None, report=report)

    camera, estimated = video_camera(video, params, track_log, checkpoint / "lens.json", inputs.get("camera"))
    warnings: list[str] = []
    gps = read_gps(video, inputs.get("gps"), params.gps_offset, warnings.append)
    description = ""

    log_file, refinement = checkpoint / "tracks.bin", checkpoint / "refined.json"
    refine = camera.model in LENS_MODELS and not params.fixed_lens and (estimated is None or not estimated.final)

    def tracked(camera: Camera, log: TrackLog | None, *, record: bool = False) -> Run:
        nonlocal description
        tracker, description = tracker_of(camera, mask, params, inputs)
        if log is not None:
            tracker = Replay(log, camera)
        recorder = RecordingTracker(tracker, camera, log_file) if record else None

        def start(warn: Callable[[str], None]) -> Odometry:
            return Odometry(
                camera, params, mask=mask if log is None else None, gps=gps, backend=params.backend,
                keep=params.context.keep, warn=warn, tracker=recorder or tracker,
            )  # fmt: skip

        run = track(
            video, start, every=params.every, until=params.until or None, log=log, state=checkpoint / "state.npz",
            report=report,
        )  # fmt: skip
        if recorder is not None and not run.odometry.losses:  # tracks end where tracking is lost
            recorder.finish([p.time for p in run.odometry.placed], run.names, run.warnings)
        return run

    def tracked_again(camera: Camera) -> Run:
        log = TrackLog.read(log_file)
        run = tracked(camera, log)
        if log is None or not run.odometry.losses:
            return run
        (checkpoint / "state.npz").unlink(missing_ok=True)
        log_file.unlink()
        return tracked(camera, None)

    given, refined = estimated, EstimatedCamera.read(refinement) if refine else None
    if refined is None:
        run = tracked(camera, None, record=refine)
    else:
        run, estimated = tracked_again(refined.camera), refined
    for _ in range(REFINEMENTS_MAX - (refined is not None) if refine else 0):
        refined = refined_camera(camera, given, run.odometry)
        if refined is None:
            break
        (checkpoint / "state.npz").unlink(missing_ok=True)
        refined.write(refinement)
        estimated, seconds = refined, run.seconds
        run = tracked_again(refined.camera)
        run.seconds += seconds
    wrong_lens = None if params.calibrate else _lens_warning(estimated, run.odometry, track_log)
    warnings = [*([estimated.message()] if estimated else []), *warnings, *([wrong_lens] if wrong_lens else [])]
    files = {"map": MapCheckpoint.of(run.odometry, run.names).write(out / "map.npz")}
    metrics = run.metrics() | ({"summary": description} if description else {})
    return Done(files, metrics | (estimated.metrics() if estimated else {}), [*warnings, *dict.fromkeys(run.warnings)])


def refined_camera(camera: Camera, given: EstimatedCamera | None, odometry: Odometry) -> EstimatedCamera | None:
    """Lens of an odometry refined by its drive, within the prior of the given one; None if the drive fits it.

    Args:
        camera: the given camera, mean of the prior.
        given: its source, if it comes from metadata.
        odometry: odometry over the drive, with this camera or one refined before.
    """
    sigma = GIVEN_SIGMA if given is None else given.sigma
    found = lens.fit_lens(odometry.map.camera, odometry.map.misfits, sigma, prior=camera)
    if found is None or not lens.contradicts(found):
        return None
    source = "the given lens" if given is None else f"the lens from {given.how}"
    fits = lens.lens_changes(camera, found) or "another lens better"
    return EstimatedCamera.of(found, f"refinement of {source}: the images fit {fits} (--fixed-lens keeps it)")


def _lens_warning(
    estimated: EstimatedCamera | None, odometry: Odometry, track_log: Callable[[], TrackLog]
) -> str | None:
    """Warning if the lens doesn't fit the turns; if tracking was lost too often, after calibration from scratch."""
    camera, from_drive = odometry.map.camera, estimated is not None and estimated.final
    if camera.model not in LENS_MODELS:
        return None
    warning = None
    if calibrate.lost_share(odometry) >= calibrate.LOST_SHARE_MAX:
        warning = lens.lens_warning(camera, calibrate.calibrated_from_scratch(track_log()))
    if warning is None and not from_drive:
        warning = lens.lens_warning(camera, lens.fit_lens(camera, odometry.map.misfits, GIVEN_SIGMA))
    return warning


def can_track(params: TrackParams) -> None:
    """Raise a ScanError if a backend doesn't exist, or a package that it needs isn't installed."""
    solvers.named(params.backend)
    if params.features != "corners":
        plugins.find(features.__name__, params.features, "track.features")
        plugins.find(matchers.__name__, params.matcher, "track.matcher")


def video_camera(
    video: Video, params: TrackParams, track_log: Callable[[], TrackLog], cache: Path, file: Path | None = None
) -> tuple[Camera, EstimatedCamera | None]:
    """Camera of the frames: from a file or tile, from the options, or estimated; `cache` stores an estimate.

    Raises:
        InputError: the camera is unknown. SettingError: a file and a number are given.
    """
    if file is not None:
        for name in ("focal", "centre", "k1", "k2"):
            if getattr(params, name) is not None:
                raise SettingError(f"--{name}", "is given beside a file with the camera", "Leave one of them out")
        given: Camera | None = read_camera(file, video.width, video.height, names=(video.path.stem,))
    else:
        given = _tile_camera(video, params) or camera_of(
            video, params.camera, params.focal, params.centre, params.k1, params.k2
        )
    estimated = EstimatedCamera.read(cache) or estimated_camera(video, given, track_log, calibrate=params.calibrate)
    if estimated is not None:
        estimated.write(cache)
        return estimated.camera, estimated
    assert given is not None
    return given, None


def _tile_camera(video: Video, params: TrackParams) -> Camera | None:
    if not params.context.cameras:
        return None
    cameras = [Camera(**given | {"distortion": tuple(given["distortion"])}) for given in params.context.cameras]
    fitting = [one for one in cameras if (one.width, one.height) == (video.width, video.height)]
    if len(fitting) != 1:
        count, size = "several cameras" if fitting else "no camera", f"{video.width}x{video.height}"
        raise InputError(
            video.path, f"the tile has {count} with an image size of {size}",
            "Give a file by --camera, or leave out --tile and give --focal",
        )  # fmt: skip
    return fitting[0]


def read_gps(video: Video, path: Path | None, offset: float | None, warn: Callable[[str], None]) -> GpsTrack | None:
    """Smoothed GPS track in the frames' times; None without a file.

    Args:
        video: the video.
        path: GPS file.
        offset: seconds to add to its times; None: determined from both clocks.
        warn: receives a warning if the clocks can't be compared.

    Raises:
        InputError: the file can't be read.
    """
    if path is None:
        return None
    gps = gps_io.read(path)
    if offset is not None:
        gps = gps.shifted(offset)
    elif gps.times[0] > ABSOLUTE_S and video.start is not None:
        gps = video_clock(gps, video.start, warn)
    elif gps.times[0] > ABSOLUTE_S:
        warn("the video has no start time: its first frame is assumed to be at the first GPS fix (see --gps-offset)")
        gps = gps.shifted(-float(gps.times[0]))
    return smooth(gps)


def read_mask(video: Video, path: Path | None) -> U8 | None:
    """Ego-vehicle mask (H, W) in the frames' size, 0 where the car itself is visible; None without a file.

    Raises:
        InputError: the file can't be read.
    """
    if path is None:
        return None
    import cv2

    rgb = image.read_rgb(path)
    return cv2.resize(rgb[..., 0], (video.width, video.height), interpolation=cv2.INTER_NEAREST)


def tracker_of(camera: Camera, mask: U8 | None, params: TrackParams, inputs: Inputs) -> tuple[Tracker, str]:
    """Feature tracker (corners by Lucas-Kanade, or descriptors as in D3.2), and its description for the report."""
    views = VirtualViews(camera)
    if params.features == "corners":
        return trackers.named("corners", views, mask, params.count), ""
    detector = features.named(params.features, inputs.get("weights"))
    matcher = matchers.named(params.matcher, inputs.get("matcher_weights"))
    matchers.check(detector, matcher)
    tracker = trackers.named("descriptors", views, mask, params.count, detector, matcher)
    return tracker, f"{detector.describe()}; {matcher.describe()}"


TRACK = Step("track", VERSION, track_video, TrackParams, check=can_track, resumes=True, memory=(1.0, 0))

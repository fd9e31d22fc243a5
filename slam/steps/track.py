"""Track: a video, frame by frame, to poses and a map; goes on where it was killed."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.parameters import Focal, Pixels, Rate, Shift
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import U8, Camera, GpsTrack
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io.images import image
from scan2sim.slam import features, matchers, solvers, trackers
from scan2sim.slam.calibration import calibrate, lens
from scan2sim.slam.calibration.camera import Found, camera_of, found
from scan2sim.slam.mapping.map_file import Mapped
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.odometry.track_log import Recording, record
from scan2sim.slam.odometry.video_odometry import VERSION, track
from scan2sim.slam.odometry.virtual_cameras import Facets
from scan2sim.slam.trackers import Tracker
from scan2sim.slam.tracking_video import Recorder
from scan2sim.slam.trajectory.gps import smooth
from scan2sim.slam.video import Video, open_video


class Filmed(Params):
    """How a video was filmed, and what follows it."""

    camera: str = Field("auto", description="auto, equirectangular or pinhole.")
    focal: Focal | None = Field(None, description="Pixels, of a pinhole camera; default: EXIF's, or what fits best.")
    centre: tuple[Pixels, Pixels] | None = Field(None, description="Pixels; default: the middle.")
    k1: Annotated[float, Field(ge=-1, le=1)] | None = Field(None, description="Radial distortion, OpenCV's.")
    calibrate: bool = Field(False, description="Find focal length, centre and k1 that fit the whole drive.")
    fps: Rate = Field(10.0, description="Of a folder of pictures.")
    every: Annotated[int, Field(ge=1, le=1_000_000)] = Field(1, description="Take every Nth frame.")
    until: Annotated[float, Field(ge=0, le=1e7)] = Field(0.0, description="Seconds of the video; 0: all.")
    gps_offset: Shift | None = Field(None, description="Seconds to add to its times; first frame at 0.")
    backend: str = Field("lm", description="lm, or adam: the mission's.")
    features: str = Field("corners", description="corners (tracked), orb, rootsift, superpoint, aliked.")
    matcher: str = Field("nearest", description="nearest, superglue, lightglue.")


class TrackParams(OdometryParams, Filmed):
    """See `Filmed` and `OdometryParams`.

    Attributes:
        cameras: of which the one of the video's size is taken; set by the recipe from a tile.
        keep: keep all points, for loops, adjustment and COLMAP; set by the recipe.
        view: record what is tracked, and where.
    """

    cameras: tuple[dict[str, Any], ...] = ()
    keep: bool = False
    view: bool = False


def track_video(inputs: Inputs, params: TrackParams, out: Path, report: Report, checkpoint: Path) -> Done:
    """Follow `video` (a file, or a folder of pictures with `times`), with `gps`, `mask` and weights if there are any.

    Raises:
        InputError: one of them can't be read, or the camera isn't known.
        DataError: the video is too short.
    """
    video = open_video(inputs["video"], fps=params.fps, times=inputs.get("times"))
    mask = read_mask(video, inputs.get("mask"))

    def recorded() -> Recording:
        return record(video, mask, every=params.every, until=params.until or None, report=report)

    camera, own = video_camera(video, params, recorded, checkpoint / "lens.json")
    warnings: list[str] = [own.told()] if own is not None else []
    gps = read_gps(video, inputs.get("gps"), params.gps_offset, warnings.append)
    tracker, about = tracker_of(camera, mask, params, inputs)

    def start(warn: Callable[[str], None]) -> Odometry:
        return Odometry(
            camera, params, mask=mask, gps=gps, backend=params.backend, keep=params.keep, warn=warn, tracker=tracker
        )

    film = out / "view.mp4"
    with Recorder(film, fps=video.fps / params.every) if params.view else nullcontext() as recorder:
        run = track(
            video, start, every=params.every, until=params.until or None, state=checkpoint / "state.npz",
            watch=recorder, report=report,
        )  # fmt: skip
    wrong = _doubted(camera, run.odometry, recorded)
    warnings += [] if wrong is None or params.calibrate else [wrong]
    files = {"mapped": Mapped.of(run.odometry, run.names).write(out / "mapped.npz")}
    films = {"view": film} if params.view else {}
    return Done(
        files | films, run.facts() | ({"told": about} if about else {}) | (own.facts() if own else {}),
        [*warnings, *dict.fromkeys(run.warnings)],
    )  # fmt: skip


def _doubted(camera: Camera, odometry: Odometry, recorded: Callable[[], Recording]) -> str | None:
    """What is wrong with the lens, as turns tell; where the path was lost, by looking for it as if it weren't known."""
    if camera.model not in lens.MODELS:
        return None
    said = lens.told(camera, lens.better(camera, odometry.map.misfits))
    if calibrate.lost(odometry) < calibrate.LOST:
        return said
    return lens.told(camera, calibrate.looked_for(recorded())) or said


def can_track(params: TrackParams) -> None:
    """Raise a ScanError for backends that don't exist, or can't run here."""
    solvers.named(params.backend)
    if params.features != "corners":
        plugins.find(features.__name__, params.features, "track.features")
        plugins.find(matchers.__name__, params.matcher, "track.matcher")
    if params.view:
        need("--view", "av")


def video_camera(
    video: Video, params: TrackParams, recorded: Callable[[], Recording], kept: Path
) -> tuple[Camera, Found | None]:
    """Of the frames: as is said, or the one of a tile's that has their size; or as was found, which is `kept`.

    Raises:
        InputError: there is none.
    """
    said = _tile_camera(video, params) or camera_of(video, params.camera, params.focal, params.centre, params.k1)
    own = Found.read(kept) or found(video, said, recorded, calibrate=params.calibrate)
    if own is not None:
        own.write(kept)
        return own.camera, own
    assert said is not None
    return said, None


def _tile_camera(video: Video, params: TrackParams) -> Camera | None:
    for given in params.cameras:
        camera = Camera(**given | {"distortion": tuple(given["distortion"])})
        if (camera.width, camera.height) == (video.width, video.height):
            return camera
    if params.cameras:
        size = f"{video.width}x{video.height}"
        raise InputError(video.path, f"the tile has no camera of {size}", "Give --camera and --focal")
    return None


def read_gps(video: Video, path: Path | None, offset: float | None, warn: Callable[[str], None]) -> GpsTrack | None:
    """The track in the frames' times, smoothed.

    Args:
        offset: seconds that are added to its times; None: as the clocks of both tell.

    Raises:
        InputError: it can't be read.
    """
    if path is None:
        return None
    found = gps_io.read(path)
    absolute = found.times[0] > 1e8
    if offset is not None:
        found = found.shifted(offset)
    elif absolute and video.start is not None and abs(video.start - found.times[0]) < 3600:
        found = found.shifted(-video.start)
    elif absolute:
        warn("no clock of the video's: its first frame is taken to be at the first fix")
        found = found.shifted(-float(found.times[0]))
    return smooth(found)


def read_mask(video: Video, path: Path | None) -> U8 | None:
    """(H, W) of the frames' size, 0 where the car itself is seen.

    Raises:
        InputError: it can't be read.
    """
    if path is None:
        return None
    import cv2

    rgb = image.read_rgb(path)
    return cv2.resize(rgb[..., 0], (video.width, video.height), interpolation=cv2.INTER_NEAREST)


def tracker_of(camera: Camera, mask: U8 | None, params: TrackParams, inputs: Inputs) -> tuple[Tracker, str]:
    """What follows features: corners by Lucas-Kanade, or descriptors from frame to frame (D3.2); and what it is."""
    facets = Facets(camera)
    if params.features == "corners":
        return trackers.named("corners", facets, mask, params.count), ""
    detector = features.named(params.features, inputs.get("weights"))
    matcher = matchers.named(params.matcher, inputs.get("matcher_weights"))
    matchers.check(detector, matcher)
    tracker = trackers.named("descriptors", facets, mask, params.count, detector, matcher)
    return tracker, f"{detector.describe()}; {matcher.describe()}"


TRACK = Step("track", VERSION, track_video, TrackParams, check=can_track, resumes=True, memory=(1.0, 0))

"""Pipeline definition of a video's trajectory: the task graph of visual SLAM."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from pydantic import Field

from scan2sim.flows.pipelines.graph import Output, Task, TaskId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.step import Step
from scan2sim.pipeline.io import camera_calibrations
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.slam.steps.adjust import ADJUST
from scan2sim.slam.steps.georeference import GEOREFERENCE
from scan2sim.slam.steps.loops import LOOPS
from scan2sim.slam.steps.track import TRACK, Filmed

STEPS: tuple[Step, ...] = (TRACK, LOOPS, ADJUST, GEOREFERENCE)
ODOMETRY_GROUP = "odometry"
"""Group of the task that writes the trajectory without loop closures and bundle adjustment."""


class Video(Filmed):
    """A video and how to track it: the options of `scan2sim slam`, and table `[slam]` of a `drive.toml`."""

    video: Path = Field(description="Video file, or folder of images.")
    gps: Path | None = Field(
        None, description="GPS track that scales and georeferences the trajectory: GPX, NMEA, CSV, or a GoPro video."
    )
    local: bool = Field(False, description="Use GPS for the scale only: don't georeference the trajectory.")
    mask: Path | None = Field(None, description="Ego-vehicle mask: an image of the video's size, 0 on the car.")
    tile: Path | None = Field(
        None, description="Take the intrinsics from the camera of this tile that has the video's image size."
    )
    times: Path | None = Field(
        None, description="Text file with the times of a folder's images: seconds, one per line."
    )
    weights: Path | None = Field(
        None, description="Weights of the feature network: a file or folder (superpoint), a file (aliked)."
    )
    matcher_weights: Path | None = Field(
        None, description="Weights of the matching network: a folder (superglue), a file or folder (lightglue)."
    )
    colmap: bool = Field(False, description="Write the map also as a COLMAP model.")
    loops: bool = Field(False, description="Detect loop closures: places that the video passes more than once.")
    adjust: bool = Field(False, description="Run a global bundle adjustment of all keyframes at the end.")

    @property
    def camera_file(self) -> Path | None:
        """File of the camera, if `camera` names a file and not a camera model."""
        return camera_calibrations.file_of(self.camera)


def build_graph(video: Video, settings: Settings) -> list[Task]:
    """The task graph of a video, each task after those that it reads.

    Raises:
        SettingError: a setting that doesn't exist or is out of range.
        UnavailableError: a package that reads the video, or GPS data in it, is missing.
        InputError: the tile whose camera is used can't be read.
    """
    settings.check(STEPS)
    if video.video.is_file():
        require("a video", "av")
    if video.gps is not None:
        gps_io.reader(video.gps)
    tasks: list[Task] = []

    def add(
        step: Step,
        inputs: dict[str, Path | Output],
        group: str = "",
        context: dict[str, Any] | None = None,
        **given: Any,
    ) -> Output:
        tasks.append(Task(step, settings.params(step, group, context, **given), inputs, group))
        return Output(TaskId(step.name, group), "map")

    filmed = {name: getattr(video, name) for name in Filmed.model_fields.keys() & video.model_fields_set}
    if video.camera_file is not None:
        filmed.pop("camera", None)
    frames: dict[str, Path | Output] = {"video": video.video}
    if video.times is not None:
        frames["times"] = video.times
    beside = {name: getattr(video, name) for name in ("gps", "mask", "weights", "matcher_weights")}
    beside["camera"] = video.camera_file
    files: dict[str, Path | Output] = {name: path for name, path in beside.items() if path is not None}
    keep = video.colmap or video.loops or video.adjust or settings.params(GEOREFERENCE).colmap
    local: dict[str, Any] = {"georeference": False} if video.local else {}
    points: dict[str, Any] = {"colmap": True} if video.colmap else {}
    context = {"keep": keep, "cameras": _cameras(video.tile)}
    mapped = add(TRACK, frames | files, context=context, **filmed)
    if video.loops or video.adjust:
        add(GEOREFERENCE, {"map": mapped}, ODOMETRY_GROUP, **local)
    if video.loops:
        fps = settings.params(TRACK, **filmed).fps
        mapped = add(LOOPS, {"map": mapped, **frames}, context={"fps": fps})
    if video.adjust:
        mapped = add(ADJUST, {"map": mapped})
    add(GEOREFERENCE, {"map": mapped}, **points, **local)
    return tasks


def _cameras(tile: Path | None) -> tuple[dict[str, Any], ...]:
    """The distinct cameras of a tile."""
    if tile is None:
        return ()
    return tuple(asdict(camera) for camera in dict.fromkeys(view.camera for view in read_tile(tile).views))

"""Pipeline definition of the compression study: a task graph for each cell of tables 4 and 5 of 5G-ERA D3.2."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from bench.slam.study.encode import ENCODE
from bench.slam.study.evaluate import EVALUATE
from bench.slam.study.video_degradation import scaled
from scan2sim.flows.pipelines.graph import Output, Task, TaskId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.video import STEPS as VIDEO
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Params, Step
from scan2sim.pipeline.core.types import GpsTrack, Trajectory
from scan2sim.slam.calibration.camera import camera_of
from scan2sim.slam.steps.georeference import GEOREFERENCE
from scan2sim.slam.steps.track import TRACK
from scan2sim.slam.trajectory.evaluate import distance_along
from scan2sim.slam.trajectory.gps import smooth
from scan2sim.slam.video import Video, open_video

STEPS: tuple[Step, ...] = (ENCODE, EVALUATE)
SEGMENTS_M = (200.0, 400.0)
"""Lengths of the local errors' segments; 400 as in D3.2."""
MIN_TRUTH_SEGMENTS = 1.2
"""Minimum length of the ground truth, in segments; if it is shorter, the segments are left out."""
SHORTER_SEGMENTS_M = (100.0, 50.0, 20.0, 10.0)
"""Used for drives that are too short for any of `SEGMENTS_M`, the longest that fits."""


def _even(height: int) -> int:
    if height % 2:
        raise ValueError("H.264 needs even heights")
    return height


class Study(Params):
    """Parameters of the study: heights in pixels, bit rates in Mbit/s, frame rates in Hz; defaults as in D3.2."""

    source: Path
    truth: Path
    gps: Path | None = None
    mask: Path | None = None
    heights: tuple[Annotated[int, Field(ge=64, le=100_000), AfterValidator(_even)], ...] = Field(
        (512, 768, 1024, 1536), min_length=1
    )
    bitrates: tuple[Annotated[float, Field(ge=0.01, le=10_000)], ...] = Field(
        (1.0, 2.0, 5.0, 10.0, 20.0, 40.0), min_length=1
    )
    rates: tuple[Annotated[float, Field(ge=0.5, le=1000)], ...] = Field((30.0, 15.0), min_length=1)

    def video(self) -> Video:
        """The video of a file, of a folder of images, or of a drive's folder, whose lossless frames are preferred.

        Raises:
            InputError: it can't be read.
        """
        file, frames = self.source / "video.mp4", self.source / "frames"
        if self.source.is_dir() and file.is_file():
            video = open_video(file)
            return open_video(frames, fps=video.fps) if frames.is_dir() else video
        return open_video(self.source)


@dataclass(frozen=True)
class Cell:
    """A cell of the tables: a re-encoded video with a height in pixels, a bit rate in Mbit/s and a frame rate in Hz."""

    height: int
    bitrate: float
    rate: float

    @property
    def name(self) -> str:
        """Group of its tasks: height, bit rate and frame rate."""
        return f"h{self.height}_b{self.bitrate:g}_f{self.rate:g}"

    @property
    def label(self) -> str:
        """As users read it."""
        return f"{self.height} px, {self.bitrate:g} Mbit/s, {self.rate:g} fps"

    @property
    def cost(self) -> float:
        """Computing time relative to other cells of the same drive: linear in height, as measured from 256 to 768."""
        return self.rate * (500 + self.height)


def cells(study: Study) -> list[Cell]:
    """All cells of the tables, by descending frame rate, ascending height and bit rate."""
    axes = sorted(study.rates)[::-1], sorted(study.heights), sorted(study.bitrates)
    return [Cell(height, bitrate, rate) for rate, height, bitrate in product(*axes)]


def rejection(cell: Cell, video: Video) -> str | None:
    """Why a cell can't be made from a video: neither images nor frame rates are scaled up; None if it can."""
    if cell.height > video.height:
        return f"the source has only {video.height} px"
    if cell.rate > 1.02 * video.fps:
        return f"the source has only {video.fps:.4g} fps"
    return None


def build_graph(study: Study, video: Video, segments: tuple[float, ...], settings: Settings) -> list[Task]:
    """The task graph of all cells that can be made from the video, those that take the least time first.

    The group of a task is the name of its cell.

    Args:
        study: parameters of the study.
        video: its source.
        segments: lengths of the segments of the local errors in metres (`segments_of`).
        settings: of the steps.

    Raises:
        SettingError: a setting that doesn't exist or is out of range.
    """
    settings.check((*VIDEO, *STEPS))
    tasks: list[Task] = []
    for cell in sorted(cells(study), key=lambda cell: cell.cost):
        if rejection(cell, video) is None:
            tasks += _cell_tasks(cell, study, video, segments, settings)
    return tasks


def _cell_tasks(cell: Cell, study: Study, video: Video, segments: tuple[float, ...], settings: Settings) -> list[Task]:
    """The tasks of a cell: encode the video, track it, place the trajectory, evaluate it against the ground truth."""
    camera = camera_of(video, "auto", None, None)
    if camera is None:
        raise InputError(
            video.path, "is not a 360 degree video, so its camera is unknown", "Give a video twice as wide as high"
        )
    name, camera = cell.name, scaled(camera, cell.height)
    size = (camera.width, camera.height)
    gps_and_mask: dict[str, Path | Output] = {
        key: path for key, path in (("gps", study.gps), ("mask", study.mask)) if path
    }

    def add(
        step: Step, inputs: Mapping[str, Path | Output], context: dict[str, Any] | None = None, **given: Any
    ) -> Task:
        return Task(step, settings.params(step, name, context, **given), inputs, name)

    def output_of(step: Step, output: str) -> dict[str, Output]:
        return {output: Output(TaskId(step.name, name), output)}

    encoded = {"size": size, "bitrate": cell.bitrate, "rate": cell.rate, "fps": video.fps}
    return [
        add(ENCODE, {"video": video.path}, encoded),
        add(TRACK, output_of(ENCODE, "video") | gps_and_mask, {"cameras": (asdict(camera),)}, gps_offset=0.0),
        add(GEOREFERENCE, output_of(TRACK, "map"), georeference=False),
        add(EVALUATE, output_of(GEOREFERENCE, "trajectory") | {"truth": study.truth}, {"segments": segments}),
    ]


def truth_length(video: Video, truth: Trajectory | GpsTrack) -> float:
    """Length of the ground truth's path during the video, metres."""
    times = truth.times
    if video.count:
        times = times[(times >= 0) & (times <= video.count / video.fps)]
    trajectory = smooth(truth, 2.0) if isinstance(truth, GpsTrack) else truth
    positions = trajectory.at(times)
    positions = positions[np.isfinite(positions).all(axis=1)]
    return float(distance_along(positions[:, :2])[-1]) if len(positions) else 0.0


def segments_of(length: float) -> tuple[float, ...]:
    """Lengths of the local errors' segments on a path of a length, metres: 200 and 400, or one that is shorter."""
    fitting = [s for s in (*SEGMENTS_M, *SHORTER_SEGMENTS_M) if length >= MIN_TRUTH_SEGMENTS * s]
    return tuple(s for s in SEGMENTS_M if s in fitting) or (max(fitting, default=SHORTER_SEGMENTS_M[-1]),)

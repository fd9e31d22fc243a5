"""Which steps make the study of compression: a graph a cell of D3.2's tables 4 and 5."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from scan2sim.flows.pipelines.graph import Node, NodeId, Output
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.video import STEPS as VIDEO
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Params, Step
from scan2sim.pipeline.core.types import GpsTrack, Trajectory
from scan2sim.slam.calibration.camera import camera_of
from scan2sim.slam.steps.encode import ENCODE
from scan2sim.slam.steps.evaluate import EVALUATE
from scan2sim.slam.steps.place import PLACE
from scan2sim.slam.steps.track import TRACK
from scan2sim.slam.trajectory.evaluate import SEGMENT, way
from scan2sim.slam.trajectory.gps import smooth
from scan2sim.slam.video import Video, open_video
from scan2sim.slam.video_degradation import scaled

STEPS: tuple[Step, ...] = (ENCODE, EVALUATE)
ROOM = 1.2
"""The truth must be this many times as long as a segment, or else shorter segments are taken."""
SHORTER = (200.0, 100.0, 50.0, 20.0, 10.0)


def _even(height: int) -> int:
    if height % 2:
        raise ValueError("H.264 needs even heights")
    return height


class Study(Params):
    """What is studied; heights in pixels, bit rates in Mbit/s, rates in frames a second; all as in D3.2's tables."""

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
        """The video of a file, of a folder of pictures, or of a drive; pictures without loss are preferred.

        Raises:
            InputError: it can't be read.
        """
        file, frames = self.source / "video.mp4", self.source / "frames"
        if self.source.is_dir() and file.is_file():
            made = open_video(file)
            return open_video(frames, fps=made.fps) if frames.is_dir() else made
        return open_video(self.source)


@dataclass(frozen=True)
class Cell:
    """A video to make and to follow: `height` in pixels, `bitrate` in Mbit/s, `rate` in frames a second."""

    height: int
    bitrate: float
    rate: float

    @property
    def name(self) -> str:
        """Of its node: rows, megabits a second and frames a second."""
        return f"h{self.height}_b{self.bitrate:g}_f{self.rate:g}"


def cells(study: Study) -> list[Cell]:
    """All cells of the tables: rates descending, heights and bit rates ascending."""
    axes = sorted(study.rates)[::-1], sorted(study.heights), sorted(study.bitrates)
    return [Cell(height, bitrate, rate) for rate, height, bitrate in product(*axes)]


def refused(cell: Cell, video: Video) -> str | None:
    """Why a cell can't be made of a video: nothing is scaled up, no frame shown twice."""
    if cell.height > video.height:
        return f"the source has only {video.height} px"
    if cell.rate > 1.02 * video.fps:
        return f"the source has only {video.fps:.4g} fps"
    return None


def recipe(study: Study, video: Video, segment: float, settings: Settings) -> list[Node]:
    """The graph of all cells that can be made of the video; a node's group is its cell's name.

    Args:
        study: what is asked.
        video: its source.
        segment: metres, of the local error (`segment_of`).
        settings: of the steps.

    Raises:
        SettingError: a setting that doesn't exist or is out of range.
    """
    settings.check((*VIDEO, *STEPS))
    nodes: list[Node] = []
    for cell in cells(study):
        if refused(cell, video) is None:
            nodes += _of_cell(cell, study, video, segment, settings)
    return nodes


def _of_cell(cell: Cell, study: Study, video: Video, segment: float, settings: Settings) -> list[Node]:
    """A cell's video made, followed, placed and compared with the truth."""
    camera = camera_of(video, "auto", None, None)
    if camera is None:
        raise InputError(video.path, "is no 360 video: its camera isn't known", "Give one twice as wide as high")
    name, camera = cell.name, scaled(camera, cell.height)
    size = (camera.width, camera.height)
    beside: dict[str, Path | Output] = {key: path for key, path in (("gps", study.gps), ("mask", study.mask)) if path}

    def add(step: Step, inputs: Mapping[str, Path | Output], **given: Any) -> Node:
        return Node(step, settings.params(step, name, **given), inputs, name)

    def made(step: Step, output: str) -> dict[str, Output]:
        return {output: Output(NodeId(step.name, name), output)}

    return [
        add(ENCODE, {"video": video.path}, size=size, bitrate=cell.bitrate, rate=cell.rate, fps=video.fps),
        add(TRACK, made(ENCODE, "video") | beside, cameras=(asdict(camera),), gps_offset=0.0),
        add(PLACE, made(TRACK, "mapped"), georeference=False),
        add(EVALUATE, made(PLACE, "trajectory") | {"truth": study.truth}, segment=segment),
    ]


def segment_of(video: Video, truth: Trajectory | GpsTrack) -> float:
    """D3.2's 400 m, or less where the truth is too short while the video lasts."""
    times = truth.times
    if video.count:
        times = times[(times >= 0) & (times <= video.count / video.fps)]
    track_ = smooth(truth, 2.0) if isinstance(truth, GpsTrack) else truth
    places = track_.at(times)
    places = places[np.isfinite(places).all(axis=1)]
    length = float(way(places[:, :2])[-1]) if len(places) else 0.0
    return next((s for s in (SEGMENT, *SHORTER) if length >= ROOM * s), SHORTER[-1])

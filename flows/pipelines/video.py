"""Which steps make a trajectory of a video, in order: the whole graph on one page."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from pydantic import Field

from scan2sim.flows.pipelines.graph import Node, NodeId, Output
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.step import Step
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.slam.steps.adjust import ADJUST
from scan2sim.slam.steps.loops import LOOPS
from scan2sim.slam.steps.place import PLACE
from scan2sim.slam.steps.track import TRACK, Filmed

STEPS: tuple[Step, ...] = (TRACK, LOOPS, ADJUST, PLACE)
ALONE = "odometry"
"""Group of the trajectory as it was before loops and adjustment."""


class Video(Filmed):
    """A video and what is asked of it: the options of `scan2sim slam`, and `[slam]` of a `drive.toml`."""

    video: Path = Field(description="A video file, or a folder of pictures.")
    gps: Path | None = Field(None, description="GPX, NMEA, CSV, or a GoPro video: ties the scale, and places it.")
    local: bool = Field(False, description="Don't place it where GPS says: scale alone.")
    mask: Path | None = Field(None, description="Picture: 0 where the car itself is seen.")
    tile: Path | None = Field(None, description="Take the camera of this tile that has the video's size.")
    times: Path | None = Field(None, description="Of a folder's pictures: seconds, one a line.")
    weights: Path | None = Field(None, description="Your file of the features' weights.")
    matcher_weights: Path | None = Field(None, description="Your file of the matcher's.")
    colmap: bool = Field(False, description="Write the map as a COLMAP model, too.")
    loops: bool = Field(False, description="Recognise places that were passed before.")
    adjust: bool = Field(False, description="Adjust all keyframes at once in the end.")
    view: bool = Field(False, description="Record what is tracked, and where: view.mp4.")


def recipe(video: Video, settings: Settings) -> list[Node]:
    """The graph of a video, each node after those that it reads.

    Raises:
        SettingError: a setting that doesn't exist or is out of range.
        UnavailableError: a package is missing that reads the video, or GPS in one.
        InputError: the tile whose camera is asked for can't be read.
    """
    settings.check(STEPS)
    if video.video.is_file():
        need("a video", "av")
    if video.gps is not None:
        gps_io.reader(video.gps)
    nodes: list[Node] = []

    def add(step: Step, inputs: dict[str, Path | Output], group: str = "", **given: Any) -> Output:
        nodes.append(Node(step, settings.params(step, group, **given), inputs, group))
        return Output(NodeId(step.name, group), "mapped")

    filmed = {name: getattr(video, name) for name in Filmed.model_fields.keys() & video.model_fields_set}
    frames: dict[str, Path | Output] = {"video": video.video}
    if video.times is not None:
        frames["times"] = video.times
    beside = ("gps", "mask", "weights", "matcher_weights")
    files: dict[str, Path | Output] = {name: path for name in beside if (path := getattr(video, name)) is not None}
    keep = video.colmap or video.loops or video.adjust or settings.params(PLACE).colmap
    local: dict[str, Any] = {"georeference": False} if video.local else {}
    film: dict[str, Any] = {"view": True} if video.view else {}
    points: dict[str, Any] = {"colmap": True} if video.colmap else {}
    mapped = add(TRACK, frames | files, keep=keep, cameras=_cameras(video.tile), **filmed, **film)
    if video.loops or video.adjust:
        add(PLACE, {"mapped": mapped}, ALONE, **local)
    if video.loops:
        mapped = add(LOOPS, {"mapped": mapped, **frames}, fps=settings.params(TRACK, **filmed).fps)
    if video.adjust:
        mapped = add(ADJUST, {"mapped": mapped})
    add(PLACE, {"mapped": mapped}, **points, **local)
    return nodes


def _cameras(tile: Path | None) -> tuple[dict[str, Any], ...]:
    """All cameras of a tile, each once."""
    if tile is None:
        return ()
    return tuple(asdict(camera) for camera in dict.fromkeys(view.camera for view in read_tile(tile).views))

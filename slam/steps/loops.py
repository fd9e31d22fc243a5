"""Step `loops`: detects loop closures in a video and corrects the path by pose graph optimization."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.parameters import Rate
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.slam.global_map.loop_closure import KeyframeIndex, correct_by_loops
from scan2sim.slam.global_map.map_file import MapCheckpoint
from scan2sim.slam.video import open_video
from scan2sim.slam.virtual_cameras import VirtualViews


class LoopsParams(Params):
    """Settings of loop closure.

    Attributes:
        fps: frames per second of a folder of images; set by the pipeline.
    """

    fps: Rate = 10.0


def close_loops(inputs: Inputs, params: LoopsParams, out: Path, report: Report) -> Done:
    """Detect loop closures among the keyframes of `map`, by their frames in `video`, and correct the path."""
    checkpoint = MapCheckpoint.read(inputs["map"])
    video = open_video(inputs["video"], fps=params.fps, times=inputs.get("times"))
    views = VirtualViews(checkpoint.camera)
    index = KeyframeIndex(views)
    keyframes = {keyframe.time: number for number, keyframe in enumerate(checkpoint.map.keyframes)}
    for frame in video.frames():
        if frame.time in keyframes:
            index.add(keyframes[frame.time], views.images(frame.grey))
            report(0.9 * len(index.features) / len(keyframes), f"{len(index.features)} of {len(keyframes)} keyframes")
    metrics = correct_by_loops(checkpoint, index)
    return Done({"map": checkpoint.write(out / "map.npz")}, dict(metrics))


LOOPS = Step("loops", 1, close_loops, LoopsParams, memory=(1.0, 0))

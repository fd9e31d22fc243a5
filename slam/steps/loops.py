"""Loops: places that the video passed before are recognised, and the path is bent so that they coincide."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.parameters import Rate
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.slam.mapping.loop_closure import Places, close
from scan2sim.slam.mapping.map_file import Mapped
from scan2sim.slam.odometry.virtual_cameras import Facets
from scan2sim.slam.video import open_video


class LoopsParams(Params):
    """How the video is read.

    Attributes:
        fps: of a folder of pictures; set by the recipe.
    """

    fps: Rate = 10.0


def close_loops(inputs: Inputs, params: LoopsParams, out: Path, report: Report) -> Done:
    """Bend the keyframes' path of `mapped`, whose frames are read from `video` (and `times`) again."""
    mapped = Mapped.read(inputs["mapped"])
    video = open_video(inputs["video"], fps=params.fps, times=inputs.get("times"))
    facets = Facets(mapped.camera)
    places = Places(facets)
    keyframes = {keyframe.time: number for number, keyframe in enumerate(mapped.map.keyframes)}
    for frame in video.frames():
        if frame.time in keyframes:
            places(keyframes[frame.time], facets.pictures(frame.grey))
            report(0.9 * len(places.seen) / len(keyframes), f"{len(places.seen)} of {len(keyframes)} keyframes")
    facts = close(mapped, places)
    return Done({"mapped": mapped.write(out / "mapped.npz")}, dict(facts))


LOOPS = Step("loops", 1, close_loops, LoopsParams, memory=(1.0, 0))

"""A flight through a finished world as a video: along its road from the air down, by the project's own renderer."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from scan2sim.pipeline.camera import renderer
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F64, Mesh
from scan2sim.pipeline.io.images.video import Encoder
from scan2sim.pipeline.io.trajectory import replacing
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.pipeline.simulation.spawn import courses

FPS = 24
OVER = {"path": 0.5, "lane": 2.5, "road": 2.5}
"""Metres above the places of a course: a recording device's own height counts for a path."""
AHEAD = 12.0
"""Metres ahead of the eye that it looks at, on the course."""
SHORT = 25.0, 0.4
"""Metres of the course, and its share at most, that are left in the end: there is something ahead to the last."""
SOFT = 6.0
"""Metres of the course over which the eye's way is averaged."""
DOWN = 0.25
"""Share of the flight that goes down from the air."""
HIGH = 15.0
"""Metres that it begins higher."""
SAMPLES = 2
"""Rays a pixel each way: textures of far surfaces would flicker otherwise."""


def film(scene: Scene, file: Path, seconds: float, width: int, report: Report) -> None:
    """Render a flight and write it as MP4 (H.264), whole or not at all.

    Args:
        scene: the world.
        file: of the video.
        seconds: that it takes.
        width: of the picture, pixels; it is 16 to 9.
        report: progress.

    Raises:
        UnavailableError: PyAV isn't installed.
        SpaceError: the file can't be written.
    """
    import cv2

    size = width // 2 * 2, width * 9 // 32 * 2
    camera = renderer.pinhole(*size)
    world = renderer.Renderer(
        [placed(tile.folder / group, tile.offset) for tile in scene.tiles for group in tile.groups]
    )
    poses = flight(scene, round(seconds * FPS))
    with replacing(file) as fresh, Encoder(fresh, size, FPS, preset="medium", crf="20") as encoder:
        for i, pose in enumerate(poses):
            report(i / len(poses), f"{i / FPS:.1f} s")
            picture = world.view(camera, pose, samples=SAMPLES).rgb
            encoder.add(np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2YUV_I420), np.uint8), i / FPS)


def flight(scene: Scene, count: int) -> list[F64]:
    """Poses (4, 4) of so many frames, world metres: along the longest course, else in a circle around the middle."""
    ways = courses(scene)
    if not ways:
        return _circle(scene, count)
    way = ways[0]
    eye = _evenly(way.places + (0, 0, OVER[way.by]))
    step = float(np.linalg.norm(np.diff(eye, axis=0), axis=1).mean())
    eye = _soft(eye, max(1, round(SOFT / step)))
    reach = max(1, round(AHEAD / step))
    beyond = eye[-1] + np.outer(np.arange(1, reach + 1), eye[-1] - eye[-2])
    target = np.concatenate([eye, beyond])[reach:] - (0, 0, OVER[way.by] / 2)
    share = np.linspace(0, 1, count)
    left = min(SHORT[0] / step, SHORT[1] * len(eye))
    at = share * (len(eye) - 1 - left)
    rise = HIGH * np.clip(1 - share / DOWN, 0, 1) ** 2

    def line(of: F64) -> F64:
        return np.column_stack([np.interp(at, np.arange(len(of)), of[:, k]) for k in range(3)])

    lines = line(eye), line(target)
    return [renderer.look_at(e + (0, 0, up), t) for e, t, up in zip(*lines, rise, strict=True)]


def placed(folder: Path, offset: tuple[float, float, float]) -> renderer.Body:
    """A textured mesh of a tile in its place in the world."""
    body = renderer.textured(folder)
    mesh: Mesh = body.mesh
    return replace(body, mesh=replace(mesh, vertices=(mesh.vertices + np.asarray(offset)).astype(np.float32)))


def _circle(scene: Scene, count: int) -> list[F64]:
    low = np.min([np.add(tile.low, tile.offset) for tile in scene.tiles], axis=0)
    high = np.max([np.add(tile.high, tile.offset) for tile in scene.tiles], axis=0)
    middle, reach = (low + high) / 2, 0.7 * float(np.linalg.norm((high - low)[:2]))
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [renderer.look_at(middle + (reach * np.cos(a), reach * np.sin(a), 0.5 * reach), middle) for a in turns]


def _evenly(places: F64) -> F64:
    """Places along the same line, evenly spaced."""
    along = np.concatenate([[0.0], np.cumsum([np.linalg.norm(b - a) for a, b in pairwise(places)])])
    at = np.linspace(0, along[-1], max(2, 2 * len(places)))
    return np.column_stack([np.interp(at, along, places[:, k]) for k in range(3)])


def _soft(places: F64, half: int) -> F64:
    """Places, each the mean of those up to `half` before and behind, as many on both sides."""
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(places, axis=0)])
    index = np.arange(len(places))
    wide = np.minimum(half, np.minimum(index, len(places) - 1 - index))
    return (total[index + wide + 1] - total[index - wide]) / (2 * wide + 1)[:, None]

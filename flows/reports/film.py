"""Renders a flight through a finished world as a video: a descent from the air, then along the road."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from scan2sim.pipeline.camera import renderer
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F64, U8, Camera
from scan2sim.pipeline.io.images.video import Encoder
from scan2sim.pipeline.io.trajectory import atomic_write
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.pipeline.io.worlds.spawn import courses

FPS = 24
"""Frames per second of the video."""
SAMPLES_PER_AXIS = 2
"""Rays per pixel and axis (supersampling): textures of distant surfaces would flicker with one."""


@dataclass(frozen=True)
class FlightShape:
    """Shape of a flight along a course (path, lane or road).

    Attributes:
        height_m: camera height above a course, by its source; a path already is at the height of the recording device.
        look_ahead_m: distance along the course to the point that the camera looks at.
        end_margin_m, end_margin_share: length at the end of the course that is not flown, so that something is ahead to
            the last frame: metres, and maximum share of the course.
        smoothing_m: length of the moving average of the camera's path.
        descent_share: share of the flight in which the camera descends.
        start_height_m: additional height at the start.
    """

    height_m: Mapping[str, float] = field(default_factory=lambda: {"path": 0.5, "lane": 2.5, "road": 2.5})
    look_ahead_m: float = 12.0
    end_margin_m: float = 25.0
    end_margin_share: float = 0.4
    smoothing_m: float = 6.0
    descent_share: float = 0.25
    start_height_m: float = 15.0


SHAPE = FlightShape()


def film(scene: Scene, file: Path, seconds: float, width: int, report: Report) -> None:
    """Render a flight and write it as MP4 (H.264); the file appears only when it is complete.

    Args:
        scene: the world.
        file: video file to write.
        seconds: duration of the flight.
        width: image width in pixels; the aspect ratio is 16:9.
        report: receives the progress.

    Raises:
        UnavailableError: PyAV isn't installed.
        SpaceError: the file can't be written.
    """
    import cv2

    size = width // 2 * 2, width * 9 // 32 * 2
    view = _view(scene, renderer.pinhole(*size))
    poses = flight(scene, round(seconds * FPS))
    with atomic_write(file) as fresh, Encoder(fresh, size, FPS, preset="medium", crf="20") as encoder:
        for i, pose in enumerate(poses):
            report(i / len(poses), f"{i / FPS:.1f} s")
            encoder.add(np.asarray(cv2.cvtColor(view(pose), cv2.COLOR_RGB2YUV_I420), np.uint8), i / FPS)


def _view(scene: Scene, camera: Camera) -> Callable[[F64], U8]:
    """Function from poses (4, 4) in world metres to images (H, W, 3) of the splats or, without any, the surfaces."""
    if scene.has_splats:
        from scan2sim.texturing.world_camera import WorldCamera  # loads numba

        world = WorldCamera(scene)
        return lambda pose: world.render(pose, camera, samples=SAMPLES_PER_AXIS).rgb
    bodies = [renderer.placed(tile.folder / group, tile.offset) for tile in scene.tiles for group in tile.groups]
    surfaces = renderer.Renderer(bodies, scene.sky)
    return lambda pose: surfaces.view(camera, pose, samples=SAMPLES_PER_AXIS).rgb


def flight(scene: Scene, count: int) -> list[F64]:
    """Camera poses (4, 4) of `count` frames in world metres: along the longest course, else on a circle."""
    ways = courses(scene)
    if not ways:
        return _circle(scene, count)
    way = ways[0]
    height = SHAPE.height_m[way.by]
    eye = _resample_evenly(way.places + (0, 0, height))
    spacing = float(np.linalg.norm(np.diff(eye, axis=0), axis=1).mean())
    eye = _moving_average(eye, max(1, round(SHAPE.smoothing_m / spacing)))
    ahead = max(1, round(SHAPE.look_ahead_m / spacing))
    beyond = eye[-1] + np.outer(np.arange(1, ahead + 1), eye[-1] - eye[-2])
    target = np.concatenate([eye, beyond])[ahead:] - (0, 0, height / 2)
    share = np.linspace(0, 1, count)
    margin = min(SHAPE.end_margin_m / spacing, SHAPE.end_margin_share * len(eye))
    at = share * (len(eye) - 1 - margin)
    rise = SHAPE.start_height_m * np.clip(1 - share / SHAPE.descent_share, 0, 1) ** 2

    def interpolated(points: F64) -> F64:
        return np.column_stack([np.interp(at, np.arange(len(points)), points[:, k]) for k in range(3)])

    lines = interpolated(eye), interpolated(target)
    return [renderer.look_at(e + (0, 0, up), t) for e, t, up in zip(*lines, rise, strict=True)]


def _circle(scene: Scene, count: int) -> list[F64]:
    """Camera poses (4, 4) on a circle around the world, looking at its middle."""
    low = np.min([np.add(tile.low, tile.offset) for tile in scene.tiles], axis=0)
    high = np.max([np.add(tile.high, tile.offset) for tile in scene.tiles], axis=0)
    middle, radius = (low + high) / 2, 0.7 * float(np.linalg.norm((high - low)[:2]))
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [renderer.look_at(middle + (radius * np.cos(a), radius * np.sin(a), 0.5 * radius), middle) for a in angles]


def _resample_evenly(points: F64) -> F64:
    """Points at even spacing along the polyline through `points` (N, 3)."""
    along = np.concatenate([[0.0], np.cumsum([np.linalg.norm(b - a) for a, b in pairwise(points)])])
    at = np.linspace(0, along[-1], max(2, 2 * len(points)))
    return np.column_stack([np.interp(at, along, points[:, k]) for k in range(3)])


def _moving_average(points: F64, half_width: int) -> F64:
    """Moving average of points (N, 3) over `half_width` neighbours on either side; the window shrinks at the ends."""
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(points, axis=0)])
    index = np.arange(len(points))
    wide = np.minimum(half_width, np.minimum(index, len(points) - 1 - index))
    return (total[index + wide + 1] - total[index - wide]) / (2 * wide + 1)[:, None]

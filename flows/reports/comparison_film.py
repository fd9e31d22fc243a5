"""A film of a world with its traffic as the recording's own camera saw it, beside the recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from scan2sim.flows.reports.film import SAMPLES_PER_AXIS
from scan2sim.pipeline.camera import renderer
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import U8, Frame, Mesh, View
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.images.video import Encoder
from scan2sim.pipeline.io.trajectory import atomic_write
from scan2sim.pipeline.io.worlds.scene import BACKDROP, Scene
from scan2sim.pipeline.io.worlds.scene_traffic import scenario_of
from scan2sim.pipeline.scenario.scenario import Scenario
from scan2sim.pipeline.scenario.shapes import faces_of

DEFAULT_FPS = 10.0
"""Frames per second of photos without times."""
MAX_FPS, MIN_FPS = 60.0, 1.0


def comparison_film(scene: Scene, photos: Mapping[str, Path], file: Path, width: int, report: Report) -> None:
    """Render the world at the poses and times of a recording's photos, and write it beside them as MP4 (H.264).

    The photo is above the world if it is wider than high, else to its left. The ego isn't shown: it carries the camera.

    Args:
        scene: the world, with the photos' poses.
        photos: photo files by the names of the views.
        file: video file to write; appears when it is complete.
        width: width of each of the two pictures in pixels.
        report: receives the progress.

    Raises:
        DataError: none of the world's photos is among `photos`.
        UnavailableError: PyAV isn't installed.
        SpaceError: the file can't be written.
    """
    import cv2

    views = _first_camera([view for view in _views(scene) if view.name in photos])
    if not views:
        raise DataError(
            scene.name,
            "none of its photos is in the tile given to --compare",
            "Name the tile that the world was made from",
        )
    traffic = scenario_of(scene)
    world = renderer.Renderer(
        [renderer.placed(tile.folder / group, tile.offset) for tile in scene.tiles for group in tile.groups], scene.sky
    )
    behind = renderer.Renderer(
        [
            renderer.placed(tile.folder / BACKDROP, tile.offset)
            for tile in scene.with_dome
            if (tile.folder / BACKDROP).is_dir()
        ],
        scene.sky,
    )
    wide = views[0].camera.width > views[0].camera.height
    camera = views[0].camera.resized(
        width // 2 * 2, round(width * views[0].camera.height / views[0].camera.width) // 2 * 2
    )
    size = (camera.width, 2 * camera.height) if wide else (2 * camera.width, camera.height)
    fps = _fps(views)
    with atomic_write(file) as fresh, Encoder(fresh, size, fps, preset="medium", crf="18") as encoder:
        for i, view in enumerate(views):
            report(i / len(views), view.name)
            photo = cv2.resize(
                image.read_rgb(photos[view.name]), (camera.width, camera.height), interpolation=cv2.INTER_AREA
            )
            shown = view_of(world, behind, traffic, replace(view, camera=camera))
            both = np.concatenate([photo, shown], axis=0 if wide else 1)
            encoder.add(np.asarray(cv2.cvtColor(both, cv2.COLOR_RGB2YUV_I420), np.uint8), i / fps)


def view_of(world: renderer.Renderer, behind: renderer.Renderer, traffic: Scenario, view: View) -> U8:
    """The frame (H, W, 3) that a photo's camera sees: surfaces, what is behind them, and the traffic of its time."""
    picture = world.view(view.camera, view.T_world_cam, samples=SAMPLES_PER_AXIS)
    rgb, near = picture.rgb, picture.range
    layers = [behind] if behind.bodies else []
    if view.time is not None and (bodies := traffic_bodies(traffic, view.time)):
        layers.append(renderer.Renderer(bodies))
    for layer in layers:
        over = layer.view(view.camera, view.T_world_cam, samples=SAMPLES_PER_AXIS)
        rgb = np.where((over.range < near)[..., None], over.rgb, rgb)
        near = np.minimum(near, over.range)
    return np.asarray(rgb, np.uint8)


def traffic_bodies(traffic: Scenario, clock: float) -> list[renderer.Body]:
    """Shapes of the moving road users in world metres at a time of the recording's clock."""
    time = clock - traffic.start
    found = []
    for actor in traffic.moving:
        if not actor.begin <= time <= actor.end:
            continue
        x, y, z, yaw = actor.track.at([time])[0]
        c, s = np.cos(yaw), np.sin(yaw)
        corners, colours = faces_of(actor.track)
        turned = corners @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + (x, y, z)
        triangles = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
        mesh = Mesh(Frame(), turned.reshape(-1, 3).astype(np.float32), triangles)
        found.append(renderer.Body(mesh, colour=colours))
    return found


def _views(scene: Scene) -> list[View]:
    """The photos' poses of all tiles in world metres."""
    found = []
    for tile in scene.tiles:
        for view in tile.views():
            pose = view.T_world_cam.copy()
            pose[:3, 3] += tile.offset
            found.append(View(view.name, view.camera, pose, view.photo, view.mask, view.time))
    return found


def _first_camera(views: list[View]) -> list[View]:
    """The photos of the first one's size, in the order of time."""
    same = [v for v in views if (v.camera.width, v.camera.height) == (views[0].camera.width, views[0].camera.height)]
    return sorted(same, key=lambda view: (view.time is None, view.time or 0.0, view.name))


def _fps(views: list[View]) -> float:
    times = [view.time for view in views if view.time is not None]
    steps = np.diff(times)
    return (
        float(np.clip(1 / np.median(steps), MIN_FPS, MAX_FPS)) if len(steps) and np.median(steps) > 0 else DEFAULT_FPS
    )

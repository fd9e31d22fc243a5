"""Camera of a simulated vehicle: renders the textured surfaces of a finished world from the vehicle's current pose.

Location: the world's folder, as given to `scan2sim run` or `survey` by --out. Cameras of one world share its data.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

from scan2sim.pipeline.camera.renderer import pinhole
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.services.teleoperation.cameras import CameraFrame, View, frame_times
from scan2sim.services.teleoperation.sim.world_renderer import World, WorldRenderer, build_world

_worlds: dict[Path, World] = {}
_loading = threading.Lock()


def frames(view: View) -> Iterator[CameraFrame]:
    """Yield frames without end; capture times are those of the vehicle's pose."""
    renderer = WorldRenderer(
        _load(Path(view.location).resolve()), pinhole(view.width, view.height, field=view.mount.field)
    )
    mounted = view.mount.pose()
    for captured in frame_times(view.fps):
        yield CameraFrame(renderer.view(view.pose() @ mounted), captured)


def _load(folder: Path) -> World:
    with _loading:
        if folder not in _worlds:
            _worlds.clear()
            scene = read_scene(folder)
            _worlds[folder] = build_world(
                (shape, tile.offset) for tile in scene.tiles for shape in tile.textured().values()
            )
        return _worlds[folder]

"""Camera of a simulated vehicle: renders a finished world from the vehicle's current pose, as photographs show it.

Location: the world's folder, as given to `scan2sim run` or `survey` by --out. A world with splats shows these; one
without has only its textured surfaces (`surfaces`). Cameras of one world share its data and take turns.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

from scan2sim.pipeline.camera.renderer import pinhole
from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.types import F64, U8, Camera
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.services.teleoperation.cameras import CameraFrame, OpenWorld, SplatWorld, View, frame_times, surfaces

_worlds: dict[Path, SharedWorld] = {}
_loading = threading.Lock()


class SharedWorld:
    """A world with splats that cameras in several threads render, one at a time: each uses all cores."""

    def __init__(self, world: SplatWorld) -> None:
        self._world, self._rendering = world, threading.Lock()

    def colours(self, T_world_cam: F64, camera: Camera) -> U8:
        """Image (H, W, 3), RGB, from a camera pose."""
        with self._rendering:
            return self._world.colours(T_world_cam, camera)


def frames(view: View) -> Iterator[CameraFrame]:
    """Yield frames without end; capture times are those of the vehicle's pose.

    Raises:
        UnavailableError: the world has splats, and this program has no renderer for them.
    """
    folder = Path(view.location).resolve()
    if not read_scene(folder).has_splats:
        yield from surfaces.frames(view)
        return
    if view.open_world is None:
        remedy = f"Run `scan2sim teleop vehicle`, or show the surfaces: surfaces:{view.location}"
        raise UnavailableError("camera world", "this program can't render splats", remedy)
    world, camera = _shared(folder, view.open_world), pinhole(view.width, view.height, field=view.mount.field)
    mounted = view.mount.pose()
    for captured in frame_times(view.fps):
        yield CameraFrame(world.colours(view.pose() @ mounted, camera), captured)


def _shared(folder: Path, open_world: OpenWorld) -> SharedWorld:
    with _loading:
        if folder not in _worlds:
            _worlds.clear()
            _worlds[folder] = SharedWorld(open_world(folder))
        return _worlds[folder]

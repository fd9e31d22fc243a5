"""A simulated vehicle's camera: a finished world as it is seen from where the vehicle is now.

`where` is the world's folder, as `scan2sim run` or `survey` were given it by --out. Cameras of one world share it.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.camera.renderer import pinhole
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.services.teleoperation.cameras import Mount, Picture, View, ticks
from scan2sim.services.teleoperation.sim.world_renderer import Eye, World, world

_worlds: dict[Path, World] = {}
_loading = threading.Lock()


def pictures(view: View) -> Iterator[Picture]:
    """Without end; the time is that of the vehicle's pose."""
    eye = Eye(_load(Path(view.where).resolve()), pinhole(view.width, view.height, field=view.mount.field))
    mounted = mount(view.mount)
    for captured in ticks(view.fps):
        yield Picture(eye.view(view.pose() @ mounted), captured)


def mount(place: Mount) -> F64:
    """(4, 4) of the camera (x right, y down, z ahead) to the vehicle (x ahead, y left, z up)."""
    pose = np.eye(4)
    turned = Rotation.from_euler("ZY", [place.yaw, -place.pitch], degrees=True).as_matrix()
    pose[:3, :3] = turned @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[:3, 3] = place[:3]
    return pose


def _load(folder: Path) -> World:
    with _loading:
        if folder not in _worlds:
            _worlds.clear()
            scene = read_scene(folder)
            _worlds[folder] = world((shape, tile.offset) for tile in scene.tiles for shape in tile.textured().values())
        return _worlds[folder]

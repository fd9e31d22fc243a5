"""Shared parameters: how a rolling shutter and lenses that don't share a centre move the camera under each ray.

A row that is read later is seen from farther on: its camera is moved and turned by the car's own motion times the
fraction of the readout. A 360 camera's front and back lens sit a few centimetres apart: a ray starts at its own lens.
Both are linear in one number that all frames share: the readout in seconds, and half the distance of the lenses.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.core.types import F64, I32, Camera

NAMES = ("readout", "lens_offset")
SIGMA = (0.02, 0.05)
"""Seconds and metres: how large they may well be."""


def bend(camera: Camera, names: tuple[str, ...], poses: F64, velocity: F64, camera_of: I32, bearing: F64) -> F64:
    """(O, S, 6) metres and radians (about world axes) by which a unit of each parameter moves the camera of a ray.

    Args:
        camera: of the frames.
        names: of `NAMES`, the parameters.
        poses: (C, 4, 4) camera to world.
        velocity: (C, 6) metres and radians a second, in the camera's axes.
        camera_of: (O,) of each ray.
        bearing: (O, 3).
    """
    out = np.zeros((len(camera_of), len(names), 6))
    R = poses[camera_of, :3, :3]
    for s, name in enumerate(names):
        if name == "readout":
            uv, _ = project(camera, bearing)
            late = (uv[:, 1] + 0.5) / camera.height - 0.5
            moving = velocity[camera_of].reshape(-1, 2, 3)
            out[:, s] = late[:, None] * np.einsum("oij,okj->oki", R, moving).reshape(-1, 6)
        else:
            out[:, s, :3] = R[:, :, 2] * np.sign(bearing[:, 2:3])
    return out

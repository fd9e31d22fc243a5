"""Shared parameters of all frames: rolling shutter readout time, and the lens offset of a 360 camera.

With a rolling shutter, an image row that is read out later is exposed from a later camera pose: it is shifted by the
car's motion times the row's share of the readout time. A 360 camera's front and back lens are a few centimetres apart:
a ray starts at its own lens. Both effects are linear in one parameter that all frames share: the readout time in
seconds, and half the distance between the lenses in metres.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.core.types import F64, I32, Camera

NAMES = ("readout", "lens_offset")
SIGMA = (0.02, 0.05)
"""Standard deviation of each parameter's prior, which has mean 0: seconds, metres."""


def shared_jacobian(
    camera: Camera, names: tuple[str, ...], poses: F64, velocity: F64, camera_of: I32, bearing: F64
) -> F64:
    """(O, S, 6) translation (m) and rotation (rad, about world axes) of a ray's camera per unit of each parameter.

    Args:
        camera: camera of the frames.
        names: the estimated parameters, among `NAMES`.
        poses: (C, 4, 4) camera to world.
        velocity: (C, 6) metres and radians per second, in the camera's axes.
        camera_of: (O,) camera of each ray.
        bearing: (O, 3) unit vectors of the rays, camera axes.
    """
    out = np.zeros((len(camera_of), len(names), 6))
    R = poses[camera_of, :3, :3]
    for s, name in enumerate(names):
        if name == "readout":
            uv, _ = project(camera, bearing)
            readout_share = (uv[:, 1] + 0.5) / camera.height - 0.5
            ray_velocity = velocity[camera_of].reshape(-1, 2, 3)
            out[:, s] = readout_share[:, None] * np.einsum("oij,okj->oki", R, ray_velocity).reshape(-1, 6)
        else:
            out[:, s, :3] = R[:, :, 2] * np.sign(bearing[:, 2:3])
    return out

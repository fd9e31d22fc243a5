"""Splats in scripts of web pages (`flows/reports/pages/splats.js`): 32 bytes each, and the background as JPEG.

A page that is opened from the file system can load scripts, but no other files.
"""

from __future__ import annotations

import base64

import numpy as np

from scan2sim.pipeline.core.splats import MAX_COLOUR, SplatLayer, Splats

RECORD = np.dtype(
    [("xyz", "<f4", 3), ("rgb", "<u4"), ("scale", "<f2", 3), ("opacity", "<u2"), ("quaternion", "<i2", 4)]
)
"""A splat: position in metres; red, green and blue from the lowest bit, 10 bits each, 0 to `MAX_COLOUR`; standard
deviations in metres; opacity in 1/65535; unit quaternion w x y z in 1/32767."""
RGB_BITS = 10
SCALE_M = 1e-4, 6e4
"""Range of standard deviations: of normal 16-bit floats."""
BACKGROUND_QUALITY = 90
"""JPEG quality of the background."""


def pack(splats: Splats) -> bytes:
    """N splats as records of 32 bytes (`RECORD`)."""
    packed = np.empty(len(splats), RECORD)
    levels = np.rint(np.clip(splats.rgb / MAX_COLOUR, 0, 1) * (2**RGB_BITS - 1)).astype(np.uint32)
    packed["xyz"] = splats.xyz
    packed["rgb"] = levels[:, 0] | levels[:, 1] << RGB_BITS | levels[:, 2] << 2 * RGB_BITS
    packed["scale"] = np.clip(splats.scale, *SCALE_M)
    packed["opacity"] = np.rint(splats.opacity * 65535)
    packed["quaternion"] = np.rint(splats.quaternion * 32767)
    return packed.tobytes()


def script_arguments(layer: SplatLayer) -> str:
    """Arguments of a call in JavaScript: records and background, with the colours of their highest levels.

    The records and the JPEG of the background are strings in base64; `MAX_COLOUR` and the background's brightest colour
    are numbers, of which 1 is white.
    """
    from scan2sim.pipeline.io.worlds.gltf.textures import jpeg

    brightest = max(1.0, float(layer.background.max()))
    levels = np.clip(np.rint(layer.background / brightest * 255), 0, 255).astype(np.uint8)
    parts = pack(layer.splats), jpeg.encode(levels, BACKGROUND_QUALITY)
    return ", ".join([*(f'"{base64.b64encode(part).decode()}"' for part in parts), str(MAX_COLOUR), str(brightest)])

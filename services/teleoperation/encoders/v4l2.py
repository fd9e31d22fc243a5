"""Encoders in hardware that Linux shows as video devices (V4L2 memory to memory), by PyAV."""

from __future__ import annotations

from scan2sim.pipeline.core.plugins import Lacking
from scan2sim.services.teleoperation.encoders import Settings
from scan2sim.services.teleoperation.encoders.pyav import Encoder

NEEDS, EXTRA = ("av",), "teleop"
RANK = 1
CODEC = "vp8_v4l2m2m"


def lacking() -> Lacking | None:
    """A device that encodes VP8: tried."""
    import av
    import numpy as np

    try:
        encoder(Settings(640, 480, 30.0, 1_000_000)).encode(np.zeros((720, 640), np.uint8), 0, True)
    except (av.FFmpegError, ValueError) as error:
        return Lacking(f"needs a device that encodes VP8 ({error})", "Leave the encoder's name out")
    return None


def encoder(settings: Settings) -> Encoder:
    """On the first device that can."""
    return Encoder(CODEC, settings, {})

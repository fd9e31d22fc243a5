"""Hardware encoders that Linux offers as video devices (V4L2 memory-to-memory), by PyAV."""

from __future__ import annotations

from scan2sim.pipeline.core.plugins import Unavailable
from scan2sim.services.teleoperation.encoders import EncoderSettings
from scan2sim.services.teleoperation.encoders.pyav import Encoder

NEEDS, EXTRA = ("av",), "teleop"
RANK = 1
CODEC = "vp8_v4l2m2m"


def unavailable() -> Unavailable | None:
    """Try whether a device encodes VP8."""
    import av
    import numpy as np

    try:
        encoder(EncoderSettings(640, 480, 30.0, 1_000_000)).encode(np.zeros((720, 640), np.uint8), 0, True)
    except (av.FFmpegError, ValueError) as error:
        return Unavailable(f"needs a device that encodes VP8 ({error})", "Omit the encoder's name")
    return None


def encoder(settings: EncoderSettings) -> Encoder:
    """Create an encoder on the first suitable device."""
    return Encoder(CODEC, settings, {})

"""Hardware encoders of Intel and AMD GPUs (VA-API), by GStreamer."""

from __future__ import annotations

from scan2sim.pipeline.core.plugins import Unavailable
from scan2sim.services.teleoperation.encoders import EncoderSettings
from scan2sim.services.teleoperation.encoders.gstreamer import Encoder, missing_element

RANK = 2
ELEMENT = "vaapivp8enc"


def unavailable() -> Unavailable | None:
    """Whether the element is missing: it registers only where the hardware supports it."""
    return missing_element(ELEMENT, "gstreamer1.0-vaapi")


def encoder(settings: EncoderSettings) -> Encoder:
    """Create an encoder; the element takes its bit rate in kbit/s."""
    element = f"{ELEMENT} rate-control=cbr keyframe-period=0 bitrate={max(1, settings.bitrate // 1000)}"
    return Encoder(element, settings)

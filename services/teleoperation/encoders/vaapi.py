"""Encoders in graphics hardware of Intel and AMD (VA-API), by GStreamer."""

from __future__ import annotations

from scan2sim.pipeline.core.plugins import Lacking
from scan2sim.services.teleoperation.encoders import Settings
from scan2sim.services.teleoperation.encoders.gstreamer import Encoder, without

RANK = 2
ELEMENT = "vaapivp8enc"


def lacking() -> Lacking | None:
    """The element registers where the hardware has it."""
    return without(ELEMENT, "gstreamer1.0-vaapi")


def encoder(settings: Settings) -> Encoder:
    """Rates are told in kbit/s."""
    element = f"{ELEMENT} rate-control=cbr keyframe-period=0 bitrate={max(1, settings.bitrate // 1000)}"
    return Encoder(element, settings)

"""libvpx by GStreamer; needs GStreamer's Python bindings, which Debian installs for the system's Python."""

from __future__ import annotations

import importlib.util
from typing import Any

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.plugins import Unavailable
from scan2sim.pipeline.core.types import U8
from scan2sim.services.teleoperation.encoders import EncoderSettings
from scan2sim.services.teleoperation.encoders.pyav import KEY_FRAME_MAX_PERCENT

RANK = 2
ENCODE_TIMEOUT_NS = 1_000_000_000
"""Timeout for encoding one frame."""
ELEMENT = (
    "vp8enc deadline=1 cpu-used=8 lag-in-frames=0 threads=1 keyframe-max-dist=9999 end-usage=cbr buffer-size=500 "
    "buffer-initial-size=375 buffer-optimal-size=400 "
    f"max-intra-bitrate={KEY_FRAME_MAX_PERCENT} target-bitrate={{bitrate}}"
)


def unavailable() -> Unavailable | None:
    """Whether GStreamer, its Python bindings or the element is missing."""
    if importlib.util.find_spec("gi") is None:
        return Unavailable("needs gi, not installed here", "apt-get install python3-gi gir1.2-gst-plugins-base-1.0")
    gst = load_gstreamer()
    if gst is None or gst.ElementFactory.find("appsrc") is None:
        return Unavailable("needs GStreamer, not installed here", "apt-get install gir1.2-gst-plugins-base-1.0")
    if gst.ElementFactory.find("vp8enc") is None:
        cause = "needs the GStreamer element vp8enc, not installed here"
        return Unavailable(cause, "apt-get install gstreamer1.0-plugins-good")
    return None


def encoder(settings: EncoderSettings) -> Encoder:
    """Create an encoder, which runs in a GStreamer thread."""
    return Encoder(settings)


def load_gstreamer() -> Any:
    """GStreamer's Python bindings, initialized; None: not installed."""
    import gi

    try:
        gi.require_version("Gst", "1.0")
        gi.require_version("GstVideo", "1.0")
    except ValueError:
        return None
    from gi.repository import Gst

    Gst.init(None)
    return Gst


class Encoder:
    """GStreamer pipeline: appsrc, encoder element, appsink."""

    def __init__(self, settings: EncoderSettings) -> None:
        self._gst = load_gstreamer()
        raw = (
            f"video/x-raw,format=I420,width={settings.width},height={settings.height},"
            f"framerate={round(settings.fps * 1000)}/1000"
        )
        self._pipeline = self._gst.parse_launch(
            f"appsrc name=source is-live=true format=time block=true max-buffers=1 caps={raw} ! "
            f"{ELEMENT.format(bitrate=settings.bitrate)} name=encoder ! appsink name=sink sync=false max-buffers=4"
        )
        self._source = self._pipeline.get_by_name("source")
        self._sink = self._pipeline.get_by_name("sink")
        self._encoder_pad = self._pipeline.get_by_name("encoder").get_static_pad("src")
        self._pipeline.set_state(self._gst.State.PLAYING)
        self._first: int | None = None

    def encode(self, planes: U8, captured: int, key: bool) -> bytes:
        """See `encoders.Encoder`.

        Raises:
            UnavailableError: the element accepts no frames, or does not encode one in time.
        """
        from gi.repository import GstVideo

        if self._first is None:
            self._first = captured
        buffer = self._gst.Buffer.new_wrapped(planes.tobytes())
        buffer.pts = captured - self._first
        if key:
            self._encoder_pad.send_event(
                GstVideo.video_event_new_upstream_force_key_unit(self._gst.CLOCK_TIME_NONE, True, 0)
            )
        self._source.emit("push-buffer", buffer)
        sample = self._sink.emit("try-pull-sample", ENCODE_TIMEOUT_NS)
        if sample is None:
            raise UnavailableError("GStreamer", "delivers no encoded frames", "Choose another encoder")
        made = sample.get_buffer()
        return bytes(made.extract_dup(0, made.get_size()))

    def close(self) -> None:
        """Stop the pipeline and its threads."""
        self._pipeline.set_state(self._gst.State.NULL)

"""libvpx by GStreamer, where it is installed with its bindings to Python (Debian's, which its own Python sees)."""

from __future__ import annotations

import importlib.util
from typing import Any

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.plugins import Lacking
from scan2sim.pipeline.core.types import U8
from scan2sim.services.teleoperation.encoders import Settings
from scan2sim.services.teleoperation.encoders.pyav import LARGEST_KEY

RANK = 4
SLOWEST = 1_000_000_000
"""Nanoseconds that a picture may take."""
ELEMENT = (
    "vp8enc deadline=1 cpu-used=8 lag-in-frames=0 threads=1 keyframe-max-dist=9999 end-usage=cbr buffer-size=500 "
    f"buffer-initial-size=375 buffer-optimal-size=400 max-intra-bitrate={LARGEST_KEY} target-bitrate={{bitrate}}"
)


def lacking() -> Lacking | None:
    """GStreamer, its bindings, and the element."""
    return without("vp8enc", "gstreamer1.0-plugins-good")


def encoder(settings: Settings) -> Encoder:
    """In a thread of GStreamer's."""
    return Encoder(ELEMENT.format(bitrate=settings.bitrate), settings)


def without(element: str, package: str) -> Lacking | None:
    """`Backend.lacking` of an element, and the Debian package that brings it."""
    if importlib.util.find_spec("gi") is None:
        return Lacking("needs gi, not installed here", "apt-get install python3-gi gir1.2-gst-plugins-base-1.0")
    gst = load()
    if gst is None or gst.ElementFactory.find("appsrc") is None:
        return Lacking("needs GStreamer, not installed here", "apt-get install gir1.2-gst-plugins-base-1.0")
    if gst.ElementFactory.find(element) is None:
        return Lacking(f"needs GStreamer's {element}, not there", f"apt-get install {package}")
    return None


def load() -> Any:
    """GStreamer's bindings; None: they aren't there."""
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
    """A pipeline: appsrc, an element that encodes, appsink."""

    def __init__(self, element: str, settings: Settings) -> None:
        self._gst = load()
        raw = (
            f"video/x-raw,format=I420,width={settings.width},height={settings.height},"
            f"framerate={round(settings.fps * 1000)}/1000"
        )
        self._pipeline = self._gst.parse_launch(
            f"appsrc name=source is-live=true format=time block=true max-buffers=1 caps={raw} ! "
            f"{element} name=encoder ! appsink name=sink sync=false max-buffers=4"
        )
        self._source = self._pipeline.get_by_name("source")
        self._sink = self._pipeline.get_by_name("sink")
        self._asked = self._pipeline.get_by_name("encoder").get_static_pad("src")
        self._pipeline.set_state(self._gst.State.PLAYING)
        self._first: int | None = None

    def encode(self, planes: U8, captured: int, key: bool) -> bytes:
        """See `video.Encoder`.

        Raises:
            UnavailableError: the element doesn't take pictures, or not in time.
        """
        from gi.repository import GstVideo

        if self._first is None:
            self._first = captured
        buffer = self._gst.Buffer.new_wrapped(planes.tobytes())
        buffer.pts = captured - self._first
        if key:
            self._asked.send_event(GstVideo.video_event_new_upstream_force_key_unit(self._gst.CLOCK_TIME_NONE, True, 0))
        self._source.emit("push-buffer", buffer)
        sample = self._sink.emit("try-pull-sample", SLOWEST)
        if sample is None:
            raise UnavailableError("GStreamer", "gives no frames", "Choose another encoder")
        made = sample.get_buffer()
        return bytes(made.extract_dup(0, made.get_size()))

    def close(self) -> None:
        """Ends its threads."""
        self._pipeline.set_state(self._gst.State.NULL)

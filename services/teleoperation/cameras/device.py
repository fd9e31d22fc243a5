"""Real cameras, by PyAV: `where` is a device of Video4Linux (/dev/video0), or an address (rtsp://..., http://...)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.credentials import redacted
from scan2sim.services.teleoperation.cameras import Picture, View

NEEDS, EXTRA = ("av",), "teleop"
PATIENCE = 5.0, 2.0
"""Seconds for a camera to open, and for a picture to come."""
PROMPT = {"fflags": "nobuffer", "flags": "low_delay", "rtsp_transport": "tcp", "probesize": "200000"}
"""Of FFmpeg's readers: nothing is held back."""
OLDEST = 1_000_000_000
"""Nanoseconds before now that a device's own time is believed."""


def pictures(view: View) -> Iterator[Picture]:
    """Until the camera is gone.

    Raises:
        InputError: it can't be opened, or breaks off.
    """
    import av

    local = view.where.startswith("/dev/")
    asked = {"video_size": f"{view.width}x{view.height}", "framerate": f"{view.fps:g}"} if local else PROMPT
    try:
        with av.open(view.where, format="v4l2" if local else None, options=asked, timeout=PATIENCE) as camera:
            stream = camera.streams.video[0]
            stream.thread_type = "NONE"  # threads would hold pictures back
            for packet in camera.demux(stream):
                came = time.monotonic_ns()
                for frame in packet.decode():
                    captured = _captured(frame, came) if local else came
                    yield Picture(np.asarray(frame.to_ndarray(format="rgb24"), np.uint8), captured)
    except (av.FFmpegError, OSError, IndexError) as error:
        cause = f"gives no video ({redacted(str(error))})"
        raise InputError(redacted(view.where), cause, "Check its address and that it runs") from None


def _captured(frame: Any, came: int) -> int:
    """When a device says that it took a picture, if that is of the monotonic clock, as most say."""
    stamp = came if frame.time is None else round(frame.time * 1e9)
    return stamp if came - OLDEST < stamp <= came else came

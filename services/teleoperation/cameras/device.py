"""Real cameras, read by PyAV; location: a Video4Linux device (/dev/video0) or an address (rtsp://..., http://...)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.credentials import redacted
from scan2sim.services.teleoperation.cameras import CameraFrame, View

NEEDS, EXTRA = ("av",), "teleop"
OPEN_AND_READ_TIMEOUTS_S = 5.0, 2.0
"""Timeouts for opening a camera, and for its next frame."""
LOW_LATENCY_OPTIONS = {"fflags": "nobuffer", "flags": "low_delay", "rtsp_transport": "tcp", "probesize": "200000"}
"""FFmpeg demuxer options that disable buffering."""
DEVICE_TIMESTAMP_MAX_AGE_NS = 1_000_000_000
"""Timestamps of a device that are older than this are ignored."""


def frames(view: View) -> Iterator[CameraFrame]:
    """Yield frames until the camera is lost.

    Raises:
        InputError: the camera cannot be opened, or its stream broke.
    """
    import av

    local = view.location.startswith("/dev/")
    options = (
        {"video_size": f"{view.width}x{view.height}", "framerate": f"{view.fps:g}"} if local else LOW_LATENCY_OPTIONS
    )
    try:
        with av.open(
            view.location, format="v4l2" if local else None, options=options, timeout=OPEN_AND_READ_TIMEOUTS_S
        ) as camera:
            stream = camera.streams.video[0]
            stream.thread_type = "NONE"  # decoding threads would delay frames
            for packet in camera.demux(stream):
                arrived = time.monotonic_ns()
                for frame in packet.decode():
                    captured = _captured(frame, arrived) if local else arrived
                    yield CameraFrame(np.asarray(frame.to_ndarray(format="rgb24"), np.uint8), captured)
    except (av.FFmpegError, OSError, IndexError) as error:
        cause = f"delivers no video ({redacted(str(error))})"
        raise InputError(redacted(view.location), cause, "Check its address, and that the camera is on") from None


def _captured(frame: Any, arrived: int) -> int:
    """Capture time by the device, if its timestamp is of the monotonic clock, as with most drivers; else arrival."""
    stamp = arrived if frame.time is None else round(frame.time * 1e9)
    return stamp if arrived - DEVICE_TIMESTAMP_MAX_AGE_NS < stamp <= arrived else arrived

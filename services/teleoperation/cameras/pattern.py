"""Synthetic moving test pattern, for tests without a camera: colour bars and a ball."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scan2sim.pipeline.core.types import U8
from scan2sim.services.teleoperation.cameras import CameraFrame, View, frame_times

BAR_COLOURS = (
    (235, 235, 235),
    (235, 235, 16),
    (16, 235, 235),
    (16, 235, 16),
    (235, 16, 235),
    (235, 16, 16),
    (16, 16, 235),
)


def frames(view: View) -> Iterator[CameraFrame]:
    """Yield frames without end; the location is ignored."""
    still = bars(view.width, view.height)
    for captured in frame_times(view.fps):
        yield CameraFrame(draw_at(still, captured / 1e9), captured)


def bars(width: int, height: int) -> U8:
    """Colour bars (H, W, 3); the lower half gets darker to the right."""
    colours = np.array(BAR_COLOURS, np.uint8)[np.arange(width) * len(BAR_COLOURS) // width]
    image = np.broadcast_to(colours, (height, width, 3)).copy()
    shade = np.linspace(1.0, 0.2, width)[:, None]
    image[height // 2 :] = (image[height // 2 :] * shade).astype(np.uint8)
    return image


def draw_at(still: U8, seconds: float) -> U8:
    """Test pattern at a time in seconds; the ball circles in four seconds."""
    import cv2

    height, width = still.shape[:2]
    angle = seconds * np.pi / 2
    centre = (round(width * (0.5 + 0.35 * np.cos(angle))), round(height * (0.5 + 0.35 * np.sin(angle))))
    image = still.copy()
    cv2.circle(image, centre, height // 12, (255, 128, 0), -1)
    return image

"""A picture that moves, for tries without a camera: bars of colour and a ball."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scan2sim.pipeline.core.types import U8
from scan2sim.services.teleoperation.cameras import Picture, View, ticks

BARS = ((235, 235, 235), (235, 235, 16), (16, 235, 235), (16, 235, 16), (235, 16, 235), (235, 16, 16), (16, 16, 235))


def pictures(view: View) -> Iterator[Picture]:
    """Without end; `where` means nothing."""
    still = bars(view.width, view.height)
    for captured in ticks(view.fps):
        yield Picture(at(still, captured / 1e9), captured)


def bars(width: int, height: int) -> U8:
    """(H, W, 3): the bars alone, the lower half darker to the right."""
    colours = np.array(BARS, np.uint8)[np.arange(width) * len(BARS) // width]
    picture = np.broadcast_to(colours, (height, width, 3)).copy()
    shade = np.linspace(1.0, 0.2, width)[:, None]
    picture[height // 2 :] = (picture[height // 2 :] * shade).astype(np.uint8)
    return picture


def at(still: U8, seconds: float) -> U8:
    """The picture at a moment: the ball goes round in four seconds."""
    import cv2

    height, width = still.shape[:2]
    angle = seconds * np.pi / 2
    place = (round(width * (0.5 + 0.35 * np.cos(angle))), round(height * (0.5 + 0.35 * np.sin(angle))))
    picture = still.copy()
    cv2.circle(picture, place, height // 12, (255, 128, 0), -1)
    return picture

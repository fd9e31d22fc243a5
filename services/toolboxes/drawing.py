"""Draws results on images: boxes with labels, lines of text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes.results import Detection, Moving

STATIONARY_COLOUR, MOVING_COLOUR = (60, 140, 255), (255, 90, 40)
"""Box colours of objects that are stationary, or whose motion is unknown, and of moving ones."""
BACKGROUND_COLOUR, TEXT_COLOUR = (20, 20, 20), (255, 255, 255)


def lines(image: U8, texts: Sequence[str]) -> U8:
    """Draw lines of text into the upper left corner of a copy of an image."""
    result = image.copy()
    scale = _scale(image)
    for i, text in enumerate(texts):
        _text(result, text, (int(8 * scale), int((10 + 24 * i) * scale)), scale, BACKGROUND_COLOUR)
    return result


def detections(image: U8, found: Iterable[Detection]) -> U8:
    """Draw boxes with their labels on a copy of an image."""
    import cv2

    result, scale = image.copy(), _scale(image)
    for one in found:
        left, top, right, bottom = (round(value) for value in one.box)
        is_moving = isinstance(one, Moving) and bool(one.moving)
        colour = MOVING_COLOUR if is_moving else STATIONARY_COLOUR
        cv2.rectangle(result, (left, top), (right, bottom), colour, max(1, round(2 * scale)))
        caption = f"{one.label} {one.score:.0%}"
        if isinstance(one, Moving):
            state = {True: "moves", False: "stands", None: "..."}[one.moving]
            caption = f"{one.label} {one.track} {state}"
        _text(result, caption, (left, max(0, top - round(18 * scale))), scale * 0.8, colour)
    return result


def _text(image: U8, text: str, at: tuple[int, int], scale: float, colour: tuple[int, int, int]) -> None:
    """Draw text on a coloured background whose upper left corner is at a pixel."""
    import cv2

    plain = text.encode("ascii", "replace").decode()  # OpenCV's font has ASCII only
    (width, height), below = cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * scale, 1)
    left, top = at
    cv2.rectangle(image, (left, top), (left + width + 4, top + height + below + 2), colour, cv2.FILLED)
    origin = (left + 2, top + height + 1)
    cv2.putText(image, plain, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * scale, TEXT_COLOUR, 1, cv2.LINE_AA)


def _scale(image: U8) -> float:
    """Scale of line widths and font size."""
    return max(0.8, image.shape[1] / 900)

"""Results drawn on images: boxes with their labels, lines of text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes.results import Detection, Moving

STANDING, MOVING = (60, 140, 255), (255, 90, 40)
"""Colours of things that stand (or of which that isn't known) and that move."""
DARK, LIGHT = (20, 20, 20), (255, 255, 255)


def lines(image: U8, texts: Sequence[str]) -> U8:
    """An image with lines of text in its upper left corner."""
    made = image.copy()
    scale = _scale(image)
    for i, text in enumerate(texts):
        _text(made, text, (int(8 * scale), int((10 + 24 * i) * scale)), scale, DARK)
    return made


def detections(image: U8, found: Iterable[Detection]) -> U8:
    """An image with boxes."""
    import cv2

    made, scale = image.copy(), _scale(image)
    for one in found:
        left, top, right, bottom = (round(value) for value in one.box)
        moves = isinstance(one, Moving) and bool(one.moving)
        colour = MOVING if moves else STANDING
        cv2.rectangle(made, (left, top), (right, bottom), colour, max(1, round(2 * scale)))
        what = f"{one.label} {one.score:.0%}"
        if isinstance(one, Moving):
            state = {True: "moves", False: "stands", None: "..."}[one.moving]
            what = f"{one.label} {one.track} {state}"
        _text(made, what, (left, max(0, top - round(18 * scale))), scale * 0.8, colour)
    return made


def _text(image: U8, text: str, at: tuple[int, int], scale: float, colour: tuple[int, int, int]) -> None:
    """On a ground of a colour, its upper left corner at a pixel."""
    import cv2

    plain = text.encode("ascii", "replace").decode()  # what OpenCV's font has
    (width, height), below = cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * scale, 1)
    left, top = at
    cv2.rectangle(image, (left, top), (left + width + 4, top + height + below + 2), colour, cv2.FILLED)
    place = (left + 2, top + height + 1)
    cv2.putText(image, plain, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * scale, LIGHT, 1, cv2.LINE_AA)


def _scale(image: U8) -> float:
    """Of lines and letters."""
    return max(0.8, image.shape[1] / 900)

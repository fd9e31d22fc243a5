"""Images of traffic signs and shop boards."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F32, U8

NAMES = (
    "crossing",
    "speed_30",
    "no_parking",
    "parking",
    "give_way",
    "stop",
    "priority",
    "bakery",
    "books",
    "cafe",
    "flowers",
)
SHAPES = {"give_way": "triangle", "stop": "octagon", "speed_30": "round", "no_parking": "round", "priority": "diamond"}
FIRST_SHOP = 7  # index of the first shop front
IMAGE_SIZE_PX = 256


def images() -> F32:
    """(K, 256, 256, 3) linear RGB images in the order of `NAMES`; shop boards are stretched to the square."""
    drawn = np.stack([_draw(name) for name in NAMES]).astype(np.float32) / 255
    return (0.9 * np.where(drawn <= 0.04045, drawn / 12.92, ((drawn + 0.055) / 1.055) ** 2.4)).astype(np.float32)


def _draw(name: str) -> U8:
    import cv2

    white, red, blue, black, yellow = (245, 245, 245), (190, 25, 30), (25, 80, 165), (20, 20, 22), (245, 190, 20)
    p = np.full((IMAGE_SIZE_PX, IMAGE_SIZE_PX, 3), white, np.uint8)
    c = (IMAGE_SIZE_PX // 2, IMAGE_SIZE_PX // 2)

    def text(words: str, scale: float, colour: tuple[int, int, int], thick: int, y: int = 0) -> None:
        font = cv2.FONT_HERSHEY_DUPLEX
        (w, h), _ = cv2.getTextSize(words, font, scale, thick)
        cv2.putText(
            p, words, ((IMAGE_SIZE_PX - w) // 2, (IMAGE_SIZE_PX + h) // 2 + y), font, scale, colour, thick, cv2.LINE_AA
        )

    def shape(points: list[tuple[int, int]], colour: tuple[int, int, int]) -> None:
        cv2.fillPoly(p, [np.array(points, np.int32)], colour, cv2.LINE_AA)

    if name == "crossing":
        p[:] = blue
        shape([(128, 28), (230, 218), (26, 218)], white)
        cv2.circle(p, (132, 82), 13, black, -1, cv2.LINE_AA)
        for a, b in (
            ((131, 98), (124, 145)),
            ((124, 145), (150, 200)),
            ((124, 145), (98, 198)),
            ((129, 108), (158, 138)),
            ((129, 108), (100, 140)),
        ):
            cv2.line(p, a, b, black, 13, cv2.LINE_AA)
        for x in range(52, 215, 36):
            cv2.line(p, (x, 208), (x + 18, 208), black, 7)
    elif name == "speed_30":
        cv2.circle(p, c, 126, red, -1, cv2.LINE_AA)
        cv2.circle(p, c, 98, white, -1, cv2.LINE_AA)
        text("30", 3.4, black, 13)
    elif name == "no_parking":
        cv2.circle(p, c, 128, red, -1, cv2.LINE_AA)
        cv2.circle(p, c, 104, blue, -1, cv2.LINE_AA)
        cv2.line(p, (55, 55), (201, 201), red, 24, cv2.LINE_AA)
    elif name == "parking":
        p[:] = blue
        cv2.rectangle(p, (8, 8), (247, 247), white, 6)
        text("P", 6.2, white, 24)
    elif name == "give_way":
        p[:] = red
        shape([(46, 46), (210, 46), (128, 188)], white)
    elif name == "stop":
        p[:] = red
        text("STOP", 2.5, white, 12)
    elif name == "priority":
        shape([(128, 30), (226, 128), (128, 226), (30, 128)], yellow)
    else:
        ground, ink, words = {
            "bakery": ((120, 30, 28), (250, 230, 180), "BAKERY"),
            "books": ((28, 58, 50), (235, 225, 190), "BOOKS"),
            "cafe": ((36, 34, 40), (235, 190, 90), "CAFE"),
            "flowers": ((225, 222, 205), (60, 105, 50), "FLOWERS"),
        }[name]
        p[:] = ground
        wide = np.full((64, 420, 3), ground, np.uint8)  # drawn in the proportions of the board
        (w, h), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_TRIPLEX, 1.6, 3)
        cv2.putText(wide, words, ((420 - w) // 2, (64 + h) // 2), cv2.FONT_HERSHEY_TRIPLEX, 1.6, ink, 3, cv2.LINE_AA)
        cv2.rectangle(wide, (3, 3), (416, 60), ink, 2)
        p[:] = cv2.resize(wide, (IMAGE_SIZE_PX, IMAGE_SIZE_PX), interpolation=cv2.INTER_AREA)
    return p

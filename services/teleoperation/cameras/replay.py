"""Pictures that were taken beforehand, again and again: `where` is a folder of pictures, or a video."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.credentials import redacted
from scan2sim.services.teleoperation.cameras import Picture, View, ticks

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
KEPT = 256_000_000
"""Bytes of pictures that are held in memory; longer ones are decoded in each round."""


def pictures(view: View) -> Iterator[Picture]:
    """Without end, of the size that is asked for.

    Raises:
        InputError: there are none.
    """
    for captured, image in zip(ticks(view.fps), _rounds(view), strict=False):
        yield Picture(image.copy(), captured)


def _rounds(view: View) -> Iterator[U8]:
    kept, bytes_ = list[U8](), 0
    for image in _images(view):
        yield image
        bytes_ += image.nbytes
        if bytes_ <= KEPT:
            kept.append(image)
    if not bytes_:
        remedy = f"Give a folder of {', '.join(SUFFIXES)}, or a video"
        raise InputError(redacted(view.where), "holds no pictures", remedy)
    while True:
        yield from kept if bytes_ <= KEPT else _images(view)


def _images(view: View) -> Iterator[U8]:
    import cv2

    size = view.width, view.height
    for bgr in _files(Path(view.where)) if Path(view.where).is_dir() else _video(view.where):
        image = bgr if bgr.shape[1::-1] == size else cv2.resize(bgr, size, interpolation=cv2.INTER_AREA)
        yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def _files(folder: Path) -> Iterator[Any]:
    import cv2

    for file in sorted(one for one in folder.iterdir() if one.suffix.lower() in SUFFIXES):
        image = cv2.imread(str(file))
        if image is None:
            raise InputError(file, "can't be read as a picture", "Take it out of the folder")
        yield image


def _video(file: str) -> Iterator[Any]:
    import cv2

    video = cv2.VideoCapture(file)
    for _ in itertools.count():
        good, image = video.read()
        if not good:
            return
        yield image

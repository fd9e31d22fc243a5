"""Recorded frames in a loop; location: a folder of images, or a video file."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.io import file_checks
from scan2sim.services.credentials import redacted
from scan2sim.services.teleoperation.cameras import CameraFrame, View, frame_times

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
CACHE_MAX_BYTES = 256_000_000
"""Decoded frames up to this size stay in memory; longer recordings are decoded again in each loop."""


def frames(view: View) -> Iterator[CameraFrame]:
    """Yield frames without end, resized to the requested size.

    Raises:
        InputError: there are no images.
    """
    for captured, image in zip(frame_times(view.fps), _loop(view), strict=False):
        yield CameraFrame(image.copy(), captured)


def _loop(view: View) -> Iterator[U8]:
    cache, bytes_ = list[U8](), 0
    for image in _images(view):
        yield image
        bytes_ += image.nbytes
        if bytes_ <= CACHE_MAX_BYTES:
            cache.append(image)
    if not bytes_:
        remedy = f"Give a folder of images ({', '.join(IMAGE_SUFFIXES)}) or a video file"
        raise InputError(redacted(view.location), "contains no images", remedy)
    while True:
        yield from cache if bytes_ <= CACHE_MAX_BYTES else _images(view)


def _images(view: View) -> Iterator[U8]:
    import cv2

    size = view.width, view.height
    for bgr in _files(Path(view.location)) if Path(view.location).is_dir() else _video(view.location):
        image = bgr if bgr.shape[1::-1] == size else cv2.resize(bgr, size, interpolation=cv2.INTER_AREA)
        yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def _files(folder: Path) -> Iterator[Any]:
    import cv2

    images = (one for one in folder.iterdir() if one.suffix.lower() in IMAGE_SUFFIXES and not file_checks.hidden(one))
    for file in sorted(images):
        image = cv2.imread(str(file))
        if image is None:
            raise InputError(file, "cannot be decoded as an image", "Remove it from the folder")
        yield image


def _video(file: str) -> Iterator[Any]:
    import cv2

    video = cv2.VideoCapture(file)
    for _ in itertools.count():
        good, image = video.read()
        if not good:
            return
        yield image

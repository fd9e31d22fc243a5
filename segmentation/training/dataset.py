"""Labelled photos, to learn from and to check with: `images/*.jpg` (or png) and `labels/*.png` of the same names.

Labels are LAS class codes a pixel (0 sky, 255 not to be learnt), as `data_samples.training` writes them. What a scan
tells of the same pixels may lie in `channels/*.png`, as `segmentation.lidar_channels` codes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import U8
from scan2sim.segmentation.labels import index_of_code
from scan2sim.segmentation.lidar_channels import COUNT, FRACTION


def pairs(folder: Path) -> list[tuple[Path, Path]]:
    """Images and their ground truth (LAS codes a pixel), by name.

    Raises:
        DataError: there are none.
    """
    found = [
        (image, truth)
        for image in sorted((folder / "images").glob("*"))
        if (truth := folder / "labels" / f"{image.stem}.png").is_file()
    ]
    if not found:
        raise DataError(
            folder, "has no images/NAME.jpg with labels/NAME.png", "Make some, as docs/segmentation.md says"
        )
    return found


def split(found: Sequence[tuple[Path, Path]], share: float) -> tuple[list[tuple[Path, Path]], list[tuple[Path, Path]]]:
    """To learn from, and to check with: whole streets, the last ones."""
    streets = sorted({image.stem.split("_")[0] for image, _ in found})
    last = set(streets[len(streets) - round(share * len(streets)) :])
    learn = [pair for pair in found if pair[0].stem.split("_")[0] not in last]
    return (learn, [pair for pair in found if pair[0].stem.split("_")[0] in last]) if learn else (list(found), [])


def read(image: Path, truth: Path) -> tuple[U8, U8]:
    """(H, W, 3) colours and (H, W) indices of classes, `IGNORED` where there is none.

    Raises:
        DataError: either can't be read, or they differ in size.
    """
    import cv2

    bgr, codes = cv2.imread(str(image)), cv2.imread(str(truth), cv2.IMREAD_GRAYSCALE)
    if bgr is None or codes is None or bgr.shape[:2] != codes.shape:
        raise DataError(truth, "and its image can't be read, or differ in size", "Make them again")
    return np.asarray(bgr[..., ::-1], np.uint8), index_of_code()[codes]


def read_channels(image: Path, size: tuple[int, int]) -> U8:
    """(h, w, 4) channels beside a photo of `size` (H, W) pixels; nothing in them where it has none.

    Raises:
        DataError: they can't be read, or aren't a `FRACTION`-th of the photo's size.
    """
    import cv2

    small = round(size[0] / FRACTION), round(size[1] / FRACTION)
    path = image.parent.parent / "channels" / f"{image.stem}.png"
    if not path.is_file():
        return np.zeros((*small, COUNT), np.uint8)
    codes = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if codes is None or codes.shape != (*small, COUNT):
        raise DataError(path, f"is no picture of {COUNT} channels, {small[1]} x {small[0]} pixels", "Make it again")
    return np.asarray(codes, np.uint8)

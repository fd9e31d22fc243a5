"""Dataset of labelled photos for training and validation: `images/*.jpg` (or png) and `labels/*.png` of the same names.

Labels are LAS class codes per pixel (0 sky, 255 ignored), as written by `data_samples.training`, or the indices of the
names in `labels.txt` (one per line), as grey levels or with a palette. Lidar channels of the photos may be in
`channels/*.png`, encoded by `segmentation.lidar_channels`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.types import U8
from scan2sim.segmentation.label_images import NAMES, read_classes
from scan2sim.segmentation.lidar_channels import CHANNELS, DOWNSAMPLING


def pairs(folder: Path) -> list[tuple[Path, Path]]:
    """Pairs of image file and label file in a folder, by name.

    Raises:
        DataError: the folder has no such pairs.
    """
    found = [
        (image, truth)
        for image in sorted((folder / "images").glob("*"))
        if (truth := folder / "labels" / f"{image.stem}.png").is_file()
    ]
    if not found:
        raise DataError(
            folder,
            "no images/NAME.jpg with labels/NAME.png found",
            "Create training data as described in docs/segmentation.md",
        )
    return found


def split(found: Sequence[tuple[Path, Path]], share: float) -> tuple[list[tuple[Path, Path]], list[tuple[Path, Path]]]:
    """Pairs for training, and for validation: all pairs of the last streets, a `share` of the streets."""
    streets = sorted({image.stem.split("_")[0] for image, _ in found})
    last = set(streets[len(streets) - round(share * len(streets)) :])
    training = [pair for pair in found if pair[0].stem.split("_")[0] not in last]
    validation = [pair for pair in found if pair[0].stem.split("_")[0] in last]
    return (training, validation) if training else (list(found), [])


def names_of(truth: Path) -> Path:
    """File with the names of the labels in a label image's data set."""
    return truth.parent.parent / NAMES


def read(image: Path, truth: Path) -> tuple[U8, U8]:
    """(H, W, 3) colours and (H, W) class indices, `IGNORED` for pixels without a class.

    Raises:
        DataError: a file can't be read, or they differ in size.
    """
    import cv2

    bgr, classes = cv2.imread(str(image)), read_classes(truth, names_of(truth))
    if bgr is None or bgr.shape[:2] != classes.shape:
        raise DataError(truth, "its image can't be read, or their sizes differ", "Create both again")
    return np.asarray(bgr[..., ::-1], np.uint8), classes


def read_channels(image: Path, size: tuple[int, int]) -> U8:
    """(h, w, 4) lidar channels of a photo of `size` (H, W) pixels; all 0 if it has none.

    Raises:
        DataError: the file can't be read, or its size is not 1/`DOWNSAMPLING` of the photo's.
    """
    import cv2

    small = round(size[0] / DOWNSAMPLING), round(size[1] / DOWNSAMPLING)
    path = image.parent.parent / "channels" / f"{image.stem}.png"
    if not path.is_file():
        return np.zeros((*small, CHANNELS), np.uint8)
    codes = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if codes is None or codes.shape != (*small, CHANNELS):
        raise DataError(
            path, f"not an image with {CHANNELS} channels of {small[1]} x {small[0]} pixels", "Create it again"
        )
    return np.asarray(codes, np.uint8)

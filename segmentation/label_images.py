"""Label images: the class of every pixel of a photo, from a user's own network or by hand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.classes import UNCLASSIFIED
from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.types import U8, Bools, View
from scan2sim.pipeline.io.images.image import SUFFIXES
from scan2sim.pipeline.io.tile_folder import without_parents
from scan2sim.segmentation.labels import CLASSES, IGNORED, index_of_code, map_labels, read_names
from scan2sim.segmentation.photos import OUTPUT_STRIDE

NAMES = "labels.txt"
"""File in a folder of labels with the names of their values, one per line."""
MAX_ASPECT_ERROR = 0.02
"""Relative difference of the proportions of a photo and its label image that rounding explains."""


class LabelImages:
    """The label images in a folder of some photos: `NAME.png`, or in the photos' folders, and `NAMES` if any.

    Attributes:
        folder: the folder.
        files: label image of each photo, by the photo's name; photos without one are missing.
        classes: names of the classes that the labels can have.

    Raises:
        InputError: no photo has a label image, or one is that of several photos.
    """

    def __init__(self, folder: Path, views: Sequence[View]) -> None:
        self.folder, self.names = folder, folder / NAMES
        self.files = {view.name: file for view in views if (file := _file_of(folder, view.name))}
        remedy = "Name them after the photos: NAME.png, with the photos' folders if names repeat"
        if views and not self.files:
            raise InputError(folder, f"has no label image of any photo, such as {views[0].name}", remedy)
        file, count = Counter(self.files.values()).most_common(1)[0] if views else (folder, 0)
        if count > 1:
            raise InputError(file, f"is the label image of {count} photos", remedy)
        predicted = _meaning(self.names)[0]
        self.classes = tuple(name for i, name in enumerate(CLASSES) if (predicted == i).any())

    def probabilities(self, view: View) -> U8:
        """(h, w, C) uint8, the share of each class of `CLASSES` (255 for 1), at 1/`OUTPUT_STRIDE` of a photo's size.

        Raises:
            InputError: the label image has other proportions than the photo.
            DataError: as `read_classes`.
        """
        import cv2

        file, width, height = self.files[view.name], view.camera.width, view.camera.height
        index = read_classes(file, self.names)
        if abs(index.shape[1] * height / (index.shape[0] * width) - 1) > MAX_ASPECT_ERROR:
            cause = f"{index.shape[1]} x {index.shape[0]} pixels don't have the proportions of the photo"
            raise InputError(file, cause, f"Make label images of the whole photos, {width} x {height} pixels")
        size = max(1, width // OUTPUT_STRIDE), max(1, height // OUTPUT_STRIDE)
        shares = [
            cv2.resize((index == k).astype(np.float32), size, interpolation=cv2.INTER_AREA) for k in range(len(CLASSES))
        ]
        return np.asarray(np.stack(shares, axis=-1) * 255 + 0.5, np.uint8)


def _file_of(folder: Path, name: str) -> Path | None:
    """The label image of a photo: by its name with as many of its folders as there are."""
    path = Path(without_parents(name))
    stem = path.with_suffix("") if path.suffix.lower() in SUFFIXES else path
    candidates = (folder / Path(*stem.parts[i:-1]) / f"{stem.name}.png" for i in range(len(stem.parts)))
    return next((file for file in candidates if file.is_file()), None)


def read_classes(truth: Path, names: Path) -> U8:
    """(H, W) class indices of a label image, `IGNORED` for pixels without a class.

    Args:
        truth: image of one byte per pixel, as grey level or index of a palette.
        names: file with the names of the values from 0 on, one per line; without it, they are LAS codes (0 sky).

    Raises:
        DataError: it can't be read, has colours instead of indices, or values without a meaning.
        InputError: `names` is invalid.
    """
    from PIL import Image

    try:
        with Image.open(truth) as file:
            mode, values = file.mode, np.asarray(file)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(truth, f"the label file can't be read ({error})", "Create it again") from None
    remedy = f"Write one byte per pixel: a LAS code, {IGNORED} to ignore it, or the index of a line of {NAMES}"
    if mode not in ("L", "P"):
        raise DataError(truth, f"the label file has pixels of kind {mode}, not indices of classes", remedy)
    table, known = _meaning(names)
    unknown = np.flatnonzero(np.bincount(values.ravel(), minlength=256) * ~known).tolist()
    if unknown:
        named = ", ".join(map(str, unknown[:8]))
        raise DataError(truth, f"values that are no classes of photos: {named}", f"{remedy}, which names all values")
    return table[values]


def _meaning(names: Path) -> tuple[U8, Bools]:
    """(256,) class index of each value of a label image, `IGNORED` for none, and whether the value has a meaning."""
    if not names.is_file():
        table = index_of_code()
        return table, (table != IGNORED) | np.isin(np.arange(256), (UNCLASSIFIED, IGNORED))
    given = map_labels(read_names(names), str(names), whole_scene=False)
    table = np.concatenate([given, np.full(256, IGNORED, np.uint8)])[:256]
    return table, (np.arange(256) < len(given)) | (np.arange(256) == IGNORED)

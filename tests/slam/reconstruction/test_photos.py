"""Folders of photos: formats that aren't read are named instead of being left out silently."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import silent
from scan2sim.slam.reconstruction.photos import list_photos, no_photos, read_photos


def album(folder: Path, jpegs: int, others: tuple[str, ...]) -> Path:
    """A folder of JPEG photos 1.jpg, 2.jpg, ... and other files."""
    for i in range(jpegs):
        cv2.imwrite(str(folder / f"{i + 1}.jpg"), np.full((8, 8, 3), i, np.uint8))
    for name in others:
        (folder / name).write_bytes(b"raw")
    return folder


def test_a_folder_of_raw_photos_says_so(tmp_path: Path) -> None:
    error = no_photos(album(tmp_path, 0, ("IMG_2.CR3", "IMG_10.CR3")))
    assert "has 2 photos in formats that aren't read (.cr3): IMG_2.CR3, IMG_10.CR3" in error.cause
    assert "JPEG" in error.remedy
    with pytest.raises(InputError, match=r"\.cr3"):
        read_photos(tmp_path, silent)


def test_photos_in_other_formats_are_counted_unless_a_copy_is_read(tmp_path: Path) -> None:
    photos, warnings = read_photos(album(tmp_path, 3, ("1.DNG", "2.dng", "away.arw", ".hidden.arw")), silent)
    assert len(photos) == 3
    assert len(warnings) == 1 and "has 1 photos in formats that aren't read (.arw): away.arw" in warnings[0]
    _, warnings = read_photos(album(tmp_path, 4, ("4.arw",)), silent)
    assert len(warnings) == 1 and "away.arw" in warnings[0]


def test_too_few_photos_because_of_their_format_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"only 2 photos, and 1 photos in formats that aren't read \(\.arw\)"):
        read_photos(album(tmp_path, 2, ("3.arw",)), silent)


def test_a_photo_and_its_copy_are_one(tmp_path: Path) -> None:
    folder = album(tmp_path, 2, ("1.HEIC", "3.heic"))
    assert list_photos(folder) == ["1.jpg", "2.jpg", "3.heic"]

"""Photos and videos in formats that aren't read are named instead of being left out, or read wrongly."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import silent
from scan2sim.slam.reconstruction.photos import no_photos, read_photos
from scan2sim.slam.video import open_video


def album(folder: Path, jpegs: int, others: tuple[str, ...]) -> Path:
    """A folder of JPEG photos 1.jpg, 2.jpg, ... and other files."""
    for i in range(jpegs):
        cv2.imwrite(str(folder / f"{i + 1}.jpg"), np.full((8, 8, 3), i, np.uint8))
    for name in others:
        (folder / name).write_bytes(b"....ftypheic")
    return folder


def test_a_folder_of_heic_photos_says_so(tmp_path: Path) -> None:
    error = no_photos(album(tmp_path, 0, ("IMG_2.HEIC", "IMG_10.HEIC")))
    assert "has 2 photos in formats that aren't read (.heic): IMG_2.HEIC, IMG_10.HEIC" in error.cause
    assert "JPEG" in error.remedy
    with pytest.raises(InputError, match=r"\.heic"):
        read_photos(tmp_path, silent)


def test_photos_in_other_formats_are_counted_unless_a_copy_is_read(tmp_path: Path) -> None:
    photos, warnings = read_photos(album(tmp_path, 3, ("1.DNG", "2.dng", "away.heic", ".hidden.heic")), silent)
    assert len(photos) == 3
    assert len(warnings) == 1 and "has 1 photos in formats that aren't read (.heic): away.heic" in warnings[0]
    _, warnings = read_photos(album(tmp_path, 4, ("4.heic",)), silent)
    assert len(warnings) == 1 and "away.heic" in warnings[0]


def test_too_few_photos_because_of_their_format_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"only 2 photos, and 1 photos in formats that aren't read \(\.heic\)"):
        read_photos(album(tmp_path, 2, ("3.heic",)), silent)


@pytest.mark.parametrize("name", ["GS010001.360", "VID_00_001.insv"])
def test_unstitched_videos_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"....ftypmp42")
    with pytest.raises(InputError, match=r"isn't stitched.*equirectangular MP4"):
        open_video(tmp_path / name)

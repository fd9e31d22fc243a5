"""Folders of photos: formats that aren't read are named instead of being left out silently."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.io.images import image
from scan2sim.slam.reconstruction.photos import Photo, list_photos, no_photos, read_photos, stage
from tests.fakes import exif_photos


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


def test_videos_beside_photos_are_named_but_not_those_of_live_photos(tmp_path: Path) -> None:
    folder = album(tmp_path, 3, ("1.MOV", "walk.mp4", "drive.MP4"))
    _, warnings = read_photos(folder, silent)
    assert len(warnings) == 1 and "has 2 videos (drive.MP4, walk.mp4) beside the photos, left out" in warnings[0]
    (tmp_path / "videos").mkdir()
    error = no_photos(album(tmp_path / "videos", 0, ("walk.mp4",)))
    assert "contains no photos, but 1 video (walk.mp4)" in error.cause and "one video" in error.remedy


def test_a_name_that_is_no_text_is_skipped(tmp_path: Path) -> None:
    folder = album(tmp_path, 3, ())
    try:
        (folder / "1.jpg").rename(folder / b"caf\xe9.jpg".decode(errors="surrogateescape"))
    except OSError:
        pytest.skip("the file system takes UTF-8 names only")
    cv2.imwrite(str(folder / "für Jörg 4.jpg"), np.zeros((8, 8, 3), np.uint8))
    photos, warnings = read_photos(folder, silent)
    assert [photo.name for photo in photos] == ["2.jpg", "3.jpg", "für Jörg 4.jpg"]
    assert len(warnings) == 1 and "its name isn't valid UTF-8" in warnings[0] and warnings[0].isprintable()


def test_photos_that_colmap_does_not_read_are_converted_once(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    album(folder, 1, ())
    cv2.imwrite(str(folder / "2.webp"), np.full((8, 8, 3), 200, np.uint8))
    (folder / "2.webp").rename(folder / "2.jpg")
    photos = [Photo("1.jpg", 8, 8), Photo("2.jpg", 8, 8)]
    staged = stage(photos, folder, tmp_path / "staged")
    assert staged == {"1.jpg": "000000.jpg", "2.jpg": "000001.png"}
    assert abs(int(image.read_levels(tmp_path / "staged" / "000001.png")[4, 4]) - 200) < 4
    (tmp_path / "staged" / "000001.png").write_bytes(b"converted before")
    assert stage(photos, folder, tmp_path / "staged") == staged
    assert (tmp_path / "staged" / "000001.png").read_bytes() == b"converted before"


def test_photos_of_two_phones_in_one_folder_are_two_cameras(tmp_path: Path) -> None:
    for name, device in (("1.jpg", "Pixel 8"), ("2.jpg", "iPhone 15"), ("3.jpg", "Pixel 8")):
        exif_photos.write(tmp_path / name, device=device, equivalent=26, position=(52.5, 13.4, 30))
    photos, _ = read_photos(tmp_path, silent)
    one, other, again = (photo.camera for photo in photos)
    assert one == again != other and photos[0].position == pytest.approx((52.5, 13.4))

"""Approximate positions of photos from tracks with another clock, and from lists."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.types import GpsTrack
from scan2sim.slam.reconstruction.photos import Photo
from scan2sim.slam.reconstruction.positions import by_list, by_track, check_sources, shifted
from tests.fakes import exif_photos

NOON = 1_700_000_000.0
TRACK = GpsTrack(NOON + np.arange(60.0), np.column_stack([np.arange(60.0), np.zeros(60), np.zeros(60)]))


def photos(times: list[float | None], zoned: bool = True) -> list[Photo]:
    return [Photo(f"{i}.jpg", 640, 480, time=time, zoned=zoned) for i, time in enumerate(times)]


def write(path: Path) -> Path:
    path.write_text("time,x,y,z\n" + "".join(f"{NOON + i},{i},0,0\n" for i in range(60)), encoding="utf-8")
    return path


def test_photos_are_located_on_a_track_by_time(tmp_path: Path) -> None:
    found = by_track(write(tmp_path / "gps.csv"), photos([NOON + 10, NOON + 20.5, NOON + 30]), None, None, None)
    assert np.allclose(found.xyz[:, 0], [10, 20.5, 30], atol=0.05) and found.crs == "local" and not found.notes


def test_time_zone_is_chosen_so_that_photos_are_within_the_track() -> None:
    notes: list[str] = []
    times = NOON + 2 * 3600 + np.array([5.0, 25.0, 50.0])
    moved = shifted(TRACK, times, Path("gps.gpx"), None, None, False, notes.append)
    assert np.allclose(moved.at(times)[:, 0], [5, 25, 50]) and "+2 h from UTC" in notes[0]


def test_video_times_count_from_its_start_or_the_first_fix() -> None:
    notes: list[str] = []
    times = np.array([0.0, 1.0, 2.0])
    known = shifted(TRACK, times, Path("gps.gpx"), NOON + 7, None, True, notes.append)
    assert np.allclose(known.at(times)[:, 0], [7, 8, 9]) and not notes
    guessed = shifted(TRACK, times, Path("gps.gpx"), None, None, True, notes.append)
    assert np.allclose(guessed.at(times)[:, 0], [0, 1, 2]) and "--gps-offset" in notes[0]
    given = shifted(TRACK, times, Path("gps.gpx"), None, -NOON - 3, True, notes.append)
    assert np.allclose(given.at(times)[:, 0], [3, 4, 5])


@pytest.mark.parametrize(
    ("times", "cause"),
    [
        ([NOON, None, NOON + 1], "1.jpg has no time"),
        ([NOON + 1e5, NOON + 2e5, NOON + 3e5], "covers the times of 0 of 3"),
    ],
)
def test_photos_that_a_track_cannot_locate_are_an_error(times: list[float | None], cause: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=cause):
        by_track(write(tmp_path / "gps.csv"), photos(times), None, None, None)


def test_rough_positions_are_read_from_a_list(tmp_path: Path) -> None:
    path = tmp_path / "rough.csv"
    path.write_text("file,x,y,z\n2.jpg, 1, 2, 3\n0.jpg,4,5,6\n", encoding="utf-8")
    found = by_list(path, photos([None, None, None]), "local")
    assert np.allclose(found.xyz[[0, 2]], [[4, 5, 6], [1, 2, 3]]) and np.isnan(found.xyz[1]).all()
    for text, cause in (("file,x,y,z\n9.jpg,1,2,3\n", "9.jpg"), ("name,x\n1,2\n", "no column `file`")):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=cause):
            by_list(path, photos([None, None, None]), "local")


def test_photos_without_a_time_are_left_out_of_those_that_a_track_locates(tmp_path: Path) -> None:
    found = by_track(write(tmp_path / "gps.csv"), photos([NOON + 10, None, NOON + 20, NOON + 30]), None, None, None)
    assert np.allclose(found.xyz[[0, 2, 3], 0], [10, 20, 30], atol=0.05) and np.isnan(found.xyz[1]).all()
    assert any("1 photos have no time" in note for note in found.notes)


def test_a_track_of_another_day_is_an_error_before_anything_is_computed(tmp_path: Path) -> None:
    track, folder = write(tmp_path / "gps.csv"), tmp_path / "photos"
    for i in range(4):
        exif_photos.write(folder / f"{i}.jpg", time=NOON + 10 * i)
    assert check_sources(folder, gps=track)
    (tmp_path / "times.txt").write_text("".join(f"{NOON + 86400 + i}\n" for i in range(4)), encoding="utf-8")
    with pytest.raises(DataError, match="covers the times of 0 of 4 photos"):
        check_sources(folder, gps=track, times=tmp_path / "times.txt")
    assert check_sources(folder, gps=track, times=tmp_path / "times.txt", offset=86400.0)


def test_a_list_is_checked_before_anything_is_computed(tmp_path: Path) -> None:
    folder, path = tmp_path / "photos", tmp_path / "rough.csv"
    for name in ("0.jpg", "links/Strau\N{LATIN SMALL LETTER SHARP S} u\u0308.jpg", "2.jpg"):
        exif_photos.write(folder / name)
    row = "{},1,2,3\n".format
    umlaut = "links\\Strau\N{LATIN SMALL LETTER SHARP S} \N{LATIN SMALL LETTER U WITH DIAERESIS}.jpg"
    path.write_text("file,x,y,z\n" + row("0.jpg") + row(umlaut) + row("2.jpg"), encoding="utf-8")
    assert check_sources(folder, positions=path)
    for rows, cause in (
        (row("0.jpg") + row("7.jpg"), "names 7.jpg, which photos doesn't have"),
        (row("0.jpg"), "of 1 photos"),
    ):
        path.write_text("file,x,y,z\n" + rows, encoding="utf-8")
        with pytest.raises(InputError, match=cause):
            check_sources(folder, positions=path)


def test_positions_of_photos_without_a_pose_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "rough.csv"
    path.write_text("file,x,y,z\n2.jpg,1,2,3\nlost.jpg,9,9,9\n0.jpg,4,5,6\n", encoding="utf-8")
    found = by_list(path, photos([None, None, None]), "local")
    assert np.allclose(found.xyz[[0, 2]], [[4, 5, 6], [1, 2, 3]])
    assert "photos without a pose: lost.jpg" in found.notes[0]

"""Files of tracks."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.tracking.tracks import Track, footprint, read_frame, read_tracks, write_tracks

FRAME = Frame("EPSG:32632", (458_800.0, 5_428_600.0, 110.0))
T0 = 1_001_077_704.957315


def moving_car() -> Track:
    times = T0 + np.arange(5, dtype=np.float64) / 10
    poses = np.column_stack([np.arange(5) / 3, np.full(5, 2.0), np.full(5, -1.7), np.full(5, 0.1)])
    return Track(3, "car", (4.2, 1.8, 1.5), times, poses, np.full((5, 2), 0.05), True, (200, 10, 30))


def parked_van() -> Track:
    pose = np.array([[10.0, -4.0, -1.6, 3.0]])
    return Track(7, "van", (5.1, 1.9, 2.1), np.array([T0]), pose, np.array([[0.1, 0.02]]), False, None)


def test_tracks_are_read_exactly_as_written(tmp_path: Path) -> None:
    tracks = [moving_car(), parked_van()]
    write_tracks(tmp_path / "tracks.json", tracks, FRAME)
    for read, written in zip(read_tracks(tmp_path / "tracks.json"), tracks, strict=True):
        for (name, one), other in zip(asdict(read).items(), asdict(written).values(), strict=True):
            np.testing.assert_array_equal(one, other, err_msg=name) if one is not None else None
            assert (one is None) == (other is None), name
    assert read_frame(tmp_path / "tracks.json") == FRAME


def test_box_lies_along_its_yaw() -> None:
    corners = footprint((4.0, 2.0, 1.5), (10, 20, 0, np.pi / 2))
    np.testing.assert_allclose(corners, [[9, 22], [9, 18], [11, 18], [11, 22]], atol=1e-9)


def test_yaw_is_interpolated_the_short_way() -> None:
    poses = np.array([[0.0, 0, 0, 3.1], [1.0, 0, 0, -3.1]])
    track = Track(1, "car", (4.2, 1.8, 1.5), np.array([0.0, 1.0]), poses, np.zeros((2, 2)), True, None)
    assert abs(np.cos(track.at([0.5])[0, 3]) + 1) < 1e-3


@pytest.mark.parametrize("content", ["no JSON", '{"version": 99, "tracks": []}', "[]"])
def test_invalid_track_files_are_rejected_with_their_name(tmp_path: Path, content: str) -> None:
    (tmp_path / "tracks.json").write_text(content)
    with pytest.raises(InputError, match=r"tracks\.json"):
        read_tracks(tmp_path / "tracks.json")
    with pytest.raises(InputError, match="not found"):
        read_tracks(tmp_path / "missing.json")

from __future__ import annotations

import itertools
from typing import Any

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError, UnavailableError
from scan2sim.services.teleoperation import encoders
from scan2sim.services.teleoperation.encoders import Decoder, Settings, planes
from scan2sim.services.teleoperation.video import rtp_packets
from tests.services.teleoperation.video.videos import psnr, scenery

each = pytest.mark.parametrize("name", plugins.names(encoders.__name__))


def encoder(name: str, settings: Settings) -> encoders.Encoder:
    backend: Any = plugins.module(encoders.__name__, name)
    lacking = backend.lacking()
    if lacking:
        pytest.skip(f"{name} {lacking.cause}")
    made: encoders.Encoder = backend.encoder(settings)
    return made


@each
def test_frames_are_there_at_once_and_key_frames_where_asked(name: str) -> None:
    decoder, made = Decoder(), encoder(name, Settings(320, 240, 30.0, 1_000_000))
    keys, quality = [], []
    for i, picture in enumerate(itertools.islice(scenery(), 60)):
        data = made.encode(planes(picture.image), picture.captured + 10**15, i == 30)
        image = decoder.decode(data)
        assert image is not None
        keys += [] if data[0] & 1 else [i]
        quality.append(psnr(image, picture.image))
    made.close()
    assert keys == [0, 30] and rtp_packets.size(made_key(name)) == (320, 240)
    assert min(quality) > 25 and np.median(quality) > 30


def made_key(name: str) -> bytes:
    made = encoder(name, Settings(320, 240, 30.0, 1_000_000))
    data = made.encode(planes(next(scenery()).image), 0, True)
    made.close()
    return data


@each
@pytest.mark.parametrize("bitrate", [300_000, 1_200_000])
def test_the_rate_is_kept_and_key_frames_are_bounded(name: str, bitrate: int) -> None:
    made = encoder(name, Settings(640, 480, 30.0, bitrate))
    street = np.random.default_rng(0).integers(0, 255, (60, 120, 3), np.uint8).repeat(16, 0).repeat(16, 1)
    street = cv2.GaussianBlur(street, (0, 0), 10).astype(np.uint8)
    sizes = []
    for i in range(120):
        part = np.ascontiguousarray(street[i : i + 480, 4 * i : 4 * i + 640])
        sizes.append(len(made.encode(planes(part), i * 33_333_333, i == 60)))
    made.close()
    share = bitrate / 8 / 30
    assert sum(sizes[30:]) < 1.25 * 90 * share
    assert sizes[60] < 4 * share and sizes[0] < 0.5 * bitrate / 8


def test_what_can_run_here_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: Any = encoders.find()
    assert chosen.lacking() is None and chosen.RANK <= plugins.module(encoders.__name__, "pyav").RANK
    for name in plugins.names(encoders.__name__):
        lacking = plugins.module(encoders.__name__, name).lacking()
        if lacking:
            with pytest.raises(UnavailableError) as caught:
                encoders.find(name)
            assert caught.value.cause == f"{name} {lacking.cause}" and caught.value.remedy == lacking.remedy
    with pytest.raises(SettingError, match="there is no 'theora'"):
        encoders.find("theora")


def test_what_is_no_frame_gives_no_picture() -> None:
    decoder = Decoder()
    assert decoder.decode(b"\x10nothing at all") is None
    assert decoder.decode(made_key("pyav")) is not None


def test_odd_rows_and_columns_are_cut_off() -> None:
    assert planes(np.zeros((241, 321, 3), np.uint8)).shape == (360, 320)

from __future__ import annotations

import itertools
from typing import Any

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError, UnavailableError
from scan2sim.services.teleoperation import encoders
from scan2sim.services.teleoperation.encoders import Decoder, EncoderSettings, to_i420
from scan2sim.services.teleoperation.video import rtp_packets
from tests.services.teleoperation.video.videos import psnr, scenery

each = pytest.mark.parametrize("name", plugins.names(encoders.__name__))


def encoder(name: str, settings: EncoderSettings) -> encoders.Encoder:
    backend: Any = plugins.module(encoders.__name__, name)
    reason = backend.unavailable()
    if reason:
        pytest.skip(f"{name} {reason.cause}")
    vp8_encoder: encoders.Encoder = backend.encoder(settings)
    return vp8_encoder


@each
def test_frames_are_encoded_at_once_with_key_frames_on_request(name: str) -> None:
    decoder, vp8_encoder = Decoder(), encoder(name, EncoderSettings(320, 240, 30.0, 1_000_000))
    keys, quality = [], []
    for i, frame in enumerate(itertools.islice(scenery(), 60)):
        data = vp8_encoder.encode(to_i420(frame.image), frame.captured + 10**15, i == 30)
        image = decoder.decode(data)
        assert image is not None
        keys += [] if data[0] & 1 else [i]
        quality.append(psnr(image, frame.image))
    vp8_encoder.close()
    assert keys == [0, 30] and rtp_packets.key_frame_size(key_frame(name)) == (320, 240)
    assert min(quality) > 25 and np.median(quality) > 30


def key_frame(name: str) -> bytes:
    vp8_encoder = encoder(name, EncoderSettings(320, 240, 30.0, 1_000_000))
    data = vp8_encoder.encode(to_i420(next(scenery()).image), 0, True)
    vp8_encoder.close()
    return data


@each
@pytest.mark.parametrize("bitrate", [300_000, 1_200_000])
def test_bit_rate_is_kept_and_key_frames_are_limited(name: str, bitrate: int) -> None:
    vp8_encoder = encoder(name, EncoderSettings(640, 480, 30.0, bitrate))
    street = np.random.default_rng(0).integers(0, 255, (60, 120, 3), np.uint8).repeat(16, 0).repeat(16, 1)
    street = cv2.GaussianBlur(street, (0, 0), 10).astype(np.uint8)
    sizes = []
    for i in range(120):
        part = np.ascontiguousarray(street[i : i + 480, 4 * i : 4 * i + 640])
        sizes.append(len(vp8_encoder.encode(to_i420(part), i * 33_333_333, i == 60)))
    vp8_encoder.close()
    share = bitrate / 8 / 30
    assert sum(sizes[30:]) < 1.25 * 90 * share
    assert sizes[60] < 4 * share and sizes[0] < 0.5 * bitrate / 8


def test_available_encoder_of_lowest_rank_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: Any = encoders.find()
    assert chosen.unavailable() is None and chosen.RANK <= plugins.module(encoders.__name__, "pyav").RANK
    for name in plugins.names(encoders.__name__):
        reason = plugins.module(encoders.__name__, name).unavailable()
        if reason:
            with pytest.raises(UnavailableError) as caught:
                encoders.find(name)
            assert caught.value.cause == f"{name} {reason.cause}" and caught.value.remedy == reason.remedy


@pytest.mark.parametrize("name", ["theora", "vaapi", "../pyav"])
def test_unknown_encoder_lists_available_ones(name: str) -> None:
    with pytest.raises(SettingError, match="unknown value") as caught:
        encoders.find(name)
    assert caught.value.remedy == "Choose one of: pyav"


def test_invalid_data_decodes_to_none() -> None:
    decoder = Decoder()
    assert decoder.decode(b"\x10nothing at all") is None
    assert decoder.decode(key_frame("pyav")) is not None


def test_odd_rows_and_columns_are_cropped() -> None:
    assert to_i420(np.zeros((241, 321, 3), np.uint8)).shape == (360, 320)

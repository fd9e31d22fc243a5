"""Images that are sent fit what they are allowed, as well as they can, and more is allowed never makes them worse."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.qos.encoding import (
    by_http,
    choose_h264,
    choose_jpeg,
    jpeg,
    pictures,
    scaled,
    stream,
)

RATE = 10.0


@pytest.fixture(scope="module")
def images() -> list[U8]:
    """Twenty of a pattern that moves, with a sensor's noise."""
    import cv2

    rng = np.random.default_rng(3)
    wide = cv2.resize(rng.integers(0, 255, (18, 40, 3), np.uint8), (400, 180), interpolation=cv2.INTER_CUBIC)
    shown = (wide[:, 3 * i : 3 * i + 320].astype(np.int16) for i in range(20))
    return [np.clip(one + rng.normal(0, 4, one.shape), 0, 255).astype(np.uint8) for one in shown]


def test_jpegs_never_take_more_than_allowed_and_are_as_good_as_that_lets(images: list[U8]) -> None:
    chosen = [choose_jpeg(images, RATE, budget) for budget in (0.5, 0.7, 1, 1.5, 2, 4, 50)]
    for budget, one in zip((0.5, 0.7, 1, 1.5, 2, 4, 50), chosen, strict=True):
        sent = [by_http(len(one.encoded(image))) for image in images]
        assert 8e-6 * RATE * sum(sent) / len(sent) <= one.megabits <= budget
    assert all(a.scale <= b.scale for a, b in pairwise(chosen)) and len(set(chosen)) > 3
    assert all(a.quality <= b.quality for a, b in pairwise(chosen) if a.scale == b.scale)
    assert chosen[-1].scale == 1 and chosen[-1].quality == 90
    assert chosen[0].scale < 1, "where quality alone doesn't do"


def test_what_cant_fit_is_said(images: list[U8]) -> None:
    with pytest.raises(InputError, match=r"0\.01 Mbit/s.* are needed"):
        choose_jpeg(images, RATE, 0.01)


def test_headers_count() -> None:
    assert by_http(100_000) > 100_000 * 1.04
    assert by_http(1_000_000) - by_http(0) == pytest.approx(1_000_000 * (1 + 1.5 * 66 / 1448), rel=0.001)


def test_a_stream_never_takes_more_than_allowed(images: list[U8]) -> None:
    pytest.importorskip("av", reason="the extra slam isn't installed")
    chosen = [choose_h264(images, RATE, budget) for budget in (0.1, 0.3, 1.0, 3.0)]
    for budget, one in zip((0.1, 0.3, 1.0, 3.0), chosen, strict=True):
        assert budget / 2 < one.megabits <= budget
    assert [one.bitrate for one in chosen] == sorted(one.bitrate for one in chosen)


def test_a_streams_pictures_come_back_in_order_and_better_for_more(images: list[U8]) -> None:
    pytest.importorskip("av", reason="the extra slam isn't installed")
    off = []
    for bitrate in (1e5, 1e6):
        came = list(pictures(list(stream(images, RATE, bitrate))))
        assert len(came) == len(images)
        errors = [[np.abs(a.astype(int) - b).mean() for b in images] for a in came]
        assert list(np.argmin(errors, axis=1)) == list(range(len(images)))
        off.append(np.diag(errors).mean())
    assert off[1] < off[0]


def test_scales_and_qualities_make_less(images: list[U8]) -> None:
    assert scaled(images[0], 0.5).shape == (90, 160, 3) and scaled(images[0], 1.0) is images[0]
    assert len(jpeg(images[0], 30)) < len(jpeg(images[0], 80))


def test_the_command_tells_both_choices(images: list[U8], tmp_path: Path) -> None:
    pytest.importorskip("av", reason="the extra slam isn't installed")
    for number, image in enumerate(images):
        Image.fromarray(image).save(tmp_path / f"{number:02}.png")
    told = CliRunner().invoke(app, ["qos", "choose", str(tmp_path), "--rate", str(RATE), "--budget", "1"])
    assert told.exit_code == 0, told.output
    chosen = choose_jpeg(images, RATE, 1.0)
    assert f"quality {chosen.quality}" in told.output and "Mbit/s for the encoder" in told.output

"""Chosen encodings fit the budget with the best possible quality, and a larger budget never lowers the quality."""

from __future__ import annotations

import json
import shutil
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
    choose_h264,
    choose_jpeg,
    decode_h264,
    encode_h264,
    http_wire_bytes,
    jpeg,
    scaled,
)
from tests.conftest import ROOT

RATE = 10.0
SAMPLE_IMAGES = ROOT / "data_samples" / "tile"


@pytest.fixture(scope="module")
def images() -> list[U8]:
    """Twenty frames of a moving pattern with sensor noise."""
    import cv2

    rng = np.random.default_rng(3)
    wide = cv2.resize(rng.integers(0, 255, (18, 40, 3), np.uint8), (400, 180), interpolation=cv2.INTER_CUBIC)
    shown = (wide[:, 3 * i : 3 * i + 320].astype(np.int16) for i in range(20))
    return [np.clip(one + rng.normal(0, 4, one.shape), 0, 255).astype(np.uint8) for one in shown]


def test_jpegs_fit_the_budget_with_the_best_quality(images: list[U8]) -> None:
    chosen = [choose_jpeg(images, RATE, budget) for budget in (0.5, 0.7, 1, 1.5, 2, 4, 50)]
    for budget, one in zip((0.5, 0.7, 1, 1.5, 2, 4, 50), chosen, strict=True):
        sent = [http_wire_bytes(len(one.encoded(image))) for image in images]
        assert 8e-6 * RATE * sum(sent) / len(sent) <= one.megabits <= budget
    assert all(a.scale <= b.scale for a, b in pairwise(chosen)) and len(set(chosen)) > 3
    assert all(a.quality <= b.quality for a, b in pairwise(chosen) if a.scale == b.scale)
    assert chosen[-1].scale == 1 and chosen[-1].quality == 90
    assert chosen[0].scale < 1, "where lowering the quality isn't enough"


def test_a_budget_that_is_too_small_is_reported(images: list[U8]) -> None:
    with pytest.raises(InputError, match=r"0\.01 Mbit/s.* need at least"):
        choose_jpeg(images, RATE, 0.01)


def test_http_overhead_is_counted() -> None:
    assert http_wire_bytes(100_000) > 100_000 * 1.04
    assert http_wire_bytes(1_000_000) - http_wire_bytes(0) == pytest.approx(
        1_000_000 * (1 + 1.5 * 66 / 1448), rel=0.001
    )


def test_a_stream_fits_the_budget(images: list[U8]) -> None:
    pytest.importorskip("av", reason="the extra slam isn't installed")
    chosen = [choose_h264(images, RATE, budget) for budget in (0.1, 0.3, 1.0, 3.0)]
    for budget, one in zip((0.1, 0.3, 1.0, 3.0), chosen, strict=True):
        assert budget / 2 < one.megabits <= budget
    assert [one.bitrate for one in chosen] == sorted(one.bitrate for one in chosen)


def test_decoded_frames_are_in_order_and_better_with_a_higher_bit_rate(images: list[U8]) -> None:
    pytest.importorskip("av", reason="the extra slam isn't installed")
    mean_errors = []
    for bitrate in (1e5, 1e6):
        decoded = list(decode_h264(list(encode_h264(images, RATE, bitrate))))
        assert len(decoded) == len(images)
        errors = [[np.abs(a.astype(int) - b).mean() for b in images] for a in decoded]
        assert list(np.argmin(errors, axis=1)) == list(range(len(images)))
        mean_errors.append(np.diag(errors).mean())
    assert mean_errors[1] < mean_errors[0]


def test_lower_scale_and_quality_give_smaller_images(images: list[U8]) -> None:
    assert scaled(images[0], 0.5).shape == (90, 160, 3) and scaled(images[0], 1.0) is images[0]
    assert len(jpeg(images[0], 30)) < len(jpeg(images[0], 80))


def test_the_command_prints_both_choices(images: list[U8], tmp_path: Path) -> None:
    pytest.importorskip("av", reason="the extra slam isn't installed")
    for number, image in enumerate(images):
        Image.fromarray(image).save(tmp_path / f"{number:02}.png")
    run = CliRunner().invoke(app, ["qos", "choose", str(tmp_path), "--rate", str(RATE), "--budget", "1"])
    assert run.exit_code == 0, run.output
    chosen = choose_jpeg(images, RATE, 1.0)
    assert f"quality {chosen.quality}" in run.output and "Mbit/s for the encoder" in run.output
    assert run.output.count("; agreement ") == 2


def test_the_command_shows_what_accuracy_an_encoding_costs(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="the extra slam isn't installed")
    shutil.copytree(SAMPLE_IMAGES, tmp_path / "tile")
    photos = sorted((tmp_path / "tile").rglob("*.jpg"))
    kept = []
    for name, budget in (("rich", 40.0), ("poor", 0.7)):
        folder = tmp_path / name
        folder.mkdir()
        for photo in photos:
            shutil.copy(photo, folder)
        arguments = ["qos", "choose", str(folder), "--rate", "2", "--budget", str(budget), "--json"]
        run = CliRunner().invoke(app, arguments)
        assert run.exit_code == 0, run.output
        kept.append(json.loads(run.output))
    assert kept[0]["detector"] == "vehicles"
    assert 0.7 < kept[0]["jpeg"]["agreement"] <= 1 and kept[1]["jpeg"]["agreement"] < kept[0]["jpeg"]["agreement"]

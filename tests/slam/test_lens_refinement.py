"""A given lens that the images contradict is refined, and the drive tracked again with it; `fixed_lens` keeps it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import Trajectory
from scan2sim.slam.steps.track import TrackParams, track_video
from tests.slam.conftest import PERSPECTIVE

WRONG = 1.04
"""Ratio of the given focal length and the true one."""


@pytest.fixture(scope="module")
def frames(turn: tuple[Trajectory, np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    for k, grey in enumerate(turn[1]):
        cv2.imwrite(str(folder / f"{k:03d}.png"), grey)
    return folder


def tracked(frames: Path, out: Path, factor: float, *, fixed_lens: bool = False) -> Done:
    """Track a turn with a focal length that is wrong by a factor."""
    centre = PERSPECTIVE.cx, PERSPECTIVE.cy
    params = TrackParams(focal=factor * PERSPECTIVE.fx, centre=centre, camera="pinhole", fixed_lens=fixed_lens)
    return track_video({"video": frames}, params, out, silent, out)


def test_wrong_lens_is_refined_and_reported(frames: Path, tmp_path: Path) -> None:
    done = tracked(frames, tmp_path, WRONG)
    assert abs(done.metrics["lens"]["focal"] / PERSPECTIVE.fx - 1) < 0.5 * (WRONG - 1)
    assert any("refinement of the given lens" in text and "--fixed-lens" in text for text in done.warnings)


def test_fixed_lens_is_kept_with_a_warning(frames: Path, tmp_path: Path) -> None:
    done = tracked(frames, tmp_path, WRONG, fixed_lens=True)
    assert "lens" not in done.metrics
    assert any("the images fit" in text for text in done.warnings)


def test_correct_lens_is_kept_without_a_warning(frames: Path, tmp_path: Path) -> None:
    done = tracked(frames, tmp_path, 1.0)
    assert "lens" not in done.metrics and not any("the images fit" in text for text in done.warnings)

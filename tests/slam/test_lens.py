"""Whether a wrong lens is noticed, and a right one isn't doubted."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.slam.lens import changed_lens, fit_lens, lens_warning
from tests.fakes.slam_drive import LENS, mistaken
from tests.present import present


@pytest.mark.parametrize(
    ("off", "said"),
    [
        pytest.param((0, 0, 0, 0), None, id="right"),
        pytest.param((-0.05, 0, 0, 0), "a focal length of", id="short", marks=pytest.mark.slow),
        pytest.param((-0.7, 0, 0, 0), "a focal length of", id="half"),
        pytest.param((0, 0.1, 0, 0), "a centre at", id="cropped", marks=pytest.mark.slow),
        pytest.param((0, 0, 0, 0.15), "distortion k1", id="bent"),
    ],
)  # fmt: skip
def test_a_lens_that_is_wrong_is_noticed_in_a_turn_and_a_better_one_named(
    off: tuple[float, ...], said: str | None
) -> None:
    given = changed_lens(LENS, np.array(off))
    misfits = mistaken(given, seed=1).map.misfits
    text = lens_warning(given, fit_lens(given, misfits))
    assert (text is None) == (said is None)
    assert said is None or said in present(text)
    found = present(fit_lens(given, misfits))
    wrong = np.array([np.log(found.camera.fx / LENS.fx), (found.camera.cx - LENS.cx) / LENS.fx])
    assert np.all(np.abs(wrong) < max(0.02, 0.4 * np.abs(off).max()))


def test_straight_ahead_nothing_is_said_of_the_lens() -> None:
    given = changed_lens(LENS, np.array([0.3, 0, 0, 0]))
    assert lens_warning(given, fit_lens(given, mistaken(given, seed=1, turn=0.0).map.misfits)) is None

"""Whether a wrong focal length is noticed, and a right one isn't doubted."""

from __future__ import annotations

import pytest

from scan2sim.slam.lens import told
from tests.slam.made_up import misfits_of


@pytest.mark.parametrize(("wrong", "noticed"), [(1.0, False), (0.95, True), (1.05, True)])
def test_five_percent_are_noticed_in_a_turn(wrong: float, noticed: bool) -> None:
    said = told(misfits_of(wrong, seed=1), 700 * wrong)
    assert (said is not None) == noticed
    if said is not None:
        better = float(said.split("length of ")[1].split()[0])
        assert abs(better - 700) < 15

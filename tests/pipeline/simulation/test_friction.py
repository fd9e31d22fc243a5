"""Friction by class of the ground."""

from __future__ import annotations

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.simulation.friction import coefficient

GROUND = (CODE["road"], CODE["sidewalk"], CODE["terrain"])


def test_soil_is_slipperier_than_asphalt() -> None:
    assert coefficient(CODE["road"], GROUND) == 0.9 == coefficient(CODE["building"], GROUND)
    assert coefficient(CODE["terrain"], GROUND) == 0.68


def test_wetness_scales_all_frictions() -> None:
    assert coefficient(CODE["road"], GROUND, 0.45) == 0.45
    assert coefficient(CODE["terrain"], GROUND, 0.45) == 0.34


def test_unclassified_ground_counts_as_paved() -> None:
    assert coefficient(CODE["terrain"], (CODE["terrain"],), 0.8) == 0.8

"""Settings of a tile made from a robot's map: lengths follow the spacing, the user's values take precedence."""

from __future__ import annotations

import numpy as np

from scan2sim.flows.pipelines.map_defaults import map_defaults
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.pipeline.core.types import RobotMap
from scan2sim.pipeline.steps.islands import ISLANDS
from scan2sim.pipeline.steps.voxel import VOXEL
from scan2sim.texturing.unwrap import UNWRAP


def outdoor(spacing: float) -> RobotMap:
    return RobotMap("outdoor", spacing, 1.0, np.eye(4))


def test_other_tiles_keep_their_defaults() -> None:
    assert map_defaults(None) == {}
    assert "voxel" not in map_defaults(outdoor(0.05))


def test_lengths_follow_the_spacing() -> None:
    settings = Settings().with_defaults(map_defaults(outdoor(0.5)))
    assert settings.params(VOXEL, "terrain").size == 0.45
    assert settings.params(ISLANDS, "terrain").min_area > settings.params(ISLANDS, "building").min_area > 0.5
    assert settings.params(UNWRAP, "terrain").texel == 0.2
    assert settings.params(UNWRAP, "vegetation").texel > 0.2


def test_user_settings_take_precedence() -> None:
    settings = Settings.of({"voxel.size": 0.2, "islands.terrain.min_area": 1.0, "unwrap.texel": 0.05})
    settings = settings.with_defaults(map_defaults(outdoor(0.5)))
    assert settings.params(VOXEL, "building").size == 0.2
    assert settings.params(ISLANDS, "terrain").min_area == 1.0
    assert settings.params(UNWRAP, "vegetation").texel == 0.05

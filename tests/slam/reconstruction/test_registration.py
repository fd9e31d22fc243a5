"""Registration of a reconstruction to a cloud."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.geometry.similarity import Similarity
from scan2sim.slam.reconstruction.registration import candidates, climb, moved
from scan2sim.slam.scan_pairs import surface_of
from tests.fakes import textured_street

CENTRES = textured_street.poses()[:, :3, 3]
TRUE = Similarity(1.0, np.eye(3), np.zeros(3))


def test_candidates_contain_the_true_position_in_spite_of_offsets() -> None:
    cloud = textured_street.cloud(textured_street.street(), Frame(), spacing=0.15).xyz.astype(np.float64)
    points, surface = cloud[::40], surface_of(cloud)
    coarse = moved(TRUE, CENTRES.mean(axis=0), np.array([1.5, -1.2, 45.0, 0.0, 0.0, 0.03, 0.01]))
    found = candidates(points, np.full(len(points), 0.02), CENTRES, surface, coarse, 2.0)
    errors = [np.linalg.norm(one.apply(CENTRES) - CENTRES, axis=1).max() for one in found]
    assert min(errors) < 0.5 and len(found) < 40  # photos select one of them


def test_hill_climbing_finds_the_maximum_of_a_score() -> None:
    middle = CENTRES.mean(axis=0)
    goal = moved(TRUE, middle, np.array([0.6, -0.3, 0.2, 0.0, 0.02, -0.04, 0.02]))

    def score(onto: Similarity) -> float:
        corners = middle + 10 * np.vstack([np.eye(3), -np.eye(3)])
        return -float(np.square(onto.apply(corners) - goal.apply(corners)).sum())

    best, _ = climb(score, TRUE, middle, 15.0, (1.0, 0.5, 0.25, 0.12, 0.06, 0.03, 0.01))
    assert np.linalg.norm(best.apply(CENTRES) - goal.apply(CENTRES), axis=1).max() < 0.05

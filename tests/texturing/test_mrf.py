"""View selection of one photo per face, against exhaustive search."""

import itertools
from collections.abc import Sequence

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F32, I32
from scan2sim.texturing.view_selection.mrf import adjacent, costs, detail_views, solve


def energy(selected: Sequence[int] | I32, view: I32, cost: F32, pairs: I32, seam_cost: F32) -> float:
    """Energy of a selection: data costs and seam costs."""
    own = sum(cost[i, list(view[i]).index(selected[i])] for i in range(len(selected)))
    return own + sum(seam_cost[k] for k, (a, b) in enumerate(pairs) if selected[a] != selected[b])


@pytest.mark.parametrize("seed", range(8))
def test_energy_is_close_to_the_optimum(seed: int) -> None:
    rng = np.random.default_rng(seed)
    view = np.array([rng.choice(4, 3, replace=False) for _ in range(7)], np.int32)
    quality = (rng.random((7, 3)) + 0.01).astype(np.float32)
    pairs = np.array([(i, i + 1) for i in range(6)] + [(0, 3), (2, 6)], np.int32)
    seam_cost = (0.5 * rng.random(len(pairs))).astype(np.float32)
    cost = costs(view, quality)
    solution = solve(view, cost, pairs, seam_cost)
    best = min(energy(x, view, cost, pairs, seam_cost) for x in itertools.product(*view))
    assert solution.bound <= best + 1e-5
    assert solution.energy == pytest.approx(energy(solution.view, view, cost, pairs, seam_cost), abs=1e-5)
    assert solution.energy <= 1.002 * best + 1e-5


def test_higher_seam_cost_gives_fewer_seams() -> None:
    rng = np.random.default_rng(0)
    n = 400
    view = np.tile(np.array([0, 1], np.int32), (n, 1))
    quality = (1 + 0.3 * rng.random((n, 2))).astype(np.float32)
    pairs = np.column_stack([np.arange(n - 1), np.arange(1, n)]).astype(np.int32)

    def seams(seam_cost: float) -> int:
        selected = detail_views(view, quality, pairs, np.full(n - 1, seam_cost, np.float32))
        return int((selected[1:] != selected[:-1]).sum())

    assert seams(0.0) > 100 and seams(0.02) < seams(0.0) / 2 and seams(10.0) == 0


def test_unseen_faces_have_no_view_and_do_not_constrain_neighbours() -> None:
    view = np.array([[0, 1], [-1, -1], [1, -1]], np.int32)
    quality = np.array([[1, 0.9], [0, 0], [1, 0]], np.float32)
    pairs = np.array([[0, 1], [1, 2]], np.int32)
    assert detail_views(view, quality, pairs, np.array([9, 9], np.float32)).tolist() == [0, -1, 1]


def test_adjacent_faces_share_an_edge() -> None:
    pairs, edge = adjacent(np.array([[0, 1, 2], [2, 1, 3], [3, 1, 4]], np.int32))
    assert sorted(map(tuple, pairs.tolist())) == [(0, 1), (1, 2)]
    assert {tuple(sorted(e)) for e in edge.tolist()} == {(1, 2), (1, 3)}

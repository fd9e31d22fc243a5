"""Lamps: points of an arm and a lamp head of known position, at the top of a pole."""

from __future__ import annotations

import json

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.furniture.lamps import Arm, fit_arm
from scan2sim.pipeline.furniture.poles import Stem

FOOT, TOP = np.array([12.0, -7.0, 1.0]), np.array([12.0, -7.0, 9.0])
STEM = Stem(np.linspace(FOOT, TOP, 9), np.full(9, 0.07), 0.004, 0.005)
LENGTH, RISE, ARM_RADIUS = 1.5, 0.3, 0.03
"""Length of the arm in plan view, its rise, and its radius, metres."""
HEAD_HALF = np.array([0.3, 0.12, 0.06])
"""Half extents of the lamp head along the arm, across and up, metres."""


def axes(heading: float) -> F64:
    """Axes (3, 3) of the arm: along in plan view, across, up."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])


def pole_points(rng: np.random.Generator) -> F64:
    angle, z = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(FOOT[2], TOP[2], 3000)
    return np.column_stack([TOP[0] + 0.07 * np.cos(angle), TOP[1] + 0.07 * np.sin(angle), z])


def arm_points(rng: np.random.Generator, count: int = 900, start: float = 0.0) -> F64:
    """Points (N, 3) along, across and up from the top of the pole, on the surface of the arm."""
    t, angle = rng.uniform(start / LENGTH, 1, count), rng.uniform(0, 2 * np.pi, count)
    return np.column_stack([LENGTH * t, ARM_RADIUS * np.cos(angle), RISE * t + ARM_RADIUS * np.sin(angle)])


def head_centre() -> F64:
    """Centre (3,) of the lamp head, along, across and up: it begins at the end of the arm."""
    return np.array([LENGTH + HEAD_HALF[0], 0.0, RISE])


def head_points(rng: np.random.Generator, count: int = 1500) -> F64:
    """Points (N, 3) on the surface of the lamp head, along, across and up from the top of the pole."""
    area = np.array([HEAD_HALF[1] * HEAD_HALF[2], HEAD_HALF[0] * HEAD_HALF[2], HEAD_HALF[0] * HEAD_HALF[1]])
    face, points = rng.choice(3, count, p=area / area.sum()), rng.uniform(-1, 1, (count, 3))
    points[np.arange(count), face] = rng.choice((-1.0, 1.0), count)
    return points * HEAD_HALF + head_centre()


def lamp(heading: float = 0.0, *, head: bool = True, noise: float = 0.004, seed: int = 0) -> F64:
    """Points (N, 3) of a pole with an arm, and with a lamp head."""
    rng = np.random.default_rng(seed)
    local = np.concatenate([arm_points(rng), head_points(rng)] if head else [arm_points(rng)])
    xyz = np.concatenate([pole_points(rng), TOP + local @ axes(heading)])
    return np.asarray(xyz + rng.normal(0, noise, xyz.shape))


def fit(xyz: F64, stem: Stem = STEM, ground: float = FOOT[2], leafy: bool = False) -> Arm | None:
    return fit_arm(stem, ground, xyz, np.full(len(xyz), leafy))


def assert_path(arm: Arm, heading: float) -> None:
    """The axis of the arm is within 3 cm of the true one, up to the head."""
    for point in arm.path:
        along, across, up = axes(heading) @ (point - TOP)
        assert abs(across) < 0.03 and abs(up - RISE * min(along / LENGTH, 1)) < 0.03


@pytest.mark.parametrize("heading", [0.0, 0.7, 2.5, -1.9])
@pytest.mark.parametrize("seed", [0, 1])
def test_arm_and_head_are_fitted_at_their_true_positions(heading: float, seed: int) -> None:
    arm = fit(lamp(heading, seed=seed))
    assert arm is not None and arm.box is not None
    assert arm.path[0] == pytest.approx(TOP)
    assert_path(arm, heading)
    assert arm.direction == pytest.approx(axes(heading)[0, :2], abs=0.02)
    assert arm.radius == pytest.approx(ARM_RADIUS, abs=0.01)
    centre, half = arm.box
    assert axes(heading) @ (centre - TOP) == pytest.approx(head_centre(), abs=0.06)
    assert half[1:] == pytest.approx(HEAD_HALF[1:], abs=0.015)
    assert half[0] == pytest.approx(HEAD_HALF[0], abs=0.1)  # its inner end is rounded to sections of 20 cm
    outer = axes(heading)[0] @ (centre - TOP) + half[0]
    assert outer == pytest.approx(LENGTH + 2 * HEAD_HALF[0], abs=0.03)
    assert arm.path[-1] == pytest.approx(centre)


def test_arm_without_a_head_has_no_box() -> None:
    arm = fit(lamp(0.4, head=False))
    assert arm is not None and arm.box is None
    assert_path(arm, 0.4)
    end = axes(0.4)[0] @ (arm.path[-1] - TOP)
    assert LENGTH - 0.2 < end < LENGTH


def test_fit_is_equivariant_to_rigid_motion() -> None:
    xyz = lamp(0.3)
    arm = fit(xyz)
    shift, turn = np.array([128.0, -64.0, 32.0]), axes(1.1).T
    stem = Stem((STEM.centre - TOP) @ turn.T + TOP + shift, STEM.radius, STEM.spread, STEM.wobble)
    moved = fit((xyz - TOP) @ turn.T + TOP + shift, stem, FOOT[2] + shift[2])
    assert arm is not None and arm.box is not None and moved is not None and moved.box is not None
    assert moved.path == pytest.approx((arm.path - TOP) @ turn.T + TOP + shift, abs=1e-6)
    assert moved.box[0] == pytest.approx(turn @ (arm.box[0] - TOP) + TOP + shift, abs=1e-6)
    assert moved.box[1] == pytest.approx(arm.box[1], abs=1e-6)
    assert moved.radius == pytest.approx(arm.radius, abs=1e-6)
    assert arm.moved(shift).path == pytest.approx(arm.path + shift)
    assert arm.moved(shift).box[0] == pytest.approx(arm.box[0] + shift)  # type: ignore[index]


def test_fit_is_independent_of_the_order_of_points() -> None:
    xyz = lamp(0.3)
    one, two = fit(xyz), fit(xyz[np.random.default_rng(5).permutation(len(xyz))])
    assert one is not None and two is not None and one.box is not None and two.box is not None
    assert two.path == pytest.approx(one.path, abs=1e-9) and two.box[0] == pytest.approx(one.box[0], abs=1e-9)


def test_arm_contains_only_points_of_the_lamp() -> None:
    xyz = lamp(0.7)
    arm = fit(xyz)
    assert arm is not None
    assert arm.contains(xyz[3000:], 0.06).mean() > 0.99
    local = np.array([[0.7, 0.25, 0.14], [0.7, 0, -0.3], [1.8, 0, 0.6], [2.4, 0, 0.3], [-0.3, 0, 0]])
    assert not arm.contains(TOP + local @ axes(0.7), 0.06).any()


def test_meshes_cover_arm_and_head() -> None:
    arm = fit(lamp(2.0))
    assert arm is not None and arm.box is not None
    (tube, _), (box, _) = arm.meshes()
    assert np.isfinite(tube).all() and np.isfinite(box).all()
    along = (box - TOP) @ axes(2.0).T
    assert along.max(axis=0) == pytest.approx(head_centre() + HEAD_HALF, abs=0.04)
    assert along[:, 1:].min(axis=0) == pytest.approx((head_centre() - HEAD_HALF)[1:], abs=0.04)
    assert np.linalg.norm(tube - TOP, axis=1).min() < 0.06


def test_json_round_trip() -> None:
    for head in (True, False):
        arm = fit(lamp(0.5, head=head))
        assert arm is not None
        again = Arm.from_json(json.loads(json.dumps(arm.to_json())))
        np.testing.assert_array_equal(again.path, arm.path)
        assert again.radius == arm.radius and (again.box is None) == (not head)
        if arm.box is not None and again.box is not None:
            np.testing.assert_array_equal(again.box, arm.box)


def test_only_the_arm_of_a_tall_pole_is_a_lamp() -> None:
    xyz = lamp()
    assert fit(xyz) is not None
    assert fit(xyz, ground=TOP[2] - 3.0) is None, "a short pole"
    assert fit(xyz, leafy=True) is None, "a branch"
    rng = np.random.default_rng(0)
    assert fit(pole_points(rng) + rng.normal(0, 0.004, (3000, 3))) is None, "a pole alone"
    apart = TOP + np.concatenate([arm_points(rng, start=0.5), head_points(rng)]) @ axes(0)
    assert fit(np.concatenate([pole_points(rng), apart])) is None, "separated from the pole"
    short = TOP + rng.uniform((0.1, -0.05, -0.05), (0.35, 0.05, 0.05), (500, 3))
    assert fit(np.concatenate([pole_points(rng), short])) is None, "shorter than an arm"
    crown = TOP + rng.uniform((0.1, -0.6, -0.6), (2.0, 0.6, 0.6), (5000, 3))
    assert fit(np.concatenate([pole_points(rng), crown])) is None, "wider than an arm"


@pytest.mark.parametrize(("length", "is_lamp"), [(3.2, True), (3.7, False), (6.0, False)])
def test_arm_longer_than_the_maximum_is_not_a_lamp(length: float, is_lamp: bool) -> None:
    """A wire or a bridge that begins at a pole must not become an arm of the maximum length."""
    rng = np.random.default_rng(0)
    bar = TOP + rng.uniform((0, -0.04, -0.04), (length, 0.04, 0.04), (int(1000 * length), 3))
    assert (fit(np.concatenate([pole_points(rng), bar])) is not None) == is_lamp


def test_too_few_or_degenerate_points_are_not_a_lamp() -> None:
    rng = np.random.default_rng(0)
    assert fit(np.zeros((0, 3))) is None
    assert fit(TOP + [[0.5, 0, 0]]) is None
    assert fit(TOP + arm_points(rng, 29)) is None
    assert fit(np.repeat(TOP[None] + (0.1, 0, 0), 100, axis=0)) is None


def test_coincident_or_collinear_points_give_a_finite_arm() -> None:
    line = TOP + np.column_stack([np.linspace(0.12, 1.5, 200), np.zeros((200, 2))])
    place = TOP + np.tile([0.41, 0.0, 0.1], (200, 1))
    near = TOP + np.column_stack([np.linspace(0.12, 0.41, 10), np.zeros(10), np.linspace(0, 0.1, 10)])
    for xyz in (line, np.concatenate([place, near])):
        arm = fit(xyz)
        assert arm is not None and np.isfinite(arm.path).all() and np.isfinite(arm.radius)
        assert all(np.isfinite(vertices).all() for vertices, _ in arm.meshes())


def test_sparse_wire_with_points_behind_the_pole_is_not_a_lamp() -> None:
    """No section of the arm has enough points for a centre."""
    wire = np.column_stack([np.arange(0.15, 3.3, 0.19), np.zeros((17, 2))])
    behind = np.column_stack([np.full(16, -0.12), np.linspace(-0.02, 0.02, 16), np.zeros(16)])
    assert fit(TOP + np.concatenate([wire, behind])) is None

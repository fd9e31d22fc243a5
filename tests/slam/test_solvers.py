"""Solvers of the graph compared with a slow reference and each other; custom constraints."""

from dataclasses import replace

import numpy as np
import pytest

from scan2sim.pipeline.core.plugins import names
from scan2sim.pipeline.core.types import F64
from scan2sim.slam import solvers
from scan2sim.slam.factor_graph import DistanceConstraint, Factor, Graph, Solution, errors
from scan2sim.slam.geometry import exp_so3
from scan2sim.slam.solvers import lm


def street(cameras: int = 8, points: int = 120, noise: float = 5e-4, seed: int = 0) -> tuple[F64, Graph]:
    """True poses, and a graph with wrong initial values."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (cameras, 1, 1))
    poses[:, 2, 3] = 2.5 * np.arange(cameras)
    poses[:, :3, :3] = exp_so3(rng.normal(0, 0.02, (cameras, 3)))
    xyz = rng.uniform([-20, -6, -10], [20, 2, 2.5 * cameras + 10], (points, 3))
    xyz[:, 0] += 4 * np.sign(xyz[:, 0])
    point, camera = (part.ravel().astype(np.int32) for part in np.mgrid[:points, :cameras])
    bearing = np.einsum("oji,oj->oi", poses[camera, :3, :3], xyz[point] - poses[camera, :3, 3])
    bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
    bearing += rng.normal(0, noise, bearing.shape)
    bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
    start = poses.copy()
    start[2:, :3, 3] += rng.normal(0, 0.15, (cameras - 2, 3))
    start[2:, :3, :3] = exp_so3(rng.normal(0, 0.005, (cameras - 2, 3))) @ start[2:, :3, :3]
    fixed = np.arange(cameras) < 2
    xyz = xyz + rng.normal(0, 0.2, xyz.shape)
    return poses, Graph(start, xyz, point, camera, bearing, fixed, np.radians(0.1))


def positions(solved: Solution) -> F64:
    return solved.poses[:, :3, 3]


def test_levenberg_marquardt_reaches_the_minimum_of_a_general_solver() -> None:
    from scipy.optimize import minimize

    _, graph = street(4, 12)
    free = ~graph.fixed
    n = 6 * int(free.sum())

    def unpack(x: F64) -> tuple[F64, F64]:
        poses = graph.poses.copy()
        poses[free, :3, 3] += x[:n].reshape(-1, 6)[:, :3]
        poses[free, :3, :3] = exp_so3(0.1 * x[:n].reshape(-1, 6)[:, 3:]) @ poses[free, :3, :3]
        return poses, graph.points + x[n:].reshape(-1, 3)

    def cost(x: F64) -> float:
        return np.log1p((np.sin(errors(graph, *unpack(x))) / graph.sigma) ** 2).sum()

    solved = lm.solve(graph, iterations=50)
    start = np.zeros(n + graph.points.size)
    slow = minimize(cost, start, method="BFGS", options={"maxiter": 150})
    fast = np.log1p((np.sin(errors(graph, solved.poses, solved.points)) / graph.sigma) ** 2).sum()
    assert cost(start) > 20 * fast
    assert fast < 1.01 * slow.fun


@pytest.mark.parametrize("name", names(solvers.__name__))
def test_every_backend_estimates_the_poses(name: str) -> None:
    if name == "adam":
        pytest.importorskip("torch")
    poses, graph = street()
    solved = solvers.named(name).solve(graph)
    before = np.abs(graph.poses[:, :3, 3] - poses[:, :3, 3]).max()
    assert np.abs(positions(solved) - poses[:, :3, 3]).max() < 0.2 * before
    assert np.median(errors(graph, solved.poses, solved.points)) < np.radians(0.06)
    assert (solved.poses[graph.fixed] == graph.poses[graph.fixed]).all()


@pytest.mark.parametrize("name", names(solvers.__name__))
def test_custom_constraint_can_be_added(name: str) -> None:
    """Wheel odometry measures the position of the second camera in the axes of the first."""
    if name == "adam":
        pytest.importorskip("torch")
    _, graph = street(noise=0.0)
    wheels = Factor((0, 1), lambda a, b, m: (a[:3, :3].T @ (b[:3, 3] - a[:3, 3]) - m) / 0.001, np.array([0, 0, 3.0]))
    graph = replace(graph, fixed=np.arange(8) < 1, factors=(wheels,))
    solved = solvers.named(name).solve(graph, iterations=600 if name == "adam" else 30)
    step = solved.poses[0, :3, :3].T @ (solved.poses[1, :3, 3] - solved.poses[0, :3, 3])
    assert np.abs(step - [0, 0, 3.0]).max() < 0.02
    if name == "lm":  # scales the whole path by 3 / 2.5
        assert np.linalg.norm(positions(solved)[-1]) == pytest.approx(7 * 3.0, rel=0.02)


def test_solver_is_robust_to_outliers_and_points_behind_the_camera() -> None:
    poses, graph = street()
    bearing = graph.bearing.copy()
    wrong = np.random.default_rng(1).random(len(bearing)) < 0.15
    bearing[wrong] = exp_so3([0, 0.3, 0]) @ bearing[wrong][0]
    bearing[:5] *= -1
    solved = lm.solve(replace(graph, bearing=bearing), iterations=30)
    assert np.abs(positions(solved) - poses[:, :3, 3]).max() < 0.08


def test_distance_constraint_sets_the_scale() -> None:
    poses, graph = street()
    length = float(np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3]))
    graph = replace(graph, fixed=np.arange(8) < 1, distances=(DistanceConstraint(0, 7, 1.2 * length, 0.01),))
    solved = lm.solve(graph, iterations=30)
    assert np.linalg.norm(positions(solved)[-1]) == pytest.approx(1.2 * length, rel=1e-3)


def test_gradient_is_half_the_numerical_derivative_of_the_cost() -> None:
    """For all kinds of constraints, between poses that are not fixed."""
    _, graph = street(5, 20)
    rng = np.random.default_rng(4)
    wheels = Factor((3, 1), lambda a, b, m: (a[:3, :3].T @ (b[:3, 3] - a[:3, 3]) - m) / 0.5, np.array([1.0, 0, -4]))
    graph = replace(
        graph, distances=(DistanceConstraint(2, 4, 6.0, 0.8), DistanceConstraint(0, 3, 8.0, 0.5)), factors=(wheels,),
        sigma=np.radians(2.0),
        shared_jacobian=rng.normal(0, 0.3, (len(graph.bearing), 2, 6)), shared=np.array([1e-3, -2e-3]),
        shared_sigma=np.array([0.02, 0.03]),
    )  # fmt: skip
    shared, size = np.zeros(2), 6 * int((~graph.fixed).sum()) + 2
    known = lm.layout(graph.point_of, graph.camera_of, graph.fixed, len(graph.points), 2)
    normal = lm._normal(graph, known, graph.poses, graph.points, shared)

    def cost(step: F64) -> float:
        poses, bent = lm._moved(graph.poses, shared, step[:size], graph.fixed)
        return lm._cost(graph, poses, graph.points + step[size:].reshape(-1, 3), bent)

    h = 1e-6 * np.eye(size + graph.points.size)
    slope = np.array([(cost(step) - cost(-step)) / 2e-6 for step in h])
    assert np.allclose(
        np.concatenate([normal.g, normal.gp.ravel()]), slope / 2, rtol=1e-4, atol=1e-4 * np.abs(slope).max()
    )


def test_covariances_match_the_scatter_of_poses() -> None:
    found = []
    poses, graph = street(5, 60, noise=0.0)
    for seed in range(20):
        noise = np.random.default_rng(100 + seed).normal(0, np.radians(0.1), graph.bearing.shape)
        bearing = graph.bearing + noise
        bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
        found.append(
            positions(lm.solve(replace(graph, bearing=bearing, sigma=1.0), iterations=30))[2:] - poses[2:, :3, 3]
        )
    solved = lm.solve(graph, iterations=30)
    known = lm.information(replace(graph, poses=solved.poses, points=solved.points))[12:, 12:]  # two are fixed
    sigma = np.radians(0.1) * np.sqrt(np.diag(np.linalg.inv(known)).reshape(3, 6)[:, :3])
    assert np.allclose(np.std(found, axis=0) / sigma, 1, atol=0.5)

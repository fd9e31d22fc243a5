"""Rays without a return, found in the gaps of scanner rings; surfaces that they hit in a world may be phantoms."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F32, F64, Bools, Frame, Mesh
from scan2sim.pipeline.lidar.casting import Scanner
from scan2sim.pipeline.lidar.score import SweepScore, score
from scan2sim.pipeline.lidar.sweeps import Sweeps
from scan2sim.pipeline.lidar.unreturned import NO_RINGS, near_excluded, unreturned_rays

HEIGHT, AZIMUTH_DEG = 2.0, 1.0
NAMES = ("terrain", "building", "vegetation")


def rectangle(a: tuple[float, ...], b: tuple[float, ...], c: tuple[float, ...]) -> Mesh:
    corners = np.array([a, b, c, np.add(np.subtract(a, b), c)], np.float32)
    return Mesh(Frame(), corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


GROUND = rectangle((-40, -40, 0), (40, -40, 0), (40, 40, 0))
WALL = rectangle((10, -40, 0), (10, 40, 0), (10, 40, 12))


def rays(turn: int = 1) -> F64:
    """Unit vectors (N, 3) of a scanner, ring after ring from top to bottom; each ring starts straight ahead."""
    azimuth, elevation = np.meshgrid(
        np.radians(turn * np.arange(0, 360, AZIMUTH_DEG)), np.radians(np.arange(10, -16, -1.0))
    )
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)


def sweep(lost: Bools | bool = False, turn: int = 1, tilt_deg: float = 0.0) -> tuple[Sweeps, F64]:
    """Returns of a scanner in front of a wall, without the lost ones; and the true rays without a return."""
    way, c, s = rays(turn), np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    local = way @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    origins = np.tile([0.0, 0, HEIGHT], (len(way), 1))
    distance, _ = Scanner.of([GROUND, WALL]).cast(origins, local)
    there = np.isfinite(distance) & ~np.asarray(lost)
    xyz = (origins + np.where(there, distance, 0)[:, None] * local).astype(np.float32)[there]
    scanned = (np.where(there, distance, 0)[:, None] * way).astype(np.float32)[there]
    count = len(xyz)
    return Sweeps(xyz, origins[there], np.zeros(count, np.int32), scanned, np.zeros(count)), local[~there]


def scored(sweeps: Sweeps, *more: Mesh, inside: float | None = None) -> SweepScore:
    """Score of ground, wall and `more` (vegetation); `inside`: objects beyond this x are excluded."""
    meshes, found = [GROUND, WALL, *more], unreturned_rays(sweeps)

    def excluded(xyz: F32) -> Bools:
        return np.asarray(xyz[:, 0] > (np.inf if inside is None else inside))

    return score(Scanner.of(meshes), sweeps, NAMES, np.full(len(sweeps), -1), *found, excluded)


@pytest.mark.parametrize("turn", [1, -1])
@pytest.mark.parametrize("tilt", [0.0, 2.0])
def test_gaps_of_rings_are_rays_without_a_return(turn: int, tilt: float) -> None:
    """The sky above the wall and behind the scanner, in both directions of rotation, with level and tilted axes."""
    sweeps, true = sweep(turn=turn, tilt_deg=tilt)
    found, reason = unreturned_rays(sweeps)
    assert not reason and len(found) == pytest.approx(len(true), abs=5)
    apart = np.linalg.norm(found.directions[:, None] - true[None], axis=2).min(axis=1)
    assert np.degrees(np.median(apart)) < 0.5 and np.degrees(apart.max()) < 1.5
    assert np.allclose(found.origins, [0, 0, HEIGHT])


def test_returns_not_in_ring_order_have_no_rings() -> None:
    sweeps, _ = sweep()
    found, reason = unreturned_rays(sweeps.take(np.random.default_rng(0).permutation(len(sweeps))))
    assert not len(found) and reason == NO_RINGS
    phantoms = scored(sweeps.take(np.random.default_rng(0).permutation(len(sweeps)))).phantoms
    assert phantoms["reason"] == NO_RINGS and phantoms["phantom"] is None and phantoms["without_return"] is None


def test_surface_in_the_sky_is_a_phantom() -> None:
    """A crown high above the ground behind the scanner, where no ray had a return."""
    sweeps, _ = sweep()
    assert scored(sweeps).phantoms["phantom"] == 0
    crown = rectangle((-20, -9, 2.1), (-20, 9, 2.1), (-20, 9, 9))
    found = scored(sweeps, crown).phantoms
    assert found["phantom"] == found["without_return"] > 0.02
    assert found["by_surface"] == {"terrain": 0, "building": 0, "vegetation": 1}
    assert found["by_distance"]["20-40 m"] > 0 and found["by_distance"]["0-10 m"] == 0
    assert scored(sweeps, crown, inside=-30.0).phantoms["phantom"] == 0  # in the box of an excluded object


def test_surface_in_front_of_recorded_returns_is_a_phantom() -> None:
    sweeps, _ = sweep()
    found = scored(sweeps, rectangle((5, -2, 0.5), (5, 2, 0.5), (5, 2, 2))).phantoms
    assert found["phantom"] > 0.01 and found["without_return"] == 0


def test_glass_and_wet_ground_are_not_phantoms() -> None:
    """Rays lost on a window and on the road hit surfaces that exist in the street, too."""
    way = rays()
    azimuth, elevation = np.degrees(np.arctan2(way[:, 1], way[:, 0])), np.degrees(np.arcsin(way[:, 2]))
    window = (np.abs(azimuth) < 5.5) & (np.abs(elevation - 2) < 2.5)
    puddle = (azimuth > 90) & (elevation < -8) & (elevation > -12)
    sweeps, _ = sweep(lost=window | puddle)
    found = scored(sweeps).phantoms
    assert found["phantom"] == 0 and found["surface"] > 0.01 and found["ground"] > 0.05


def test_rays_next_to_excluded_returns_are_excluded() -> None:
    sweeps, _ = sweep()
    found, _ = unreturned_rays(sweeps)
    car = sweeps.take(np.array([len(sweeps) // 2]))
    way = (car.xyz - car.origins)[0]
    true = found.directions @ (way / np.linalg.norm(way)) > np.cos(0.02)
    assert (near_excluded(found, car) == true).all()
    assert near_excluded(found, sweeps).sum() > near_excluded(found, car).sum()

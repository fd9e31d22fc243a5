"""Leaf cards: one small square for each cell of penetrable foliage, the one that most rays through the cell confirm.

A card stops rays. Those that ended near it confirm it, those that passed on contradict it. In a cell of few returns
and many passing rays only a small card, or none, has more of the former. Import late: it loads numba.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from scan2sim.pipeline.core.types import F64, I32, I64, Frame, Mesh


@dataclass(frozen=True)
class LeafCardModel:
    """What is tried, and what counts."""

    sides: tuple[float, ...] = (0.25, 0.4, 0.6, 0.8, 1.0, 1.2)
    """Sides of the cards that are tried, in cells, ascending; above 1, cards of dense neighbours overlap."""
    centres: int = 4
    """Number of the cell's points that are tried as centres, beside their mean."""
    tilt_deg: float = 50.0
    """Angle by which cards are turned away from the scanner to each of four sides; they are tried facing it, too."""
    tolerance: float = 0.2
    """Distance between card and return, metres, up to which a ray confirms a card; the nearer, the more."""
    early: float = 0.5
    """Distance from card to return, metres, from which a ray contradicts a card in full."""
    confirm: float = 0.75
    """Weight of rays that confirm a card over those that contradict it."""
    max_rays: int = 200
    """Rays of a cell beyond that number are left out, evenly."""


MODEL = LeafCardModel()


@dataclass(frozen=True)
class Rays:
    """Rays of a scanner: `start` (N, 3) and `end` (N, 3) in local metres."""

    start: F64
    end: F64


def leaf_cards(
    frame: Frame,
    points: npt.NDArray[np.floating],
    points_of: tuple[I64, I64],
    rays: Rays,
    rays_of: tuple[I64, I32],
    size: float,
    max_count: int,
    model: LeafCardModel = MODEL,
) -> Mesh:
    """Squares, two triangles each, at most one for each of C cells; their fronts face the scanner.

    If there are more than `max_count`, those that most rays confirm are kept.

    Args:
        frame: frame of the mesh.
        points: (P, 3) points of the foliage, local metres.
        points_of: index of each cell's first point in a list (C + 1,), and that list of points (P,).
        rays: all rays.
        rays_of: index of each cell's first ray in a list (C + 1,), and that list of rays (M,).
        size: size of the cells, metres.
        max_count: maximum number of squares.
        model: what is tried.
    """
    way = rays.end - rays.start
    length = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    *vectors, support = _fit(
        points.astype(np.float64), *points_of, rays.start, way / length[:, None], length, *rays_of,
        np.array(model.sides) * size, model.centres, math.radians(model.tilt_deg), model.tolerance, model.early,
        model.max_rays, model.confirm,
    )  # fmt: skip
    chosen = np.sort(np.argsort(-support, kind="stable")[: min(max_count, int((support > 0).sum()))])
    centre, across, up = (vector[chosen] for vector in vectors)
    corners = np.stack([centre - across - up, centre + across - up, centre + across + up, centre - across + up], axis=1)
    first = 4 * np.arange(len(centre))[:, None]
    faces = np.stack([first + (0, 1, 2), first + (0, 2, 3)], axis=1).reshape(-1, 3)
    return Mesh(frame, corners.reshape(-1, 3).astype(np.float32), faces.astype(np.int32))


@njit(cache=True, parallel=True)
def _fit(
    points: F64,
    first_point: I64,
    point_of: I64,
    start: F64,
    direction: F64,
    length: F64,
    first_ray: I64,
    ray_of: I32,
    sides: F64,
    max_centres: int,
    tilt: float,
    tolerance: float,
    early: float,
    max_rays: int,
    confirm: float,
) -> tuple[F64, F64, F64, F64]:
    """Centre, vectors to the middles of the right and upper edges (C, 3), support (C,) of each cell's card; 0: none."""
    count = len(first_ray) - 1
    centre, across, up = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    total = np.zeros(count)
    for c in prange(count):
        rays = ray_of[first_ray[c] : first_ray[c + 1]]
        own = point_of[first_point[c] : first_point[c + 1]]
        if not len(rays) or not len(own):
            continue
        every = (len(rays) + max_rays - 1) // max_rays
        rays = rays[::every]
        centres = np.zeros((1 + min(max_centres, len(own)), 3))
        for p in own:
            centres[0] += points[p] / len(own)
        for k in range(1, len(centres)):
            centres[k] = points[own[(k - 1) * len(own) // (len(centres) - 1)]]
        best = 0.0
        for turn in range(5):
            right, top, normal = _axes(direction, rays, turn, tilt)
            for k in range(len(centres)):
                support = _support(
                    start, direction, length, rays, centres[k], right, top, normal, sides, tolerance, early, confirm
                )
                for s in range(len(sides)):
                    # where no ray decides, the larger card leaves fewer gaps
                    if support[s] > 0 and support[s] >= best:
                        best, total[c] = support[s], support[s] * every
                        centre[c], across[c], up[c] = centres[k], right * sides[s] / 2, top * sides[s] / 2
    return centre, across, up, total


@njit(cache=True)
def _axes(direction: F64, rays: I32, turn: int, tilt: float) -> tuple[F64, F64, F64]:
    """Unit vectors to the right, up and to the front of a card: facing the rays, or turned to one of four sides."""
    front = np.zeros(3)
    for ray in rays:
        front -= direction[ray]
    front /= max(math.sqrt((front**2).sum()), 1e-9)
    right = np.array([-front[1], front[0], 0.0])
    flat = math.sqrt((right**2).sum())
    right = right / flat if flat > 1e-6 else np.array([1.0, 0.0, 0.0])
    top = np.cross(front, right)
    if turn == 0:
        return right, top, front
    cos, sin = math.cos(tilt), math.sin(tilt) * (1 if turn % 2 else -1)
    if turn <= 2:
        return cos * right - sin * front, top, cos * front + sin * right
    return right, cos * top - sin * front, cos * front + sin * top


@njit(cache=True)
def _support(
    start: F64,
    direction: F64,
    length: F64,
    rays: I32,
    centre: F64,
    right: F64,
    top: F64,
    normal: F64,
    sides: F64,
    tolerance: float,
    early: float,
    confirm: float,
) -> F64:
    """(S,) rays that confirm the card of each side, less those that contradict it."""
    support = np.zeros(len(sides))
    for ray in rays:
        slope = distance = 0.0
        for k in range(3):
            slope += direction[ray, k] * normal[k]
            distance += (centre[k] - start[ray, k]) * normal[k]
        if abs(slope) < 1e-6:
            continue
        distance /= slope
        gap = length[ray] - distance
        if gap < -tolerance:
            continue
        u = v = 0.0
        for k in range(3):
            offset = start[ray, k] + distance * direction[ray, k] - centre[k]
            u += offset * right[k]
            v += offset * top[k]
        if abs(gap) <= tolerance:
            value = confirm * (1 - abs(gap) / tolerance)
        else:
            value = -min(1.0, (gap - tolerance) / (early - tolerance))
        for s in range(len(sides)):
            if 2 * max(abs(u), abs(v)) <= sides[s]:
                support[s] += value
    return support

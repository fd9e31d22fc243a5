"""Where roads run, roughly: the way that was driven, each stretch once, and a little beyond its ends."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F64, Bools

STEP = 1.0
"""Metres between places of a way."""
SAME = 8.0
"""Metres: a way this near to an earlier one, along the same line, is on the same road."""
APART = 20.0
"""Metres along the way from which on it may come by again in the same direction; the other one it may take at once."""
ALONG = 0.85
"""Cosine of the angle from which on two ways run along the same line."""
SHORTEST = 2.0
"""Metres of a way: in the next tile it may go on."""


LONGEST = 1000.0
"""Metres of one way: longer roads are told of in pieces, as what is solved grows with the square."""


def ways(positions: F64, on: Bools) -> list[F64]:
    """Polylines (M, 2), `STEP` apart, of what was driven on a road.

    Args:
        positions: (N, 2 or 3) of the vehicle, in order.
        on: (N,) whether there is road below.
    """
    found: list[F64] = []
    for piece in _pieces(positions[:, :2], on):
        way = _spaced(piece)
        for part in _pieces(way, _first_time(way, found)):
            pieces = np.array_split(part, int(np.ceil(length(part) / LONGEST)))
            found += [piece for piece in pieces if length(piece) >= SHORTEST]
    return found


def _pieces(places: F64, held: Bools) -> list[F64]:
    """The runs of places that are held."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], held, [False]]).astype(int)))
    return [places[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1]


def length(places: F64) -> float:
    """Metres of a polyline (N, 2)."""
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def _spaced(places: F64) -> F64:
    """(M, 2) at even steps along places; standing still is left out."""
    kept = [0]
    for i in range(1, len(places)):
        if np.linalg.norm(places[i] - places[kept[-1]]) >= STEP / 2:
            kept.append(i)
    places = places[kept]
    chainage = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    even = np.linspace(0, chainage[-1], max(2, round(chainage[-1] / STEP) + 1))
    return np.column_stack([np.interp(even, chainage, column) for column in places.T])


def _first_time(way: F64, earlier: list[F64]) -> Bools:
    """(M,) where no road is that was driven before, in this way or an earlier one."""
    from scipy.spatial import cKDTree

    direction = np.gradient(way, axis=0)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    first = np.ones(len(way), bool)
    others = [(cKDTree(other), np.gradient(other, axis=0)) for other in earlier]
    for i, place in enumerate(way):
        near = np.flatnonzero(first[:i] & (np.linalg.norm(way[:i] - place, axis=1) < SAME))
        cosine = direction[near] @ direction[i]
        again = bool((np.where(i - near > APART / STEP, np.abs(cosine), -cosine) > ALONG).any())
        for tree, heading in others:
            distance, k = tree.query(place)
            unit = heading[k] / max(float(np.linalg.norm(heading[k])), 1e-9)
            again |= bool(distance < SAME and abs(unit @ direction[i]) > ALONG)
        first[i] = not again
    return first


def extended(way: F64, beyond: float) -> F64:
    """A way that goes straight on at both ends."""
    first, last = way[0] - way[min(5, len(way) - 1)], way[-1] - way[-min(6, len(way))]
    out = [end + beyond * step / np.linalg.norm(step) for end, step in ((way[0], first), (way[-1], last))]
    return np.concatenate([out[:1], way, out[1:]])

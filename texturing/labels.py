"""One photo for every face's detail: a Markov random field over the faces, solved by graph cuts.

Energy: how much worse a photo is than the best one that sees the face, and a price for every edge between
faces of different photos, by its length (Waechter et al. 2014, "Let There Be Color!"). Alpha expansion
(Boykov et al. 2001), each move cut exactly by PyMaxflow among the faces that see the photo: time and memory
grow with faces times candidates, not with the number of photos.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.types import F32, I32

UNSEEN = 1e3
SWEEPS = 3


def adjacent(faces: I32) -> tuple[I32, I32]:
    """Pairs of faces (E, 2) that share an edge, and the edge's vertices (E, 2); an edge of more faces is left out."""
    start, end = faces.ravel().astype(np.int64), faces[:, [1, 2, 0]].ravel().astype(np.int64)
    key = np.minimum(start, end) << 32 | np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0])
    pairs = first[np.diff(np.r_[first, len(key)]) == 2]
    a, b = order[pairs], order[pairs + 1]
    return np.stack([a // 3, b // 3], axis=1).astype(np.int32), np.stack([start[a], end[a]], axis=1).astype(np.int32)


def label(view: I32, quality: F32, pairs: I32, price: F32) -> I32:
    """The view (F,) that each face takes its detail from; -1 where none sees it.

    Args:
        view: (F, K) candidates, -1 for none.
        quality: (F, K) of each, 0 for none.
        pairs: (E, 2) neighbouring faces.
        price: (E,) of different views on both sides, against a cost of 1 for a useless view.
    """
    best = quality.max(axis=1, initial=0.0)
    cost = np.where(view >= 0, 1 - np.sqrt(quality / np.maximum(best, 1e-30)[:, None]), UNSEEN).astype(np.float32)
    current = np.where(best > 0, view[np.arange(len(view)), quality.argmax(axis=1)] if view.shape[1] else -1, -1)
    at = np.where(best > 0, cost.min(axis=1, initial=UNSEEN), 0).astype(np.float32)  # cost of the current label
    both = (best[pairs] > 0).all(axis=1)
    pairs, price = pairs[both], price[both]
    if not len(pairs) or not price.any():
        return current.astype(np.int32)
    for _ in range(SWEEPS):
        changed = sum(_expand(int(a), view, cost, current, at, pairs, price) for a in np.unique(view[view >= 0]))
        if changed == 0:
            break
    return current.astype(np.int32)


def _expand(alpha: int, view: I32, cost: F32, current: npt.NDArray[np.integer], at: F32, pairs: I32, price: F32) -> int:
    """The best set of faces that go over to view `alpha`, in place; returns their number."""
    import maxflow

    is_alpha = view == alpha
    free = is_alpha.any(axis=1) & (current != alpha)
    nodes = np.flatnonzero(free)
    if not len(nodes):
        return 0
    index = np.full(len(view), -1, np.int64)
    index[nodes] = np.arange(len(nodes))
    go = np.where(is_alpha[nodes], cost[nodes], 0).sum(axis=1).astype(np.float64)
    stay = at[nodes].astype(np.float64)
    touching = free[pairs].any(axis=1)
    pairs, price = pairs[touching], price[touching].astype(np.float64)
    inner = free[pairs].all(axis=1)
    for side in (0, 1):  # neighbours that can't move, or are at alpha already
        edge = ~inner & free[pairs[:, side]]
        mine, other = pairs[edge, side], pairs[edge, 1 - side]
        np.add.at(stay, index[mine], price[edge] * (current[mine] != current[other]))
        np.add.at(go, index[mine], price[edge] * (current[other] != alpha))
    p, q = pairs[inner, 0], pairs[inner, 1]
    apart = price[inner] * (current[p] != current[q])  # both stay; if one goes it is `price`, if both go nothing
    # E = apart + (price - apart) x_p - price x_q + (2 price - apart) (1 - x_p) x_q
    np.add.at(go, index[p], price[inner] - apart)
    np.add.at(stay, index[q], price[inner])
    graph = maxflow.Graph[float](len(nodes), int(inner.sum()))
    ids = graph.add_nodes(len(nodes))
    # in the source's segment (0) a face stays, in the sink's (1) it goes: cutting source -> node costs `go`
    graph.add_grid_tedges(ids, go, stay)
    graph.add_edges(index[p], index[q], 2 * price[inner] - apart, np.zeros(len(p)))
    graph.maxflow()
    moves = nodes[graph.get_grid_segments(ids)]
    at[moves] = np.where(is_alpha[moves], cost[moves], 0).sum(axis=1)
    current[moves] = alpha
    return len(moves)

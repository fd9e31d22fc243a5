"""Compare solvers of view selection (`texturing.view_selection.mrf`): energy, time, and the resulting textures.

`python -m bench.texture.view_selection [--scenes kitti street_clean street_hard] [--solvers best ours ...]
[--energies] [--out DIR]`,
after `python -m bench.texture`, whose scenes and depth maps it uses (`--scenes sample` generates its own small one).

- best: the best photo of each face, independent of its neighbours.
- settled: iterated conditional modes from there: each face's best photo given its neighbours'.
- scipy: alpha expansion (Boykov et al. 2001) with `scipy.sparse.csgraph.maximum_flow` on integers.
- pymaxflow: the same with PyMaxflow (GPL; not a dependency), if installed.
- ours: message passing.

Energies are given in percent above our lower bound; seconds are CPU time. Textures: as in `bench.texture.ablation`.
Ends with `RESULT {json}`: scene, solver, metrics.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.paths import ROOT
from bench.texture.ablation import metrics
from bench.texture.scenes import SCENES, WARM_UP, Scene, available, fresh, make, run
from scan2sim.pipeline.core.types import F32, F64, I32, Bools, Mesh
from scan2sim.pipeline.steps.visibility import VISIBILITY
from scan2sim.texturing.exposure import EXPOSURE
from scan2sim.texturing.photo_consistency import PHOTO_CONSISTENCY
from scan2sim.texturing.texture import TEXTURE
from scan2sim.texturing.unwrap import UNWRAP
from scan2sim.texturing.view_selection import mrf
from scan2sim.texturing.view_selection.choice import Choice
from scan2sim.texturing.view_selection.step import VIEW_SELECTION, ViewSelectionParams, seam_costs

MAX_SWEEPS = 3
UNSEEN_COST = 1e3
Cut = Callable[[F64, F64, I32, I32, F64], Bools]
"""Nodes that move: from costs of moving and staying (N,), pairs p, q (E,), and the cost if q moves and p stays."""
Problem = tuple[I32, F32, I32, F32]
"""Candidates (F, K), their costs, pairs (E, 2), smoothness costs (E,)."""


def best(view: I32, cost: F32, pairs: I32, price: F32) -> I32:
    """Best photo of each face."""
    return np.where(np.isfinite(cost).any(axis=1), view[np.arange(len(view)), cost.argmin(axis=1)], -1)


def iterated_conditional_modes(view: I32, cost: F32, pairs: I32, price: F32) -> I32:
    """Best photo of one face after another, given its neighbours, until none changes."""
    chosen = best(view, cost, pairs, price)
    beside: list[list[tuple[int, float]]] = [[] for _ in view]
    for (a, b), paid in zip(pairs.tolist(), price.tolist(), strict=True):
        if chosen[a] >= 0 and chosen[b] >= 0:
            beside[a].append((b, paid))
            beside[b].append((a, paid))
    changed = True
    while changed:
        changed = False
        for face in np.flatnonzero(chosen >= 0):
            total = cost[face].copy()
            for other, paid in beside[face]:
                total += np.where(view[face] != chosen[other], np.float32(paid), np.float32(0))
            new = view[face, total.argmin()]
            if new != chosen[face] and total.min() < total[np.flatnonzero(view[face] == chosen[face])[0]]:
                chosen[face], changed = new, True
    return chosen


def expansion(problem: Problem, cut: Cut) -> I32:
    """Alpha expansion: for each view in turn the best set of faces that move to it."""
    view, cost, pairs, price = problem
    current = best(*problem)
    cost = np.where(np.isfinite(cost), cost, UNSEEN_COST)
    both = (current[pairs] >= 0).all(axis=1)
    pairs, price = pairs[both], price[both]
    for _ in range(MAX_SWEEPS):
        if not sum(_expand(int(a), view, cost, current, pairs, price, cut) for a in np.unique(view[view >= 0])):
            break
    return current


def _expand(alpha: int, view: I32, cost: F32, current: I32, pairs: I32, price: F32, cut: Cut) -> int:
    is_alpha = view == alpha
    free = is_alpha.any(axis=1) & (current != alpha)
    nodes = np.flatnonzero(free)
    if not len(nodes):
        return 0
    index = np.full(len(view), -1, np.int64)
    index[nodes] = np.arange(len(nodes))
    go = np.where(is_alpha[nodes], cost[nodes], 0).sum(axis=1).astype(np.float64)
    stay = np.where(view[nodes] == current[nodes, None], cost[nodes], 0).sum(axis=1).astype(np.float64)
    touching = free[pairs].any(axis=1)
    pairs, price = pairs[touching], price[touching].astype(np.float64)
    inner = free[pairs].all(axis=1)
    for side in (0, 1):  # neighbours that can't move, or have alpha already
        edge = ~inner & free[pairs[:, side]]
        mine, other = pairs[edge, side], pairs[edge, 1 - side]
        np.add.at(stay, index[mine], price[edge] * (current[mine] != current[other]))
        np.add.at(go, index[mine], price[edge] * (current[other] != alpha))
    p, q = pairs[inner, 0], pairs[inner, 1]
    apart = price[inner] * (current[p] != current[q])  # cost if both stay; `price` if one moves, nothing if both do
    # E = apart + (price - apart) x_p - price x_q + (2 price - apart) (1 - x_p) x_q
    np.add.at(go, index[p], price[inner] - apart)
    np.add.at(stay, index[q], price[inner])
    moves = nodes[cut(go, stay, index[p], index[q], 2 * price[inner] - apart)]
    current[moves] = alpha
    return len(moves)


def by_pymaxflow(go: F64, stay: F64, p: I32, q: I32, weight: F64) -> Bools:
    """Minimum cut with PyMaxflow: nodes in the sink's segment move; cutting source -> node costs `go`."""
    import maxflow

    graph = maxflow.Graph[float](len(go), len(p))
    nodes = graph.add_nodes(len(go))
    graph.add_grid_tedges(nodes, go, stay)
    graph.add_edges(p, q, weight, np.zeros(len(p)))
    graph.maxflow()
    return graph.get_grid_segments(nodes)


def by_scipy(go: F64, stay: F64, p: I32, q: I32, weight: F64) -> Bools:
    """Minimum cut with scipy, capacities in 1e-4; nodes reachable from the source in the residual graph stay."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    count = len(go)
    source, sink = count, count + 1
    least = np.minimum(go, stay)
    nodes = np.arange(count)
    rows = np.concatenate([np.full(count, source), nodes, p])
    columns = np.concatenate([nodes, np.full(count, sink), q])
    capacity = np.rint(1e4 * np.concatenate([go - least, stay - least, weight])).astype(np.int32)
    graph = csr_array((capacity, (rows, columns)), shape=(count + 2, count + 2))
    left = graph - maximum_flow(graph, source, sink).flow
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    moves = np.ones(count + 2, bool)
    moves[breadth_first_order(left, source, return_predecessors=False)] = False
    return moves[:count]


def solvers() -> dict[str, Callable[[Problem], I32]]:
    """Available solvers by name."""
    found: dict[str, Callable[[Problem], I32]] = {
        "best": lambda problem: best(*problem),
        "settled": lambda problem: iterated_conditional_modes(*problem),
        "scipy": lambda problem: expansion(problem, by_scipy),
        "ours": lambda problem: mrf.solve(*problem).view,
    }
    if importlib.util.find_spec("maxflow"):
        found["pymaxflow"] = lambda problem: expansion(problem, by_pymaxflow)
    return found


def energy(chosen: I32, view: I32, cost: F32, pairs: I32, price: F32) -> float:
    """Energy of a labelling: (F,) the view of each face."""
    own = np.where((view == chosen[:, None]) & (chosen >= 0)[:, None], cost, 0).sum(dtype=np.float64)
    apart = (chosen[pairs[:, 0]] != chosen[pairs[:, 1]]) & (chosen[pairs] >= 0).all(axis=1)
    return float(own + price[apart].sum(dtype=np.float64))


def prepare(scene: Scene, folder: Path) -> dict[str, Path]:
    """Input files of view selection and texturing: exposures, photo consistency, candidates."""
    if not scene.depth.is_dir():
        run(VISIBILITY, {"mesh.surface": scene.mesh, "views": scene.views} | scene.clouds, scene.depth.parent)
    files = {"mesh": scene.mesh, "views": scene.views, "depth": scene.depth} | scene.clouds
    for step in (EXPOSURE, PHOTO_CONSISTENCY, VIEW_SELECTION):
        files |= run(step, files, fresh(folder / step.name))
    return files


def textured(files: dict[str, Path], choice: Choice, folder: Path) -> Path:
    """Texture a scene with a choice of views; returns the texture's folder."""
    choice.save(folder / "choice.npz")
    files = files | {"choice": folder / "choice.npz"}
    for step in (UNWRAP, TEXTURE):
        files |= run(step, files, fresh(folder / step.name))
    return files["textured"]


def compare(scene: Scene, names: Sequence[str], *, textures: bool) -> dict[str, dict[str, Any]]:
    """Metrics of all solvers, printed as they are computed."""
    folder = scene.folder / "choices"
    found = folder / "view_selection" / "choice.npz"
    files = prepare(scene, folder) if textures or not found.is_file() else {}
    choice, mesh = Choice.load(found), Mesh.load(scene.mesh)
    pairs, length, price = seam_costs(mesh, ViewSelectionParams.model_validate({}).smoothness)
    problem = (choice.view, mrf.costs(choice.view, choice.quality), pairs, price)
    bound = mrf.solve(*problem).bound
    result: dict[str, dict[str, Any]] = {}
    for name in names:
        solver = solvers()[name]
        began = time.process_time()
        chosen = solver(problem)
        seconds = time.process_time() - began
        apart = (chosen[pairs[:, 0]] != chosen[pairs[:, 1]]) & (chosen[pairs] >= 0).all(axis=1)
        result[name] = {
            "above_bound_percent": round(100 * (energy(chosen, *problem) / bound - 1), 3),
            "seconds": round(seconds, 2),
            "seam_share": round(float(length[apart].sum() / length.sum()), 4),
            "again_the_same": bool((solver(problem) == chosen).all()),
        }
        if textures:
            painted = textured(files, Choice(choice.view, choice.quality, chosen.astype(np.int32)), folder)
            result[name] |= metrics(scene, painted, None)
        print(f"{scene.folder.name:12s} {name:10s} {result[name]}", flush=True)
    return result


def main() -> None:
    """Print a table per scene, and the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=[*SCENES, WARM_UP])
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "texture")
    parser.add_argument("--solvers", nargs="+", default=list(solvers()), choices=list(solvers()))
    parser.add_argument("--energies", action="store_true", help="no textures; reuse candidates of an earlier run")
    arguments = parser.parse_args()
    result = {}
    for name in arguments.scenes:
        scene = Scene(arguments.out / name)
        if not available(name):
            continue
        if not scene.views.is_file():
            make(name, scene)
        result[name] = compare(scene, arguments.solvers, textures=not arguments.energies)
    print("RESULT " + json.dumps(result))


if __name__ == "__main__":
    main()

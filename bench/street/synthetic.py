"""Metrics that need ground truth, on a synthetic street: lost static points, and recall of poles."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bench.street.world import World
from scan2sim.pipeline.core.types import F64, U8, PointCloud

STREET: dict[str, Any] = {"length": 40.0, "points": 1.6e6, "photos": 16, "seed": 0}
MATCH_DISTANCE_M = 0.1
"""Distance from a true sample within which it counts as scanned, or as shown."""
MIN_POLE_DISTANCE_M = 0.3
"""Horizontal distance beyond which samples belong to different poles."""
MIN_SHOWN_SHARE = 0.5
"""Minimum share of a pole's scanned samples that are shown for the pole to be found."""


def metrics(folder: Path, run: Callable[..., float]) -> dict[str, float]:
    """`static_lost` and `pole_recall` on the synthetic street with a moving car; `run` runs a command."""
    from scan2sim.data_samples.layout import Style
    from scan2sim.data_samples.street import generate

    tile, out = folder / "tile", folder / "run"
    if not (tile / "tile.toml").is_file():
        generate(tile, **STREET, style=Style(moving_car=True))
    run("run", tile, "--out", out)
    return {"static_lost": static_lost(out), "pole_recall": pole_recall(tile, World(out / "world"))}


def static_lost(out: Path) -> float:
    """Share of the points other than vehicles and people that `dynamic_objects` removed."""
    from scan2sim.pipeline.core.classes import CODE

    classification = PointCloud.load(next((out / "steps" / "ingest").glob("*/cloud.npz"))).classification
    dropped = np.load(next((out / "steps" / "dynamic_objects").glob("*/dropped.npy")))
    assert classification is not None
    still = ~np.isin(classification, (CODE["vehicle"], CODE["person"]))
    return float((dropped[still] > 0).mean()) if len(dropped) else 0.0


def pole_recall(tile: Path, world: World) -> float:
    """Share of the true poles of which the world shows half of the scanned samples within 10 cm."""
    import laspy
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    from scan2sim.pipeline.core.classes import CODE

    def read(file: str) -> tuple[F64, U8]:
        cloud = laspy.read(tile / file)
        return np.stack([cloud.x, cloud.y, cloud.z], axis=1) - world.origin, np.asarray(cloud.classification)

    (truth, classification), (cloud, _) = read("truth/points.laz"), read("cloud.laz")
    pole = truth[classification == CODE["pole"]]
    pole = pole[cKDTree(cloud).query(pole)[0] < MATCH_DISTANCE_M]
    pairs = cKDTree(pole[:, :2]).sparse_distance_matrix(cKDTree(pole[:, :2]), MIN_POLE_DISTANCE_M)
    count, which = connected_components(pairs, directed=False)
    shown = world.distance(pole) < MATCH_DISTANCE_M
    found = np.array([shown[which == i].mean() >= MIN_SHOWN_SHARE for i in range(count)])
    print(f"synthetic street: {found.sum()} of {count} poles are shown; {shown.mean():.0%} of their scanned samples")
    return float(found.mean())

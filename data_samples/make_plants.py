"""Generate the low-poly plants of `pipeline.terrain`: `python -m scan2sim.data_samples.make_plants [FILE]`.

Crowns of the generator's trees and bushes with few triangles and without the trunk, scaled to a height and radius of 1.
Arrays of model k: `vertices<k>` (V, 3), `faces<k>` (F, 3), `light<k>` (V,) sky openness.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.data_samples.layout import Tree
from scan2sim.data_samples.paints import Material
from scan2sim.data_samples.plants import leafy_tree, shrub
from scan2sim.data_samples.shapes import Part
from scan2sim.pipeline.terrain import low_poly_plants

GREEN = (0.2, 0.4, 0.1)


def make(out: Path = low_poly_plants.MODELS) -> Path:
    """Write the models to an .npz file; returns its path."""
    trees = [leafy_tree(Tree(0, 0, 8.0, 2.5, GREEN, seed), rounds=0) for seed in range(low_poly_plants.TREE_MODELS)]
    bushes = [shrub(1.0, GREEN, seed, rounds=1) for seed in range(low_poly_plants.BUSH_MODELS)]
    arrays: dict[str, Any] = {}
    for k, plant in enumerate([*trees, *bushes]):
        vertices, faces, light = _crown(plant)
        arrays |= {f"vertices{k}": vertices, f"faces{k}": faces, f"light{k}": light}
    np.savez_compressed(out, **arrays)
    return out


def _crown(plant: Part) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and sky openness of a plant's leaves, scaled to a height and radius of 1."""
    faces = plant.faces[plant.material == Material.FOLIAGE]
    used, index = np.unique(faces, return_inverse=True)
    xyz = plant.vertices[used].astype(np.float64)
    xyz[:, :2] -= (xyz[:, :2].min(axis=0) + xyz[:, :2].max(axis=0)) / 2
    xyz[:, :2] /= np.linalg.norm(xyz[:, :2], axis=1).max()
    xyz[:, 2] /= xyz[:, 2].max()
    return xyz.astype(np.float32), index.reshape(-1, 3).astype(np.int32), plant.sky[used]


if __name__ == "__main__":
    print(make(Path(sys.argv[1]) if len(sys.argv) > 1 else low_poly_plants.MODELS))

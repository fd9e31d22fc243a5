"""Regenerate the small committed tile: `python -m scan2sim.data_samples.make_tile [FOLDER]`."""

from __future__ import annotations

import sys
from pathlib import Path

from scan2sim.data_samples import SMALL
from scan2sim.data_samples.photos import Effects
from scan2sim.data_samples.street import generate

STREET_LENGTH_M, SEED = 26.0, 5


def make(out: Path = SMALL) -> Path:
    """Write the tile described in `data_samples/README.md`; returns the path of its `tile.toml`."""
    return generate(
        out,
        length=STREET_LENGTH_M,
        points=4.2e5,
        photos=10,
        seed=SEED,
        photo_width=800,
        truth_density=30.0,
        cloud_scale=0.005,
        effects=Effects(quality=90),
        name="sample_street",
    )


if __name__ == "__main__":
    print(make(Path(sys.argv[1]) if len(sys.argv) > 1 else SMALL))

"""Finds of neighbouring tiles made one list: what stands at a border is one thing, and the same one for all tiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from scan2sim.pipeline.furniture.classify import Thing
from scan2sim.pipeline.tiling.voronoi_cell import Seed, nearest

NEAR = 2.0
"""Metres between two feet beyond which nobody asks whether they are one's."""


def agreed(finds: Mapping[str, Sequence[Thing]], seeds: Mapping[str, Seed]) -> list[tuple[str, Thing]]:
    """Everything that tiles tell of, once, each with the tile in whose cell its foot stands, be it asked or not.

    Of doubles, the tile's word counts in whose cell the thing stands; where both or neither say so of themselves, that
    of the tile whose name sorts first. So all tiles that know of the same finds come to the same things.

    Args:
        finds: by the tile that tells of them, world metres.
        seeds: of these tiles and all around them.
    """
    names = sorted(seeds)
    told = [(name, thing) for name in sorted(finds) for thing in finds[name]]
    if not told:
        return []
    feet = np.array([thing.foot[:2] for _, thing in told])
    owner = [names[i] for i in nearest(feet, [seeds[name] for name in names])]
    kept: list[int] = []
    for i in sorted(range(len(told)), key=lambda i: owner[i] != told[i][0]):  # stable: by name, as told
        near = [k for k in kept if told[k][0] != told[i][0] and np.hypot(*(feet[k] - feet[i])) < NEAR]
        if not any(told[k][1].stem.covers(told[i][1].stem) for k in near):
            kept.append(i)
    return [(owner[i], told[i][1]) for i in kept]

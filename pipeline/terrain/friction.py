"""Friction of what bodies drive on, by the ground's class.

Coulomb coefficients of tyres on dry ground, peak values: Wong, Theory of Ground Vehicles, 4th ed. 2008, table 1.3
(after Taborek 1957): asphalt and concrete .8 to .9, gravel .6, earth road .68. Ground that no photo tells apart is of
the class `terrain`, be it a road or a lawn.
"""

from __future__ import annotations

from collections.abc import Collection

from scan2sim.pipeline.core.classes import CODE

PAVED = 0.9
OF_CLASS = {CODE["terrain"]: 0.68, CODE["keypoint"]: 0.68, CODE["rail"]: 0.6}
"""Of LAS codes; what is not here is paved, or of stone."""


def coefficient(code: int, codes: Collection[int], paved: float = PAVED) -> float:
    """Of a class, among those `codes` that the tile's ground has.

    Where none of these is a road, nobody told roads from lawns: `terrain` counts as paved.

    Args:
        code: LAS code of what is driven on.
        codes: of all ground of the tile.
        paved: of roads; another one than `PAVED` (rain, another tyre) scales all classes.
    """
    if CODE["road"] not in codes:
        return paved
    return round(OF_CLASS.get(code, PAVED) / PAVED * paved, 4)

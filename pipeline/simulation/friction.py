"""Friction coefficients of the ground by class.

Coulomb coefficients of tyres on dry ground, peak values: Wong, Theory of Ground Vehicles, 4th ed. 2008, table 1.3
(after Taborek 1957): asphalt and concrete 0.8 to 0.9, gravel 0.6, earth road 0.68. Ground that was not classified by
photos has the class `terrain`, whether it is a road or a lawn.
"""

from __future__ import annotations

from collections.abc import Collection

from scan2sim.pipeline.core.classes import CODE

PAVED = 0.9
UNPAVED = {CODE["terrain"]: 0.68, CODE["keypoint"]: 0.68, CODE["rail"]: 0.6}
"""Friction coefficient by LAS code; other classes are paved or made of stone."""


def coefficient(code: int, codes: Collection[int], paved: float = PAVED) -> float:
    """Friction coefficient of a class of ground.

    If none of the ground's classes is a road, roads were not classified, and `terrain` counts as paved.

    Args:
        code: LAS code of the ground.
        codes: LAS codes of all ground of the tile.
        paved: coefficient of roads; a value other than `PAVED` (rain, other tyres) scales all classes.
    """
    if CODE["road"] not in codes:
        return paved
    return round(UNPAVED.get(code, PAVED) / PAVED * paved, 4)

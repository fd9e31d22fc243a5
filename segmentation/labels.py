"""The classes that networks predict, as LAS codes, and how the label sets of others map onto them by name."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scan2sim.pipeline.core.classes import CODE, SHOWN
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import U8

CLASSES = SHOWN
GROUND = ("road", "sidewalk", "terrain")
SKY = CLASSES.index("sky")
IGNORED = 255
"""Index of what is not to be learnt, or says nothing."""


def code_of_index() -> U8:
    """(12,) LAS codes of `CLASSES`; 0 for the sky."""
    return np.array([CODE.get(name, 0) for name in CLASSES], np.uint8)


def index_of_code() -> U8:
    """(256,) index into `CLASSES` of a LAS code; code 0 is the sky, 255 and what networks don't predict `IGNORED`."""
    table = np.full(256, IGNORED, np.uint8)
    for i, name in enumerate(CLASSES):
        table[CODE.get(name, 0)] = i
    table[CODE["mid_vegetation"]] = CLASSES.index("low_vegetation")
    return table


def _named(**names: str) -> dict[str, str]:
    """Comma-separated foreign names by class, turned round."""
    return {name.strip(): ours for ours, many in names.items() for name in many.split(",")}


LABEL_SETS: dict[str, dict[str, str]] = {
    "cityscapes": _named(
        road="road, parking, ground, bridge, tunnel", sidewalk="sidewalk", terrain="terrain, rail track, dynamic",
        building="building", road_sign="traffic sign, traffic light", pole="pole, polegroup",
        high_vegetation="vegetation", person="person, rider",
        vehicle="car, truck, bus, train, motorcycle, bicycle, caravan, trailer, license plate, ego vehicle",
        wall_or_fence="wall, fence, guard rail", sky="sky",
    ),
    "vistas": _named(
        road="road, bike lane, crosswalk - plain, lane marking - crosswalk, lane marking - general, parking, "
        "service lane, manhole, catch basin, pothole, bridge, tunnel, rail track",
        sidewalk="sidewalk, pedestrian area, curb, curb cut", terrain="terrain, sand, snow, mountain, water",
        building="building, billboard, phone booth, bench, banner",
        road_sign="traffic sign (front), traffic sign (back), traffic sign frame, traffic light",
        pole="pole, street light, utility pole, bike rack, fire hydrant, mailbox, cctv camera",
        high_vegetation="vegetation", person="person, bicyclist, motorcyclist, other rider, ground animal",
        vehicle="car, bus, truck, caravan, trailer, on rails, motorcycle, bicycle, boat, other vehicle, wheeled slow, "
        "ego vehicle, car mount",
        wall_or_fence="wall, fence, guard rail, barrier", sky="sky",
    ),
    "ade20k": _named(
        road="road, runway, path, dirt track", sidewalk="sidewalk, stairs, step, stairway",
        terrain="earth, grass, field, sand, land, hill, mountain, rock, water, floor",
        building="building, house, skyscraper, hovel, tower, windowpane, door, awning, booth, column, bridge, canopy",
        road_sign="signboard, traffic light", pole="pole, streetlight, bannister",
        low_vegetation="plant, flower", high_vegetation="tree, palm", person="person, animal",
        vehicle="car, bus, truck, van, minibike, bicycle, boat, ship, airplane, trade name",
        wall_or_fence="wall, fence, railing", sky="sky",
    ),
    "scan2sim": {name: name for name in CLASSES},
}  # fmt: skip


def mapped(names: Sequence[str], where: str) -> U8:
    """(len(names),) index into `CLASSES` of every label of a network, `IGNORED` where it has none of ours.

    Args:
        names: of the network's labels, in order, of any of `LABEL_SETS`; the set is found by them.
        where: the file, for the message.

    Raises:
        InputError: the names are of no known set.
    """
    plain = [name.lower().strip().split(";")[0].split(",")[0] for name in names]
    best = max(LABEL_SETS, key=lambda key: sum(name in LABEL_SETS[key] for name in plain))
    table = LABEL_SETS[best]
    known = [name for name in plain if name in table]
    if len({table[name] for name in known}) < 4:
        raise InputError(
            where,
            f"tells labels of no known set ({', '.join(list(names)[:6])} ...)",
            f"Use weights trained on one of: {', '.join(LABEL_SETS)}",
        )
    return np.array([CLASSES.index(table[name]) if name in table else IGNORED for name in plain], np.uint8)

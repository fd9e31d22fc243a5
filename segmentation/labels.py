"""Classes that networks predict, their LAS codes, and the mapping of other label sets onto them by name."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scan2sim.pipeline.core.classes import CODE, PHOTO_CLASSES
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import U8

CLASSES = PHOTO_CLASSES
GROUND_CLASSES = ("road", "sidewalk", "terrain")
SKY = CLASSES.index("sky")
"""Index of the sky."""
IGNORED = 255
"""Index of pixels that are ignored in training, and of labels without a class."""


def code_of_index() -> U8:
    """(12,) LAS codes of `CLASSES`; 0 for the sky."""
    return np.array([CODE.get(name, 0) for name in CLASSES], np.uint8)


def index_of_code() -> U8:
    """(256,) index into `CLASSES` of each LAS code; 0 is sky; 255 and codes without a class are `IGNORED`."""
    table = np.full(256, IGNORED, np.uint8)
    for i, name in enumerate(CLASSES):
        table[CODE.get(name, 0)] = i
    table[CODE["mid_vegetation"]] = CLASSES.index("low_vegetation")
    return table


def _class_by_label(**names: str) -> dict[str, str]:
    """Class by label name, from comma-separated label names by class."""
    return {name.strip(): ours for ours, many in names.items() for name in many.split(",")}


LABEL_SETS: dict[str, dict[str, str]] = {
    "cityscapes": _class_by_label(
        road="road, parking, ground, bridge, tunnel", sidewalk="sidewalk", terrain="terrain, rail track, dynamic",
        building="building", road_sign="traffic sign, traffic light", pole="pole, polegroup",
        high_vegetation="vegetation", person="person, rider",
        vehicle="car, truck, bus, train, motorcycle, bicycle, caravan, trailer, license plate, ego vehicle",
        wall_or_fence="wall, fence, guard rail", sky="sky",
    ),
    "vistas": _class_by_label(
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
    "ade20k": _class_by_label(
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


def map_labels(names: Sequence[str], where: str) -> U8:
    """(len(names),) index into `CLASSES` of every label of a network, `IGNORED` for labels without a class.

    Args:
        names: names of the network's labels, in order; the best matching set of `LABEL_SETS` is used.
        where: file with the labels, for the error message.

    Raises:
        InputError: the names belong to none of `LABEL_SETS`.
    """
    plain = [name.lower().strip().split(";")[0].split(",")[0] for name in names]
    best = max(LABEL_SETS, key=lambda key: sum(name in LABEL_SETS[key] for name in plain))
    table = LABEL_SETS[best]
    known = [name for name in plain if name in table]
    if len({table[name] for name in known}) < 4:
        raise InputError(
            where,
            f"unknown label set ({', '.join(list(names)[:6])} ...)",
            f"Use weights trained on one of: {', '.join(LABEL_SETS)}",
        )
    return np.array([CLASSES.index(table[name]) if name in table else IGNORED for name in plain], np.uint8)

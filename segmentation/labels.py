"""Classes that networks predict, their LAS codes, and the mapping of other label sets onto them by name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

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
    """(256,) LAS codes of `CLASSES`; 0 for the sky, and `IGNORED` for what is no index."""
    table = np.full(256, IGNORED, np.uint8)
    table[: len(CLASSES)] = [CODE.get(name, 0) for name in CLASSES]
    return table


def index_of_code() -> U8:
    """(256,) index into `CLASSES` of each LAS code; 0 is sky; 255 and codes without a class are `IGNORED`."""
    table = np.full(256, IGNORED, np.uint8)
    for i, name in enumerate(CLASSES):
        table[CODE.get(name, 0)] = i
    table[CODE["mid_vegetation"]] = CLASSES.index("low_vegetation")
    return table


def _plain(name: str) -> str:
    """First synonym of a label in lower case, letters and digits only: "Traffic_Sign", "road, route", "sky-other"."""
    first = re.sub("-(other|merged|stuff)", "", re.split("[;,]", name.lower())[0])
    return re.sub("[^a-z0-9]", "", first)


def _class_by_label(**names: str) -> dict[str, str]:
    """Class by plain label name, from comma-separated label names by class."""
    return {_plain(name): ours for ours, many in names.items() for name in many.split(",")}


RECOGNIZED = 10
"""Number of names of a label set from which a network's labels are that set."""
LABEL_SETS: dict[str, dict[str, str]] = {
    "cityscapes": _class_by_label(
        road="road, parking, ground, bridge, tunnel", sidewalk="sidewalk", terrain="terrain, rail track, dynamic",
        building="building, garage, unknown construction", road_sign="traffic sign, traffic light",
        pole="pole, polegroup, smallpole, lamp", high_vegetation="vegetation", person="person, rider",
        vehicle="car, truck, bus, train, motorcycle, bicycle, caravan, trailer, license plate, ego vehicle, "
        "unknown vehicle",
        wall_or_fence="wall, fence, guard rail, gate", sky="sky",
    ),
    "vistas": _class_by_label(
        road="road, bike lane, crosswalk - plain, lane marking - crosswalk, crosswalk zebra, lane marking - general, "
        "marking general, parking, service lane, manhole, catch basin, pothole, bridge, tunnel, rail track",
        sidewalk="sidewalk, pedestrian area, curb, curb cut", terrain="terrain, sand, snow, mountain, water",
        building="building, billboard, phone booth, bench, banner",
        road_sign="traffic sign (front), traffic sign (back), traffic sign frame, traffic light",
        pole="pole, street light, utility pole, bike rack, fire hydrant, mailbox, cctv camera",
        high_vegetation="vegetation", person="person, bicyclist, motorcyclist, other rider, ground animal",
        vehicle="car, bus, truck, caravan, trailer, on rails, motorcycle, bicycle, boat, other vehicle, wheeled slow, "
        "ego vehicle, car mount",
        wall_or_fence="wall, fence, guard rail, barrier, other barrier", sky="sky",
    ),
    "ade20k": _class_by_label(
        road="road, runway, path, dirt track", sidewalk="sidewalk, stairs, step, stairway",
        terrain="earth, grass, field, sand, land, hill, mountain, rock, water, floor",
        building="building, house, skyscraper, hovel, tower, windowpane, door, awning, booth, column, bridge, canopy",
        road_sign="signboard, traffic light", pole="pole, streetlight, street lamp, bannister",
        low_vegetation="plant, flower", high_vegetation="tree, palm", person="person, animal",
        vehicle="car, bus, truck, van, minibike, bicycle, boat, ship, airplane, trade name",
        wall_or_fence="wall, fence, railing", sky="sky",
    ),
    "coco": _class_by_label(
        road="road, railroad", sidewalk="pavement, platform, stairs",
        terrain="dirt, grass, ground, gravel, sand, mud, playingfield, mountain, hill, rock, stone, snow, water, "
        "river, sea",
        building="building, house, roof, skyscraper, bridge, door, window, window-blind, tent",
        road_sign="stop sign, street sign, traffic light", pole="parking meter, fire hydrant",
        low_vegetation="bush, plant, flower", high_vegetation="tree, branch, leaves", person="person",
        vehicle="car, truck, bus, train, motorcycle, bicycle, airplane, boat",
        wall_or_fence="wall, wall-brick, wall-concrete, wall-panel, wall-stone, wall-tile, wall-wood, fence, railing",
        sky="sky, clouds",
    ),
    "camvid": _class_by_label(
        road="road, road marking", sidewalk="pavement, sidewalk", building="building", road_sign="sign symbol",
        pole="pole, column pole", high_vegetation="tree", person="pedestrian, bicyclist", vehicle="car",
        wall_or_fence="fence", sky="sky",
    ),
    "scan2sim": _class_by_label(**{name: name for name in CLASSES}),
}  # fmt: skip


def read_names(path: Path) -> list[str]:
    """Label names of a text file, one per line.

    Raises:
        InputError: it can't be read, or a line is empty, which would shift the names after it.
    """
    remedy = "Name one label per line, in their order; void for one without a meaning"
    try:
        names = [line.strip() for line in path.read_text("utf-8-sig").rstrip().split("\n")]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"can't be read ({error})", remedy) from None
    if not all(names):
        raise InputError(path, f"line {names.index('') + 1} is empty", remedy)
    return names


def map_labels(names: Sequence[str], where: str, *, whole_scene: bool = True) -> U8:
    """(len(names),) index into `CLASSES` of every label, `IGNORED` for labels without a class.

    Args:
        names: names of the labels, in order; if the best matching set of `LABEL_SETS` has few of them, the others are
            looked up in the other sets. Of names with parents ("construction--flat--road") the last parts count.
        where: file with the labels, for the error message.
        whole_scene: reject labels of objects alone, as of networks for instances.

    Raises:
        InputError: no name is known, or the names are not of a whole scene: of fewer than four classes, or of no ground
            or no building.
    """
    parts = [name.split("--") for name in names]
    plain = [[_plain("".join(part[i:])) for i in range(len(part))] for part in parts]
    matches = [sum(any(one in table for one in name) for name in plain) for table in LABEL_SETS.values()]
    table = list(LABEL_SETS.values())[int(np.argmax(matches))]
    if max(matches) < RECOGNIZED:  # names of the user's own, which no set has all of
        table = {label: ours for labels in LABEL_SETS.values() for label, ours in labels.items()} | table
    found = [next((table[one] for one in name if one in table), None) for name in plain]
    classes = {name for name in found if name}
    partial = len(classes) < 4 or "building" not in classes or not classes & set(GROUND_CLASSES)
    if not classes or (whole_scene and partial):
        raise InputError(
            where,
            f"unknown label set ({', '.join(list(names)[:6])} ...)",
            f"Use weights trained on one of: {', '.join(LABEL_SETS)}; or name their labels after the classes "
            f"{', '.join(CLASSES)}, and others void",
        )
    return np.array([IGNORED if name is None else CLASSES.index(name) for name in found], np.uint8)

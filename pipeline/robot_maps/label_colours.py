"""Maps whose colours are semantic labels: recognizes them, and converts colours to classes by a legend.

The colours of SemanticKITTI (Behley et al., "SemanticKITTI: A Dataset for Semantic Scene Understanding of LiDAR
Sequences", ICCV 2019) are those of its API (`config/semantic-kitti.yaml`), which lists blue, green, red: maps in
either order are read.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.classes import CODE, code_of
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F32, U8
from scan2sim.pipeline.io import label_sets

Legend = Mapping[tuple[int, int, int], int]
"""Class code by colour (red, green, blue)."""
_COLOURS_OF_SEMANTIC_KITTI = {
    0: (0, 0, 0), 10: (100, 150, 245), 11: (100, 230, 245), 13: (100, 80, 250), 15: (30, 60, 150), 16: (0, 0, 255),
    18: (80, 30, 180), 30: (255, 30, 30), 31: (255, 40, 200), 32: (150, 30, 90), 40: (255, 0, 255),
    44: (255, 150, 255), 48: (75, 0, 75), 49: (175, 0, 75), 50: (255, 200, 0), 51: (255, 120, 50), 52: (255, 150, 0),
    60: (150, 255, 170), 70: (0, 175, 0), 71: (135, 60, 0), 72: (150, 240, 80), 80: (255, 240, 150), 81: (255, 0, 0),
    99: (50, 255, 255),
}  # fmt: skip
SEMANTIC_KITTI: Legend = {
    colour: CODE[label_sets.SEMANTIC_KITTI.classes.get(label, "unclassified")]
    for label, colour in _COLOURS_OF_SEMANTIC_KITTI.items()
}
LEGENDS: dict[str, Legend] = {"semantickitti": SEMANTIC_KITTI}
"""Built-in legends by name."""
MAX_COLOUR_DISTANCE = 25.0
"""Largest difference (Euclidean, of 0 to 255) to a colour of the legend; farther ones are means of several labels."""
BORDER_NEIGHBOURS = 5
"""Points with such a colour get the most frequent class of this number of nearest points of the legend."""
LABEL_COLOURS, LABEL_SHARE = (3, 24), 0.6
"""Minimum and maximum number of colours that cover this share of points if they are labels; photos have thousands."""
MIN_CHROMA = 40
"""Difference of the largest and smallest channel of at least one of these colours: grey levels are no labels."""


def are_labels(rgb: U8) -> bool:
    """Whether the colours (N, 3) of a map are semantic labels: a few colours, some of them saturated."""
    packed = rgb.astype(np.int32) @ np.array([65536, 256, 1], np.int32)
    found, count = np.unique(packed, return_counts=True)
    order = np.argsort(-count)
    needed = int(np.searchsorted(np.cumsum(count[order]), LABEL_SHARE * len(rgb))) + 1
    frequent = found[order[: max(needed, LABEL_COLOURS[0])]]
    channels = np.stack([frequent >> 16, frequent >> 8 & 255, frequent & 255], axis=1)
    saturated = int((np.ptp(channels, axis=1) >= MIN_CHROMA).sum())
    return needed <= LABEL_COLOURS[1] and len(found) >= LABEL_COLOURS[0] and saturated >= 2


def matching_legend(rgb: U8) -> str | None:
    """Name of the built-in legend that has the colours (N, 3) of most points, or None."""
    for name, legend in LEGENDS.items():
        if _nearest(rgb, legend)[1].mean() >= LABEL_SHARE:
            return name
    return None


def read_legend(given: str) -> str:
    """The name of a built-in legend, or the entries of a legend file: one `r,g,b=class` per line, `#` for comments.

    Raises:
        SettingError: neither a legend nor a file, or an entry that `parse_legend` rejects.
    """
    if given.lower() in LEGENDS:
        return given.lower()
    try:
        lines = Path(given).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        cause = f"{given!r} is neither a legend ({', '.join(LEGENDS)}) nor a text file"
        raise SettingError("--classes-from-colours", cause, "Give a legend or a file of lines r,g,b=class") from None
    entries = [text for line in lines if (text := line.partition("#")[0].strip())]
    parse_legend(";".join(entries))
    return ";".join(entries)


def parse_legend(text: str) -> Legend:
    """A legend from its name or its entries, `255,0,255=road;75,0,75=sidewalk`.

    Raises:
        SettingError: an entry has a wrong form, or a class is unknown.
    """
    if text in LEGENDS:
        return LEGENDS[text]
    legend: dict[tuple[int, int, int], int] = {}
    for entry in filter(None, map(str.strip, text.split(";"))):
        colour, _, name = entry.partition("=")
        parts = [part.strip() for part in colour.split(",")]
        code = code_of(name)
        if len(parts) != 3 or not all(part.isdecimal() and int(part) < 256 for part in parts) or code is None:
            cause = f"{entry[:40]!r} is no colour with a class"
            remedy = f"Write r,g,b=class, such as 255,0,255=road; classes: {', '.join(CODE)}"
            raise SettingError("--classes-from-colours", cause, remedy)
        red, green, blue = (int(part) for part in parts)
        legend[red, green, blue] = code
    if not legend:
        raise SettingError("--classes-from-colours", "the legend is empty", "Write lines r,g,b=class")
    return legend


def classes_of_colours(xyz: F32, rgb: U8, legend: Legend) -> tuple[U8, float]:
    """(N,) class codes of coloured points (N, 3), and the share of points with a colour of the legend.

    Means of several labels, at the borders of voxels, take the most frequent class of their neighbours.
    """
    from scipy.spatial import cKDTree

    code, sure = _nearest(rgb, legend)
    if sure.any() and not sure.all():
        known = code[sure]
        k = min(BORDER_NEIGHBOURS, len(known))
        near = cKDTree(xyz[sure]).query(xyz[~sure], k=k, workers=-1)[1].reshape(-1, k)
        codes = np.unique(known)
        votes = np.stack([(known[near] == one).sum(axis=1) for one in codes])
        code[~sure] = codes[votes.argmax(axis=0)]
    return code, float(sure.mean())


def _nearest(rgb: U8, legend: Legend) -> tuple[U8, npt.NDArray[np.bool_]]:
    """(N,) class of the nearest colour of the legend, and whether it is near; for the better order of the channels."""
    from scipy.spatial import cKDTree

    tree = cKDTree(np.array(list(legend), np.float64))
    distance, index = min(
        (tree.query(channels.astype(np.float64)) for channels in (rgb, rgb[:, ::-1])),
        key=lambda found: -int((found[0] <= MAX_COLOUR_DISTANCE).sum()),
    )
    return np.array(list(legend.values()), np.uint8)[index], distance <= MAX_COLOUR_DISTANCE

"""Occupancy maps for `nav2_map_server`: a YAML file and a PGM image.

The server reads `p = (255 - pixel) / 255`: over `occupied_thresh` a cell is occupied, below `free_thresh` free, between
them unknown (mode `trinary`; docs.nav2.org, Map Server). `origin` is the pose of the lower left pixel's corner in the
map's frame, metres and radians; the image's first row is the one with the largest y.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.simulation.occupancy import FREE, OCCUPIED, UNKNOWN, Storey

PIXEL = {FREE: 254, OCCUPIED: 0, UNKNOWN: 205}
"""Pixels as Nav2's map saver writes them."""
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
"""Thresholds that read `PIXEL` back; unknown is p = .19608, so that Nav2's default of .25 would make it free."""


def write(storey: Storey, path: Path, offset: tuple[float, float] = (0.0, 0.0), note: str = "") -> None:
    """Write `path` (.yaml), and the image beside it (.pgm).

    Args:
        storey: the map.
        path: of the YAML file.
        offset: (x, y) of the storey's coordinates in the map's frame, metres.
        note: a comment in the YAML file.
    """
    table = np.zeros(3, np.uint8)
    table[list(PIXEL)] = list(PIXEL.values())
    pixels = table[storey.occupancy][::-1]
    image = path.with_suffix(".pgm")
    header = f"P5\n{pixels.shape[1]} {pixels.shape[0]}\n255\n"
    image.write_bytes(header.encode() + np.ascontiguousarray(pixels).tobytes())
    x, y = (round(a + b, 6) for a, b in zip(storey.grid.origin, offset, strict=True))
    comment = f"# {note}\n" if note else ""
    path.write_text(
        f"{comment}image: {image.name}\nmode: trinary\nresolution: {round(storey.grid.cell, 6)}\n"
        f"origin: [{x}, {y}, 0.0]\nnegate: 0\noccupied_thresh: {OCCUPIED_THRESH}\nfree_thresh: {FREE_THRESH}\n",
        encoding="utf-8",
    )

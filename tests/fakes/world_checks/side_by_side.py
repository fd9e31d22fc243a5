"""Photo and renderings side by side: overview, and close-ups of a facade, the kerb and the road."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.io.images import image

OVERVIEW_WIDTH_PX = 640
"""Width of an image in the overview."""
CLOSE_UP_PX = (360, 270)
"""Size of a close-up in the original; shown at twice this size."""
CLOSE_UP_CENTRES = {"left": (0.18, 0.42), "middle": (0.5, 0.66), "right": (0.8, 0.55)}
"""Centres of the close-ups, as shares of width and height."""

NamedImages = Sequence[tuple[str, U8]]


def side_by_side(folder: Path, name: str, images: NamedImages) -> None:
    """Write `<name>.png`, and `<name>_<place>.png` for each close-up; named `images` (H, W, 3) of the same size."""
    import cv2

    height, width = images[0][1].shape[:2]
    size = (OVERVIEW_WIDTH_PX, round(OVERVIEW_WIDTH_PX * height / width))
    image.write(
        folder / f"{name}.png",
        _row([(n, np.asarray(cv2.resize(i, size, interpolation=cv2.INTER_AREA))) for n, i in images]),
    )
    w, h = min(CLOSE_UP_PX[0], width), min(CLOSE_UP_PX[1], height)
    for place, (across, down) in CLOSE_UP_CENTRES.items():
        x = int(np.clip(across * width - w / 2, 0, width - w))
        y = int(np.clip(down * height - h / 2, 0, height - h))
        parts = [(n, np.repeat(np.repeat(i[y : y + h, x : x + w], 2, axis=0), 2, axis=1)) for n, i in images]
        image.write(folder / f"{name}_{place}.png", _row(parts))


def _row(images: NamedImages) -> U8:
    """Images in rows of up to three, with their names."""
    import cv2

    height, width = images[0][1].shape[:2]
    columns = min(3, len(images))
    rows = -(-len(images) // columns)
    whole = np.full((rows * height, columns * width, 3), 255, np.uint8)
    for k, (name, picture) in enumerate(images):
        y, x = k // columns * height, k % columns * width
        whole[y : y + height, x : x + width] = picture
        cv2.putText(whole, name, (x + 8, y + 22), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 0, 0), 4, cv2.LINE_AA)
        cv2.putText(whole, name, (x + 8, y + 22), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 0), 1, cv2.LINE_AA)
    return whole

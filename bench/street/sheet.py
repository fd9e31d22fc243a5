"""Contact sheet of worlds of a street from its driver's eye: crowns, posts and walls before and after a change.

`python -m bench.street.sheet --runs OUT/raw0009/run OTHER/raw0009/run [--names before after]
[--frames 4 12 20] [--part LEFT TOP RIGHT BOTTOM] --out sheet.png`

A row for each frame: the photo, then a rendering of each run's world from its pose. `--part` is a section of the frame
in pixels, enlarged to `WIDTH_PX`. `bench.street.ablation` writes such a sheet of each street.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.street.run import HOLD_OUT
from bench.street.world import World, photos
from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.lidar.sweeps import every_nth

WIDTH_PX, GAP_PX, TITLE_PX = 900, 6, 28
Part = tuple[int, int, int, int]


def driver_views(run: Path, frames: Sequence[int] = ()) -> list[tuple[U8, U8]]:
    """Photo, and rendering of a run's world from its pose, for each of the frames, counted from 0.

    The run's tile is the folder `tile` beside it. Without `frames`, the held-out ones.
    """
    world = World(run / "world")
    views = photos(run.parent / "tile", run, world.origin)
    chosen = [views[sorted(views)[frame]] for frame in frames or every_nth(len(views), HOLD_OUT).tolist()]
    return [(view.rgb, world.render(view).rgb) for view in chosen]


def sheet(rows: Sequence[Sequence[U8]], names: Sequence[str], part: Part | None = None) -> U8:
    """Image of rows of images of the same size, with the names of the columns above."""
    from PIL import Image, ImageDraw, ImageFont

    left, top, right, bottom = part or (0, 0, rows[0][0].shape[1], rows[0][0].shape[0])
    height = round(WIDTH_PX * (bottom - top) / (right - left))
    size = (len(names) * (WIDTH_PX + GAP_PX) - GAP_PX, len(rows) * (height + GAP_PX) + TITLE_PX)
    page = Image.new("RGB", size, "white")
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(18)
    for column, name in enumerate(names):
        x = column * (WIDTH_PX + GAP_PX)
        draw.text((x + GAP_PX, 3), name, "black", font)
        for row, images in enumerate(rows):
            cut = Image.fromarray(images[column]).crop((left, top, right, bottom))
            page.paste(
                cut.resize((WIDTH_PX, height), Image.Resampling.LANCZOS), (x, TITLE_PX + row * (height + GAP_PX))
            )
    return np.asarray(page)


def write_sheet(
    views: Sequence[Sequence[tuple[U8, U8]]], names: Sequence[str], out: Path, part: Part | None = None
) -> None:
    """Write the sheet of the `driver_views` of some worlds with these names."""
    from PIL import Image

    rows = [[frames[0][0], *(rendering for _, rendering in frames)] for frames in zip(*views, strict=True)]
    out.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(sheet(rows, ("photo", *names), part)).save(out)


def main() -> None:
    """Write the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", nargs="+", type=Path, required=True)
    parser.add_argument("--names", nargs="+")
    parser.add_argument("--frames", nargs="+", type=int, default=[])
    parser.add_argument("--part", nargs=4, type=int, metavar=("LEFT", "TOP", "RIGHT", "BOTTOM"))
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    names = arguments.names or [run.resolve().parent.parent.name for run in arguments.runs]
    part = tuple(arguments.part) if arguments.part else None
    write_sheet([driver_views(run, arguments.frames) for run in arguments.runs], names, arguments.out, part)


if __name__ == "__main__":
    main()

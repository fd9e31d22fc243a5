"""Splats of odometry 04 trained on 14 photos of 25, and scored on the eleven others.

The distance between neighbouring photos of the training is 2.8 to 7 m where photos are held out. All other inputs are
those of the street's run: poses and exposures were found with eight of the eleven photos.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bench.street import frame, score, splats, training
from bench.street.world import Photo
from scan2sim.pipeline.core.types import Bools
from scan2sim.pipeline.io import views as views_io
from scan2sim.texturing.splats.view import SplatRenderer

HELD_OUT = (2, 4, 5, 8, 11, 12, 13, 14, 17, 20, 21)
"""Numbers of the photos, vehicles are drawn on all of them (`truth.json`)."""


def metrics(
    run: Path,
    photos: Mapping[int, Photo],
    vehicles: Callable[[int, Photo], Bools],
    folder: Path,
    pictures: Path,
) -> dict[str, Any]:
    """Train and score.

    Args:
        run: the street's run.
        photos: all photos of the street by number, at their refined poses.
        vehicles: function of a photo's number and the photo that returns its (H, W) pixels of vehicles and people.
        folder: folder for the training.
        pictures: folder for pictures of photo, splats and difference.
    """
    inputs, params = training.of_run(run)
    inputs["views"] = _held_out(inputs["views"], folder / "views.json")
    layer, used = training.train(inputs, params, folder / "splats")
    renderer, rows = SplatRenderer(layer), {}
    for number in HELD_OUT:
        photo = photos[number]
        counts, rgb = ~vehicles(number, photo), splats.rendered(renderer, photo).rgb
        like = score.apply_gain(rgb, score.solve_gain(photo.rgb, rgb, counts))
        rows[number] = score.psnr(score.squared_error(photo.rgb, like, counts))
        frame.picture(pictures / f"few_{number:02d}.png", photo.rgb, rgb, counts)
    return {"photos": rows, "psnr_db": float(np.mean(list(rows.values()))), **used}


def _held_out(views: Path, out: Path) -> Path:
    """Write the photos `views` of a run to `out`, with `HELD_OUT` held out; returns `out`."""
    every = views_io.load(views)
    views_io.save(out, every, [int(Path(view.name).name) in HELD_OUT for view in every])
    return out


def table(found: Mapping[str, Any]) -> None:
    """Print the scores."""
    rows = ", ".join(f"{number} {value:.2f}" for number, value in found["photos"].items())
    print(f"\nfew: {found['psnr_db']:.2f} dB on eleven photos, none of them trained on ({rows})")

"""Score: the textured world against photos held out of texturing, and against the true colours."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pydantic import Field

from pipeline.classes import GROUPS
from pipeline.step import Done, Inputs, Params, Report, Step


class ScoreParams(Params):
    """How closely is looked.

    Attributes:
        truth_reach: metres from a true surface sample within which the mesh stands for it.
        truth_samples: true samples that are compared, at most.
    """

    truth_reach: float = Field(0.1, gt=0)
    truth_samples: int = Field(500_000, ge=1000)


def score(inputs: Inputs, params: ScoreParams, out: Path, report: Report) -> Done:
    """Compare the textured groups with held-out photos and with the truth.

    Pixels count where another photo saw the surface, and where this one does: not where it shows a car or
    person that the world leaves out (`depth`, the folder of depth maps, tells).

    Facts: `held_out` photos; their mean `psnr_db` (as it is), `psnr_gain_db` (after a gain a channel) and
    `ssim`, None without any; `photos`, the same for each; `truth_psnr_db` for generated tiles.
    """
    from pipeline.io import views as views_io
    from texturing.evaluate import held_out

    folders = [inputs[g] for g in GROUPS if g in inputs]
    views = views_io.load(inputs["views"])
    index = [i for i, out_ in enumerate(views_io.load_held_out(inputs["views"])) if out_]
    held = [views[i] for i in index]
    depths = [inputs["depth"] / f"{i}.npy" for i in index]
    photos: dict[str, dict[str, float]] = {}
    for i, result in enumerate(held_out(folders, held, depths) if held else ()):
        report(i / (len(held) + 1), result.view.name)
        figures = {name: getattr(result, name) for name in ("psnr_db", "psnr_gain_db", "ssim", "coverage")}
        if not any(math.isnan(value) for value in figures.values()):
            photos[result.view.name] = {name: round(value, 4) for name, value in figures.items()}
    facts: dict[str, Any] = {"held_out": len(photos)}
    for name in ("psnr_db", "psnr_gain_db", "ssim"):
        values = [figures[name] for figures in photos.values()]
        facts[name] = round(sum(values) / len(values), 4) if values else None
    facts["photos"] = photos
    if "truth.points" in inputs:
        report(0.9, "true colours")
        facts["truth_psnr_db"] = _truth(inputs, folders, params)
    return Done({}, facts)


def _truth(inputs: Inputs, folders: list[Path], params: ScoreParams) -> float | None:
    """PSNR of the texture against the true surface colours, where a photo saw it; None where none did."""
    import numpy as np

    from pipeline.io import las
    from pipeline.render import Renderer, textured

    bodies = [textured(folder) for folder in folders]
    truth = las.read(inputs["truth.points"], bodies[0].mesh.frame)
    truth = truth.take(slice(None, None, max(1, len(truth) // params.truth_samples)))
    assert truth.rgb is not None
    rgb, seen, distance = Renderer(bodies).nearest(truth.xyz)
    counts = (seen == 255) & (distance < params.truth_reach)
    if not counts.any():
        return None
    error = np.mean((rgb[counts].astype(float) - truth.rgb[counts]) ** 2)
    return round(float(10 * np.log10(255**2 / max(error, 1e-3))), 2)


SCORE = Step("score", 1, score, ScoreParams)

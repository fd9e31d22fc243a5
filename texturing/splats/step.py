"""Splats step: 3D Gaussian splats of all that the photos show, trained on the photos."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Seed
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.io import views as views_io

MIN_BASELINE_M = 0.5
"""Photos closer to each other than this are not compared for depth."""
CHECKPOINT_S = 60.0
STATE, SPLATS = "training.npz", "splats.npz"


class SplatsParams(Params):
    """Splats: what cameras see, beside the mesh, which is for physics and lidars.

    Attributes:
        when: auto: if there are photos taken from the street; never: no splats.
        epochs: visits of every photo in a quarter, half and full size.
        cover: weight of the loss that covers what isn't sky and uncovers what is.
        seed: of the order in which photos are visited.
    """

    when: Literal["auto", "never"] = "auto"
    epochs: tuple[int, int, int] = Field((5, 12, 14), json_schema_extra={"range": "3 numbers, 0 to 1,000"})
    cover: float = Field(0.017, ge=0, le=1)
    seed: Seed = 0


def splats(inputs: Inputs, params: SplatsParams, out: Path, report: Report) -> Done:
    """Train splats on `views` that aren't held out.

    Inputs: `views`, their `depth` maps and `exposures`; `labels` (optional), class probabilities of photos; `mesh.*`.
    File: `splats`, (N, 14) `parameters` as of `model.Splats`, and `background`, (H, W, 3) as of `background`.
    """
    from scan2sim.pipeline.camera.renderer import Body, Renderer
    from scan2sim.texturing.backdrop import photos as prepared
    from scan2sim.texturing.backdrop import plane_sweep
    from scan2sim.texturing.photo_cache import Exposures
    from scan2sim.texturing.splats.shots import shots
    from scan2sim.texturing.splats.start import first_background, first_splats
    from scan2sim.texturing.splats.training import Schedule, Training

    meshes = [Mesh.load(path) for name, path in inputs.items() if name.startswith("mesh.")]
    world, exposures = Renderer([Body(mesh) for mesh in meshes]), Exposures.load(inputs["exposures"])
    views, held_out = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    used = []
    for k, view in enumerate(views):
        if held_out[k] or view.camera.model == "orthographic":
            continue
        report(0.05 * k / len(views), view.name)
        labels = inputs["labels"] / f"{k}.npy" if "labels" in inputs else None
        photo = prepared.prepare(view, inputs["depth"] / f"{k}.npy", labels, world, exposures)
        if photo is not None:
            used.append(photo)
    for i, photo in enumerate(used):
        report(0.05 + 0.1 * i / len(used), f"depth of {photo.view.name}")
        others = plane_sweep.neighbours(used, i, MIN_BASELINE_M)
        photo.inverse = plane_sweep.inverse_depth(photo, [used[j] for j in others])
    seen = [shot for photo in used for shot in shots(photo)]
    first, size = first_splats(used)
    training = Training.of(first, size, first_background(seen), len(seen))
    training.run(
        seen, Schedule(params.epochs, cover=params.cover, seed=params.seed),
        lambda share, text: report(0.15 + 0.85 * share, text),
    )  # fmt: skip
    result = training.result()
    np.savez_compressed(out / SPLATS, parameters=result.parameters, background=training.background.texture)
    return Done({"splats": out / SPLATS}, {"splats": len(result), "photos": len(used), "first": len(first)})


SPLATS_STEP = Step("splats", 1, splats, SplatsParams, memory=(1.5, 3))

"""Splats step: 3D Gaussian splats of all that the photos show, trained on the photos."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from scan2sim.pipeline.core.parameters import Seed
from scan2sim.pipeline.core.splats import SplatLayer
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.io import views as views_io

if TYPE_CHECKING:
    from scan2sim.texturing.backdrop.photos import Photo
    from scan2sim.texturing.splats.shots import Shot
    from scan2sim.texturing.splats.training import Schedule, Training

MIN_BASELINE_M = 0.5
"""Photos closer to each other than this are not compared for depth."""
CHECKPOINT_S = 60.0
"""Seconds between checkpoints."""
STATE_FILE, SPLATS_FILE = "training.npz", "splats.npz"
DEPTH_SHARE, TRAINING_SHARE = 0.05, 0.2
"""Progress at which depth is estimated, and at which the training begins."""


class SplatsParams(Params):
    """Splats: what cameras see, beside the mesh, which is for physics and lidars.

    Attributes:
        when: never: no splats; auto: if there are photos taken from the street.
        epochs: visits of every photo in a quarter, half and full size.
        parked: show vehicles that stand still, although the mesh may leave them out; those that moved are never shown.
        cover: weight of the loss that covers what isn't sky and uncovers what is.
        seed: of the order in which photos are visited.
    """

    when: Literal["never", "auto"] = "never"
    epochs: tuple[int, int, int] = Field((5, 12, 14), json_schema_extra={"range": "3 numbers, 0 to 1,000"})
    parked: bool = True
    cover: float = Field(0.017, ge=0, le=1)
    seed: Seed = 0


def splats(inputs: Inputs, params: SplatsParams, out: Path, report: Report, checkpoint: Path) -> Done:
    """Train splats on the photos `views` that aren't held out.

    Inputs: `views`, their `depth` maps and `exposures`; `mesh.*`; optionally `labels`, class probabilities of photos,
    and `instances`, boxes of vehicles and people.

    File: `splats`, a `SplatLayer`, without any splats if fewer than two photos can be used.
    """
    from scan2sim.texturing.splats.training import Schedule

    used = _prepared(inputs, params, report)
    if len(used) < 2:
        SplatLayer.nothing().save(out / SPLATS_FILE)
        return Done({"splats": out / SPLATS_FILE}, {"photos": len(used), "splats": 0})
    schedule = Schedule(params.epochs, cover=params.cover, seed=params.seed)
    training, seen = _begun(used, checkpoint / STATE_FILE)
    first = len(training.descent.parameters)
    _train(training, seen, schedule, checkpoint / STATE_FILE, report)
    result = training.result()
    SplatLayer(result, training.background.texture).save(out / SPLATS_FILE)
    return Done({"splats": out / SPLATS_FILE}, {"photos": len(used), "first": first, "splats": len(result)})


def _prepared(inputs: Inputs, params: SplatsParams, report: Report) -> list[Photo]:
    """The photos of training, with depth."""
    from scan2sim.pipeline.camera.renderer import Body, Renderer
    from scan2sim.texturing.backdrop import photos as prepared
    from scan2sim.texturing.backdrop import plane_sweep
    from scan2sim.texturing.photo_cache import Exposures
    from scan2sim.texturing.whole_frame import parked_mesh

    meshes = [Mesh.load(path) for name, path in inputs.items() if name.startswith("mesh.")]
    world, exposures = Renderer([Body(mesh) for mesh in meshes]), Exposures.load(inputs["exposures"])
    views, held_out = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    parked = None
    if params.parked and "instances" in inputs:
        parked = Renderer([Body(parked_mesh(inputs["instances"], meshes[0].frame))])
    used = []
    for k, view in enumerate(views):
        if held_out[k] or view.camera.model == "orthographic":
            continue
        report(DEPTH_SHARE * k / len(views), view.name)
        labels = inputs["labels"] / f"{k}.npy" if "labels" in inputs else None
        photo = prepared.prepare(view, inputs["depth"] / f"{k}.npy", labels, world, exposures)
        if photo is not None:
            if parked is not None:
                photo.movable &= ~parked.view(photo.camera, view.T_world_cam).hit
            used.append(photo)
    for i, photo in enumerate(used):
        report(DEPTH_SHARE + (TRAINING_SHARE - DEPTH_SHARE) * i / len(used), f"depth of {photo.view.name}")
        others = plane_sweep.neighbours(used, i, MIN_BASELINE_M)
        photo.inverse = plane_sweep.inverse_depth(photo, [used[j] for j in others])
    return used


def _begun(used: Sequence[Photo], state: Path) -> tuple[Training, list[Shot]]:
    """The training that was interrupted, or a new one; and its shots."""
    from scan2sim.texturing.splats.shots import shots
    from scan2sim.texturing.splats.start import first_background, first_splats
    from scan2sim.texturing.splats.training import Training

    seen = [shot for photo in used for shot in shots(photo)]
    if state.is_file():
        return Training.load(state), seen
    first, size = first_splats(used)
    return Training.of(first, size, first_background(seen), len(seen)), seen


def _train(training: Training, seen: Sequence[Shot], schedule: Schedule, state: Path, report: Report) -> None:
    """Train to the end, with a checkpoint every minute."""
    saved = time.monotonic()

    def after_epoch(share: float, text: str) -> None:
        nonlocal saved
        report(TRAINING_SHARE + (1 - TRAINING_SHARE) * share, text)
        if time.monotonic() - saved > CHECKPOINT_S:
            training.save(state)
            saved = time.monotonic()

    training.run(seen, schedule, after_epoch)


SPLATS = Step("splats", 1, splats, SplatsParams, resumes=True, memory=(1.5, 3))

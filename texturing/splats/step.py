"""Splats step: 3D Gaussian splats of all that the photos show, trained on the photos."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Seed
from scan2sim.pipeline.core.splats import SplatLayer, Splats
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import Bools, Mesh, PointCloud
from scan2sim.pipeline.io import views as views_io

if TYPE_CHECKING:
    from scan2sim.texturing.backdrop.photos import Photo
    from scan2sim.texturing.splats.shots import Shot
    from scan2sim.texturing.splats.training import Schedule, Training

MIN_BASELINE_M = 0.5
"""Photos closer to each other than this are not compared for depth."""
CHECKPOINT_S = 60.0
"""Seconds between checkpoints."""
MATCHING_PIXELS, HYPOTHESES, NEIGHBOURS = 113_000, 128, 4
"""Size of the images in which depth is estimated, number of inverse depths, and of photos to compare with."""
UNMASKED = "vehicles and people are not recognized, so that moving ones may leave traces: run it with the step `label`"
TOO_FEW = "there are no splats: at least two photos that show something are needed"
STATE_FILE, SPLATS_FILE = "training.npz", "splats.npz"
DEPTH_SHARE, TRAINING_SHARE = 0.05, 0.2
"""Progress at which depth is estimated, and at which the training begins."""


class SplatsContext(Context):
    """The tile.

    Attributes:
        cell: the tile's cell within a survey, to which its splats are cut; None: the tile is built alone.
        origin: origin of local coordinates, metres.
    """

    cell: TileCell | None = None
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)


Epochs = Annotated[int, Field(ge=0, le=1000)]


class SplatsParams(Params):
    """Splats: what cameras see, beside the mesh, which is for physics and lidars.

    Attributes:
        when: never: no splats; auto: outdoors, if there are photos other than orthophotos.
        spacing: distance in metres between the photos that are used; photos in between are left out.
        max_photos: maximum number of photos; with more, the distance between them is larger. One of a megapixel needs
            about 30 MB of memory.
        epochs: visits of every photo in a quarter, half and full size; full size is at most a megapixel.
        parked: show parked vehicles, although the mesh may leave them out, if the step `instances` found them; people
            and what moved are never shown.
        cover: weight of the opacity loss: higher opacity where a photo doesn't show sky, lower where it does.
        depth: weight of the depth loss: relative error of inverse depths against scan and surfaces, along each photo's
            rays.
        backend: what renders and computes gradients: "cpu"; "gpu": gsplat's CUDA kernels, whose results may differ by
            rounding from run to run; "auto": "gpu" if gsplat, torch and an NVIDIA GPU are available.
        seed: of the order in which photos are visited, and of the jitter of estimated depths.
    """

    when: Literal["never", "auto"] = "never"
    spacing: float = Field(0.5, ge=0, le=100)
    max_photos: int = Field(100, ge=2, le=1000)
    epochs: tuple[Epochs, Epochs, Epochs] = Field((5, 12, 14), json_schema_extra={"range": "3 numbers, 0 to 1,000"})
    parked: bool = True
    cover: float = Field(0.017, ge=0, le=1)
    depth: float = Field(0.3, ge=0, le=10)
    backend: Literal["auto", "cpu", "gpu"] = "auto"
    seed: Seed = 0
    context: SplatsContext = SplatsContext()


def splats(inputs: Inputs, params: SplatsParams, out: Path, report: Report, checkpoint: Path) -> Done:
    """Train splats on the photos `views` that aren't held out.

    Inputs: `views`, their `depth` maps and `exposures`; `mesh.*`; optionally `labels`, class probabilities of photos,
    `instances`, boxes of vehicles and people, and `moving`, points of what moved.

    File: `splats`, a `SplatLayer`, without any splats if fewer than two photos can be used.
    """
    from scan2sim.texturing.splats import backends
    from scan2sim.texturing.splats.training import Schedule

    backend = backends.choose(params.backend)
    used, excluded, seen = _prepared(inputs, params, report)
    state = checkpoint / STATE_FILE
    training = _begun(used, excluded, seen, params, state, report)
    if training is None:
        SplatLayer.nothing().save(out / SPLATS_FILE)
        return Done({"splats": out / SPLATS_FILE}, {"photos": len(used), "splats": 0}, [TOO_FEW])
    first = len(training.descent.parameters)
    used.clear()  # training needs the shots only
    training.backend = backend
    report(TRAINING_SHARE, f"training {backend.description()}")
    _train(
        training, seen, Schedule(params.epochs, cover=params.cover, depth=params.depth, seed=params.seed), state, report
    )
    result = _within_cell(training.result(seen), params.context)
    SplatLayer(result, training.background.texture, *training.photos(seen)).save(out / SPLATS_FILE)
    metrics = {
        "photos": len(excluded), "first": first, "splats": len(result), "rendered": backend.description()
    }  # fmt: skip
    warnings = [] if "labels" in inputs or "instances" in inputs else [UNMASKED]
    rejected = backends.rejected(params.backend, backend)
    warnings += [rejected] if rejected else []
    return Done({"splats": out / SPLATS_FILE}, metrics, warnings)


def _prepared(inputs: Inputs, params: SplatsParams, report: Report) -> tuple[list[Photo], list[Bools], list[Shot]]:
    """The photos of training, their pixels that aren't used, and their shots."""
    from scan2sim.pipeline.camera.renderer import Body, Renderer
    from scan2sim.texturing.backdrop import photos as prepared
    from scan2sim.texturing.photo_cache import Exposures
    from scan2sim.texturing.splats.moving import MovingMask
    from scan2sim.texturing.splats.shots import shots

    meshes = [Mesh.load(path) for name, path in inputs.items() if name.startswith("mesh.")]
    world, exposures = Renderer([Body(mesh) for mesh in meshes]), Exposures.load(inputs["exposures"])
    points = PointCloud.load(inputs["moving"]) if "moving" in inputs else None
    moving = MovingMask(inputs.get("instances"), meshes[0].frame, params.parked, points)
    views, held_out = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    used: list[Photo] = []
    excluded: list[Bools] = []
    seen: list[Shot] = []
    free = [k for k, held in enumerate(held_out) if not held]
    chosen = prepared.choose(views, free, params.spacing, params.max_photos)
    for k in chosen:
        view = views[k]
        report(DEPTH_SHARE * k / len(views), view.name)
        labels = inputs["labels"] / f"{k}.npy" if "labels" in inputs else None
        depth = inputs["depth"] / f"{k}.npy"
        photo = prepared.prepare(view, depth, labels, world, exposures, MATCHING_PIXELS)
        if photo is not None:
            used.append(photo)
            excluded.append(moving.of(photo))
            seen.extend(shots(photo, excluded[-1], np.load(depth)))
    return used, excluded, seen


def _begun(
    used: Sequence[Photo], excluded: Sequence[Bools], seen: Sequence[Shot], params: SplatsParams, state: Path,
    report: Report,
) -> Training | None:  # fmt: skip
    """The training that was interrupted, or a new one; None if there is nothing to train."""
    from scan2sim.texturing.backdrop import plane_sweep
    from scan2sim.texturing.splats.depth import inverse_depths
    from scan2sim.texturing.splats.start import first_background, first_splats
    from scan2sim.texturing.splats.training import Training

    if len(used) < 2:
        return None
    if state.is_file():
        return Training.load(state)
    near = [plane_sweep.neighbours(used, i, MIN_BASELINE_M)[:NEIGHBOURS] for i in range(len(used))]
    for i, photo in enumerate(used):
        report(DEPTH_SHARE + (TRAINING_SHARE - DEPTH_SHARE) * i / len(used), f"depth of {photo.view.name}")
        photo.inverse = plane_sweep.inverse_depth(photo, [used[j] for j in near[i]], HYPOTHESES)
    first, size = first_splats(used, inverse_depths(used, near, params.seed), excluded)
    return Training.of(first, size, first_background(seen), seen) if len(first) else None


def _within_cell(found: Splats, context: SplatsContext) -> Splats:
    """The splats within a tile's cell; all of a tile that is built alone."""
    if context.cell is None:
        return found
    inside = context.cell.cell.outside(found.xyz[:, :2] + np.asarray(context.origin)[:2]) <= 0
    return Splats(found.parameters[inside])


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


def can_train(params: SplatsParams) -> None:
    """Check that the packages of the backend are installed.

    Raises:
        UnavailableError: packages are missing.
    """
    if params.when != "never" and params.backend == "gpu":
        from scan2sim.texturing.splats import backends

        backends.require(params.backend)


# photos take 30 MB for each megapixel, whatever the size of their files, and are 100 at most by default
SPLATS = Step("splats", 4, splats, SplatsParams, check=can_train, resumes=True, memory=(4.5, 3))

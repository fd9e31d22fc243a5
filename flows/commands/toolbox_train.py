"""Work of `scan2sim toolbox train`: trains the project's own detector on drives, without labels drawn by hand."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from scan2sim.data_samples import boxes
from scan2sim.flows.commands.display import print_line, progress, warn
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import plan_and_run
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import STORE
from scan2sim.flows.pipelines.graph import TaskId, required_tasks
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.types import PointCloud
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.segmentation.steps.instances import INSTANCES

if TYPE_CHECKING:
    from scan2sim.services.toolboxes.detector.drive_labels import Drive

WEIGHTS = "vehicles.onnx"
"""Name of the trained network in the output folder."""
LICENCE = "as your drives'; do not redistribute without their licence"


def train_on_drives(
    drives: Sequence[Path],
    out: Path,
    held_out: Sequence[Path],
    *,
    minutes: float,
    steps: int,
    synthetic: int,
    start: Path | None,
    threads: int,
    seed: int,
) -> None:
    """Train the detector on drives, and print its figures on others; an interrupted training is resumed.

    Args:
        drives: tiles to learn from.
        out: output folder.
        held_out: tiles that are only used for the evaluation.
        minutes: time limit; 0: none.
        steps: of the optimiser.
        synthetic: number of generated images beside the photos.
        start: weights (.safetensors) to start from; None: those of the included network.
        threads: CPU threads.
        seed: of the random numbers.

    Raises:
        InputError: a drive has no photos, no lidar or no vehicles.
        UnavailableError: torch isn't installed.
        ScanError: see `pipeline.core.errors`.
    """
    require("the training of the detector", "torch", "onnx", "safetensors")
    import torch

    from scan2sim.data_samples.fleet import CLASSES
    from scan2sim.services.toolboxes.detector import drive_labels, evaluate, train
    from scan2sim.services.toolboxes.tasks import detect

    torch.set_num_threads(threads)
    out.mkdir(parents=True, exist_ok=True)
    folders = {"training": out / "labels", "held out": out / "labels-held-out"}
    for kind, tiles in (("training", drives), ("held out", held_out)):
        labelled = [labelled_drive(tile, out / "drives", f"{i:02d}") for i, tile in enumerate(tiles)]
        with progress(f"labels ({kind})") as report:
            counts = drive_labels.write(labelled, CLASSES, folders[kind], report)
        if tiles:
            print_line(f"{kind}: {counts['images']} photos with {counts['boxes']} vehicles: {folders[kind]}")
        if kind == "training" and not counts["boxes"]:
            raise InputError(drives[0], "no vehicles were found in the photos", "Give drives with photos and traffic")
    datasets = [folders["training"]]
    if synthetic:
        with progress("synthetic images") as report:
            for share in boxes.write(out / "synthetic", synthetic, processes=threads):
                report(share)
        datasets.append(out / "synthetic")
    settings = train.TrainingSettings(steps=steps, minutes=minutes, seed=seed, rate=train.FINE_TUNING_RATE)
    with progress("training") as report:
        weights = out / WEIGHTS
        train.train_and_export(datasets, weights, settings, start or train.OWN_WEIGHTS, report, LICENCE)
    model = detect.load(detect.Params(weights=weights, threshold=evaluate.MIN_SCORE))
    figures = evaluate.at_precision(*evaluate.vehicles_in(folders["held out" if held_out else "training"], model))
    export_thresholds(weights, figures.threshold if figures.recall else None)
    of = f"{len(held_out)} held-out drives" if held_out else "the drives of the training, as none are held out"
    if figures.recall:
        print_line(
            f"{weights}: of {figures.vehicles} vehicles in {of}, {figures.recall:.0%} are detected with a precision of "
            f"{figures.precision:.0%}, at a score of {figures.threshold:.2f}"
        )
    else:
        why = f"no score has a precision of {evaluate.WANTED_PRECISION:.0%} on {figures.vehicles} vehicles in {of}"
        warn(f"{weights}: {why}: train longer, or on more drives; thresholds are those of the included network")
    (out / "figures.json").write_text(json.dumps(asdict(figures), indent=1), encoding="utf-8")


def labelled_drive(path: Path, out: Path, name: str) -> Drive:
    """Run the steps of a tile up to `instances`; results are cached in `out`.

    Raises:
        InputError: the tile has no photos or no lidar.
        ScanError: see `pipeline.core.errors`.
    """
    from scan2sim.services.toolboxes.detector import drive_labels

    tile = read_tile(path)
    tasks = build_graph(tile, Settings.of({"sweeps.hold_out": 0}))
    if not tile.views or not any(task.step is INSTANCES for task in tasks):
        cause = "has no photos" if not tile.views else "has no trajectory of the scanner"
        raise InputError(tile.path, cause, "Give a tile of a drive: `scan2sim import` writes them from recordings")
    folder = out / f"{name}-{tile.name}"
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        store, log = Store(folder / STORE), Log(folder / "run.log")
        read = {"dynamic_objects", "label", "instances"}
        with log.errors(folder):
            planned, done = plan_and_run(required_tasks(tasks, [TaskId("instances")]), store, log, read)
    keys = {item.task.id.name: item.key for item in planned}

    def file(step: str, output: str) -> Path:
        return store.folder(step, keys[step]) / done[step].files[output]

    cloud = PointCloud.load(file("instances", "cloud"))
    labels = file("label", "labels") if "label" in done else None
    moving = PointCloud.load(file("dynamic_objects", "moving"))
    parked = drive_labels.parked_boxes(file("instances", "instances"), cloud)
    return drive_labels.Drive(f"{name}-{tile.name}", tile.views, cloud, moving, parked, labels)


def export_thresholds(weights: Path, threshold: float | None) -> None:
    """Write the minimum score of vehicles into an ONNX file's metadata; other classes keep the included network's."""
    from scan2sim.services.toolboxes.detector.evaluate import VEHICLES
    from scan2sim.services.toolboxes.detector.export import read_thresholds, write_thresholds
    from scan2sim.services.toolboxes.tasks.detect import INCLUDED_WEIGHTS

    own = read_thresholds(INCLUDED_WEIGHTS)
    by_class = {} if threshold is None else {name: round(threshold, 3) for name in VEHICLES}
    write_thresholds(weights, own | by_class)

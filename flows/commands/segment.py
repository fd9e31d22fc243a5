"""`scan2sim segment`: classifies the points and photos of a tile, trains and evaluates the network."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Annotated

import numpy as np
import typer

from scan2sim.flows.commands.app import App, Config, Sets, TilePath, settings_of
from scan2sim.flows.commands.display import console, print_line, progress, warn
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import plan_and_run, show_warnings
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.output_folder import check_own
from scan2sim.flows.engine.planning import STORE
from scan2sim.flows.pipelines.graph import TaskId, required_tasks
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import DataError, SettingError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.types import U8, Camera, PointCloud, Tile
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.las_classes import write_classified
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.io.tile_folder import without_parents
from scan2sim.segmentation.backends import load
from scan2sim.segmentation.labels import CLASSES, IGNORED, code_of_index
from scan2sim.segmentation.metrics import confusion
from scan2sim.segmentation.photos import Classifier, class_map
from scan2sim.segmentation.steps.instances import INSTANCES
from scan2sim.segmentation.steps.label import LABEL
from scan2sim.segmentation.steps.segment import SOURCE_CLOUD, SOURCE_SHAPE
from scan2sim.segmentation.training.dataset import pairs, read, read_channels

LAS_SUFFIXES = (".las", ".laz", ".copc")

app = App("Classify the points and photos of a tile: `segment TILE --out DIR`.", first=True)


@app.command("tile")
def segment_a_tile(
    tile: TilePath,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Output folder: classified clouds, label images, masks, cached results.")
    ],
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Predict the classes of all points, even if the cloud is classified already."),
    ] = False,
    set_: Sets = None,
    config: Config = None,
) -> None:
    """Classify the points of a tile from its photos; write LAZ files, label images and masks."""
    segment_tile(tile, out, settings_of([*(set_ or []), *(["segment.overwrite=true"] if overwrite else [])], config))


@app.command("train")
def segment_train(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Training data: folder with images/ and labels/ (docs/segmentation.md)."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="ONNX file to write the weights to.")] = Path("street.onnx"),
    minutes: Annotated[float, typer.Option(help="Time limit of the training in minutes; 0: no limit.")] = 0,
    steps: Annotated[int, typer.Option(help="Number of optimiser steps.")] = 3000,
    seed: Annotated[int, typer.Option(help="Random seed of initial weights, crops and augmentation.")] = 0,
    start: Annotated[Path | None, typer.Option(help="Weights (.safetensors) to start from; default: random.")] = None,
) -> None:
    """Train the project's own network on labelled photos."""
    train_network(folder, out, minutes=minutes, steps=steps, seed=seed, start=start)


@app.command("evaluate")
def segment_evaluate(
    path: Annotated[
        Path,
        typer.Argument(metavar="PATH", help="A tile whose cloud is classified, or a folder with images/ and labels/."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Output folder for the results of a tile.")] = Path(
        "segment-out"
    ),
    set_: Sets = None,
    config: Config = None,
) -> None:
    """Compare predicted with known classes: IoU per class, and the confusion matrix of a tile."""
    evaluate(path, out, settings_of([*(set_ or []), "segment.overwrite=true"], config))


def segment_tile(path: Path, out: Path, settings: Settings) -> None:
    """Write `classified/*.laz`, `labels/*.png` (LAS code of each pixel) and `masks/*.png` of the tile at `path`.

    Results are cached in `out/steps`: `scan2sim run` with the same --out reuses them.

    Raises:
        ScanError: see `pipeline.core.errors`; results of earlier runs stay.
    """
    tile = read_tile(path)
    check_own(out, ("classified", "labels", "masks"))
    settings = Settings.of({**settings.values, "sweeps.hold_out": 0})  # every point gets a class
    with locked(out):
        store = Store(out / STORE)
        tasks = build_graph(tile, settings)
        last = "instances" if any(task.step is INSTANCES for task in tasks) else "segment"
        log = Log(out / "run.log")
        log.write(f"segment {tile.path}, settings {json.dumps(settings.values)}")
        read = {"ingest", "dynamic_objects", "views", "label", "segment", "instances"}
        with log.errors(out):
            planned, done = plan_and_run(required_tasks(tasks, [TaskId(last)]), store, log, read)
        keys = {p.task.id.name: p.key for p in planned}
        files = {
            (task, name): store.folder(task, keys[task]) / file
            for task, manifest in done.items()
            for name, file in manifest.files.items()
        }
        predicted, own = (
            PointCloud.load(files[last, "cloud"]).classification,
            PointCloud.load(files["dynamic_objects", "cloud"]).classification,
        )
        assert predicted is not None
        with np.load(files["segment", "confidence"]) as beside:
            columns = predicted, beside["confidence"], beside["source"]
            dropped = np.load(files["dynamic_objects", "dropped"])
            if len(dropped):
                kept = done["segment"].metrics["source"] == "cloud"
                whole = PointCloud.load(files["ingest", "cloud"]).classification if kept else None
                columns = _with_dropped(dropped, whole, *columns)
            _write_clouds(tile, out / "classified", *columns)
        if ("label", "labels") in files:
            _write_label_images(files["views", "views"], files["label", "labels"], out)
    show_warnings(done)
    console.print(json.dumps(done["segment"].metrics, indent=1), highlight=False, markup=False)
    if own is not None and done["segment"].metrics["source"] != "cloud" and done["segment"].metrics["own_classes"] > 0:
        print_line(confusion(own, predicted).table())
    print_line(f"Clouds: {out / 'classified'}")


def _with_dropped(dropped: U8, own: U8 | None, predicted: U8, confidence: U8, source: U8) -> tuple[U8, U8, U8]:
    """Classes, confidences and sources (N,) of all points, including those that step `dynamic_objects` has dropped.

    Args:
        dropped: (N,) uint8, 0 for points that were kept, else the class that step `dynamic_objects` gave them.
        own: (N,) the cloud's own classes if they are kept, or None.
        predicted, confidence, source: (K,) values of the kept points.
    """
    kept = dropped == 0
    codes = dropped.copy() if own is None else own
    codes[kept] = predicted
    confidences = np.full(len(kept), 255, np.uint8)
    confidences[kept] = confidence
    sources = np.full(len(kept), SOURCE_SHAPE if own is None else SOURCE_CLOUD, np.uint8)
    sources[kept] = source
    return codes, confidences, sources


def _write_clouds(tile: Tile, out: Path, code: np.ndarray, confidence: np.ndarray, source: np.ndarray) -> None:
    """Write every cloud of the tile with the classes of its points; withheld points keep those of the file."""
    out.mkdir(parents=True, exist_ok=True)
    is_las = all(path.suffix.lower() in LAS_SUFFIXES for path in tile.clouds)
    files = [las.used_and_classes(path) for path in tile.clouds] if is_las else []
    if sum(int(used.sum()) for used, _ in files) != len(code):
        raise DataError(
            tile.path,
            "has clouds that aren't LAS, or points with non-finite coordinates",
            "Convert the clouds to LAZ first",
        )
    at = 0
    names = short_names([os.path.relpath(path, tile.path.parent) for path in tile.clouds])
    for path, name, (used, own) in zip(tile.clouds, names, files, strict=True):
        part = slice(at, at + int(used.sum()))
        at = part.stop
        columns = own, np.full(len(own), 255, np.uint8), np.full(len(own), SOURCE_CLOUD, np.uint8)
        for whole, given in zip(columns, (code, confidence, source), strict=True):
            whole[used] = given[part]
        write_classified(path, out / f"{name}.laz", *columns)


def short_names(files: Sequence[str]) -> list[str]:
    """Names of results by the files that they are of, without suffix: with folders only if that is ambiguous."""
    paths = [PurePath(without_parents(file)) for file in files]
    in_folders = [path.with_suffix("").as_posix() for path in paths]
    for names in ([path.stem for path in paths], in_folders):
        if len({name.casefold() for name in names}) == len(names):
            return names
    return [path.as_posix() for path in paths]


def _write_label_images(views: Path, probabilities: Path, out: Path) -> None:
    """Write label images (LAS codes, 255 for none) and masks: 0 on vehicles, people and the sky, 255 elsewhere."""
    masked = np.isin(np.arange(256), [CLASSES.index(name) for name in ("vehicle", "person", "sky")])
    photos = views_io.load(views)
    files = [one.name if Path(one.name).suffix.lower() in image.SUFFIXES else f"{one.name}.png" for one in photos]
    names = [f"{name}.png" for name in short_names(files)]
    for i, (view, name) in enumerate(zip(photos, names, strict=True)):
        if (probabilities / f"{i}.npy").is_file():
            best, _ = class_map(np.load(probabilities / f"{i}.npy"), (view.camera.height, view.camera.width))
            mask = np.where(masked[best], 0, 255).astype(np.uint8)
            for folder, pixels in (("labels", code_of_index()[best]), ("masks", mask)):
                (out / folder / name).parent.mkdir(parents=True, exist_ok=True)
                image.write(out / folder / name, pixels)


def train_network(folder: Path, weights: Path, *, minutes: float, steps: int, seed: int, start: Path | None) -> None:
    """Train the project's own network on a folder of labelled photos, and write its weights.

    Args:
        folder: with `images/` and `labels/`.
        weights: ONNX file to write; the torch weights (.safetensors) are written next to it.
        minutes: time limit; 0: none.
        steps: of the optimiser.
        seed: of the random numbers.
        start: weights (.safetensors) to start from.

    Raises:
        SettingError: `weights` doesn't end in .onnx.
        UnavailableError: torch isn't installed.
    """
    if weights.suffix != ".onnx":
        raise SettingError("--out", f"{weights.name} is not an ONNX file", "Give a name that ends in .onnx")
    require("segment train", "torch", "safetensors", "onnx")
    from scan2sim.segmentation.backends.street import save
    from scan2sim.segmentation.training.train import TrainingSettings, train

    training_settings = TrainingSettings(steps=steps, minutes=minutes, seed=seed, start=start)
    with progress("training") as report:
        trained = train(folder, training_settings, report)
    save(trained.network, weights, {"recipe": str(training_settings), "iou": trained.iou})
    _print_iou(trained.iou)
    print_line(f"Weights: {weights}")


def evaluate(path: Path, out: Path, settings: Settings) -> None:
    """Print the accuracy of the classes: per pixel of a folder of labelled photos, per point of a classified tile."""
    if (path / "labels").is_dir():
        _print_iou(_pixel_iou(path, settings))
        return
    segment_tile(path, out, settings)


def _pixel_iou(folder: Path, settings: Settings) -> dict[str, float]:
    """Intersection over union by class, over all pixels of a folder's photos and their extra channels, if any."""
    given = settings.params(LABEL)
    network = load(given.network, given.weights, given.device)
    classifier = Classifier(network, str(given.weights or network.info.name))
    resolution = network.info.pixels_per_radian or 1.0
    known, predicted = [], []
    for pair in pairs(folder):
        rgb, truth = read(*pair)
        h, w = truth.shape
        camera = Camera("pinhole", w, h, resolution, resolution, (w - 1) / 2, (h - 1) / 2)
        best, _ = class_map(classifier.probabilities(rgb, camera, read_channels(pair[0], (h, w))), (h, w))
        labelled = truth != IGNORED
        known.append(truth[labelled])
        predicted.append(best[labelled])
    for warning in classifier.warnings():
        warn(warning)
    codes = code_of_index()
    codes[[CLASSES.index("sky"), IGNORED]] = 255, 0  # 0 means unknown
    found = confusion(codes[np.concatenate(known)], codes[np.concatenate(predicted)]).iou
    return {("sky" if name == "255" else name): value for name, value in found.items()}


def _print_iou(iou: dict[str, float]) -> None:
    for name, value in iou.items():
        console.print(f"{name:18s}{value:7.3f}", highlight=False)
    if iou:
        console.print(f"{'mean':18s}{sum(iou.values()) / len(iou):7.3f}", highlight=False)

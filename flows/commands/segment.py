"""`scan2sim segment`: classes for a tile's points and photos, training, and figures; the recipe's first steps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from scan2sim.flows.commands.app import App, Config, Sets, TilePath, settings_of
from scan2sim.flows.commands.display import console, progress
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.run_with_progress import run_shown, show_warnings
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import STORE
from scan2sim.flows.pipelines.graph import NodeId, needed
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import recipe
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import DataError, SettingError
from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.types import U8, Camera, PointCloud, Tile
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.las_classes import write_classified
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.segmentation.backends import load
from scan2sim.segmentation.labels import CLASSES, IGNORED, code_of_index
from scan2sim.segmentation.metrics import confusion
from scan2sim.segmentation.photos import Classifier, class_map
from scan2sim.segmentation.steps.instances import THINGS
from scan2sim.segmentation.steps.label import LABEL
from scan2sim.segmentation.steps.segment import OWN, SHAPE
from scan2sim.segmentation.training.dataset import pairs, read, read_channels

CLOUDS = (".las", ".laz", ".copc")


app = App("Classes of a tile's points and photos: `segment TILE --out DIR`.", first=True)


@app.command("tile")
def segment_a_tile(
    tile: TilePath,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for clouds, labels, masks and kept results.")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Tell classes anew where the cloud has some.")] = False,
    set_: Sets = None,
    config: Config = None,
) -> None:
    """Classify a tile's points from its photos; write LAZ, label pictures and masks."""
    segment_tile(tile, out, settings_of([*(set_ or []), *(["segment.overwrite=true"] if overwrite else [])], config))


@app.command("train")
def segment_train(
    folder: Annotated[Path, typer.Argument(help="Of images/ and labels/ (docs/segmentation.md).")],
    out: Annotated[Path, typer.Option("--out", "-o", help="ONNX file of the weights.")] = Path("street.onnx"),
    minutes: Annotated[float, typer.Option(help="At most; 0: no limit.")] = 0,
    steps: Annotated[int, typer.Option(help="Of the optimiser.")] = 3000,
    seed: Annotated[int, typer.Option(help="Of weights, crops and looks.")] = 0,
    start: Annotated[Path | None, typer.Option(help="Weights (safetensors) to go on from.")] = None,
) -> None:
    """Train the project's own network on labelled photos."""
    train_network(folder, out, minutes=minutes, steps=steps, seed=seed, start=start)


@app.command("evaluate")
def segment_evaluate(
    path: Annotated[Path, typer.Argument(help="A tile whose cloud has classes, or a folder of labelled photos.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for a tile's results.")] = Path("segment-out"),
    set_: Sets = None,
    config: Config = None,
) -> None:
    """Print how classes that are told compare with those that are known."""
    evaluate(path, out, settings_of([*(set_ or []), "segment.overwrite=true"], config))


def segment_tile(path: Path, out: Path, settings: Settings) -> None:
    """Write `classified/*.laz`, `probabilities/*.png` (LAS codes a pixel) and `masks/*.png` of the tile at `path`.

    Results are kept in `out/steps`, so that `scan2sim run --out` the same folder goes on from there.

    Raises:
        ScanError: see `pipeline.core.errors`; earlier results stay.
    """
    tile = read_tile(path)
    with locked(out):
        store = Store(out / STORE)
        nodes = recipe(tile, settings)
        last = "things" if any(node.step is THINGS for node in nodes) else "segment"
        log = Log(out / "run.log")
        log.write(f"segment {tile.path}, settings {json.dumps(settings.values)}")
        read = {"ingest", "carve", "views", "label", "segment", "things"}
        with log.errors(out):
            planned, done = run_shown(needed(nodes, [NodeId(last)]), store, log, read)
        keys = {p.node.id.name: p.key for p in planned}
        files = {
            (node, name): store.folder(node, keys[node]) / file
            for node, manifest in done.items()
            for name, file in manifest.files.items()
        }
        predicted, own = (
            PointCloud.load(files[last, "cloud"]).classification,
            PointCloud.load(files["carve", "cloud"]).classification,
        )
        assert predicted is not None
        with np.load(files["segment", "confidence"]) as beside:
            columns = predicted, beside["confidence"], beside["source"]
            dropped = np.load(files["carve", "dropped"])
            if len(dropped):
                kept = done["segment"].facts["source"] == "cloud"
                whole = PointCloud.load(files["ingest", "cloud"]).classification if kept else None
                columns = _of_all(dropped, whole, *columns)
            _write_clouds(tile, out / "classified", *columns)
        if ("label", "labels") in files:
            _write_pictures(files["views", "views"], files["label", "labels"], out)
    show_warnings(done)
    console.print(json.dumps(done["segment"].facts, indent=1), highlight=False, markup=False)
    if own is not None and done["segment"].facts["source"] != "cloud" and done["segment"].facts["own_classes"] > 0:
        console.print(confusion(own, predicted).table(), highlight=False, markup=False, soft_wrap=True)
    console.print(f"Clouds: {out / 'classified'}", highlight=False, soft_wrap=True, markup=False)


def _of_all(dropped: U8, own: U8 | None, predicted: U8, sure: U8, source: U8) -> tuple[U8, U8, U8]:
    """Classes of all points, how sure they are and where from, with those that `carve` has dropped.

    Args:
        dropped: (N,) uint8, 0 where a point is kept, else what it is for `carve`.
        own: (N,) the cloud's own classes, where they are kept, or None.
        predicted, sure, source: (K,) of those kept.
    """
    kept = dropped == 0
    codes = dropped.copy() if own is None else own
    codes[kept] = predicted
    all_sure = np.full(len(kept), 255, np.uint8)
    all_sure[kept] = sure
    sources = np.full(len(kept), SHAPE if own is None else OWN, np.uint8)
    sources[kept] = source
    return codes, all_sure, sources


def _write_clouds(tile: Tile, out: Path, code: np.ndarray, confidence: np.ndarray, source: np.ndarray) -> None:
    """Every cloud of the tile with its points' classes."""
    out.mkdir(parents=True, exist_ok=True)
    counts = [las.read_header(path)[0] if path.suffix.lower() in CLOUDS else 0 for path in tile.clouds]
    if 0 in counts or sum(counts) != len(code):
        raise DataError(
            tile.path, "has clouds that aren't LAS, or points that aren't finite", "Convert the clouds to LAZ first"
        )
    for path, n, start in zip(tile.clouds, counts, np.cumsum([0, *counts]), strict=False):
        here = slice(int(start), int(start) + n)
        write_classified(path, out / f"{path.stem}.laz", code[here], confidence[here], source[here])


def _write_pictures(views: Path, probabilities: Path, out: Path) -> None:
    """Codes of every pixel, and masks: 0 on vehicles, people and the sky, 255 elsewhere."""
    away = np.isin(np.arange(len(CLASSES)), [CLASSES.index(name) for name in ("vehicle", "person", "sky")])
    for folder in (out / "labels", out / "masks"):
        folder.mkdir(exist_ok=True)
    for i, view in enumerate(views_io.load(views)):
        if (probabilities / f"{i}.npy").is_file():
            best, _ = class_map(np.load(probabilities / f"{i}.npy"), (view.camera.height, view.camera.width))
            name = f"{Path(view.name).stem}.png"
            image.write(out / "labels" / name, code_of_index()[best])
            image.write(out / "masks" / name, np.where(away[best], 0, 255).astype(np.uint8))


def train_network(folder: Path, weights: Path, *, minutes: float, steps: int, seed: int, start: Path | None) -> None:
    """Train the project's own network on a folder of labelled photos, and write its weights.

    Args:
        weights: an ONNX file; what torch reads lies beside it then.
        start: weights (safetensors) to go on from.

    Raises:
        SettingError: the file's name ends otherwise.
        UnavailableError: torch isn't installed.
    """
    if weights.suffix != ".onnx":
        raise SettingError("--out", f"{weights.name} is no name of an ONNX file", "Name one that ends in .onnx")
    need("segment train", "torch", "safetensors", "onnx")
    from scan2sim.segmentation.backends.street import save
    from scan2sim.segmentation.training.train import Recipe, train

    recipe_ = Recipe(steps=steps, minutes=minutes, seed=seed, start=start)
    with progress("training") as report:
        trained = train(folder, recipe_, report)
    save(trained.network, weights, {"recipe": str(recipe_), "iou": trained.iou})
    _print_iou(trained.iou)
    console.print(f"Weights: {weights}", highlight=False, soft_wrap=True, markup=False)


def evaluate(path: Path, out: Path, settings: Settings) -> None:
    """Print figures: of a folder of labelled photos, by pixel; of a tile whose cloud has classes, by point."""
    if (path / "labels").is_dir():
        _print_iou(_pixels(path, settings))
        return
    segment_tile(path, out, settings)


def _pixels(folder: Path, settings: Settings) -> dict[str, float]:
    """Intersection over union of a network's pixels, by class; photos taken as they are, with channels if there are."""
    given = settings.params(LABEL)
    network = load(given.network, given.weights, given.device)
    classifier = Classifier(network, str(given.weights or network.facts.name))
    resolution = network.facts.pixels_a_radian or 1.0
    known, predicted = [], []
    for pair in pairs(folder):
        rgb, truth = read(*pair)
        h, w = truth.shape
        camera = Camera("pinhole", w, h, resolution, resolution, (w - 1) / 2, (h - 1) / 2)
        best, _ = class_map(classifier.probabilities(rgb, camera, read_channels(pair[0], (h, w))), (h, w))
        some = truth != IGNORED
        known.append(truth[some])
        predicted.append(best[some])
    codes = code_of_index()
    codes[CLASSES.index("sky")] = 255  # a code of its own: 0 says unknown
    found = confusion(codes[np.concatenate(known)], codes[np.concatenate(predicted)]).iou
    return {("sky" if name == "255" else name): value for name, value in found.items()}


def _print_iou(iou: dict[str, float]) -> None:
    for name, value in iou.items():
        console.print(f"{name:18s}{value:7.3f}", highlight=False)
    if iou:
        console.print(f"{'mean':18s}{sum(iou.values()) / len(iou):7.3f}", highlight=False)

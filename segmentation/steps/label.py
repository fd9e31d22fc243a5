"""Label step: a network's class probabilities for every pixel of every photo."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.classes import classified_codes
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.parameters import Device, File, Fraction, Name, Voxel
from scan2sim.pipeline.core.parts import NO_PARTS, Parts, file_digest
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import U8, PointCloud, View
from scan2sim.pipeline.geometry.voxel_grid import sample
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image

if TYPE_CHECKING:
    from scan2sim.segmentation.project_scan import ScanProjector

MIN_POINTS = 30
"""Points below which a cloud is not projected into photos."""


class SegmentSettings(Context):
    """Settings of step `segment`: photos are not classified if the cloud keeps its own classes, or without photos."""

    overwrite: bool = False
    min_classified: Fraction = 0.2
    photos: bool = True


class LabelParams(Params):
    """Settings of the segmentation network.

    Attributes:
        network: "street", the project's own network; "segformer" or "onnx", with your weights.
        weights: file or folder with the weights; default: the weights of "street" that come with the project.
        device: "cpu" or "cuda" (torch or onnxruntime); "auto": a GPU if one is available.
        size: voxel size in metres at which the cloud is projected into photos, for networks with scan channels.
    """

    network: Name = "street"
    weights: File | None = None
    device: Device = "auto"
    size: Voxel = 0.1
    context: SegmentSettings = SegmentSettings()


def label(inputs: Inputs, params: LabelParams, out: Path, report: Report, parts: Parts = NO_PARTS) -> Done:
    """Classify every photo of `views`, with channels of `cloud` if the network takes them.

    Photos of cameras on their side are turned upright for the network. Nothing is done if the cloud keeps its own
    classes. Photos that an earlier run classified are not classified again.

    Folder: `labels`, with `<view index>.npy`: (h, w, C) uint8 probabilities by class of `segmentation.labels`, and
    `network.json`: name, checksum, licence and classes of the network.
    """
    from scan2sim.segmentation.backends import load
    from scan2sim.segmentation.photos import Classifier, quarter_turns

    folder = out / "labels"
    folder.mkdir()
    views = views_io.load(inputs["views"])
    cloud = PointCloud.load(inputs["cloud"])
    kept = not params.context.overwrite and classified(cloud.classification) >= params.context.min_classified
    if kept or not views or not params.context.photos:
        return Done(
            {"labels": folder}, {"photos": 0, "why": "the cloud keeps its classes" if kept else "photos are not used"}
        )
    network = load(params.network, params.weights, params.device)
    classifier = Classifier(network, str(params.weights or network.info.name))
    projector = cache(lambda: scan_projector(cloud, params.size, report) if classifier.takes_channels else None)
    info = network.info
    own: list[object] = [info.name, info.sha256]
    own += [file_digest(path) for name, path in inputs.items() if name.startswith("weights")]
    own += [file_digest(inputs["cloud"]), params.size] if classifier.takes_channels else []
    warnings = []
    for i, view in enumerate(views):
        report(0.2 + 0.8 * i / len(views), view.name)
        if view.camera.model == "orthographic":  # networks were trained on photos taken from the street
            continue

        turns = quarter_turns(view)

        def classify(file: Path = folder / f"{i}.npy", view: View = view, turns: int = turns) -> list[Path]:
            rgb, scan = image.read_photo(view), projector()
            channels = scan.channels(view, classifier.size(view.camera)) if scan else None
            np.save(file, classifier.probabilities(rgb, view.camera, channels, turns))
            return [file]

        try:
            key = [*own, i, file_digest(view.photo), views_io.to_json(view, with_paths=False)]
            parts.provide(folder, [*key, turns] if turns else key, classify)
        except InputError as error:
            if error.where == str(params.weights) and not any(folder.glob("*.npy")):
                raise  # the network's fault, not the photo's
            warnings.append(f"{view.photo}: {error.cause}: not classified")
    about = {"network": info.name, "sha256": info.sha256, "licence": info.licence, "classes": classifier.classes}
    (folder / "network.json").write_text(json.dumps(about, indent=1), encoding="utf-8")
    return Done(
        {"labels": folder},
        {"photos": len(views) - len(warnings), **about},
        [*classifier.warnings(), *warnings],
    )


def scan_projector(cloud: PointCloud, size: float, report: Report) -> ScanProjector | None:
    """Projector of the cloud, sampled to one point per voxel, into photos; None if there are too few points."""
    from scan2sim.segmentation.project_scan import ScanProjector

    report(0.0, "downsampling the cloud")
    thin = sample(cloud, size)
    return ScanProjector(thin, size) if len(thin) >= MIN_POINTS else None


def classified(classification: U8 | None) -> float:
    """Fraction of points whose class says what they are: not "unclassified", nor a code that has no meaning."""
    if classification is None or not len(classification):
        return 0.0
    return float(classified_codes()[classification].mean())


def can_label(params: LabelParams) -> None:
    """Check that the network can run on this machine.

    Raises:
        ScanError: as raised by `segmentation.backends.check`.
    """
    from scan2sim.segmentation.backends import check

    if params.context.photos:
        check(params.network, params.weights)


LABEL = Step("label", 7, label, LabelParams, check=can_label, parts=True, memory=(1.5, 3))

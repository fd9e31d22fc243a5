"""Label: a network's classes for every pixel of every photo, and masks of what is no street."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.core.classes import known
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.parameters import Device, File, Name, Share, Voxel
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import U8, PointCloud
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.steps.voxel import sample

if TYPE_CHECKING:
    from scan2sim.segmentation.project_scan import Drawn

FEW = 30
"""Points, fewer tell nothing."""


class LabelParams(Params):
    """Which network looks at the photos.

    Attributes:
        network: "street", the project's own; "segformer" or "onnx", with the user's weights.
        weights: file or folder of the weights; default: those that come with the project (of "street").
        device: "cpu", or "cuda" by torch or onnxruntime; "auto": a GPU where they have one.
        size: metres of the voxels that the cloud is drawn into photos by, for networks that ask for it.
        overwrite, min_classified, photos: as of `segment`, set by the recipe: photos are not looked at where the
            cloud keeps its own classes, or where they aren't asked.
    """

    network: Name = "street"
    weights: File | None = None
    device: Device = "auto"
    size: Voxel = 0.1
    overwrite: bool = False
    min_classified: Share = 0.2
    photos: bool = True


def label(inputs: Inputs, params: LabelParams, out: Path, report: Report) -> Done:
    """Look at every photo of `views`, with `cloud` beside it, unless that has classes that are kept.

    Folder: `labels`, with `<view index>.npy`: (h, w, C) uint8 probabilities by class of `segmentation.labels`, and
    `network.json`: what is known of the network.
    """
    from scan2sim.segmentation.backends import load
    from scan2sim.segmentation.photos import Classifier

    folder = out / "labels"
    folder.mkdir()
    views = views_io.load(inputs["views"])
    cloud = PointCloud.load(inputs["cloud"])
    kept = not params.overwrite and classified(cloud.classification) >= params.min_classified
    if kept or not views or not params.photos:
        return Done({"labels": folder}, {"photos": 0, "why": "the cloud has classes" if kept else "none is asked"})
    network = load(params.network, params.weights, params.device)
    classifier = Classifier(network, str(params.weights or network.facts.name))
    scan = scanned(cloud, params.size, report) if classifier.takes_channels else None
    warnings = []
    for i, view in enumerate(views):
        report(0.2 + 0.8 * i / len(views), view.name)
        if view.camera.model == "orthographic":  # networks know streets from the street
            continue
        try:
            rgb = image.read_photo(view)
        except InputError as error:
            warnings.append(f"{view.photo} {error.cause}: it tells no classes")
            continue
        channels = scan.into(view, classifier.size(view.camera)) if scan else None
        np.save(folder / f"{i}.npy", classifier.probabilities(rgb, view.camera, channels))
    facts = network.facts
    about = {"network": facts.name, "sha256": facts.sha256, "licence": facts.licence, "tells": classifier.classes}
    (folder / "network.json").write_text(json.dumps(about, indent=1), encoding="utf-8")
    return Done(
        {"labels": folder},
        {"photos": len(views) - len(warnings), **about},
        warnings,
    )


def scanned(cloud: PointCloud, size: float, report: Report) -> Drawn | None:
    """The cloud, to be drawn into photos; None if it has hardly any points."""
    from scan2sim.segmentation.project_scan import Drawn

    report(0.0, "thinning")
    thin = sample(cloud, size)
    return Drawn(thin, size) if len(thin) >= FEW else None


def classified(classification: U8 | None) -> float:
    """Share of points whose class says what they are: not "unclassified", nor a code that has no meaning."""
    if classification is None or not len(classification):
        return 0.0
    return float(known()[classification].mean())


def can_label(params: LabelParams) -> None:
    """Refuse a network that can't run here.

    Raises:
        ScanError: as `segmentation.backends.check`.
    """
    from scan2sim.segmentation.backends import check

    if params.photos:
        check(params.network, params.weights)


LABEL = Step("label", 5, label, LabelParams, check=can_label, memory=(1.5, 3))

"""Label step: class probabilities for every pixel of every photo, by a network or from label images."""

from __future__ import annotations

import json
from collections.abc import Sequence
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
from scan2sim.segmentation.label_images import LabelImages
from scan2sim.segmentation.photos import Classifier, quarter_turns

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
        images: folder with label images of the photos, made by another program, which are used instead of a network.
        size: voxel size in metres at which the cloud is projected into photos, for networks with scan channels.
    """

    network: Name = "street"
    weights: File | None = None
    device: Device = "auto"
    images: File | None = None
    size: Voxel = 0.1
    context: SegmentSettings = SegmentSettings()


def label(inputs: Inputs, params: LabelParams, out: Path, report: Report, parts: Parts = NO_PARTS) -> Done:
    """Classify every photo of `views`, with channels of `cloud` if the network takes them, or read its label image.

    Nothing is done if the cloud keeps its own classes. Photos that an earlier run classified are not classified again.

    Folder: `labels`, with `<view index>.npy`: (h, w, C) uint8 probabilities by class of `segmentation.labels`, and
    `network.json`: name, checksum, licence and classes of the network.
    """
    folder = out / "labels"
    folder.mkdir()
    views = views_io.load(inputs["views"])
    cloud = PointCloud.load(inputs["cloud"])
    kept = not params.context.overwrite and classified(cloud.classification) >= params.context.min_classified
    if kept or not views or not params.context.photos:
        why = "the cloud keeps its classes" if kept else "photos are not used"
        given = params.images or params.weights
        ignored = f"{given} isn't used: {why}; --set segment.overwrite=true classifies the points by the photos"
        return Done({"labels": folder}, {"photos": 0, "why": why}, [ignored] if kept and views and given else [])
    source = _Images(params.images, views) if params.images else _Network(inputs, params, cloud, report)
    warnings = []
    for i, view in enumerate(views):
        report(0.2 + 0.8 * i / len(views), view.name)
        if view.camera.model == "orthographic":  # networks were trained on photos taken from the street
            continue

        def classify(file: Path = folder / f"{i}.npy", view: View = view) -> list[Path]:
            np.save(file, source.probabilities(view))
            return [file]

        try:
            key = [*source.key(view), i, file_digest(view.photo), views_io.to_json(view, with_paths=False)]
            parts.provide(folder, key, classify)
        except InputError as error:
            if error.where == str(params.weights) and not any(folder.glob("*.npy")):
                raise  # the network's fault, not the photo's
            warnings.append(f"{view.photo}: {error.cause}: not classified")
    (folder / "network.json").write_text(json.dumps(source.about, indent=1), encoding="utf-8")
    return Done(
        {"labels": folder},
        {"photos": len(views) - len(warnings), **source.about},
        [*source.warnings(), *warnings],
    )


class _Network:
    """Classification by a network; photos of cameras on their side are turned upright for it.

    Attributes:
        about: name, checksum, licence and classes of the network.
        warnings: see `Classifier`.
    """

    def __init__(self, inputs: Inputs, params: LabelParams, cloud: PointCloud, report: Report) -> None:
        from scan2sim.segmentation.backends import load

        network = load(params.network, params.weights, params.device)
        self._classifier = classifier = Classifier(network, str(params.weights or network.info.name))
        scanned = classifier.takes_channels
        self._projector = cache(lambda: scan_projector(cloud, params.size, report) if scanned else None)
        info, self.warnings = network.info, classifier.warnings
        self.about = {
            "network": info.name, "sha256": info.sha256, "licence": info.licence, "classes": classifier.classes
        }  # fmt: skip
        self._key: list[object] = [info.name, info.sha256]
        self._key += [file_digest(path) for name, path in inputs.items() if name.startswith("weights")]
        self._key += [file_digest(inputs["cloud"]), params.size] if scanned else []

    def key(self, view: View) -> list[object]:
        return [*self._key, quarter_turns(view)]

    def probabilities(self, view: View) -> U8:
        rgb, scan = image.read_photo(view), self._projector()
        channels = scan.channels(view, self._classifier.size(view.camera)) if scan else None
        return self._classifier.probabilities(rgb, view.camera, channels, quarter_turns(view))


class _Images:
    """Label images of the photos."""

    def __init__(self, folder: Path, views: Sequence[View]) -> None:
        self._images = LabelImages(folder, views)
        self.about = {"network": f"label images ({folder.name})", "classes": self._images.classes}

    def warnings(self) -> list[str]:
        if self._images.names.is_file():
            return []
        return [
            f"label images without {self._images.names}: their values were read as LAS codes (11 road, 6 building, 5 "
            "vegetation, 0 sky, ...). If they are others, name them there from 0 on, one per line"
        ]

    def key(self, view: View) -> list[object]:
        names, file = self._images.names, self._images.files.get(view.name)
        return [file_digest(names), file and file_digest(file)]

    def probabilities(self, view: View) -> U8:
        if view.name not in self._images.files:
            raise InputError(view.photo, f"no label image in {self._images.folder}", "Add it")
        return self._images.probabilities(view)


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

    if params.context.photos and params.images is None:
        check(params.network, params.weights)
    if params.images is not None and not params.images.is_dir():
        raise InputError(params.images, "folder not found", "Give the folder of the photos' label images")


LABEL = Step("label", 7, label, LabelParams, check=can_label, parts=True, memory=(1.5, 3))

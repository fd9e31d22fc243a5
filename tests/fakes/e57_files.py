"""E57 files with posed images, written node by node with pye57's libe57."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F64


@dataclass(frozen=True)
class Image2D:
    """An image: representation, its numbers and blobs, size, pose (quaternion w, x, y, z; translation).

    `associated`: it names the scan of the file.
    """

    kind: str
    numbers: Mapping[str, float]
    blobs: Mapping[str, bytes]
    size: tuple[int, int]
    rotation: Sequence[float] | None = (1.0, 0.0, 0.0, 0.0)
    translation: Sequence[float] = (0.0, 0.0, 0.0)
    name: str = ""
    associated: bool = False
    time: float | None = None


Pose = tuple[Sequence[float], Sequence[float]]


def write(
    path: Path, xyz: F64, images: Sequence[Image2D], scan_pose: Pose = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
) -> Path:
    """Write one scan of points (N, 3) in file coordinates, and images; `scan_pose`: its quaternion and translation."""
    pye57 = pytest.importorskip("pye57", reason="E57 files are written by pye57")
    from scipy.spatial.transform import Rotation

    rotation, translation = scan_pose
    own = Rotation.from_quat(rotation, scalar_first=True).inv().apply(xyz - np.array(translation))
    with closing(pye57.E57(str(path), mode="w")) as file:
        data = {f"cartesian{axis}": own[:, i] for i, axis in enumerate("XYZ")}
        limits = type("Limits", (), {})()
        for i, axis in enumerate("xyz"):
            setattr(limits, f"{axis}Minimum", float(own[:, i].min()))
            setattr(limits, f"{axis}Maximum", float(own[:, i].max()))
        file.write_scan_raw(
            data, rotation=np.array(rotation), translation=np.array(translation), scan_header=limits, name="scan"
        )
        guid = file.root["data3D"][0]["guid"].value()
        for i, image in enumerate(images):
            _append(file, i, image, guid)
    return path


def _append(file: Any, number: int, image: Image2D, scan_guid: str) -> None:
    from pye57 import libe57

    owner, nodes = file.image_file, file.root["images2D"]

    def structure(values: Mapping[str, float]) -> Any:
        node = libe57.StructureNode(owner)
        for key, value in values.items():
            node.set(key, libe57.FloatNode(owner, float(value)))
        return node

    node = libe57.StructureNode(owner)
    node.set("guid", libe57.StringNode(owner, f"{{image-{number}}}"))
    if image.name:
        node.set("name", libe57.StringNode(owner, image.name))
    if image.associated:
        node.set("associatedData3DGuid", libe57.StringNode(owner, scan_guid))
    if image.rotation is not None:
        pose = libe57.StructureNode(owner)
        pose.set("rotation", structure(dict(zip("wxyz", image.rotation, strict=True))))
        pose.set("translation", structure(dict(zip("xyz", image.translation, strict=True))))
        node.set("pose", pose)
    if image.time is not None:
        node.set("acquisitionDateTime", structure({"dateTimeValue": image.time}))
    body = structure(image.numbers)
    for key, value in zip(("imageWidth", "imageHeight"), image.size, strict=True):
        body.set(key, libe57.IntegerNode(owner, value))
    blobs = {key: libe57.BlobNode(owner, len(data)) for key, data in image.blobs.items()}
    for key, blob in blobs.items():
        body.set(key, blob)
    node.set(image.kind, body)
    nodes.append(node)
    for key, blob in blobs.items():
        blob.write(image.blobs[key], 0, len(image.blobs[key]))

"""Reader of 3D Tiles of splats: nodes of the tileset, and the contents of its GLBs."""

from __future__ import annotations

import json
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.splats import QUATERNION, XYZ, Splats
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io import splat_files
from scan2sim.pipeline.io.world_formats import splats_tiles3d


def tileset(export: Path) -> dict[str, Any]:
    """The JSON of the tileset in a folder."""
    return dict(json.loads((export / splats_tiles3d.FILE).read_text(encoding="utf-8")))


def nodes(node: dict[str, Any], above: F64 | None = None) -> Iterator[tuple[dict[str, Any], F64]]:
    """A node of the tileset and all below it, with their transforms (4, 4) to the earth."""
    matrix = (np.eye(4) if above is None else above) @ np.reshape(node.get("transform", np.eye(4)), (4, 4)).T
    yield node, matrix
    for child in node.get("children", ()):
        yield from nodes(child, matrix)


def leaves(export: Path) -> Iterator[tuple[Splats, F64]]:
    """The splats of each leaf, z up, with its transform (4, 4) to the earth."""
    for node, matrix in nodes(tileset(export)["root"]):
        if "content" in node and "children" not in node:
            yield content(export / node["content"]["uri"])[1], matrix


def content(path: Path) -> tuple[dict[str, Any], Splats]:
    """The JSON of a GLB, and its splats, z up."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + length])
    (view,) = tree["bufferViews"]
    with tempfile.TemporaryDirectory() as work:
        payload = Path(work) / "content.spz"
        payload.write_bytes(data[28 + length :][view["byteOffset"] :][: view["byteLength"]])
        return tree, _z_up(splat_files.read(payload))


def _z_up(splats: Splats) -> Splats:
    """The inverse of `Splats.y_up`: (x, y, z) becomes (x, -z, y)."""
    turned = splats.parameters.copy()
    turned[:, XYZ] = splats.xyz[:, [0, 2, 1]] * (1, -1, 1)
    w, x, y, z = splats.quaternion.T
    turned[:, QUATERNION] = np.sqrt(0.5) * np.column_stack([w - x, x + w, y - z, z + y])
    return Splats(turned)

"""Provenance of each face's colour in glTF: `EXT_mesh_features` and `EXT_structural_metadata`.

`_FEATURE_ID_0` of a vertex is a row of a table (`pipeline.io.worlds.provenance`): `source`, and for photos their name
`photo` and capture time `taken`. `_DISTANCE` is the distance (m) of the vertex from that photo's camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from scan2sim.pipeline.io.worlds.gltf.builder import Builder
from scan2sim.pipeline.io.worlds.provenance import SOURCES, UNKNOWN_DISTANCE, Row

FEATURES, METADATA = "EXT_mesh_features", "EXT_structural_metadata"
FEATURE, DISTANCE = "_FEATURE_ID_0", "_DISTANCE"
SCHEMA: dict[str, Any] = {
    "id": "scan2sim",
    "enums": {
        "source": {
            "valueType": "UINT8",
            "values": [{"name": name, "value": value} for value, name in enumerate(SOURCES)],
        }
    },
    "classes": {
        "origin": {
            "name": "Where a face has its colour from",
            "properties": {
                "source": {"type": "ENUM", "enumType": "source", "required": True},
                "photo": {"type": "STRING", "noData": "", "description": "The photo that gives its detail"},
                "taken": {"type": "STRING", "noData": "", "description": "When the photo was taken, UTC"},
            },
        },
        "place": {
            "properties": {
                "distance": {
                    "type": "SCALAR", "componentType": "FLOAT32", "noData": UNKNOWN_DISTANCE,
                    "description": "Metres to the photo's camera",
                }
            }
        },
    },
}  # fmt: skip


def describe(builder: Builder, rows: Sequence[Row]) -> None:
    """Add the provenance table to a file."""
    builder.use(FEATURES)
    builder.use(METADATA)
    source = np.array([SOURCES.index(row.source) for row in rows], np.uint8)
    columns: dict[str, Any] = {"source": {"values": builder.view(source.tobytes())}}
    for name in ("photo", "taken"):
        texts = [str(getattr(row, name)).encode() for row in rows]
        if any(texts):
            ends = np.cumsum([0, *map(len, texts)]).astype(np.uint32)
            columns[name] = {
                "values": builder.view(b"".join(texts)), "stringOffsets": builder.view(ends.tobytes()),
            }  # fmt: skip
    builder.tree["extensions"][METADATA] = {
        "schema": SCHEMA,
        "propertyTables": [{"class": "origin", "count": len(rows), "properties": columns}],
        "propertyAttributes": [{"class": "place", "properties": {"distance": {"attribute": DISTANCE}}}],
    }


def of_primitive(rows: int) -> dict[str, Any]:
    """The extensions of a primitive whose vertices refer to a table with `rows` rows."""
    return {
        FEATURES: {"featureIds": [{"featureCount": rows, "attribute": 0, "propertyTable": 0}]},
        METADATA: {"propertyAttributes": [0]},
    }

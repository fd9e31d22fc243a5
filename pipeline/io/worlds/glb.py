"""GLB (glTF 2.0): Y-up, textures embedded, where colours are from told of each face (`pipeline/io/worlds/gltf`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.classes import name_of
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.core.types import U8, Mesh, View
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds import provenance
from scan2sim.pipeline.io.worlds.gltf import geometry, metadata, textures
from scan2sim.pipeline.io.worlds.gltf.builder import Array, Builder
from scan2sim.pipeline.io.worlds.gltf.geometry import Codec, Part, plain
from scan2sim.pipeline.io.worlds.gltf.textures import Texture
from scan2sim.pipeline.io.worlds.scene import Surface, Vector
from scan2sim.pipeline.io.worlds.textured_mesh import unique_uv

UNLIT = "KHR_materials_unlit"
LINEAR, MIPMAPS, CLAMP = 9729, 9987, 33071


class GlbParams(Params):
    """How GLBs are written.

    Attributes:
        jpeg_quality: of the GLB's textures, and of JPEG pages.
        glb_texture: a file of `pipeline/io/worlds/gltf/textures`.
        glb_mesh: a file of `pipeline/io/worlds/gltf/geometry`.
        glb_lit: have lights fall on the world, with normals. Else textures are shown as they are
            (`KHR_materials_unlit`): the scan's daylight is in them, and a simulator's own would come on top.
        glb_bare: don't tell of each face where its colour is from.
    """

    jpeg_quality: int = Field(90, ge=1, le=100, description="Of the GLB's textures, and of JPEG pages.")
    glb_texture: str = Field(
        "jpeg", description="Textures in GLBs: jpeg, webp, ktx2.", json_schema_extra={"range": "jpeg, webp, ktx2"}
    )
    glb_mesh: str = Field(
        "plain", description="Geometry in GLBs: plain, meshopt, draco.",
        json_schema_extra={"range": "plain, meshopt, draco"},
    )  # fmt: skip
    glb_lit: bool = Field(False, description="GLBs are lit by a simulator's lights, not by those of the photos alone.")
    glb_bare: bool = Field(False, description="GLBs don't tell of each face which photo its colour is from.")


def ways(params: GlbParams) -> tuple[Texture, Codec]:
    """How pages and geometry are kept.

    Raises:
        SettingError: there is no such way.
        UnavailableError: it can't be written here.
    """
    codec: Codec = plugins.find(geometry.__name__, params.glb_mesh, geometry.SETTING)
    return textures.find(params.glb_texture), codec


def write(
    path: Path,
    surfaces: Sequence[Surface],
    params: GlbParams,
    *,
    views: Sequence[View] = (),
    offset: Vector = (0.0, 0.0, 0.0),
    scale: float = 1.0,
) -> None:
    """Write surfaces into one file, each page's faces of each as a mesh of its own, its class among its `extras`.

    Local metres, turned from z-up to glTF's y-up: (x, y, z) becomes (x, z, -y). Materials are matt
    (metallic 0, roughness 1) and single-sided. Pages are read and packed one at a time.

    Args:
        views: the tile's photos, which surfaces name by their numbers.
        offset: of the file's one root, metres, z up.
        scale: of the pages' sides.

    Raises:
        ScanError: as `ways`; a page can't be read.
    """
    texture, codec = ways(params)
    builder = Builder()
    rows = [] if params.glb_bare else provenance.table(views)
    if rows:
        metadata.describe(builder, rows)
    root: dict[str, Any] = {"name": path.stem, "translation": _y_up(np.array([offset]))[0].tolist(), "children": []}
    builder.add("nodes", root)
    materials: dict[str, int] = {}  # several classes may lie on one page
    for surface in surfaces:
        for page in surface.shape.used_pages:
            material = f"{surface.group}_{page}"
            if material not in materials:
                pixels = _scaled(image.read_rgb(surface.shape.pages[page]), scale)
                packed = texture.encode(pixels, params.jpeg_quality)
                materials[material] = _material(builder, material, packed, texture, params.glb_lit)
            part, extensions = _part(surface.on_page(page), params, views, len(rows))
            primitive = codec.primitive(builder, part)
            mesh = {
                "name": f"{surface.name}_{page}",
                "primitives": [primitive | {"material": materials[material]} | _merged(primitive, extensions)],
                "extras": {"class": surface.label, "las_code": surface.code},
            }
            node = {"name": mesh["name"], "mesh": builder.add("meshes", mesh)}
            root["children"].append(builder.add("nodes", node))
    builder.save(path)


def write_solid(path: Path, mesh: Mesh) -> None:
    """Write what bodies collide with, a mesh a class, without any material; local metres, y up, as `write`."""
    builder = Builder()
    codes = np.zeros(len(mesh), np.uint8) if mesh.classification is None else mesh.classification
    root: dict[str, Any] = {"name": path.stem, "children": []}
    builder.add("nodes", root)
    for code in np.unique(codes).tolist():
        part = mesh.keep(codes == code)
        primitive = plain.primitive(builder, Part(part.faces.astype(np.int64), {"POSITION": _y_up(part.vertices)}))
        entry = {"name": name_of(code), "primitives": [primitive], "extras": {"class": name_of(code), "las_code": code}}
        node = {"name": name_of(code), "mesh": builder.add("meshes", entry)}
        root["children"].append(builder.add("nodes", node))
    builder.save(path)


def _merged(primitive: dict[str, Any], extensions: dict[str, Any]) -> dict[str, Any]:
    found = {**primitive.get("extensions", {}), **extensions}
    return {"extensions": found} if found else {}


def _part(surface: Surface, params: GlbParams, views: Sequence[View], features: int) -> tuple[Part, dict[str, Any]]:
    """Triangles and attributes of a surface that lies on one page, and the extensions that say what these mean."""
    shape = surface.shape
    assert shape.mesh.uv is not None
    uv, corner_uv = unique_uv(shape.mesh.uv)
    row = provenance.rows(surface) if features else None
    of_face = np.zeros(len(shape), np.int64) if row is None else row.astype(np.int64)
    # glTF has one index for all: a vertex is said again for each of its texture coordinates, and each photo
    keys = (shape.mesh.faces.astype(np.int64) * len(uv) + corner_uv) * max(1, features) + of_face[:, None]
    unique, faces = np.unique(keys, return_inverse=True)
    pair, feature = np.divmod(unique, max(1, features))
    vertex, coordinate = np.divmod(pair, len(uv))
    attributes: dict[str, Array] = {
        "POSITION": _y_up(shape.mesh.vertices)[vertex],
        "TEXCOORD_0": (uv[coordinate] * (1, -1) + (0, 1)).astype(np.float32),  # from the upper left
    }
    if params.glb_lit:
        attributes["NORMAL"] = _y_up(shape.normal)[vertex]
    if row is not None:
        attributes[metadata.FEATURE] = feature.astype(np.uint16)
        places = shape.mesh.vertices[vertex]
        attributes[metadata.DISTANCE] = provenance.distance(places, feature.astype(np.int32), views)
    return Part(faces.reshape(-1, 3), attributes), {} if row is None else metadata.of_primitive(features)


def _material(builder: Builder, name: str, packed: bytes, texture: Texture, lit: bool) -> int:
    """A matt material that shows a page."""
    if not builder.tree["samplers"]:
        builder.add("samplers", {"magFilter": LINEAR, "minFilter": MIPMAPS, "wrapS": CLAMP, "wrapT": CLAMP})
    source = builder.add("images", {"name": name, "bufferView": builder.view(packed), "mimeType": texture.MIME})
    shown: dict[str, Any] = {"sampler": 0, "source": source}
    if texture.EXTENSION:
        builder.use(texture.EXTENSION, required=True)
        shown = {"sampler": 0, "extensions": {texture.EXTENSION: {"source": source}}}
    colour = {"index": builder.add("textures", shown)}
    matt = {"baseColorTexture": colour, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    material: dict[str, Any] = {"name": name, "pbrMetallicRoughness": matt}
    if not lit:
        builder.use(UNLIT)
        material["extensions"] = {UNLIT: {}}
    return builder.add("materials", material)


def _y_up(xyz: Array) -> Array:
    return xyz[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32)


def _scaled(page: U8, scale: float) -> U8:
    """A page with its sides scaled."""
    if scale >= 1:
        return page
    import cv2

    height, width = (max(1, round(side * scale)) for side in page.shape[:2])
    return np.asarray(cv2.resize(page, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

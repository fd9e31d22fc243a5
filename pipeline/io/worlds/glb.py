"""GLB (glTF 2.0) writer: y up, embedded textures, provenance of each face's colour (`pipeline/io/worlds/gltf`)."""

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
from scan2sim.pipeline.io.worlds.scene import BACKDROP, Surface, Vector
from scan2sim.pipeline.io.worlds.textured_mesh import unique_uv

UNLIT = "KHR_materials_unlit"
REFLECTANCE = "_REFLECTANCE"
LINEAR, MIPMAPS, CLAMP = 9729, 9987, 33071


class GlbParams(Params):
    """Settings of the GLB writer.

    Attributes:
        jpeg_quality: JPEG quality of GLB textures and of JPEG texture pages.
        glb_texture: texture format, a module of `pipeline/io/worlds/gltf/textures`.
        glb_mesh: geometry codec, a module of `pipeline/io/worlds/gltf/geometry`.
        glb_lit: write lit materials and normals. Otherwise textures are shown unlit (`KHR_materials_unlit`): the
            daylight of the photos is baked into them, and a simulator's lights would be added to it.
        glb_bare: omit the provenance of each face's colour.
        reflectance: write the relative reflectance of surfaces for lidar, if the cloud has intensities: Gazebo's
            `laser_retro`, the attribute `_REFLECTANCE` in GLBs, the primvar `reflectance` in USD.
        double_sided: what was scanned from one side is seen from both: a flag in GLB, 3D Tiles and USD, further faces
            where there is none (`world_formats.shown`). The backdrop is seen from inside only.
    """

    jpeg_quality: int = Field(90, ge=1, le=100, description="JPEG quality of GLB textures and of JPEG texture pages.")
    glb_texture: str = Field(
        "jpeg", description="Texture format in GLBs: jpeg, webp, ktx2.", json_schema_extra={"range": "jpeg, webp, ktx2"}
    )
    glb_mesh: str = Field(
        "plain", description="Geometry codec of GLBs: plain, meshopt, draco.",
        json_schema_extra={"range": "plain, meshopt, draco"},
    )  # fmt: skip
    glb_lit: bool = Field(
        False, description="Write lit materials and normals to GLBs, so that a simulator's lights apply."
    )
    glb_bare: bool = Field(False, description="Omit from GLBs which photo each face has its colour from.")
    reflectance: bool = Field(
        True,
        description="Write the reflectance of surfaces for lidar (Gazebo, GLB, USD), if the cloud has intensities.",
    )
    double_sided: bool = Field(True, description="Show walls that were scanned from one side from both sides.")


def find_encoders(params: GlbParams) -> tuple[Texture, Codec]:
    """The texture format and the geometry codec of the settings.

    Raises:
        SettingError: unknown format or codec.
        UnavailableError: its package or program isn't installed.
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
    """Write surfaces into one file, with one mesh per surface and texture page; its class is in its `extras`.

    Local metres, rotated from z up to glTF's y up: (x, y, z) becomes (x, z, -y). Materials are matt
    (metallic 0, roughness 1). Pages are read and encoded one at a time. Vertices have
    `_REFLECTANCE` (0 to 1) if it is known.

    Args:
        path: the .glb file.
        surfaces: surfaces of a tile.
        params: settings.
        views: the tile's photos, to whose indices surfaces refer.
        offset: translation of the root node, metres, z up.
        scale: factor for width and height of texture pages.

    Raises:
        ScanError: as `find_encoders`, or a page can't be read.
    """
    texture, codec = find_encoders(params)
    builder = Builder()
    rows = [] if params.glb_bare else provenance.table(views)
    if rows:
        metadata.describe(builder, rows)
    root: dict[str, Any] = {"name": path.stem, "translation": _y_up(np.array([offset]))[0].tolist(), "children": []}
    builder.add("nodes", root)
    materials: dict[str, int] = {}  # several classes may share a page
    for surface in surfaces:
        for page in surface.shape.used_pages:
            material = f"{surface.group}_{page}"
            if material not in materials:
                pixels = _scaled(image.read_rgb(surface.shape.pages[page]), scale)
                packed = texture.encode(pixels, params.jpeg_quality)
                both_sides = params.double_sided and surface.group != BACKDROP
                materials[material] = _material(builder, material, packed, texture, params.glb_lit, both_sides)
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
    """Write the collision mesh, one mesh per class, without materials; local metres, y up, as `write`."""
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
    """Triangles and attributes of a surface on one page, and the glTF extensions that describe the attributes."""
    shape = surface.shape
    assert shape.mesh.uv is not None
    uv, corner_uv = unique_uv(shape.mesh.uv)
    row = provenance.rows(surface) if features else None
    of_face = np.zeros(len(shape), np.int64) if row is None else row.astype(np.int64)
    # glTF has one index for all attributes: a vertex is repeated for each texture coordinate and photo
    keys = (shape.mesh.faces.astype(np.int64) * len(uv) + corner_uv) * max(1, features) + of_face[:, None]
    unique, faces = np.unique(keys, return_inverse=True)
    pair, feature = np.divmod(unique, max(1, features))
    vertex, coordinate = np.divmod(pair, len(uv))
    attributes: dict[str, Array] = {
        "POSITION": _y_up(shape.mesh.vertices)[vertex],
        "TEXCOORD_0": (uv[coordinate] * (1, -1) + (0, 1)).astype(np.float32),  # origin at the upper left
    }
    if params.glb_lit:
        attributes["NORMAL"] = _y_up(shape.normal)[vertex]
    if params.reflectance and shape.reflectance is not None:
        attributes[REFLECTANCE] = shape.reflectance[vertex]
    if row is not None:
        attributes[metadata.FEATURE] = feature.astype(np.uint16)
        positions = shape.mesh.vertices[vertex]
        attributes[metadata.DISTANCE] = provenance.distance(positions, feature.astype(np.int32), views)
    return Part(faces.reshape(-1, 3), attributes), {} if row is None else metadata.of_primitive(features)


def _material(builder: Builder, name: str, packed: bytes, texture: Texture, lit: bool, both_sides: bool) -> int:
    """Add a matt material with a page as texture; returns its index."""
    if not builder.tree["samplers"]:
        builder.add("samplers", {"magFilter": LINEAR, "minFilter": MIPMAPS, "wrapS": CLAMP, "wrapT": CLAMP})
    source = builder.add("images", {"name": name, "bufferView": builder.view(packed), "mimeType": texture.MIME})
    texture_entry: dict[str, Any] = {"sampler": 0, "source": source}
    if texture.EXTENSION:
        builder.use(texture.EXTENSION, required=True)
        texture_entry = {"sampler": 0, "extensions": {texture.EXTENSION: {"source": source}}}
    colour = {"index": builder.add("textures", texture_entry)}
    matt = {"baseColorTexture": colour, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    material: dict[str, Any] = {"name": name, "pbrMetallicRoughness": matt}
    if both_sides:
        material["doubleSided"] = True
    if not lit:
        builder.use(UNLIT)
        material["extensions"] = {UNLIT: {}}
    return builder.add("materials", material)


def _y_up(xyz: Array) -> Array:
    return xyz[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32)


def _scaled(page: U8, scale: float) -> U8:
    """A page with width and height scaled."""
    if scale >= 1:
        return page
    import cv2

    height, width = (max(1, round(side * scale)) for side in page.shape[:2])
    return np.asarray(cv2.resize(page, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

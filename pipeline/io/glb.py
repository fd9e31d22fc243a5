"""GLB (glTF 2.0), through trimesh: Y-up, textures embedded as JPEG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.errors import InputError
from scan2sim.pipeline.io.scene import Surface, Vector
from scan2sim.pipeline.io.textured import unique_uv


def write(
    path: Path,
    surfaces: Sequence[Surface],
    jpeg_quality: int = 90,
    *,
    offset: Vector = (0.0, 0.0, 0.0),
    scale: float = 1.0,
    normals: bool = True,
) -> None:
    """Write surfaces into one file, each page's faces of each as a mesh of its own, its class among its `extras`.

    Local metres, turned from z-up to glTF's y-up: (x, y, z) becomes (x, z, -y). Materials are matt
    (metallic 0, roughness 1) and single-sided. Pages are read and packed one at a time.

    Args:
        offset: of the nodes, metres, z up.
        scale: of the pages' sides.
        normals: False leaves them out, for viewers that show textures in their own light.
    """
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    scene = trimesh.Scene()
    images: dict[str, Path] = {}
    place = np.eye(4)
    place[:3, 3] = _y_up(np.array([offset]))[0]
    for surface in surfaces:
        for page in surface.shape.used_pages:
            name = f"{surface.group}_{page}"
            images[name] = surface.shape.pages[page]
            part = surface.shape.on_page(page)
            assert part.mesh.uv is not None
            uv, corner_uv = unique_uv(part.mesh.uv)
            # glTF has one index for all: a vertex is said again for each of its texture coordinates
            pairs, faces = np.unique(part.mesh.faces.astype(np.int64) * len(uv) + corner_uv, return_inverse=True)
            vertex, coordinate = np.divmod(pairs, len(uv))
            material = PBRMaterial(name=name, metallicFactor=0.0, roughnessFactor=1.0, doubleSided=False)
            mesh = trimesh.Trimesh(
                vertices=_y_up(part.mesh.vertices)[vertex],
                faces=faces.reshape(-1, 3),
                vertex_normals=_y_up(part.normal)[vertex],
                visual=TextureVisuals(uv=uv[coordinate], material=material),
                process=False,
                metadata={"class": surface.label, "las_code": surface.code},
            )
            called = f"{surface.name}_{page}"
            scene.add_geometry(mesh, node_name=called, geom_name=called, transform=place)

    def embed(buffers: dict[str, bytes], tree: dict[str, Any]) -> None:
        textures: dict[str, int] = {}  # several classes may lie on one page
        for material in tree["materials"]:
            name = material["name"]
            if name not in textures:
                data = _jpeg(images[name], jpeg_quality, scale)
                buffers[name] = data + b"\0" * (-len(data) % 4)
                tree["images"].append({"name": name, "bufferView": len(buffers) - 1, "mimeType": "image/jpeg"})
                tree["textures"].append({"source": len(tree["images"]) - 1})
                textures[name] = len(tree["textures"]) - 1
            material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": textures[name]}

    path.write_bytes(scene.export(file_type="glb", include_normals=normals, buffer_postprocessor=embed))


def _y_up(xyz: np.ndarray) -> np.ndarray:
    return xyz[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32)


def _jpeg(page: Path, quality: int, scale: float) -> bytes:
    import cv2

    image = cv2.imread(str(page), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(page, "is no readable image", "Texture the mesh again")
    if scale < 1:
        height, width = (max(1, round(side * scale)) for side in image.shape[:2])
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])

"""Textured meshes of photogrammetry and SLAM programs: OBJ with MTL, glTF (.gltf, .glb), PLY with faces.

Read by trimesh. All materials and texture images become one `SourceMesh`; vertices that were split at texture seams are
merged again. Import late: it loads trimesh and numba.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import trimesh
from trimesh.resolvers import Resolver

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, F64, I64, U8, UNCOLOURED, Bools, Frame, Mesh
from scan2sim.pipeline.io import file_checks, foreign_files, gltf_features, obj_faces
from scan2sim.pipeline.io.images.image import MAX_PIXELS
from scan2sim.pipeline.io.mesh_files import SUFFIXES, find_beside, ply_textures
from scan2sim.pipeline.io.source_mesh import SourceMesh, encoded

MAX_FACES = 20_000_000
"""Largest mesh: reading it takes about 0.5 kB per triangle (PLY) to 2 kB (OBJ)."""
FAR_ORIGIN = 10_000.0
"""Coordinates above this need an origin of their own to fit into float32."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".tga", ".webp")
REMEDY = "Export it again as OBJ, GLB or PLY"


class _Part(NamedTuple):
    """One material of a mesh: corners of its faces, and their look."""

    vertices: F64
    faces: I64
    uv: F32 | None  # (F, 3, 2)
    colour: U8  # (F, 3, 3)
    image: Any  # PIL image or None


class _Folder(Resolver):
    """Files beside a mesh; a path from another computer is looked up by its file name.

    Attributes:
        missing: names that were requested and not found, or are not images although named so.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.missing: list[str] = []

    def get(self, key: str) -> bytes:
        """Content of a file.

        Raises:
            FileNotFoundError: there is none; the name is added to `missing`.
        """
        found = find_beside(self._folder, key)
        if found is None:
            self.missing.append(key)
            raise FileNotFoundError(key)
        content = found.read_bytes()
        if found.suffix.lower() in IMAGE_SUFFIXES and not _is_image(content):
            self.missing.append(key)
        return content

    def keys(self) -> list[str]:
        """Names of the files."""
        return [file.name for file in self._folder.iterdir() if file.is_file()]

    def write(self, name: str, data: Any) -> None:
        """Not supported."""
        raise io.UnsupportedOperation("write")

    def namespaced(self, namespace: str) -> _Folder:
        """The files of a folder in this one."""
        return _Folder(self._folder / namespace)


def _is_image(content: bytes) -> bool:
    from PIL import Image

    try:
        Image.open(io.BytesIO(content))
    except (OSError, ValueError, SyntaxError):
        return False
    return True


def read(path: Path) -> tuple[SourceMesh, list[str]]:
    """Read a mesh in its own axes and unit, and notes for the user; `mesh.frame` has its origin, in that unit.

    Raises:
        InputError: it is missing, damaged, too large, or has no faces.
    """
    file_checks.check(path)
    folder = _Folder(path.parent)
    notes: list[str] = []
    with _large_images():
        parts = _merged(list(_parts(_load(path, folder), path, folder)), path, notes)
        if folder.missing:
            names = ", ".join(sorted(set(folder.missing)))
            notes.append(f"{names}: not found beside {path.name}, or damaged; it is left out, with its colours")
    return parts, notes


def _load(path: Path, folder: _Folder) -> trimesh.Scene:
    if path.suffix.lower() not in SUFFIXES:
        raise foreign_files.unread(path, "is not a mesh that can be read", f"Use {', '.join(SUFFIXES)}")
    if path.suffix.lower() in (".gltf", ".glb"):
        gltf_features.check(path)
    try:
        with _opened(path) as file:
            return trimesh.load_scene(
                file, file_type=path.suffix[1:].lower(), resolver=folder, process=False, skip_materials=False
            )
    except MemoryError:
        raise
    except Exception as error:
        if path.suffix.lower() in (".gltf", ".glb") and b"KHR_draco_mesh_compression" in _head(path):
            raise InputError(path, "is compressed with Draco", "Export it without mesh compression") from None
        missing = f"; not found: {', '.join(folder.missing)}" if folder.missing else ""
        cause = f"can't be read as a mesh ({type(error).__name__}: {error}{missing})"
        raise InputError(path, cause, REMEDY) from None


def _opened(path: Path) -> IO[Any]:
    """The file; of an OBJ its text as trimesh reads it rightly."""
    if path.suffix.lower() != ".obj":
        return path.open("rb")
    return io.StringIO(obj_faces.rewritten(trimesh.util.decode_text(path.read_bytes())))


def _head(path: Path) -> bytes:
    with open(path, "rb") as file:
        return file.read(1 << 20)


@contextmanager
def _large_images() -> Iterator[None]:
    """Raise Pillow's limit: pages of 16,384 x 16,384 pixels are common."""
    from PIL import Image

    before, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, MAX_PIXELS
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = before


def _parts(scene: trimesh.Scene, path: Path, folder: _Folder) -> Iterator[_Part]:
    """All meshes of a scene, in its axes."""
    total, textures = 0, ply_textures(path) if path.suffix.lower() == ".ply" else []
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        shape = scene.geometry[name]
        if not isinstance(shape, trimesh.Trimesh) or not len(shape.faces):
            continue
        total += len(shape.faces)
        if total > MAX_FACES:
            raise InputError(
                path, f"has more than {MAX_FACES:,} triangles", "Simplify it, or export it in blocks as separate meshes"
            )
        vertices, faces = np.asarray(shape.vertices, np.float64), np.asarray(shape.faces, np.int64)
        uv, colour, image = _look(shape)
        if not np.array_equal(T, np.eye(4)):
            vertices = vertices @ T[:3, :3].T + T[:3, 3]
            if np.linalg.det(T[:3, :3]) < 0:  # mirrored: keep the front side
                faces, colour = faces[:, ::-1], colour[:, ::-1]
                uv = None if uv is None else uv[:, ::-1]
        if len(textures) > 1 and uv is not None:
            yield from _by_texture(vertices, faces, uv, _texture_numbers(shape, path), textures, folder)
        else:
            yield _Part(vertices, faces, uv, colour, image)


def _texture_numbers(shape: trimesh.Trimesh, path: Path) -> I64:
    """Number (F,) of the texture image of each face of a PLY with several (OpenMVS, MeshLab: `texnumber`).

    Raises:
        InputError: it has no such numbers, so that images can't be assigned to faces.
    """
    data = shape.metadata.get("_ply_raw", {}).get("face", {}).get("data")
    names = data.dtype.names if isinstance(data, np.ndarray) else data
    found = np.asarray(data["texnumber"]) if "texnumber" in (names or ()) else np.empty(0)
    if found.size != len(shape.faces):
        cause = "has several texture images, but no `texnumber` for each of its triangles"
        raise InputError(path, cause, "Export it as OBJ, or with one texture image")
    return found.ravel().astype(np.int64)


def _by_texture(
    vertices: F64, faces: I64, uv: F32, numbers: I64, textures: list[str], folder: _Folder
) -> Iterator[_Part]:
    """The faces of each texture image of a PLY; those without an image are uncoloured."""
    for number in np.unique(numbers).tolist():
        image = _image(folder, textures[number]) if 0 <= number < len(textures) else None
        some = numbers == number
        colour = np.full((int(some.sum()), 3, 3), UNCOLOURED if image is None else 255, np.uint8)
        yield _Part(vertices, faces[some], None if image is None else uv[some], colour, image)


def _image(folder: _Folder, name: str) -> Any:
    from PIL import Image

    try:
        return Image.open(io.BytesIO(folder.get(name)))
    except (OSError, ValueError, SyntaxError):  # `folder` reports it
        return None


def _look(shape: trimesh.Trimesh) -> tuple[F32 | None, U8, Any]:
    """Texture coordinates (F, 3, 2) or None, colours of the corners (F, 3, 3), and image or None of a mesh."""
    visual: Any = shape.visual
    faces = np.asarray(shape.faces)
    colour = np.full((len(faces), 3, 3), UNCOLOURED, np.uint8)
    if visual.kind == "vertex":
        return None, np.asarray(visual.vertex_colors)[faces][..., :3].astype(np.uint8), None
    if visual.kind == "face":
        colour[:] = np.asarray(visual.face_colors)[:, None, :3]
        return None, colour, None
    if visual.kind != "texture":
        return None, colour, None
    material: Any = visual.material
    image, tint = getattr(material, "image", None), None
    if image is not None and _is_placeholder(image):
        image = None
    if hasattr(material, "baseColorTexture"):
        image, tint = material.baseColorTexture, material.baseColorFactor
    elif image is None:
        tint = getattr(material, "kwargs", {}).get("kd")  # the factor of an image is often wrong in OBJ
    per_vertex = visual.vertex_attributes.get("color")
    if per_vertex is None and image is None:
        per_vertex = _own_colours(shape, tint is not None)
    uv = None if visual.uv is None or len(visual.uv) != len(shape.vertices) else np.asarray(visual.uv)[faces]
    if image is not None and uv is not None:
        colour[:] = 255
    if tint is not None:
        level = np.asarray(tint, np.float64)[:3]
        colour[:] = np.clip(np.rint(level * (1 if np.asarray(tint).dtype.kind in "ui" else 255)), 0, 255)
    if per_vertex is not None and len(per_vertex) == len(shape.vertices):
        level = np.asarray(per_vertex)
        level = level * (1 if level.dtype.kind in "ui" else 255)
        own = np.clip(level, 0, 255)[faces][..., :3]
        colour = (own if image is None else own * (colour / 255.0)).astype(np.uint8)
    return (None if uv is None else uv.astype(np.float32)), colour, image if uv is not None else None


def _is_placeholder(image: Any) -> bool:
    """Whether an image is trimesh's own, of meshes with texture coordinates whose material or image is missing."""
    own = trimesh.visual.material.color_image()
    return bool(image.size == own.size and image.mode == own.mode and image.tobytes() == own.tobytes())


def _own_colours(shape: trimesh.Trimesh, tinted: bool) -> Any:
    """Colours of the vertices beside texture coordinates without an image; of a tinted mesh only if they vary."""
    found = shape.vertex_attributes.get("color")
    return None if found is None or (tinted and not np.ptp(np.asarray(found)[:, :3], axis=0).any()) else found


def _merged(parts: list[_Part], path: Path, notes: list[str]) -> SourceMesh:
    """All parts as one mesh: vertices at the same position merged, unusable faces removed."""
    if not parts:
        raise InputError(path, "has no faces", "Export the mesh with its triangles; a cloud of points is read as well")
    start = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + s for part, s in zip(parts, start[:-1], strict=True)])
    colour = np.concatenate([part.colour for part in parts])
    images: list[Any] = []
    for part in parts:
        if part.image is not None and not any(part.image is other for other in images):
            images.append(part.image)
    pages, uvs = [], []
    for part in parts:
        image_index = next((k for k, image in enumerate(images) if image is part.image), -1)
        uv = np.zeros((len(part.faces), 3, 2), np.float32) if part.uv is None else part.uv
        good: Bools = np.asarray(np.isfinite(uv).all(axis=(1, 2)))
        pages.append(np.where(good, image_index, -1).astype(np.int16))
        uvs.append(np.where(good[:, None, None], uv, 0).astype(np.float32))
    page, uv = np.concatenate(pages), np.concatenate(uvs)
    usable: Bools = np.asarray((faces >= 0).all(axis=1) & (faces < len(vertices)).all(axis=1))
    usable[usable] &= np.isfinite(vertices[faces[usable]]).all(axis=(1, 2))
    finite = vertices[np.unique(faces[usable])]
    if not len(finite):
        raise InputError(path, "has no face with finite coordinates", REMEDY)
    middle = (finite.min(axis=0) + finite.max(axis=0)) / 2
    origin = np.floor(middle) if np.abs(middle).max() > FAR_ORIGIN else np.zeros(3)
    local = np.nan_to_num(vertices - origin, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float32)
    index, first = _welded(local)
    corners = index[np.clip(faces, 0, len(vertices) - 1)].astype(np.int32)
    a, b, c = corners.T
    usable &= (a != b) & (b != c) & (c != a)
    x, y, z = origin.tolist()
    mesh = Mesh(Frame(origin=(x, y, z)), local[first], corners, uv=uv, page=page)
    usable = np.asarray(usable & (mesh.face_area > 0))
    if not usable.all():
        notes.append(f"{int((~usable).sum()):,} degenerate triangles, or with NaN coordinates, removed")
    if not usable.any():
        raise InputError(path, "has no triangle with an area", REMEDY)
    lost = (page < 0) & (colour == 255).all(axis=(1, 2)) & np.isin(np.arange(len(page)), np.flatnonzero(usable))
    colour[lost] = UNCOLOURED
    if images and lost.any():
        notes.append(
            f"{int(lost.sum()):,} triangles have no usable texture coordinates: they get the colours around them"
        )
    pixels = []
    for k, image in enumerate(images):
        try:
            pixels.append(encoded(np.asarray(image.convert("RGB"))))
        except (OSError, ValueError, SyntaxError) as error:
            notes.append(f"a texture image can't be decoded ({error}): its surfaces get the colours around them")
            colour[page == k] = UNCOLOURED
            page[page == k] = -1
            pixels.append(encoded(np.full((1, 1, 3), UNCOLOURED, np.uint8)))
    return SourceMesh(mesh, colour, tuple(pixels)).keep(usable)


def _welded(vertices: F32) -> tuple[I64, I64]:
    """Number (V,) of the position of each vertex, and the first vertex of each position."""
    order = np.lexsort(vertices.T)
    new = np.ones(len(order), bool)
    new[1:] = (vertices[order[1:]] != vertices[order[:-1]]).any(axis=1)
    index = np.empty(len(order), np.int64)
    index[order] = np.cumsum(new) - 1
    return index, order[new]

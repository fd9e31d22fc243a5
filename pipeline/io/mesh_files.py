"""Files of a mesh: which files are meshes, and which others belong to them (materials, textures, buffers)."""

from __future__ import annotations

import json
import re
from pathlib import Path, PureWindowsPath
from urllib.parse import unquote

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io import file_checks

SUFFIXES = (".obj", ".glb", ".gltf", ".ply")
HEAD_BYTES = 1 << 20
"""Part of an OBJ in which its materials are named."""


def is_mesh(path: Path) -> bool:
    """Whether a file is a mesh: by its suffix, a PLY only if it has faces."""
    if path.suffix.lower() == ".ply":
        header = _head(path, 1 << 16).split(b"end_header")[0]
        return any(int(n) > 0 for n in re.findall(rb"^element (?:face|tristrips)\s+(\d+)", header, re.MULTILINE))
    return path.suffix.lower() in SUFFIXES and path.is_file()


def find_mesh(path: Path) -> Path | None:
    """The mesh at `path`: the file itself, or the only one in a folder without other meshes; None if there is none.

    Raises:
        InputError: the folder contains several meshes.
    """
    if not path.is_dir():
        return path if is_mesh(path) else None
    found = [file for file in file_checks.files(path) if is_mesh(file)]
    if len(found) > 1:
        names = ", ".join(file.name for file in found[:5])
        raise InputError(path, f"contains several meshes ({names})", "Give the path of one of them")
    return found[0] if found else None


def companions(path: Path) -> list[Path]:
    """Existing files that a mesh refers to: materials and textures of an OBJ, buffers and images of a glTF."""
    names: list[str] = []
    suffix = path.suffix.lower()
    if suffix == ".obj":
        libraries = _named(rb"^mtllib\s+(.+?)\s*$", _head(path, HEAD_BYTES))
        names += libraries
        for library in libraries:
            file = find_beside(path.parent, library)
            if file is not None:
                names += _named(rb"^\s*map_Kd\s+(.+?)\s*$", _head(file, HEAD_BYTES))
    elif suffix == ".ply":
        names += ply_textures(path)
    elif suffix == ".gltf":
        try:
            about = json.loads(path.read_text(encoding="utf-8"))
            names += [unquote(e["uri"]) for key in ("buffers", "images") for e in about.get(key, ()) if "uri" in e]
        except (OSError, ValueError, TypeError, AttributeError):
            return []  # reading the mesh reports it
    beside = {find_beside(path.parent, name) for name in names if not name.startswith("data:")}
    return sorted(file for file in beside if file is not None)


def ply_textures(path: Path) -> list[str]:
    """Names of the texture images in the header of a PLY, in the order in which its faces number them."""
    header = _head(path, 1 << 16).split(b"end_header")[0]
    return _named(rb"^comment TextureFile\s+(.+?)\s*$", header)


def find_beside(folder: Path, name: str) -> Path | None:
    """A file that a mesh in `folder` refers to; a path of another computer is looked up by its file name."""
    options = [name, name.replace("\\", "/"), unquote(name), PureWindowsPath(name).name]
    for option in options:
        file = folder / option
        if file.is_file():
            return file
    wanted = options[-1].lower()
    try:
        return next((file for file in folder.iterdir() if file.name.lower() == wanted and file.is_file()), None)
    except OSError:
        return None


def _head(path: Path, count: int) -> bytes:
    try:
        with open(path, "rb") as file:
            return file.read(count)
    except OSError:
        return b""


def _named(pattern: bytes, text: bytes) -> list[str]:
    found = re.findall(pattern, text, re.MULTILINE | re.IGNORECASE)
    return [name.decode("utf-8", "replace").strip('"') for name in found]

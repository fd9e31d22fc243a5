"""Names of files that come from elsewhere (a manifest, a key of object storage), kept inside their folder."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from scan2sim.pipeline.core.errors import InputError


def inside(folder: Path, name: str) -> Path:
    """`folder/name`; the file itself may be a link, the folders that lead to it may not lead elsewhere.

    Raises:
        InputError: the name is absolute, holds `..`, or would lead out of the folder.
    """
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\0" in name:
        raise InputError(folder, f"holds the name {name!r}, which leads out of it", "Take it from where it was made")
    path = folder / name
    if not path.parent.resolve().is_relative_to(folder.resolve()):
        raise InputError(path, "leads out of its folder by a link", "Remove the link")
    return path

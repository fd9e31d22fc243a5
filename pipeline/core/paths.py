"""Path traversal check for file names from untrusted sources (manifests, keys of object storage); new folders."""

from __future__ import annotations

import secrets
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from scan2sim.pipeline.core.errors import InputError


def new_folder(parent: Path, prefix: str) -> Path:
    """Create a folder with a new name, and the permissions that the umask gives, unlike `tempfile.mkdtemp`."""
    folder = parent / f"{prefix}{secrets.token_hex(4)}"
    folder.mkdir()
    return folder


def check_inside(folder: Path, names: Iterable[str]) -> None:
    """Check many names as `inside` does, each parent folder once.

    Raises:
        InputError: as `inside`.
    """
    checked: set[str] = set()
    for name in names:
        parent, _, file = name.rpartition("/")
        if parent not in checked or file in ("", "..") or "\0" in file:
            inside(folder, name)
            checked.add(parent)


def inside(folder: Path, name: str) -> Path:
    """`folder/name`, checked to be inside `folder`; the file itself may be a symbolic link, its parent folders may not.

    Raises:
        InputError: the name is absolute, contains `..`, or leads out of the folder through a link.
    """
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\0" in name:
        raise InputError(folder, f"contains {name!r}, which leads out of it", "Copy the folder from its source again")
    path = folder / name
    if not path.parent.resolve().is_relative_to(folder.resolve()):
        raise InputError(path, "leads out of its folder through a link", "Remove the link")
    return path

"""Formats of the meshes in Gazebo's models: a file a format (`pipeline.core.plugins`), named in `export.meshes`.

A format's module has `SUFFIX` and `write`: a file for each class, its texture pages beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from scan2sim.pipeline.io.worlds.textured_mesh import Textured


@dataclass(frozen=True)
class PageNames:
    """What the texture pages of a class are called in its files, and beside them.

    Attributes:
        group: the class.
        materials: name of every page's material.
        images: name of every page's image, in the same folder.
        used: pages that a face of the class lies on, ascending.
    """

    group: str
    materials: tuple[str, ...]
    images: tuple[str, ...]
    used: tuple[int, ...]


class ModelFormat(Protocol):
    """Of files for each class.

    Attributes:
        SUFFIX: of them, with its dot.
    """

    SUFFIX: str

    def write(self, path: Path, surface: Textured, names: PageNames) -> None:
        """Write a class, or a part of it: local metres, z up."""

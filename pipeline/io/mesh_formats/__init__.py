"""Mesh formats of Gazebo models: one module per format (`pipeline.core.plugins`), selected by `export.meshes`.

A format's module has `SUFFIX` and `write`, which writes one file per class with its texture pages beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from scan2sim.pipeline.io.worlds.textured_mesh import Textured


@dataclass(frozen=True)
class PageNames:
    """Names of the materials and images of a class's texture pages.

    Attributes:
        group: the class.
        materials: material name of every page.
        images: image file name of every page, in the same folder.
        used: pages that have faces of the class, ascending.
    """

    group: str
    materials: tuple[str, ...]
    images: tuple[str, ...]
    used: tuple[int, ...]


class ModelFormat(Protocol):
    """Interface of a format's module.

    Attributes:
        SUFFIX: suffix of its files, with the dot.
    """

    SUFFIX: str

    def write(self, path: Path, surface: Textured, names: PageNames) -> None:
        """Write a class, or a part of it, in local metres, z up."""

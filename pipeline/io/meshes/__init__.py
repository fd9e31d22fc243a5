"""Formats that worlds are exported in: a file a format (`pipeline.backends`), named in `export.formats`.

A format's module has `SUFFIX`, and either `write` (files for each class of the model, its texture pages beside them) or
`write_world` (one file of all).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from scan2sim.pipeline.io.textured import Textured


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


class WorldFormat(Protocol):
    """Of one file for all classes.

    Attributes:
        SUFFIX: of it, with its dot.
    """

    SUFFIX: str

    def write_world(self, path: Path, surfaces: Mapping[str, Textured], jpeg_quality: int) -> None:
        """Write all classes, local metres."""

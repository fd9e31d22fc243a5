"""Texture formats of glTF: one module per format (`pipeline.core.plugins`), selected by `export.glb_texture`."""

from __future__ import annotations

import shutil
from typing import Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.types import U8

SETTING = "export.glb_texture"


class Texture(Protocol):
    """Interface of a format's module.

    Attributes:
        MIME: MIME type of its files.
        EXTENSION: glTF extension that textures need for it; "" for formats of core glTF.
        PROGRAMS: programs of which one must be installed.
    """

    MIME: str
    EXTENSION: str
    PROGRAMS: tuple[str, ...]

    def encode(self, page: U8, quality: int) -> bytes:
        """Encode a page (H, W, 3) RGB; `quality` is from 1 to 100."""


def find(name: str) -> Texture:
    """The module of a format.

    Raises:
        SettingError: unknown format.
        UnavailableError: its package or program isn't installed.
    """
    texture: Texture = plugins.find(__name__, name, SETTING)
    if texture.PROGRAMS and not any(map(shutil.which, texture.PROGRAMS)):
        programs = " or ".join(texture.PROGRAMS)
        cause = f"needs the program {programs}"
        raise UnavailableError(f"{SETTING} {name}", cause, f"Install {programs}, or choose webp")
    return texture

"""How glTF keeps texture pages: a file a format (`pipeline.core.plugins`), named in `export.glb_texture`."""

from __future__ import annotations

import shutil
from typing import Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.types import U8

SETTING = "export.glb_texture"


class Texture(Protocol):
    """What a format's module has.

    Attributes:
        MIME: type of its files.
        EXTENSION: of glTF, by which textures name it; "": it is part of glTF.
        PROGRAMS: one of which must be here.
    """

    MIME: str
    EXTENSION: str
    PROGRAMS: tuple[str, ...]

    def encode(self, page: U8, quality: int) -> bytes:
        """A page (H, W, 3) RGB as a file; `quality` is from 1 to 100."""


def find(name: str) -> Texture:
    """A format that can be written here.

    Raises:
        SettingError: there is none of that name.
        UnavailableError: its package or program isn't here.
    """
    texture: Texture = plugins.find(__name__, name, SETTING)
    if texture.PROGRAMS and not any(map(shutil.which, texture.PROGRAMS)):
        named = " or ".join(texture.PROGRAMS)
        raise UnavailableError(f"{SETTING} {name}", f"needs the program {named}", f"Install {named}, or choose webp")
    return texture

"""KTX 2 with Basis Universal (ETC1S): stays packed in graphics cards; `KHR_texture_basisu`.

Encoded by Binomial's `basisu`, or by `toktx` of Khronos' KTX-Software, with mip-maps: none can be made of it later.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.io.images import image

MIME, EXTENSION = "image/ktx2", "KHR_texture_basisu"
PROGRAMS = ("basisu", "toktx")
LIMIT = 1800.0
"""Seconds for a page."""


def encode(page: U8, quality: int) -> bytes:
    """See `gltf.textures.Texture`; sides are stretched to multiples of four texels, as glTF requires.

    Raises:
        UnavailableError: the program fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "page.png", Path(folder) / "page.ktx2"
        image.write(source, _in_fours(page), compression=1)
        of255 = str(max(1, round(quality * 2.55)))
        if shutil.which("basisu"):
            command = ["basisu", "-ktx2", "-mipmap", "-q", of255, "-file", str(source), "-output_file", str(target)]
        else:
            command = ["toktx", "--encode", "etc1s", "--genmipmap", "--qlevel", of255, str(target), str(source)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT)
        if done.returncode or not target.is_file():
            said = (done.stderr or done.stdout).strip().splitlines()[-1:]
            raise UnavailableError(command[0], f"failed: {' '.join(said)}", "Choose export.glb_texture=webp or jpeg")
        return target.read_bytes()


def _in_fours(page: U8) -> U8:
    import cv2

    height, width = (side + -side % 4 for side in page.shape[:2])
    return np.asarray(cv2.resize(page, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)

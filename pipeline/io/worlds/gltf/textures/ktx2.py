"""KTX 2 textures with Basis Universal (ETC1S, `KHR_texture_basisu`): stay compressed in GPU memory.

Encoded by Binomial's `basisu`, or by `toktx` of Khronos' KTX-Software, with mipmaps, which readers can't generate.
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
TIMEOUT_S = 1800.0
"""Timeout of the encoder for one page."""


def encode(page: U8, quality: int) -> bytes:
    """See `gltf.textures.Texture`; sides are stretched to multiples of four texels, as glTF requires.

    Raises:
        UnavailableError: the program fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "page.png", Path(folder) / "page.ktx2"
        image.write(source, _multiple_of_four(page))
        quality_255 = str(max(1, round(quality * 2.55)))
        if shutil.which("basisu"):
            command = [
                "basisu",
                "-ktx2",
                "-mipmap",
                "-q",
                quality_255,
                "-file",
                str(source),
                "-output_file",
                str(target),
            ]
        else:
            command = ["toktx", "--encode", "etc1s", "--genmipmap", "--qlevel", quality_255, str(target), str(source)]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S)
        if done.returncode or not target.is_file():
            output = (done.stderr or done.stdout).strip().splitlines()[-1:]
            raise UnavailableError(command[0], f"failed: {' '.join(output)}", "Choose export.glb_texture=webp or jpeg")
        return target.read_bytes()


def _multiple_of_four(page: U8) -> U8:
    import cv2

    height, width = (side + -side % 4 for side in page.shape[:2])
    return np.asarray(cv2.resize(page, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)

"""KTX 2 with Basis Universal (ETC1S): stays packed on graphics cards, a sixth of the memory; `KHR_texture_basisu`.

Encoded by Binomial's `basisu`, or by `toktx` of Khronos' KTX-Software, with mip-maps: none can be made of it later.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

from scan2sim.pipeline.errors import UnavailableError
from scan2sim.pipeline.io import image
from scan2sim.pipeline.types import U8

MIME, EXTENSION = "image/ktx2", "KHR_texture_basisu"
PROGRAMS = ("basisu", "toktx")
LIMIT = 1800.0
"""Seconds for a page."""


def encode(page: U8, quality: int) -> bytes:
    """See `pipeline.io.gltf.textures.Texture`; sides are filled up to multiples of four texels, as glTF wants them.

    Raises:
        UnavailableError: the program fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "page.png", Path(folder) / "page.ktx2"
        image.write(source, page, compression=1)
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

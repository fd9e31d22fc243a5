"""Size of GLBs by kind of compression, and the cost of provenance attributes.

`python -m bench.glb [--world OUT]`: OUT is the output folder of `run` or `survey` (default: the gate's demo tile). The
world's GLBs are written once for each variant. Variants that need a missing package or program are skipped.

Ends with `RESULT {"ways": {variant: {"mb", "geometry_mb", "textures_mb", "seconds"}}, "skipped": [...]}`.
"""

from __future__ import annotations

import argparse
import json
import struct
import tempfile
import time
from pathlib import Path
from typing import Any

from bench.paths import ROOT
from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import Scene, read_scene

VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "without reflectance": {"reflectance": False},
    "without provenance": {"glb_bare": True},
    "lit, without provenance": {"glb_bare": True, "glb_lit": True},
    "meshopt": {"glb_mesh": "meshopt"},
    "draco": {"glb_mesh": "draco"},
    "webp": {"glb_texture": "webp"},
    "meshopt, webp": {"glb_mesh": "meshopt", "glb_texture": "webp"},
    "ktx2": {"glb_texture": "ktx2"},
}


def measure(scene: Scene, params: dict[str, Any]) -> dict[str, float]:
    """Megabytes of a world's GLBs and of their parts; seconds to write them."""
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        world_formats.write(scene, ["glb"], Path(folder), SceneParams(**params), silent)
        seconds = time.perf_counter() - begun
        files = sorted(Path(folder).glob("*.glb"))
        whole, textures = sum(file.stat().st_size for file in files), sum(map(_textures, files))
    megabytes = {"mb": whole, "geometry_mb": whole - textures, "textures_mb": textures}
    return {name: round(size / 1e6, 2) for name, size in megabytes.items()} | {"seconds": round(seconds, 1)}


def _textures(path: Path) -> int:
    """Bytes of a GLB's textures."""
    data = path.read_bytes()
    (length,) = struct.unpack("<I", data[12:16])
    tree = json.loads(data[20 : 20 + length])
    return sum(tree["bufferViews"][picture["bufferView"]]["byteLength"] for picture in tree["images"])


def main() -> None:
    """Write all variants and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", type=Path, default=ROOT / "bench-out" / "gate" / "demo" / "run")
    parser.add_argument("--ways", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    arguments = parser.parse_args()
    scene = read_scene(arguments.world)
    result: dict[str, Any] = {"ways": {}, "skipped": []}
    for variant in arguments.ways:
        try:
            result["ways"][variant] = found = measure(scene, VARIANTS[variant])
            print(f"{variant:24}", json.dumps(found), flush=True)
        except UnavailableError as error:
            result["skipped"].append(f"{variant}: {error}")
    print("RESULT", json.dumps(result))


if __name__ == "__main__":
    main()

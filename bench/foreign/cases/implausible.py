"""Clouds and photos that their header and table describe right, and that can't be right."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from bench.foreign.case import Case
from bench.foreign.scan import PLACE, scan
from scan2sim.pipeline.core.types import F64

Make = Callable[[Path], Sequence[object]]
COUNT = 60_000


def cases() -> Iterator[Case]:
    """Cases of kinds 2, 6 and 9."""
    xyz = scan(COUNT).xyz
    yield Case("plausible", 6, _cloud(xyz))
    yield Case("float32", 6, _cloud(xyz.astype(np.float32).astype(float)), "named", "32-bit floats")
    yield Case("grid", 6, _cloud(np.round(xyz, 1)), "named", "rounded or thinned")
    far = np.concatenate([xyz, PLACE + [(5000.0, 0, 0), (0, 9000, 0), (0, 0, 700)]])
    yield Case("outliers", 6, _cloud(far), "named", "far from the rest")
    yield Case("zeros", 6, _cloud(np.concatenate([xyz - PLACE + (9000, 9000, 0), np.zeros((5, 3))]), "local"), "named",
               "far from the rest")  # fmt: skip
    yield Case("sparse", 6, _cloud(PLACE + 30 * (xyz[::30] - PLACE)), "named", "too far for the surfaces")
    turned = (xyz - PLACE)[:, [0, 2, 1]] * (1, 1, -1)
    yield Case("y-up", 9, _cloud(turned, "local"), "named", "up seems to be y")
    yield Case("millimetres", 6, _cloud(1000 * (xyz - PLACE), "local"), "named", "unit isn't the metre")
    for height, says in ((1.7, ""), (41.3, "41.. m above the ground"), (-38.0, "m below the ground")):
        name, expected = f"cameras-{height:g}-m", "named" if says else "read"
        yield Case(name, 2, _photographed(xyz, (0, 0, height)), expected, says)  # type: ignore[arg-type]
    yield Case("cameras-away", 6, _photographed(xyz, (700, 0, 1.7)), "named", "another place")


def _cloud(xyz: F64, crs: str = "EPSG:32633") -> Make:
    def make(folder: Path) -> Sequence[object]:
        np.savetxt(folder / "cloud.xyz", xyz, "%.4f")
        return ("import", "clouds", folder / "cloud.xyz", "--crs", crs, "--out", folder / "tile")

    return make


def _photographed(xyz: F64, shift: tuple[float, float, float]) -> Make:
    """The cloud with photos that look along x, shifted from the middle of its ground."""

    def make(folder: Path) -> Sequence[object]:
        from PIL import Image

        command = _cloud(xyz)(folder)
        rows = ["file,x,y,z,qw,qx,qy,qz,model,width,height,fx,cx,cy"]
        (folder / "photos").mkdir()
        for i in range(6):
            shades = np.random.default_rng(i).integers(0, 255, (120, 160, 3), dtype=np.uint8)
            Image.fromarray(shades).save(folder / "photos" / f"{i}.jpg")
            x, y, z = PLACE + shift + (i, 0, 0)
            rows.append(f"photos/{i}.jpg,{x:.3f},{y:.3f},{z:.3f},0.5,-0.5,0.5,-0.5,pinhole,160,120,120,79.5,59.5")
        (folder / "photos.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
        return (*command, "--photos", folder / "photos.csv")

    return make

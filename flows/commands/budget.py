"""Budgets as options tell them: "triangles=200k,texture=64MP"."""

from __future__ import annotations

import re
from typing import NamedTuple

from scan2sim.pipeline.core.errors import SettingError

TIMES = {"": 1, "k": 1e3, "M": 1e6}
LEAST = {"triangles": 1000, "texture": 1e5}


class Budget(NamedTuple):
    """What a tile may have; None: as much as it has."""

    triangles: int | None = None
    texels: float | None = None


def parse(text: str | None) -> Budget:
    """The budget of an option's text.

    Raises:
        SettingError: it is none.
    """
    found: dict[str, float] = {}
    for entry in filter(None, map(str.strip, (text or "").split(","))):
        match = re.fullmatch(r"(triangles|texture)=([\d.]+)([kM]?)(?:P|Pixel)?", entry)
        try:
            value = float(match[2]) * TIMES[match[3]] if match else 0.0
        except ValueError:
            value = 0.0
        if match is None or value < LEAST[match[1]]:
            raise SettingError("--budget", f"{entry[:40]!r} is none", "Write triangles=200k,texture=64MP: of each tile")
        found[match[1]] = value
    return Budget(int(found["triangles"]) if "triangles" in found else None, found.get("texture"))

"""Parser of option --budget: "triangles=200k,texture=64MP"."""

from __future__ import annotations

import re
from typing import NamedTuple

from scan2sim.pipeline.core.errors import SettingError

UNIT_FACTORS = {"": 1, "k": 1e3, "M": 1e6}
MINIMUM = {"triangles": 1000, "texture": 1e5}


class Budget(NamedTuple):
    """Limits of a tile; None: no limit."""

    triangles: int | None = None
    texels: float | None = None


def parse_budget(text: str | None) -> Budget:
    """Parse the text of the option.

    Raises:
        SettingError: it has a wrong form, or a value is too small.
    """
    found: dict[str, float] = {}
    for entry in filter(None, map(str.strip, (text or "").split(","))):
        match = re.fullmatch(r"(triangles|texture)=([\d.]+)([kM]?)(?:P|Pixel)?", entry)
        try:
            value = float(match[2]) * UNIT_FACTORS[match[3]] if match else 0.0
        except ValueError:
            value = 0.0
        if match is None or value < MINIMUM[match[1]]:
            raise SettingError(
                "--budget",
                f"{entry[:40]!r} is not a budget",
                "Write for example triangles=200k,texture=64MP; both are limits per tile",
            )
        found[match[1]] = value
    return Budget(int(found["triangles"]) if "triangles" in found else None, found.get("texture"))

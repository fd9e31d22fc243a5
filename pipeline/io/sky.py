"""Colour of the sky, as the step `sky_colour` writes it (`sky.json`)."""

from __future__ import annotations

import json
from pathlib import Path

from scan2sim.pipeline.core.types import Colour


def write(path: Path, colour: Colour | None) -> None:
    """Write the colour; None: no photo shows the sky."""
    path.write_text(json.dumps({"rgb": colour}), encoding="utf-8")


def read(path: Path | None) -> Colour | None:
    """The colour of the sky; None: no photo shows it, or there is no file (None)."""
    rgb = None if path is None else json.loads(path.read_text(encoding="utf-8"))["rgb"]
    return None if rgb is None else (rgb[0], rgb[1], rgb[2])

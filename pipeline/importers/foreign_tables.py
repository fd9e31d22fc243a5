"""Tables of camera poses that other programs write and that have no lens: what they are, and what to export instead."""

from __future__ import annotations

import re
from pathlib import Path

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io import tables

HEAD_CHARACTERS = 2000
"""Part of a table by which it is recognized."""
KNOWN: tuple[tuple[str, str, str], ...] = (
    (
        r"^#?\s*name\s*,\s*x\s*,\s*y\s*,\s*(alt|z)\s*,\s*(heading|omega|yaw)",
        "is RealityCapture's (RealityScan's) table of cameras, whose angles and lens are in its own conventions",
        "Export the registration as COLMAP text: scan2sim import colmap",
    ),
    (
        r"^#?\s*photoid\s*,.*omega",
        "is Metashape's table of cameras (omega, phi, kappa), which has no lens",
        "Export the cameras as Agisoft XML: scan2sim import metashape",
    ),
    (
        r"^#?\s*label\s*,\s*x/",
        "is Metashape's reference, of estimated or measured positions without a lens",
        "Export the cameras as Agisoft XML: scan2sim import metashape",
    ),
    (
        r"^imagename[\s,]+x[\s,]+y[\s,]+z[\s,]+omega[\s,]+phi[\s,]+kappa",
        "is Pix4D's table of external camera parameters, which has no lens",
        "Give PROJECT_calibrated_camera_parameters.txt of the same folder: scan2sim import pix4d",
    ),
)
"""First lines of tables (a pattern, letters in either case), cause and remedy."""


def check(path: Path) -> None:
    """Check that a table of photos isn't one of these.

    Raises:
        InputError: it is, or it can't be read.
    """
    head = tables.read_text(path)[:HEAD_CHARACTERS].replace("\t", ",")
    for pattern, cause, remedy in KNOWN:
        if re.search(pattern, head, re.IGNORECASE | re.MULTILINE):
            raise InputError(path, cause, remedy)

"""Paths that benchmarks share."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
"""The root of the repository."""
DATA = Path(os.environ.get("SCAN2SIM_REAL_DATA") or ROOT.parent / "shared" / "data")
"""Folder of real recordings."""

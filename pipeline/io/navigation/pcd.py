"""Writer of PCD files (Point Cloud Library, version 0.7, binary)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F32, F64


def write(path: Path, xyz: F64, intensity: F32 | None = None, *, double: bool = False) -> None:
    """Write points (N, 3) and, if known, intensities (N,), fields x y z intensity, as PCL does.

    `double`: coordinates as float64, for those that float32 would round too much.
    """
    kind = "<f8" if double else "<f4"
    names = ["x", "y", "z"] + ([] if intensity is None else ["intensity"])
    rows = np.empty(len(xyz), [(name, kind if name in "xyz" else "<f4") for name in names])
    for k, name in enumerate("xyz"):
        rows[name] = xyz[:, k]
    if intensity is not None:
        rows["intensity"] = intensity
    sizes = " ".join(str(rows.dtype[name].itemsize) for name in names)
    header = (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {' '.join(names)}\nSIZE {sizes}\n"
        f"TYPE {' '.join('F' * len(names))}\nCOUNT {' '.join('1' * len(names))}\nWIDTH {len(xyz)}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(xyz)}\nDATA binary\n"
    )
    path.write_bytes(header.encode() + rows.tobytes())

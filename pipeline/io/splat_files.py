"""Files of 3D Gaussian splats: PLY of the literature, and SPZ, which is a seventh as large (package `gsply`)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.splats import LOGIT, Splats
from scan2sim.pipeline.core.types import F64

if TYPE_CHECKING:
    from gsply import GSData

NEEDS = ("gsply",)
SH_C0 = 0.28209479177387814
"""Value of the spherical harmonic of degree 0: a colour c is stored as (c - 1/2) / SH_C0."""
SPZ_VERSION = 3
"""Version that viewers read; 4 (Zstandard instead of gzip) is newer than most of them."""
SPZ_FRACTION_BITS = range(12, 7, -1)
"""Binary digits of positions after the point, finest first: a quarter of a millimetre up to 2 km from the origin, half
a millimetre up to 4 km, and so on to 4 mm up to 32 km."""
SPZ_BITS = 23
"""Binary digits of a position, without its sign."""


def write(path: Path, splats: Splats, offset: F64) -> None:
    """Write splats in the format of the path's suffix, .ply or .spz.

    Args:
        path: file to write.
        splats: N splats.
        offset: (3,) metres that are added to their positions.

    Raises:
        SettingError: unknown suffix; positions that SPZ can't store.
    """
    import gsply

    data = _data(splats, offset)
    if path.suffix == ".ply":
        gsply.plywrite(path, data)
    elif path.suffix == ".spz":
        bits = _fraction_bits(path, float(np.abs(data.means).max(initial=0)))
        gsply.write_spz(path, data, version=SPZ_VERSION, fractional_bits=bits)
    else:
        raise SettingError(path, "has an unknown suffix", "Use .ply or .spz")


def spz(path: Path, splats: Splats) -> bytes:
    """Splats as the content of an SPZ file; gsply writes it beside the file `path` that is going to contain it.

    Raises:
        SettingError: positions that SPZ can't store.
    """
    temporary = path.with_suffix(".spz")
    try:
        write(temporary, splats, np.zeros(3))
        return temporary.read_bytes()
    finally:
        temporary.unlink(missing_ok=True)


def read(path: Path) -> Splats:
    """Read splats without view-dependent colour from a .ply or .spz file."""
    import gsply

    data = gsply.plyread(str(path)) if path.suffix == ".ply" else gsply.read_spz(path)
    rgb = np.asarray(data.sh0) * SH_C0 + 0.5
    made = np.column_stack([data.means, data.scales, data.quats, data.opacities, rgb])
    return Splats(np.ascontiguousarray(made, np.float32))


def _fraction_bits(path: Path, farthest: float) -> int:
    """Binary digits after the point of positions up to `farthest` metres from the origin."""
    for bits in SPZ_FRACTION_BITS:
        if np.rint(farthest * 2.0**bits) < 2.0**SPZ_BITS:
            return bits
    limit = 2 ** (SPZ_BITS - SPZ_FRACTION_BITS[-1])
    raise SettingError(path, f"has splats {farthest:,.0f} m from the origin, but SPZ ends at {limit:,} m", "Write PLY")


def _data(splats: Splats, offset: F64) -> GSData:
    """The splats as gsply holds them: logarithms of scales, logits of opacities, unit quaternions w x y z."""
    from gsply import GSData, create_ply_format

    parameters = splats.parameters
    columns: dict[str, Any] = {
        "means": (splats.xyz + offset).astype(np.float32),
        "scales": np.ascontiguousarray(parameters[:, 3:6]),
        "quats": np.ascontiguousarray(splats.quaternion),
        "opacities": np.ascontiguousarray(parameters[:, LOGIT]),
        "sh0": ((splats.display_rgb - 0.5) / SH_C0).astype(np.float32),
    }
    return GSData(**columns, shN=np.zeros((len(splats), 0, 3), np.float32), _format=create_ply_format(sh_degree=0))

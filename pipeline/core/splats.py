"""3D Gaussian splats: position, shape, opacity and colour (Kerbl et al., "3D Gaussian Splatting", SIGGRAPH 2023)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F32, F64

XYZ, LOG_SCALE, QUATERNION, LOGIT, RGB = slice(0, 3), slice(3, 6), slice(6, 10), 10, slice(11, 14)
"""Columns of the parameters."""
WIDTH = 14
"""Number of parameters of a splat."""


@dataclass(frozen=True)
class Splats:
    """Splats without view-dependent colour.

    Attributes:
        parameters: (N, 14) position in metres; logarithms of the standard deviations along the axes, metres; rotation
            from these axes to the world, a quaternion w x y z of any length; logit of the opacity; colour, sRGB 0 to 1.
    """

    parameters: F32

    def __len__(self) -> int:
        return len(self.parameters)

    @classmethod
    def of(cls, xyz: F64 | F32, scale: F64 | F32, quaternion: F64 | F32, opacity: F64 | F32, rgb: F64 | F32) -> Splats:
        """Splats with standard deviations `scale` (N, 3), quaternions (N, 4), opacities (N,); see `parameters`."""
        made = np.empty((len(xyz), WIDTH), np.float32)
        made[:, XYZ], made[:, LOG_SCALE], made[:, QUATERNION] = xyz, np.log(scale), quaternion
        made[:, LOGIT], made[:, RGB] = np.log(opacity / (1 - opacity)), rgb
        return cls(made)

    @property
    def xyz(self) -> F32:
        """(N, 3) positions, metres."""
        return self.parameters[:, XYZ]

    @property
    def scale(self) -> F32:
        """(N, 3) standard deviations along the axes, metres."""
        return np.exp(self.parameters[:, LOG_SCALE])

    @property
    def quaternion(self) -> F32:
        """(N, 4) unit quaternions w x y z, from the axes to the world."""
        given = self.parameters[:, QUATERNION]
        return given / np.linalg.norm(given, axis=1, keepdims=True)

    @property
    def opacity(self) -> F32:
        """(N,) opacities in their centre, 0 to 1."""
        return 1 / (1 + np.exp(-self.parameters[:, LOGIT]))

    @property
    def rgb(self) -> F32:
        """(N, 3) colours, sRGB 0 to 1."""
        return self.parameters[:, RGB]


@dataclass(frozen=True)
class SplatLayer:
    """What cameras see of a tile: splats before a background at infinity.

    Attributes:
        splats: positions in the tile's local metres.
        background: (H, W, 3) sRGB 0 to 1, equirectangular: column 0 is azimuth -180 degrees, from x (east) to y
            (north); row 0 is the zenith.
    """

    splats: Splats
    background: F32

    @classmethod
    def nothing(cls) -> SplatLayer:
        """A layer without splats."""
        return cls(Splats(np.zeros((0, WIDTH), np.float32)), np.full((1, 2, 3), 0.5, np.float32))

    def save(self, path: Path) -> None:
        """Write it as .npz: parameters with 32 bits, the background with 8 bits a channel."""
        levels = np.clip(np.rint(self.background * 255), 0, 255).astype(np.uint8)
        np.savez_compressed(path, parameters=self.splats.parameters, background=levels)

    @classmethod
    def load(cls, path: Path) -> SplatLayer:
        """Read what `save` wrote."""
        with np.load(path) as saved:
            return cls(Splats(saved["parameters"]), saved["background"].astype(np.float32) / 255)

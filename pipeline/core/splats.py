"""3D Gaussian splats: position, shape, opacity and colour (Kerbl et al., "3D Gaussian Splatting", SIGGRAPH 2023)."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, F64

XYZ, LOG_SCALE, QUATERNION, LOGIT, RGB = slice(0, 3), slice(3, 6), slice(6, 10), 10, slice(11, 14)
"""Columns of the parameters."""
WIDTH = 14
"""Number of parameters of a splat."""
MIN_COLOUR, MAX_COLOUR = -0.055, 4.0
"""Darkest and brightest colour of the world: photos that are darker than it show what is brighter than 1 in it, and
brighter ones what is below black. Exposure is a factor of the colour plus .055: no light is -.055."""
BACKGROUND_LEVELS = 1000
"""Steps of the background's colours from 0 to 1 in files, which begin at `MIN_COLOUR`."""
VERSION = 3
"""Version of files. Version 1 has neither this number, nor photos, nor colours brighter than 1: its background has 8
bits. Version 2 was never released."""
POSITION, AXIS, GAIN, OFFSET, VIGNETTING = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 14)
CAMERA = 14
"""Columns of the photos of a layer."""
PHOTO_WIDTH = 15
"""Number of a photo's columns."""
SHELL_RADIUS_M, SHELL_STEP_DEG, SHELL_LOWEST_DEG = 400.0, 1.5, -20.0
"""Radius of the background as splats, the angle between them, and the elevation of the lowest; beyond all others
(`FARTHEST_M` of the photos' depth is 250 m), and within the usual far clipping distance of cameras."""
SHELL_OVERLAP = 0.6
"""Standard deviation of its splats, relative to their distance from each other."""


@dataclass(frozen=True)
class Splats:
    """Splats without view-dependent colour.

    Attributes:
        parameters: (N, 14) position in metres; logarithms of the standard deviations along the axes, metres; rotation
            from these axes to the world, a quaternion w x y z of any length; logit of the opacity; colour, sRGB,
            `MIN_COLOUR` to `MAX_COLOUR`, of which 0 is black and 1 is white.
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
        return (given / np.linalg.norm(given, axis=1, keepdims=True)).astype(np.float32)

    @property
    def covariance(self) -> F64:
        """(N, 3, 3) covariances, square metres."""
        w, x, y, z = self.quaternion.astype(np.float64).T
        rotation = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        axes = rotation.transpose(2, 0, 1) * self.scale[:, None, :]
        return np.asarray(axes @ axes.transpose(0, 2, 1))

    @property
    def opacity(self) -> F32:
        """(N,) opacities in their centre, 0 to 1."""
        return np.asarray(1 / (1 + np.exp(-self.parameters[:, LOGIT])), np.float32)

    def y_up(self) -> Splats:
        """The splats in axes with y up: (x, y, z) becomes (x, z, -y)."""
        turned = self.parameters.copy()
        turned[:, XYZ] = self.parameters[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32)
        w, x, y, z = self.quaternion.T
        half = np.float32(np.sqrt(0.5))  # times (half, -half, 0, 0) from the left
        turned[:, QUATERNION] = half * np.column_stack([w + x, x - w, y + z, z - y])
        return Splats(turned)

    @property
    def rgb(self) -> F32:
        """(N, 3) colours, sRGB, `MIN_COLOUR` to `MAX_COLOUR`."""
        return self.parameters[:, RGB]

    @property
    def display_rgb(self) -> F32:
        """(N, 3) colours, sRGB 0 to 1, as programs draw them that know neither darker nor brighter ones."""
        return np.clip(self.rgb, 0, 1)


@dataclass(frozen=True)
class SplatLayer:
    """What cameras see of a tile: splats before a background at infinity.

    Attributes:
        splats: positions in the tile's local metres.
        background: (H, W, 3) sRGB, `MIN_COLOUR` to `MAX_COLOUR`, equirectangular: column 0 is azimuth -180 degrees,
            from x (east) to y (north); row 0 is the zenith.
        photos: (P, 15) how the photos of the training show the world: position in local metres; optical axis, 0 for
            panoramas; gain, offset and vignetting coefficients a, b of `v * (gain * colour + offset) - 0.055` with
            `v = exp(-a q - b q^2)`, where q is the squared distance from the image centre, 1 in the corners; index of
            the camera in `cameras`.
        cameras: names of the cameras that took the photos (`texturing.photo_cache.camera_of`).
    """

    splats: Splats
    background: F32
    photos: F32 = field(default_factory=lambda: np.zeros((0, PHOTO_WIDTH), np.float32))
    cameras: tuple[str, ...] = ()

    def with_shell(self) -> Splats:
        """The splats, and the background as large splats on a sphere: for programs that know no background."""
        return Splats(np.concatenate([self.splats.parameters, _shell(self.background, self.splats).parameters]))

    @classmethod
    def nothing(cls) -> SplatLayer:
        """A layer without splats."""
        return cls(Splats(np.zeros((0, WIDTH), np.float32)), np.full((1, 2, 3), 0.5, np.float32))

    def save(self, path: Path) -> None:
        """Write it as .npz: parameters with 32 bits, the background in steps of a quarter of a grey level."""
        colours = np.clip(self.background, MIN_COLOUR, MAX_COLOUR) - np.float32(MIN_COLOUR)
        levels = np.rint(colours * BACKGROUND_LEVELS).astype(np.uint16)
        np.savez_compressed(
            path, version=VERSION, parameters=self.splats.parameters, background=levels, photos=self.photos,
            cameras=np.array(self.cameras, np.str_),
        )  # fmt: skip

    @classmethod
    def load(cls, path: Path) -> SplatLayer:
        """Read what `save` wrote, also in version 1 (`VERSION`).

        Raises:
            InputError: the file has another version.
        """
        with np.load(path) as saved:
            levels = saved["background"]
            splats = Splats(saved["parameters"])
            if "version" not in saved and levels.dtype == np.uint8:
                return cls(splats, levels.astype(np.float32) / 255)
            version = int(saved["version"]) if "version" in saved else 2
            if version != VERSION:
                raise InputError(
                    path,
                    f"it has version {version} of files with splats; this scan2sim reads versions 1 and {VERSION}",
                    "Run again to train its splats again" if version < VERSION else "Update scan2sim",
                )
            background = levels.astype(np.float32) / BACKGROUND_LEVELS + np.float32(MIN_COLOUR)
            return cls(splats, background, saved["photos"], tuple(saved["cameras"].tolist()))

    @staticmethod
    def count(path: Path) -> int:
        """Number of splats in a file that `save` wrote, from its header."""
        with zipfile.ZipFile(path) as archive, archive.open("parameters.npy") as header:
            np.lib.format.read_magic(header)
            shape, _, _ = np.lib.format.read_array_header_1_0(header)
        return int(shape[0])


def _shell(background: F32, around: Splats) -> Splats:
    """Splats that show the background, evenly distributed over a sphere around the middle of others."""
    count = int(4 * np.pi / np.radians(SHELL_STEP_DEG) ** 2)
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count  # a Fibonacci sphere
    azimuth = np.pi * (1 + 5**0.5) * k
    kept = np.degrees(np.arcsin(z)) > SHELL_LOWEST_DEG
    z, azimuth = z[kept], (azimuth[kept] + np.pi) % (2 * np.pi) - np.pi
    flat = np.sqrt(1 - z**2)
    direction = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z])
    height, width = background.shape[:2]
    row = np.clip(((0.5 - np.arcsin(z) / np.pi) * height).astype(int), 0, height - 1)
    column = ((azimuth / (2 * np.pi) + 0.5) * width).astype(int) % width
    rgb = _box_mean(background, max(1, round(SHELL_STEP_DEG * width / 360)))[row, column]
    centre = np.median(around.xyz, axis=0) if len(around) else np.zeros(3)
    scale = np.full((len(z), 3), SHELL_OVERLAP * np.radians(SHELL_STEP_DEG) * SHELL_RADIUS_M)
    scale[:, 2] *= 0.05
    half = np.column_stack([1 + direction[:, 2], -direction[:, 1], direction[:, 0], np.zeros(len(z))])
    return Splats.of(centre + SHELL_RADIUS_M * direction, scale, half, np.full(len(z), 0.99), np.clip(rgb, 0, 1))


def _box_mean(image: F32, size: int) -> F32:
    """An image averaged over squares of `size` pixels."""
    import cv2

    return np.asarray(cv2.blur(image, (size, size), borderType=cv2.BORDER_REPLICATE), np.float32)

"""How photos show the colours of the world: exposure and vignetting of each, and what training finds beside them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from scan2sim.pipeline.core.splats import AXIS, CAMERA, GAIN, OFFSET, POSITION, VIGNETTING
from scan2sim.pipeline.core.types import F32, F64, I32, U8, Bools
from scan2sim.texturing.photo_cache import SRGB_OFFSET, squared_radius

MIN_GAIN, MAX_GAIN, MAX_OFFSET = 0.5, 2.0, 0.15
PRIOR, PRIOR_VARIANCE = 0.02, 0.05
"""Weight of a gain of 1, relative to the number of pixels, and the variance of colours that it counts as."""
DARK, BRIGHT = 0.02 * 255, 0.97 * 255
"""Levels of a photo outside of which pixels don't count: clipped."""
EVERY_PX = 3
CURVE_OFFSET = np.float32(SRGB_OFFSET / 255)
"""sRGB is a power law of the colour and this: an exposure is a factor of that sum."""
NEAREST = 2
"""Number of photos whose exposure another photo's is interpolated from."""
METRES_PER_TURN = 10.0
"""Distance that counts as far as a quarter turn of the camera, where photos are compared by nearness."""
MIN_DISTANCE_M = 0.01


class Response(NamedTuple):
    """How a photo shows colours of the world: vignetting * (gain * colour + offset) - `CURVE_OFFSET`.

    Attributes:
        gain, offset: (3,) of each channel.
        vignetting: (H, W) factor, or (1, 1) if it is the same everywhere.
    """

    gain: F32
    offset: F32
    vignetting: F32

    @classmethod
    def of(cls, exposure: F64, vignetting: F32) -> Response:
        """The inverse of a photo's correction `exposure` (5,) (`photo_cache.Exposures.of`).

        Args:
            exposure: the correction.
            vignetting: see the class; that of the last two numbers of `exposure`, wherever the pixels are (`falloff`).
        """
        gain = np.exp(-exposure[:3]).astype(np.float32)
        return cls(gain, gain * CURVE_OFFSET, vignetting)

    def shown(self, colour: F32) -> F32:
        """(H, W, 3) what the photo shows where the world has these colours (H, W, 3); it may exceed 0 to 1."""
        return self.vignetting[..., None] * (self.gain * colour + self.offset) - CURVE_OFFSET

    def world(self, photo: U8) -> F32:
        """(H, W, 3) colours of the world where the photo has these grey levels (H, W, 3)."""
        light = (photo / np.float32(255) + CURVE_OFFSET) / self.vignetting[..., None]
        return np.asarray((light - self.offset) / self.gain, np.float32)

    def sampled(self, rows: slice, columns: slice) -> Response:
        """The response of a part of the pixels."""
        same = self.vignetting.shape == (1, 1)
        return self if same else self._replace(vignetting=np.ascontiguousarray(self.vignetting[rows, columns]))


def falloff(a: float, b: float, height: int, width: int) -> F32:
    """Vignetting (H, W) of a photo with these coefficients (`photo_cache.Exposures`); (1, 1) if they are 0."""
    if a == 0 and b == 0:
        return np.ones((1, 1), np.float32)
    q = squared_radius(height, width)
    return np.exp(-(np.float32(a) * q + np.float32(b) * q * q))


def of_nearest(photos: F32, T_world_cam: F64, height: int, width: int, camera: int | None) -> Response:
    """Response of a photo that would be taken at a pose (4, 4): that of the nearest photos, weighted by nearness.

    Args:
        photos: (P, 15) photos of a layer (`SplatLayer.photos`); without any, the photo shows the world's colours.
        T_world_cam: pose in the layer's metres.
        height, width: of the photo, pixels.
        camera: index of the camera in the layer, of which photos are used; None, or one without photos: photos of all
            cameras are used, without their vignetting, which is another lens's.
    """
    if not len(photos):
        return Response.of(np.zeros(5), falloff(0, 0, 1, 1))
    own = photos[photos[:, CAMERA] == (-1 if camera is None else camera)]
    known = len(own) > 0
    photos = own if known else photos
    away = np.linalg.norm(photos[:, POSITION] - T_world_cam[:3, 3], axis=1)
    away = away + METRES_PER_TURN * (1 - photos[:, AXIS] @ T_world_cam[:3, 2])
    nearest = np.argsort(away, kind="stable")[:NEAREST]
    weight = 1 / np.maximum(away[nearest], MIN_DISTANCE_M)
    mean = (weight[:, None] * photos[nearest]).sum(axis=0) / weight.sum()
    a, b = mean[VIGNETTING].tolist() if known else (0.0, 0.0)
    return Response(mean[GAIN].astype(np.float32), mean[OFFSET].astype(np.float32), falloff(a, b, height, width))


class Gains:
    """Gain and offset of the photos beside their exposure: what training finds, held to those of the world.

    A photo may consist of several shots (the faces of a panorama), which are visited one after the other: its gain is
    solved over the latest visit of each.

    Args:
        photo_of: (S,) number of the photo of each shot.

    Attributes:
        photo_of: see above.
        gain, offset: (P, 3): a photo shows gain * colour + offset as others show the colour, at the same exposure.
        sums: (S, 5, 3) of the latest visit of each shot, per channel: number of pixels, and the sums of x, y, x x, x y,
            where x are the world's colours and y the photo's; relative to the number of pixels of the shot, as it is
            visited in several sizes.
    """

    def __init__(self, photo_of: I32) -> None:
        count = int(photo_of.max(initial=-1)) + 1
        self.photo_of = photo_of
        self.gain, self.offset = np.ones((count, 3), np.float32), np.zeros((count, 3), np.float32)
        self.sums = np.zeros((len(photo_of), 5, 3))

    def solve(self, shot: int, rendered: F32, rgb: U8, used: Bools, exposed: Response, rate: float) -> None:
        """Move the gain and offset of a shot's photo towards the least-squares solution by `rate` (1: replace them).

        Args:
            shot: its number.
            rendered: (H, W, 3) colours of the world.
            rgb, used: (H, W, 3) grey levels of the shot, and (H, W) pixels that count.
            exposed: response by its exposure alone.
            rate: share of the way.
        """
        part = slice(1, None, EVERY_PX)
        rendered, rgb, used = rendered[part, part], rgb[part, part], used[part, part]
        brightest = rgb.max(axis=-1)
        used = used & (brightest < BRIGHT) & (brightest > DARK)
        x, y = (one[used].astype(np.float64) for one in (rendered, exposed.sampled(part, part).world(rgb)))
        found = [np.full(3, len(x)), x.sum(axis=0), y.sum(axis=0), (x * x).sum(axis=0), (x * y).sum(axis=0)]
        self.sums[shot] = np.array(found) / max(used.size, 1)
        photo = self.photo_of[shot]
        total = self.sums[self.photo_of == photo].sum(axis=0)
        if not total[0].all():
            return
        mean_x, mean_y, mean_xx, mean_xy = total[1:] / total[0]
        prior = PRIOR * PRIOR_VARIANCE
        gain = (mean_xy - mean_x * mean_y + prior) / (np.maximum(mean_xx - mean_x**2, 0) + prior)
        gain = np.clip(gain, MIN_GAIN, MAX_GAIN)
        offset = np.clip(mean_y - gain * mean_x, -MAX_OFFSET, MAX_OFFSET)
        self.gain[photo] += (rate * (gain - self.gain[photo])).astype(np.float32)
        self.offset[photo] += (rate * (offset - self.offset[photo])).astype(np.float32)

    def centre(self) -> tuple[F32, F32]:
        """Make the geometric mean of the gains 1 and the mean offset 0: the world has the exposure of the photos' mean.

        Returns:
            (3,) factor and offset by which the world's colours must change, so that all renderings stay as they are.
        """
        factor = np.exp(np.log(self.gain).mean(axis=0))
        gain = self.gain / factor
        shift = self.offset.mean(axis=0) / gain.mean(axis=0)
        self.gain, self.offset = gain, self.offset - gain * shift
        n, x, y, xx, xy = np.moveaxis(self.sums, 1, 0).copy()
        self.sums[:, 1], self.sums[:, 4] = factor * x + shift * n, factor * xy + shift * y
        self.sums[:, 3] = factor**2 * xx + 2 * factor * shift * x + shift**2 * n
        return factor, shift

    def response(self, photo: int, exposed: Response) -> Response:
        """How a photo shows colours of the world; `exposed` is its response by its exposure alone."""
        gain, offset = exposed.gain * self.gain[photo], exposed.gain * self.offset[photo] + exposed.offset
        return Response(gain, offset, exposed.vignetting)

    def save(self) -> dict[str, Any]:
        """State, for `load`."""
        return {name: getattr(self, name) for name in ("photo_of", "gain", "offset", "sums")}

    @classmethod
    def load(cls, state: Mapping[str, Any]) -> Gains:
        """The gains that `save` describes."""
        loaded = cls(state["photo_of"].copy())
        loaded.gain, loaded.offset, loaded.sums = (state[name].copy() for name in ("gain", "offset", "sums"))
        return loaded

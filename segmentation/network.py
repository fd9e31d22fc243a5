"""The project's own small segmentation network. Import late: loads torch.

Inverted residuals (Sandler et al., "MobileNetV2", CVPR 2018), global context, and a feature pyramid (FPN, Lin et al.,
CVPR 2017) of depthwise convolutions. All photos are classified at the same angular resolution, so that objects of the
same size and distance have the same size in pixels.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from scan2sim.segmentation.lidar_channels import CHANNELS

PIXELS_PER_RADIAN = 500.0
"""Angular resolution at which photos are classified."""
RGB_MEAN, RGB_STD = (0.42, 0.43, 0.42), (0.25, 0.25, 0.26)
"""Normalisation of the colours (0 to 1)."""
LIDAR_MEAN, LIDAR_STD = 0.55, 0.15
"""Normalisation of the codes of `segmentation.lidar_channels` (0 to 1)."""


class Convolution(nn.Sequential):
    """Convolution without bias, batch normalisation, and ReLU (if `act`)."""

    def __init__(self, i: int, o: int, kernel: int = 1, stride: int = 1, groups: int = 1, act: bool = True) -> None:
        super().__init__(
            nn.Conv2d(i, o, kernel, stride, kernel // 2, groups=groups, bias=False),
            nn.BatchNorm2d(o),
            nn.ReLU(inplace=True) if act else nn.Identity(),
        )


class Residual(nn.Module):
    """Inverted residual block: expansion, depthwise convolution, projection."""

    def __init__(self, i: int, o: int, stride: int, kernel: int) -> None:
        super().__init__()
        wide = 2 * max(i, o) if stride == 1 else o
        self.body = nn.Sequential(
            Convolution(i, wide), Convolution(wide, wide, kernel, stride, wide), Convolution(wide, o, act=False)
        )
        self.adds = stride == 1 and i == o

    def forward(self, x: Tensor) -> Tensor:
        """(B, i, H, W) to (B, o, H / stride, W / stride)."""
        return x + self.body(x) if self.adds else self.body(x)


class Merge(nn.Module):
    """A level of the feature pyramid: the upsampled coarser map is added to the finer one."""

    def __init__(self, i: int, o: int) -> None:
        super().__init__()
        self.side = Convolution(i, o, act=False)
        self.smooth = nn.Sequential(Convolution(o, o, 3, groups=o), Convolution(o, o))

    def forward(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """(B, i, H, W) and a coarser map (B, o, h, w) to (B, o, H, W)."""
        up = F.interpolate(coarse, size=fine.shape[2:], mode="bilinear", align_corners=False)
        return self.smooth(F.relu(self.side(fine) + up))


class Pyramid(nn.Module):
    """Backbone with a feature pyramid: maps of an image at several strides, with wide context at the coarsest.

    Args:
        channels: channels of the image.
        widths: channels of the backbone at strides 2, 4, 8, 16, 32.
        pyramid: channels of the pyramid's maps.
        merges: number of maps at strides finer than 32.
    """

    def __init__(
        self, channels: int, widths: tuple[int, ...] = (16, 32, 64, 128, 192), pyramid: int = 64, merges: int = 3
    ) -> None:
        super().__init__()
        self.mean: Tensor
        self.spread: Tensor
        self.register_buffer("mean", torch.tensor(RGB_MEAN)[:, None, None], persistent=False)
        self.register_buffer("spread", torch.tensor(RGB_STD)[:, None, None], persistent=False)
        self.stem = Convolution(channels, widths[0], 3, 2)
        self.stages = nn.ModuleList(
            nn.Sequential(Residual(i, o, 2, 3), *(Residual(o, o, 1, kernel) for _ in range(depth)))
            for i, o, depth, kernel in zip(widths[:-1], widths[1:], (0, 2, 4, 3), (3, 3, 5, 5), strict=True)
        )
        self.context = Convolution(widths[-1], widths[-1])
        self.top = Convolution(widths[-1], pyramid)
        self.merges = nn.ModuleList(Merge(w, pyramid) for w in widths[-2:0:-1][:merges])

    def maps(self, seen: Tensor) -> list[Tensor]:
        """Maps (B, pyramid, H / s, W / s) of images (B, channels, H, W), for strides s of 32, 16 and so on."""
        x = self.stem(seen)
        levels = []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        maps = [self.top(x * torch.sigmoid(self.context(F.avg_pool2d(x, 9, 1, 4, count_include_pad=False))))]
        for merge, fine in zip(self.merges, levels[-2::-1], strict=False):
            maps.append(merge(fine, maps[-1]))
        return maps


class StreetNet(Pyramid):
    """Colours and `segmentation.lidar_channels` (B, 3 + 4, H, W) in [0, 1] to logits (B, classes, H / 4, W / 4).

    In evaluation mode it predicts twice, the second time for the mirrored image, and returns the mean (test-time
    augmentation).

    Args:
        classes: number of classes.
        widths, pyramid: see `Pyramid`.
    """

    def __init__(self, classes: int, widths: tuple[int, ...] = (16, 32, 64, 128, 192), pyramid: int = 64) -> None:
        super().__init__(3 + CHANNELS, widths, pyramid)
        self.head = nn.Sequential(nn.Dropout2d(0.1), nn.Conv2d(pyramid, classes, 1))

    def forward(self, seen: Tensor) -> Tensor:
        """Logits (B, classes, H / 4, W / 4) of colours and channels (B, 3 + CHANNELS, H, W).

        In evaluation mode, the mean of the predictions for the images and for their mirror images.
        """
        if self.training:
            return self._classify(seen)
        return (self._classify(seen) + self._classify(seen.flip(3)).flip(3)) / 2

    def _classify(self, seen: Tensor) -> Tensor:
        rgb, codes, valid = seen[:, :3], seen[:, 3:-1], seen[:, -1:]
        codes = (codes - LIDAR_MEAN) / LIDAR_STD * valid
        maps = self.maps(torch.cat([(rgb - self.mean) / self.spread, codes, valid], dim=1))
        logits: Tensor = self.head(maps[-1])
        return logits

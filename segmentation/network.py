"""The project's own small segmentation network. Import late: loads torch.

Inverted residuals (Sandler et al., "MobileNetV2", CVPR 2018), the whole picture's context, and a feature pyramid of
depthwise convolutions (Lin et al., CVPR 2017). It looks at photos at one angular resolution, so that a thing of a size
at a distance always looks the same size.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from scan2sim.segmentation.lidar_channels import COUNT

PIXELS_A_RADIAN = 500.0
"""Angular resolution at which photos are looked at."""
MEAN, SPREAD = (0.42, 0.43, 0.42), (0.25, 0.25, 0.26)
CODE_MEAN, CODE_SPREAD = 0.55, 0.15
"""Of the codes of `segmentation.lidar_channels`, 1 for 255."""


class Convolution(nn.Sequential):
    """Without bias, then normalised over the batch, then rectified."""

    def __init__(self, i: int, o: int, kernel: int = 1, stride: int = 1, groups: int = 1, act: bool = True) -> None:
        super().__init__(
            nn.Conv2d(i, o, kernel, stride, kernel // 2, groups=groups, bias=False),
            nn.BatchNorm2d(o),
            nn.ReLU(inplace=True) if act else nn.Identity(),
        )


class Residual(nn.Module):
    """An inverted residual: widened, filtered by channel, narrowed."""

    def __init__(self, i: int, o: int, stride: int, kernel: int) -> None:
        super().__init__()
        wide = 2 * max(i, o) if stride == 1 else o
        self.body = nn.Sequential(
            Convolution(i, wide), Convolution(wide, wide, kernel, stride, wide), Convolution(wide, o, act=False)
        )
        self.adds = stride == 1 and i == o

    def forward(self, x: Tensor) -> Tensor:
        """(B, o, H / stride, W / stride) of (B, i, H, W)."""
        return x + self.body(x) if self.adds else self.body(x)


class Merge(nn.Module):
    """A level of the pyramid: what is coarser, enlarged, added to what is finer."""

    def __init__(self, i: int, o: int) -> None:
        super().__init__()
        self.side = Convolution(i, o, act=False)
        self.smooth = nn.Sequential(Convolution(o, o, 3, groups=o), Convolution(o, o))

    def forward(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """(B, o, H, W) of (B, i, H, W) and a coarser (B, o, h, w)."""
        up = F.interpolate(coarse, size=fine.shape[2:], mode="bilinear", align_corners=False)
        return self.smooth(F.relu(self.side(fine) + up))


class Pyramid(nn.Module):
    """Maps of a picture at several strides, coarser ones with the whole picture's context.

    Args:
        channels: of the picture.
        widths: channels at strides 2, 4, 8, 16, 32.
        pyramid: channels of the maps.
        merges: how many strides finer than 32 there are maps of.
    """

    def __init__(
        self, channels: int, widths: tuple[int, ...] = (16, 32, 64, 128, 192), pyramid: int = 64, merges: int = 3
    ) -> None:
        super().__init__()
        self.mean: Tensor
        self.spread: Tensor
        self.register_buffer("mean", torch.tensor(MEAN)[:, None, None], persistent=False)
        self.register_buffer("spread", torch.tensor(SPREAD)[:, None, None], persistent=False)
        self.stem = Convolution(channels, widths[0], 3, 2)
        self.stages = nn.ModuleList(
            nn.Sequential(Residual(i, o, 2, 3), *(Residual(o, o, 1, kernel) for _ in range(depth)))
            for i, o, depth, kernel in zip(widths[:-1], widths[1:], (0, 2, 4, 3), (3, 3, 5, 5), strict=True)
        )
        self.context = Convolution(widths[-1], widths[-1])
        self.top = Convolution(widths[-1], pyramid)
        self.merges = nn.ModuleList(Merge(w, pyramid) for w in widths[-2:0:-1][:merges])

    def maps(self, seen: Tensor) -> list[Tensor]:
        """(B, pyramid, H / s, W / s) of (B, channels, H, W), for s 32 first, then 16 and so on."""
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
    """(B, 3 + 4, H, W) colours and `segmentation.lidar_channels` in [0, 1] to (B, classes, H / 4, W / 4) logits.

    Once trained it predicts twice, the second time the picture mirrored, and gives the mean.

    Args:
        classes: number of them.
        widths, pyramid: see `Pyramid`.
    """

    def __init__(self, classes: int, widths: tuple[int, ...] = (16, 32, 64, 128, 192), pyramid: int = 64) -> None:
        super().__init__(3 + COUNT, widths, pyramid)
        self.head = nn.Sequential(nn.Dropout2d(0.1), nn.Conv2d(pyramid, classes, 1))

    def forward(self, seen: Tensor) -> Tensor:
        """(B, classes, H / 4, W / 4) logits of (B, 3 + COUNT, H, W) colours and channels.

        Outside of training, the mean of what it says of them and of their mirror image.
        """
        if self.training:
            return self._classify(seen)
        return (self._classify(seen) + self._classify(seen.flip(3)).flip(3)) / 2

    def _classify(self, seen: Tensor) -> Tensor:
        rgb, codes, there = seen[:, :3], seen[:, 3:-1], seen[:, -1:]
        codes = (codes - CODE_MEAN) / CODE_SPREAD * there
        maps = self.maps(torch.cat([(rgb - self.mean) / self.spread, codes, there], dim=1))
        logits: Tensor = self.head(maps[-1])
        return logits

"""The project's own small segmentation network. Import late: loads torch.

Inverted residuals (Sandler et al., "MobileNetV2", CVPR 2018), the whole picture's context, and a feature pyramid of
depthwise convolutions (Lin et al., CVPR 2017). It looks at photos at one angular resolution, so that a thing of a size
at a distance always looks the same size.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from scan2sim.pipeline.channels import COUNT

PIXELS_A_RADIAN = 500.0
"""Angular resolution at which photos are looked at."""
MEAN, SPREAD = (0.42, 0.43, 0.42), (0.25, 0.25, 0.26)
CODE_MEAN, CODE_SPREAD = 0.55, 0.15
"""Of the codes of `pipeline.channels`, 1 for 255."""


class _Convolution(nn.Sequential):
    def __init__(self, i: int, o: int, kernel: int = 1, stride: int = 1, groups: int = 1, act: bool = True) -> None:
        super().__init__(
            nn.Conv2d(i, o, kernel, stride, kernel // 2, groups=groups, bias=False),
            nn.BatchNorm2d(o),
            nn.ReLU(inplace=True) if act else nn.Identity(),
        )


class _Residual(nn.Module):
    """An inverted residual: widened, filtered by channel, narrowed."""

    def __init__(self, i: int, o: int, stride: int, kernel: int) -> None:
        super().__init__()
        wide = 2 * max(i, o) if stride == 1 else o
        self.body = nn.Sequential(
            _Convolution(i, wide), _Convolution(wide, wide, kernel, stride, wide), _Convolution(wide, o, act=False)
        )
        self.adds = stride == 1 and i == o

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x) if self.adds else self.body(x)


class _Merge(nn.Module):
    """A level of the pyramid: what is coarser, enlarged, added to what is finer."""

    def __init__(self, i: int, o: int) -> None:
        super().__init__()
        self.side = _Convolution(i, o, act=False)
        self.smooth = nn.Sequential(_Convolution(o, o, 3, groups=o), _Convolution(o, o))

    def forward(self, fine: Tensor, coarse: Tensor) -> Tensor:
        up = F.interpolate(coarse, size=fine.shape[2:], mode="bilinear", align_corners=False)
        return self.smooth(F.relu(self.side(fine) + up))


class StreetNet(nn.Module):
    """(B, 3 + 4, H, W) colours and `pipeline.channels` in [0, 1] to (B, classes, H / 4, W / 4) logits.

    Once trained it predicts twice, the second time the picture mirrored, and gives the mean.

    Args:
        classes: number of them.
        widths: channels at strides 2, 4, 8, 16, 32.
        pyramid: channels of the decoder.
    """

    def __init__(self, classes: int, widths: tuple[int, ...] = (16, 32, 64, 128, 192), pyramid: int = 64) -> None:
        super().__init__()
        self.mean: Tensor
        self.spread: Tensor
        self.register_buffer("mean", torch.tensor(MEAN)[:, None, None], persistent=False)
        self.register_buffer("spread", torch.tensor(SPREAD)[:, None, None], persistent=False)
        self.stem = _Convolution(3 + COUNT, widths[0], 3, 2)
        self.stages = nn.ModuleList(
            nn.Sequential(_Residual(i, o, 2, 3), *(_Residual(o, o, 1, kernel) for _ in range(depth)))
            for i, o, depth, kernel in zip(widths[:-1], widths[1:], (0, 2, 4, 3), (3, 3, 5, 5), strict=True)
        )
        self.context = _Convolution(widths[-1], widths[-1])
        self.top = _Convolution(widths[-1], pyramid)
        self.merges = nn.ModuleList(_Merge(w, pyramid) for w in widths[-2:0:-1])
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
        x = self.stem(torch.cat([(rgb - self.mean) / self.spread, codes, there], dim=1))
        levels = []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        x = self.top(x * torch.sigmoid(self.context(F.avg_pool2d(x, 9, 1, 4, count_include_pad=False))))
        for merge, fine in zip(self.merges, levels[-2::-1], strict=True):
            x = merge(fine, x)
        return self.head(x)

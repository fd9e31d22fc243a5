"""The project's own detector. Import late: loads torch.

The trunk of the segmentation network (`segmentation.network`), maps at strides 8 to 64, and at each of their places a
box, whether there is a thing, and of which class: without anchors, as FCOS (Tian et al., ICCV 2019) and YOLOX (Ge et
al., 2021).
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from scan2sim.segmentation.network import Convolution, Pyramid

STRIDES = (8, 16, 32, 64)
MOST = 6.0
"""Logarithm of a box's side, in strides, at most."""


class VehicleNet(Pyramid):
    """(B, 3, H, W) colours in [0, 1], H and W multiples of 64, to (B, N, 5 + classes).

    N: the places of all strides. In training: how far a box's centre is off its place, logarithm of its width and
    height (both in strides), logits of there being a thing and of its classes. Else: centre, width and height in
    pixels, and probabilities.

    Args:
        classes: number of them.
        pyramid: channels of the maps.
    """

    def __init__(self, classes: int, pyramid: int = 64) -> None:
        super().__init__(3, pyramid=pyramid, merges=2)
        self.coarser = nn.Sequential(Convolution(pyramid, pyramid, 3, 2, pyramid), Convolution(pyramid, pyramid))
        self.what, self.where = (nn.Sequential(*_tower(pyramid), *_tower(pyramid)) for _ in range(2))
        self.classes = nn.Conv2d(pyramid, classes, 1)
        self.box = nn.Conv2d(pyramid, 5, 1)
        nn.init.constant_(self.classes.bias, -2.0)  # type: ignore[arg-type]
        nn.init.zeros_(self.box.bias)  # type: ignore[arg-type]
        with torch.no_grad():
            self.box.bias[4] = -math.log(99.0)  # type: ignore[index]  # hardly ever there is one
            self.box.bias[2:4] = 1.0  # type: ignore[index]

    def forward(self, images: Tensor) -> Tensor:
        """See the class."""
        top, middle, fine = self.maps((images - self.mean) / self.spread)
        raw = [torch.cat([self.box(self.where(x)), self.classes(self.what(x))], dim=1) for x in
               (fine, middle, top, self.coarser(top))]  # fmt: skip
        if self.training:
            return torch.cat([x.flatten(2) for x in raw], dim=2).transpose(1, 2)
        return torch.cat([decoded(x.flatten(2).transpose(1, 2), places(x.shape[2], x.shape[3], s).to(x), s)
                          for x, s in zip(raw, STRIDES, strict=True)], dim=1)  # fmt: skip


def _tower(channels: int) -> list[nn.Module]:
    return [Convolution(channels, channels, 5, groups=channels), Convolution(channels, channels)]


def places(rows: int, columns: int, stride: int) -> Tensor:
    """(rows * columns, 2) x and y of the middles of a map's cells, pixels."""
    y = (torch.arange(rows) + 0.5) * stride
    x = (torch.arange(columns) + 0.5) * stride
    return torch.stack([x[None].expand(rows, columns), y[:, None].expand(rows, columns)], dim=-1).flatten(0, 1)


def decoded(raw: Tensor, at: Tensor, stride: int | Tensor) -> Tensor:
    """(B, N, 5 + C) centre, width, height in pixels and probabilities, of what the network says at places (N, 2)."""
    centre = at + raw[..., :2] * stride
    size = torch.exp(raw[..., 2:4].clamp(-MOST, MOST)) * stride
    return torch.cat([centre, size, torch.sigmoid(raw[..., 4:])], dim=-1)


def grid(height: int, width: int) -> tuple[Tensor, Tensor]:
    """(N, 2) places and (N, 1) strides of a picture's maps, in the network's order."""
    sizes = [(height // s, width // s, s) for s in STRIDES]
    at = torch.cat([places(*size) for size in sizes])
    return at, torch.cat([torch.full((rows * columns, 1), float(s)) for rows, columns, s in sizes])


def corners(boxes: Tensor) -> Tensor:
    """(..., 4) x0, y0, x1, y1 of centre, width, height."""
    return torch.cat([boxes[..., :2] - boxes[..., 2:] / 2, boxes[..., :2] + boxes[..., 2:] / 2], dim=-1)


def overlap(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """(N,) intersection over union of boxes (N, 4) by corners, and its generalised form (Rezatofighi et al. 2019)."""
    low, high = torch.maximum(a[:, :2], b[:, :2]), torch.minimum(a[:, 2:], b[:, 2:])
    both = (high - low).clamp(min=0).prod(dim=1)
    either = (a[:, 2:] - a[:, :2]).prod(dim=1) + (b[:, 2:] - b[:, :2]).prod(dim=1) - both
    around = (torch.maximum(a[:, 2:], b[:, 2:]) - torch.minimum(a[:, :2], b[:, :2])).prod(dim=1)
    iou = both / either.clamp(min=1e-6)
    return iou, iou - (around - either) / around.clamp(min=1e-6)


def weighed(raw: Tensor, truth: list[Tensor], ignored: list[Tensor], size: tuple[int, int]) -> dict[str, Tensor]:
    """Losses of what the network says in training, by kind.

    Args:
        truth: of each picture (K, 5) x0, y0, x1, y1 and class.
        ignored: of each picture (I, 4) boxes of which nothing is to be learnt.
        size: height and width of the pictures.
    """
    at, stride = (x.to(raw) for x in grid(*size))
    boxes = decoded(raw, at, stride)
    there, care = torch.zeros_like(raw[..., 4]), torch.ones_like(raw[..., 4])
    wide, named = raw.new_zeros(()), raw.new_zeros(())
    count = 0
    for i, (things, leave) in enumerate(zip(truth, ignored, strict=True)):
        if len(leave):
            inside = ((at[:, None] > leave[None, :, :2]) & (at[:, None] < leave[None, :, 2:])).all(dim=2).any(dim=1)
            care[i] = (~inside).to(raw)
        if not len(things):
            continue
        place, thing = assigned(at, stride[:, 0], things[:, :4])
        iou, generalised = overlap(corners(boxes[i, place, :4]), things[thing, :4])
        there[i, place], care[i, place] = iou.detach().clamp(min=0.1), 1.0
        wide = wide + (1 - generalised).sum()
        kind = F.one_hot(things[thing, 4].long(), raw.shape[2] - 5).to(raw)
        named = named + F.binary_cross_entropy_with_logits(raw[i, place, 5:], kind, reduction="sum")
        count += len(place)
    said = torch.sigmoid(raw[..., 4])
    focus = (said.detach() - there).abs() ** 2 * care
    objects = (focus * F.binary_cross_entropy_with_logits(raw[..., 4], there, reduction="none")).sum()
    n = max(count, 1)
    return {"there": 2.0 * objects / n, "box": 2.0 * wide / n, "class": 0.5 * named / n}


def assigned(at: Tensor, stride: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Which places (P,) are to find which boxes (P,): those near their centres, at strides that fit their size.

    Args:
        at, stride: (N, 2), (N,) of the places.
        boxes: (K, 4); of two that a place might find, it is to find the smaller one.
    """
    middle, size = (boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]
    scale = size.prod(dim=1).sqrt()
    step = stride[:, None]
    fits = (scale[None] < 7 * step) | (step == STRIDES[-1])
    fits &= (scale[None] > 2.6 * step) | (step == STRIDES[0])
    reach = torch.minimum(1.5 * step[..., None], (size / 2)[None].clamp(min=0)).maximum(0.71 * step[..., None])
    near = ((at[:, None] - middle[None]).abs() < reach).all(dim=2) & fits
    cost = torch.where(near, size.prod(dim=1)[None], torch.inf)
    least, which = cost.min(dim=1)
    place = torch.nonzero(torch.isfinite(least))[:, 0]
    return place, which[place]

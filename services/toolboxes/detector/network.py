"""The project's own detection network. Import late: loads torch.

Backbone of the segmentation network (`segmentation.network`) with feature maps at strides 8 to 64; each cell of a map
predicts a box, objectness and class scores: anchor-free, like FCOS (Tian et al., ICCV 2019) and YOLOX (Ge et al.,
2021).
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from scan2sim.segmentation.network import Convolution, Pyramid

STRIDES = (8, 16, 32, 64)
MAX_LOG_SIDE = 6.0
"""Upper bound of the logarithm of a box's side in strides."""


class VehicleNet(Pyramid):
    """Detector: images (B, 3, H, W) in [0, 1], H and W multiples of 64, to (B, N, 5 + classes).

    N is the number of cells of all strides. Output in training: offset of the box's centre from the cell's centre and
    logarithm of its width and height (both in strides), logits of objectness and classes. In evaluation: centre, width
    and height in pixels, and probabilities.

    Args:
        classes: number of classes.
        pyramid: channels of the feature maps.
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
            self.box.bias[4] = -math.log(99.0)  # type: ignore[index]  # prior: 1 % of the cells have an object
            self.box.bias[2:4] = 1.0  # type: ignore[index]

    def forward(self, images: Tensor) -> Tensor:
        """Output as described at the class; in evaluation the mean of those for the images and their mirror images."""
        seen = (images - self.mean) / self.spread
        if self.training:
            return torch.cat([x.flatten(2) for x in self._raw(seen)], dim=2).transpose(1, 2)
        return torch.cat(
            [
                _mean(_decoded(plain, s), _decoded(_mirrored(mirrored), s))
                for plain, mirrored, s in zip(self._raw(seen), self._raw(seen.flip(3)), STRIDES, strict=True)
            ],
            dim=1,
        )

    def _raw(self, seen: Tensor) -> list[Tensor]:
        """Raw outputs (B, 5 + classes, H / s, W / s) for each stride s."""
        top, middle, fine = self.maps(seen)
        levels = (fine, middle, top, self.coarser(top))
        return [torch.cat([self.box(self.where(x)), self.classes(self.what(x))], dim=1) for x in levels]


def _decoded(raw: Tensor, stride: int) -> Tensor:
    """(B, h * w, 5 + C) boxes and probabilities of a raw map (B, 5 + C, h, w)."""
    centres = cell_centres(raw.shape[2], raw.shape[3], stride).to(raw)
    return decode(raw.flatten(2).transpose(1, 2), centres, stride)


def _mirrored(raw: Tensor) -> Tensor:
    """Raw map of the mirror image, mirrored back."""
    back = raw.flip(3)
    return torch.cat([-back[:, :1], back[:, 1:]], dim=1)


def _mean(a: Tensor, b: Tensor) -> Tensor:
    """Mean of two decoded outputs; boxes are weighted by their objectness."""
    share = a[..., 4:5] / (a[..., 4:5] + b[..., 4:5] + 1e-9)
    return torch.cat([a[..., :4] * share + b[..., :4] * (1 - share), (a[..., 4:] + b[..., 4:]) / 2], dim=-1)


def _tower(channels: int) -> list[nn.Module]:
    return [Convolution(channels, channels, 5, groups=channels), Convolution(channels, channels)]


def cell_centres(rows: int, columns: int, stride: int) -> Tensor:
    """(rows * columns, 2) x and y of the centres of a feature map's cells, pixels."""
    y = (torch.arange(rows) + 0.5) * stride
    x = (torch.arange(columns) + 0.5) * stride
    return torch.stack([x[None].expand(rows, columns), y[:, None].expand(rows, columns)], dim=-1).flatten(0, 1)


def decode(raw: Tensor, centres: Tensor, stride: int | Tensor) -> Tensor:
    """Decode raw outputs of cells with centres (N, 2) to (B, N, 5 + C): box in pixels and probabilities."""
    centre = centres + raw[..., :2] * stride
    size = torch.exp(raw[..., 2:4].clamp(-MAX_LOG_SIDE, MAX_LOG_SIDE)) * stride
    return torch.cat([centre, size, torch.sigmoid(raw[..., 4:])], dim=-1)


def cells(height: int, width: int) -> tuple[Tensor, Tensor]:
    """(N, 2) centres and (N, 1) strides of all cells of an image, in the order of the network's output."""
    sizes = [(height // s, width // s, s) for s in STRIDES]
    centres = torch.cat([cell_centres(*size) for size in sizes])
    return centres, torch.cat([torch.full((rows * columns, 1), float(s)) for rows, columns, s in sizes])


def box_corners(boxes: Tensor) -> Tensor:
    """Convert boxes (..., 4) from centre, width, height to corners x0, y0, x1, y1."""
    return torch.cat([boxes[..., :2] - boxes[..., 2:] / 2, boxes[..., :2] + boxes[..., 2:] / 2], dim=-1)


def iou_and_giou(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """(N,) IoU of pairs of boxes (N, 4) given by corners, and generalized IoU (Rezatofighi et al., 2019)."""
    low, high = torch.maximum(a[:, :2], b[:, :2]), torch.minimum(a[:, 2:], b[:, 2:])
    intersection = (high - low).clamp(min=0).prod(dim=1)
    union = (a[:, 2:] - a[:, :2]).prod(dim=1) + (b[:, 2:] - b[:, :2]).prod(dim=1) - intersection
    hull = (torch.maximum(a[:, 2:], b[:, 2:]) - torch.minimum(a[:, :2], b[:, :2])).prod(dim=1)
    iou = intersection / union.clamp(min=1e-6)
    return iou, iou - (hull - union) / hull.clamp(min=1e-6)


def detection_losses(
    raw: Tensor, truth: list[Tensor], ignored: list[Tensor], size: tuple[int, int]
) -> dict[str, Tensor]:
    """Weighted training losses of raw outputs: objectness, box (GIoU) and class.

    Args:
        raw: (B, N, 5 + C) output in training.
        truth: for each image (K, 5) x0, y0, x1, y1 and class.
        ignored: for each image (I, 4) boxes without a loss.
        size: height and width of the images.
    """
    centres, stride = (x.to(raw) for x in cells(*size))
    boxes = decode(raw, centres, stride)
    target, weight = torch.zeros_like(raw[..., 4]), torch.ones_like(raw[..., 4])
    box_loss, class_loss = raw.new_zeros(()), raw.new_zeros(())
    count = 0
    for i, (objects, leave) in enumerate(zip(truth, ignored, strict=True)):
        if len(leave):
            inside = (centres[:, None] > leave[None, :, :2]) & (centres[:, None] < leave[None, :, 2:])
            weight[i] = (~inside.all(dim=2).any(dim=1)).to(raw)
        if not len(objects):
            continue
        cell, assigned = assign_targets(centres, stride[:, 0], objects[:, :4])
        iou, giou = iou_and_giou(box_corners(boxes[i, cell, :4]), objects[assigned, :4])
        target[i, cell], weight[i, cell] = iou.detach().clamp(min=0.1), 1.0
        box_loss = box_loss + (1 - giou).sum()
        one_hot = F.one_hot(objects[assigned, 4].long(), raw.shape[2] - 5).to(raw)
        class_loss = class_loss + F.binary_cross_entropy_with_logits(raw[i, cell, 5:], one_hot, reduction="sum")
        count += len(cell)
    predicted = torch.sigmoid(raw[..., 4])
    focus = (predicted.detach() - target).abs() ** 2 * weight
    object_loss = (focus * F.binary_cross_entropy_with_logits(raw[..., 4], target, reduction="none")).sum()
    n = max(count, 1)
    return {"objectness": 2.0 * object_loss / n, "box": 2.0 * box_loss / n, "class": 0.5 * class_loss / n}


def assign_targets(centres: Tensor, stride: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Assign true boxes to cells near their centres, at strides that fit the size of the box.

    Args:
        centres, stride: (N, 2), (N,) of the cells.
        boxes: (K, 4); a cell with several candidates gets the smallest box.

    Returns:
        (P,) indices of the cells and (P,) indices of the boxes assigned to them.
    """
    middle, size = (boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]
    scale = size.prod(dim=1).sqrt()
    step = stride[:, None]
    fits = (scale[None] < 7 * step) | (step == STRIDES[-1])
    fits &= (scale[None] > 2.6 * step) | (step == STRIDES[0])
    radius = torch.minimum(1.5 * step[..., None], (size / 2)[None].clamp(min=0)).maximum(0.71 * step[..., None])
    near = ((centres[:, None] - middle[None]).abs() < radius).all(dim=2) & fits
    cost = torch.where(near, size.prod(dim=1)[None], torch.inf)
    smallest, which = cost.min(dim=1)
    cell = torch.nonzero(torch.isfinite(smallest))[:, 0]
    return cell, which[cell]

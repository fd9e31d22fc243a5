"""Training of the project's own network on labelled photos. Import late: loads torch.

From a folder as `segmentation.labelled` reads it. Runs are repeatable for a seed, on one machine with one number of
threads.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F

from scan2sim.pipeline.step import Report, silent
from scan2sim.pipeline.types import F32, U8
from scan2sim.segmentation.labelled import pairs, read, split
from scan2sim.segmentation.labels import CLASSES, IGNORED, index_of_code
from scan2sim.segmentation.network import StreetNet

Ints = npt.NDArray[np.int64]

MEMORY = 0.002
"""Share of a step's weights in their running mean."""


@dataclass(frozen=True)
class Recipe:
    """How the network is trained.

    Attributes:
        steps: of the optimiser.
        batch, crop: photos a step, and pixels of each, height and width.
        rate: the highest learning rate, of one cycle.
        held_out: share of the streets (the names' first part) that figures are told from.
        minutes: at most; the cycle is shortened to fit, 0: no limit.
        seed: of weights, crops and looks.
    """

    steps: int = 3000
    batch: int = 8
    crop: tuple[int, int] = (288, 384)
    rate: float = 3e-3
    held_out: float = 0.05
    minutes: float = 0
    seed: int = 0


@dataclass(frozen=True)
class Trained:
    """A network, and how it does on streets that it wasn't trained on: intersection over union, by class."""

    network: StreetNet
    iou: dict[str, float]


def train(folder: Path, recipe: Recipe, report: Report = silent) -> Trained:
    """Train on the labelled photos of a folder."""
    torch.manual_seed(recipe.seed)
    rng = np.random.default_rng(recipe.seed)
    learn, check = split(pairs(folder), recipe.held_out)
    network = StreetNet(len(CLASSES))
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    weight = class_weights([label for _, label in learn])
    optimiser = torch.optim.AdamW(network.parameters(), recipe.rate, weight_decay=1e-2)
    smooth = torch.optim.swa_utils.AveragedModel(network, avg_fn=_averaged, use_buffers=True)
    network.train()
    start, done = time.monotonic(), 0.0
    step = 0
    while done < 1:
        spent = (time.monotonic() - start) / 60
        done = max(step / recipe.steps, spent / recipe.minutes if recipe.minutes else 0.0)
        for group in optimiser.param_groups:
            group["lr"] = recipe.rate * _one_cycle(done)
        some = [learn[i] for i in rng.integers(0, len(learn), recipe.batch)]
        views = [seen_anew(*read(*pair), recipe.crop, rng) for pair in some]
        rgb = torch.from_numpy(np.stack([image for image, _ in views])).permute(0, 3, 1, 2)
        truth = torch.from_numpy(np.stack([label for _, label in views]))
        logits = network(rgb.contiguous(memory_format=torch.channels_last))
        loss = F.cross_entropy(
            F.interpolate(logits, scale_factor=2, mode="bilinear"), truth[:, 1::2, 1::2], weight, ignore_index=IGNORED
        )
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 2.0)
        optimiser.step()
        smooth.update_parameters(network)
        step += 1
        report(min(done, 0.99), f"step {step}, loss {loss.item():.3f}, {60 * spent:.0f} s")
    best = smooth.module
    assert isinstance(best, StreetNet)
    best.eval()
    return Trained(best, evaluate(best, check) if check else {})


def _averaged(mean: torch.Tensor, new: torch.Tensor, n: torch.Tensor | int) -> torch.Tensor:
    """A running mean of weights over some 500 steps, over fewer at the beginning."""
    return mean + (new - mean) * max(MEMORY, 9 / (10 + int(n)))


def _one_cycle(done: float) -> float:
    """Share of the highest rate: up over the first twentieth, down along a cosine."""
    return min(1.0, done / 0.05 + 0.02) * 0.5 * (1 + math.cos(math.pi * min(1.0, done)))


def class_weights(labels: Sequence[Path]) -> torch.Tensor:
    """(C,) what an error costs by class: rare ones more, by the root of their share."""
    import cv2

    count = np.zeros(256)
    for label in labels[:: max(1, len(labels) // 100)]:
        count += np.bincount(index_of_code()[cv2.imread(str(label), cv2.IMREAD_GRAYSCALE)].ravel(), minlength=256)
    share = count[: len(CLASSES)] / count[: len(CLASSES)].sum()
    weight = np.where(share > 0, 1 / np.sqrt(np.maximum(share, 2e-3)), 0)
    return torch.tensor(weight / weight[weight > 0].mean(), dtype=torch.float32)


def seen_anew(rgb: U8, label: U8, crop: tuple[int, int], rng: np.random.Generator) -> tuple[F32, Ints]:
    """A part of a photo as another camera might have taken it on another day: (h, w, 3) in [0, 1], (h, w)."""
    import cv2

    scale = float(np.exp(rng.uniform(np.log(0.7), np.log(1.5))))
    h, w = crop
    need_h, need_w = min(rgb.shape[0], math.ceil(h / scale)), min(rgb.shape[1], math.ceil(w / scale))
    top, left = rng.integers(0, rgb.shape[0] - need_h + 1), rng.integers(0, rgb.shape[1] - need_w + 1)
    part = rgb[top : top + need_h, left : left + need_w]
    codes = label[top : top + need_h, left : left + need_w]
    image = cv2.resize(part, (w, h), interpolation=cv2.INTER_LINEAR if scale > 1 else cv2.INTER_AREA)
    truth = cv2.resize(codes, (w, h), interpolation=cv2.INTER_NEAREST)
    if rng.random() < 0.5:
        image, truth = image[:, ::-1], truth[:, ::-1]
    return looks(image, rng), np.ascontiguousarray(truth, np.int64)


def looks(image: U8, rng: np.random.Generator) -> F32:
    """Other light, white balance, contrast, sharpness, noise and compression: (h, w, 3) in [0, 1]."""
    import cv2

    x = np.ascontiguousarray(image).astype(np.float32) / 255
    if rng.random() < 0.3:
        x = cv2.GaussianBlur(x, (0, 0), float(rng.uniform(0.3, 1.5)))
    x = x ** np.float32(np.exp(rng.uniform(-0.5, 0.5)))
    x = x * np.exp(rng.normal(0, 0.08, 3) + rng.normal(0, 0.25)).astype(np.float32)
    grey = x.mean(axis=2, keepdims=True)
    x = grey + (x - grey) * np.float32(rng.uniform(0.3, 1.5))
    x = 0.5 + (x - 0.5) * np.float32(rng.uniform(0.7, 1.4))
    if rng.random() < 0.5:
        x += rng.normal(0, rng.uniform(0, 0.04), x.shape).astype(np.float32)
    x = np.clip(x, 0, 1)
    if rng.random() < 0.3:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(30, 90))]
        x = cv2.imdecode(cv2.imencode(".jpg", (x * 255).astype(np.uint8), quality)[1], -1).astype(np.float32) / 255
    return np.ascontiguousarray(x, np.float32)


@torch.inference_mode()
def evaluate(network: StreetNet, check: Sequence[tuple[Path, Path]]) -> dict[str, float]:
    """Intersection over union of the pixels, by class."""
    n = len(CLASSES)
    confusion = np.zeros((n, n), np.int64)
    for pair in check:
        rgb, truth = read(*pair)
        logits = network(torch.from_numpy(rgb.astype(np.float32) / 255).permute(2, 0, 1)[None])
        found = F.interpolate(logits, size=truth.shape, mode="bilinear")[0].argmax(dim=0).numpy()
        told = truth != IGNORED
        confusion += np.bincount(truth[told].astype(np.int64) * n + found[told], minlength=n * n).reshape(n, n)
    both, either = np.diag(confusion), confusion.sum(axis=0) + confusion.sum(axis=1) - np.diag(confusion)
    return {name: round(float(both[i] / either[i]), 4) for i, name in enumerate(CLASSES) if confusion[i].any()}

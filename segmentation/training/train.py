"""Training of the project's own network on labelled photos. Import late: loads torch.

The folder of labelled photos is described in `segmentation.training.dataset`. Training is reproducible for a seed on
the same machine with the same number of threads.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32, I64
from scan2sim.segmentation.label_images import read_classes
from scan2sim.segmentation.labels import CLASSES, IGNORED
from scan2sim.segmentation.lidar_channels import CHANNELS
from scan2sim.segmentation.network import StreetNet
from scan2sim.segmentation.training.augment import augment
from scan2sim.segmentation.training.dataset import names_of, pairs, read, read_channels, split

AVERAGING_RATE = 0.002
"""Share of a step's weights in the exponential moving average."""


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of the training.

    Attributes:
        steps: number of optimiser steps.
        batch: photos per step.
        crop: height and width of the crops in pixels.
        rate: maximum learning rate of the one-cycle schedule.
        held_out: share of the streets (first part of the file names) used for validation.
        minutes: time limit; the schedule is shortened to fit; 0: no limit.
        seed: seed of initial weights, crops and augmentations.
        start: weights (safetensors) to continue from; None: random weights.
    """

    steps: int = 3000
    batch: int = 8
    crop: tuple[int, int] = (256, 416)
    rate: float = 3e-3
    held_out: float = 0.05
    minutes: float = 0
    seed: int = 0
    start: Path | None = None


@dataclass(frozen=True)
class Trained:
    """A trained network, and its intersection over union by class on the validation streets."""

    network: StreetNet
    iou: dict[str, float]


def train(folder: Path, settings: TrainingSettings, report: Report = silent) -> Trained:
    """Train on the labelled photos of a folder.

    Raises:
        DataError: the folder has no labelled photos.
    """
    torch.manual_seed(settings.seed)
    rng = np.random.default_rng(settings.seed)
    training_pairs, validation_pairs = split(pairs(folder), settings.held_out)
    network = StreetNet(len(CLASSES))
    if settings.start is not None:
        network.load_state_dict(_widened(settings.start), strict=False)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    weight = class_weights([file for _, file in training_pairs])
    optimiser = torch.optim.AdamW(network.parameters(), settings.rate, weight_decay=1e-2)
    smooth = torch.optim.swa_utils.AveragedModel(network, avg_fn=moving_average, use_buffers=True)
    network.train()
    start, done = time.monotonic(), 0.0
    step = 0
    while done < 1:
        spent = (time.monotonic() - start) / 60
        done = max(step / settings.steps, spent / settings.minutes if settings.minutes else 0.0)
        for group in optimiser.param_groups:
            group["lr"] = settings.rate * one_cycle(done)
        some = [training_pairs[i] for i in rng.integers(0, len(training_pairs), settings.batch)]
        views = [_seen(pair, settings.crop, rng) for pair in some]
        seen = torch.from_numpy(np.stack([image for image, _ in views])).permute(0, 3, 1, 2)
        truth = torch.from_numpy(np.stack([classes for _, classes in views]))
        logits = network(seen.contiguous(memory_format=torch.channels_last))
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
    return Trained(best, evaluate(best, validation_pairs) if validation_pairs else {})


def _seen(pair: tuple[Path, Path], crop: tuple[int, int], rng: np.random.Generator) -> tuple[F32, I64]:
    rgb, classes = read(*pair)
    return augment(rgb, classes, read_channels(pair[0], classes.shape), crop, rng)


def _widened(path: Path) -> dict[str, torch.Tensor]:
    """Weights of a `StreetNet`; those of a network without lidar channels get zeros for these channels."""
    from safetensors.torch import load_file

    state = {name: value.float() for name, value in load_file(str(path)).items()}
    first = state["stem.0.weight"]
    missing = 3 + CHANNELS - first.shape[1]
    state["stem.0.weight"] = torch.cat([first, first.new_zeros(len(first), missing, *first.shape[2:])], dim=1)
    return state


def moving_average(mean: torch.Tensor, new: torch.Tensor, n: torch.Tensor | int) -> torch.Tensor:
    """Moving average of weights over about 500 steps, over fewer at the beginning."""
    return mean + (new - mean) * max(AVERAGING_RATE, 9 / (10 + int(n)))


def one_cycle(done: float) -> float:
    """Learning rate as a share of the maximum: rises over the first 5 %, then falls along a cosine."""
    return min(1.0, done / 0.05 + 0.02) * 0.5 * (1 + math.cos(math.pi * min(1.0, done)))


def class_weights(truth: Sequence[Path]) -> torch.Tensor:
    """(C,) weights of the loss by class: inverse root of the class's share, so that rare classes count more."""
    count = np.zeros(256)
    for file in truth[:: max(1, len(truth) // 100)]:
        count += np.bincount(read_classes(file, names_of(file)).ravel(), minlength=256)
    share = count[: len(CLASSES)] / count[: len(CLASSES)].sum()
    weight = np.where(share > 0, 1 / np.sqrt(np.maximum(share, 4e-3)), 0)
    return torch.tensor(weight / weight[weight > 0].mean(), dtype=torch.float32)


@torch.inference_mode()
def evaluate(network: StreetNet, validation_pairs: Sequence[tuple[Path, Path]]) -> dict[str, float]:
    """Intersection over union of the pixels by class."""
    import cv2

    n = len(CLASSES)
    confusion = np.zeros((n, n), np.int64)
    for pair in validation_pairs:
        rgb, truth = read(*pair)
        codes = cv2.resize(read_channels(pair[0], truth.shape), truth.shape[::-1], interpolation=cv2.INTER_NEAREST)
        seen = np.concatenate([rgb, codes], axis=2).astype(np.float32) / 255
        logits = network(torch.from_numpy(seen).permute(2, 0, 1)[None])
        found = F.interpolate(logits, size=truth.shape, mode="bilinear")[0].argmax(dim=0).numpy()
        labelled = truth != IGNORED
        confusion += np.bincount(truth[labelled].astype(np.int64) * n + found[labelled], minlength=n * n).reshape(n, n)
    both, either = np.diag(confusion), confusion.sum(axis=0) + confusion.sum(axis=1) - np.diag(confusion)
    return {name: round(float(both[i] / either[i]), 4) for i, name in enumerate(CLASSES) if confusion[i].any()}

"""Training of the project's own detector. Import late: loads torch.

`python -m scan2sim.services.toolboxes.detector.train FOLDER --out vehicles.onnx [--minutes 60] [--start WEIGHTS]`
trains on a dataset (`detector.dataset`). Training is reproducible for a seed, on the same machine with the same number
of threads and without a time limit. A checkpoint is written every ten minutes; `--start` continues from it.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32
from scan2sim.segmentation.backends.street import DEFAULT_WEIGHTS as STREET
from scan2sim.segmentation.training.train import moving_average, one_cycle
from scan2sim.services.toolboxes.detector.dataset import LabelledImage, augmented_crop, read
from scan2sim.services.toolboxes.detector.export import export
from scan2sim.services.toolboxes.detector.network import VehicleNet, detection_losses

PRETRAINED_WEIGHTS = STREET.with_suffix(".safetensors")
"""Initial weights of the backbone: those of the segmentation network, which was trained on similar images."""
CHECKPOINT_INTERVAL_S = 600.0
"""Pause between two checkpoints."""

Sample = tuple[F32, F32, F32]
"""Result of `dataset.augmented_crop`."""


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of the training.

    Attributes:
        steps: number of optimiser steps.
        crops: possible heights and widths of the crops, multiples of 64; one is chosen per step.
        pixels: approximate number of pixels of a batch.
        rate: maximum learning rate of the one-cycle schedule.
        minutes: time limit, to which the schedule is shortened; 0: no limit.
        seed: random seed of weights, crops and augmentation.
    """

    steps: int = 6000
    crops: tuple[tuple[int, int], ...] = ((256, 320), (320, 448), (384, 640))
    pixels: float = 1.3e6
    rate: float = 2e-3
    minutes: float = 0
    seed: int = 0


def train(
    folder: Path,
    settings: TrainingSettings,
    start: Path | None = PRETRAINED_WEIGHTS,
    report: Report = silent,
    checkpoint: Callable[[VehicleNet], None] | None = None,
) -> VehicleNet:
    """Train on a dataset and return the network with averaged weights.

    Args:
        folder: the dataset.
        settings: settings of the training.
        start: weights (safetensors) to start from, of the backbone or the whole network; None: random weights.
        report: progress callback.
        checkpoint: called with the network every `CHECKPOINT_INTERVAL_S`.
    """
    torch.manual_seed(settings.seed)
    rng = np.random.default_rng(settings.seed)
    images, names = read(folder)
    network = VehicleNet(len(names))
    if start is not None:
        load_matching(network, start)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimiser = torch.optim.AdamW(network.parameters(), settings.rate, weight_decay=1e-2)
    averaged_model = torch.optim.swa_utils.AveragedModel(network, avg_fn=moving_average, use_buffers=True).eval()
    averaged = averaged_model.module
    assert isinstance(averaged, VehicleNet)
    network.train()
    for early in (network.stem, network.stages[0]):  # frozen if pretrained: generic edge filters, and the slowest part
        early.requires_grad_(start is None).train(start is None)
    _keep_depthwise_in_float32(network)
    begin, done, step, checkpoints = time.monotonic(), 0.0, 0, 0
    batches = _prefetched(partial(_batch, images, settings, rng))
    while done < 1:
        spent = (time.monotonic() - begin) / 60
        done = max(step / settings.steps, spent / settings.minutes if settings.minutes else 0.0)
        for group in optimiser.param_groups:
            group["lr"] = settings.rate * one_cycle(done)
        losses = batch_losses(network, next(batches))
        loss = torch.stack(list(losses.values())).sum()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        averaged_model.update_parameters(network)
        step += 1
        summary = ", ".join(f"{name} {value.item():.3f}" for name, value in losses.items())
        report(min(done, 0.99), f"step {step}, {summary}, {60 * spent:.0f} s")
        if checkpoint is not None and 60 * spent > CHECKPOINT_INTERVAL_S * (checkpoints + 1):
            checkpoints += 1
            checkpoint(averaged)
    return averaged


def _batch(images: list[LabelledImage], settings: TrainingSettings, rng: np.random.Generator) -> list[Sample]:
    """Random samples of one training step."""
    crop = settings.crops[rng.integers(len(settings.crops))]
    count = max(1, round(settings.pixels / np.prod(crop)))
    return [augmented_crop(images[i], crop, rng) for i in rng.integers(0, len(images), count)]


def _prefetched(make: Callable[[], list[Sample]]) -> Iterator[list[Sample]]:
    """Iterate over batches from `make`; the next batch is prepared in a thread meanwhile."""
    with ThreadPoolExecutor(1) as pool:
        upcoming = pool.submit(make)
        while True:
            current, upcoming = upcoming.result(), pool.submit(make)
            yield current


def batch_losses(network: VehicleNet, batch: list[Sample]) -> dict[str, torch.Tensor]:
    """Losses of a batch by kind."""
    images = torch.from_numpy(np.stack([image for image, _, _ in batch])).permute(0, 3, 1, 2)
    with torch.autocast("cpu", torch.bfloat16):
        raw = network(images.contiguous(memory_format=torch.channels_last))
    truth, ignored = ([torch.from_numpy(sample[k]) for sample in batch] for k in (1, 2))
    return detection_losses(raw.float(), truth, ignored, batch[0][0].shape[:2])


def _keep_depthwise_in_float32(network: VehicleNet) -> None:
    """Exclude depthwise convolutions from mixed precision: their gradients are slow in half precision."""
    for module in network.modules():
        if isinstance(module, torch.nn.Conv2d) and module.groups > 1:
            module.forward = partial(_forward_float32, module)  # type: ignore[method-assign]


def _forward_float32(module: torch.nn.Conv2d, x: torch.Tensor) -> torch.Tensor:
    with torch.autocast("cpu", enabled=False):
        return torch.nn.Conv2d.forward(module, x.float()).bfloat16()


def load_matching(network: VehicleNet, weights: Path) -> None:
    """Load the weights with matching name and shape; of the first layer only those of the colour channels."""
    from safetensors.torch import load_file

    own = network.state_dict()
    for name, value in load_file(str(weights)).items():
        if name in own:
            fitting = value.float()[:, : own[name].shape[1]] if name == "stem.0.weight" else value.float()
            if fitting.shape == own[name].shape:
                own[name] = fitting
    network.load_state_dict(own)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="dataset with images/, boxes.jsonl and classes.json")
    parser.add_argument("--out", type=Path, default=Path("vehicles.onnx"), help="ONNX file to write")
    parser.add_argument("--minutes", type=float, default=0, help="time limit of the training; 0: none")
    parser.add_argument("--steps", type=int, default=TrainingSettings.steps, help="number of optimiser steps")
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="CPU threads")
    parser.add_argument("--start", type=Path, default=PRETRAINED_WEIGHTS, help="weights to start from (safetensors)")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    settings = TrainingSettings(steps=arguments.steps, minutes=arguments.minutes, seed=arguments.seed)

    def report(fraction: float, message: str = "") -> None:
        print(f"\r{fraction:6.1%}  {message:70}", end="", flush=True)

    names = json.loads((arguments.folder / "classes.json").read_text(encoding="utf-8"))

    def write(network: VehicleNet) -> None:
        export(network, arguments.out, names, {"recipe": asdict(settings)})

    write(train(arguments.folder, settings, arguments.start, report, write))
    print(f"\n{arguments.out}")


if __name__ == "__main__":
    main()

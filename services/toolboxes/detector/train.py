"""Training of the project's own detector. Import late: loads torch.

`python -m scan2sim.services.toolboxes.detector.train FOLDER --out vehicles.onnx [--minutes 60] [--start WEIGHTS]`
trains on a dataset (`detector.dataset`), or on several in equal parts. Training is reproducible for a seed, on the same
machine with the same number of threads and without a time limit. A checkpoint beside the output file is written every
five minutes; the same command resumes an interrupted training from it.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32
from scan2sim.segmentation.backends.street import DEFAULT_WEIGHTS as STREET
from scan2sim.segmentation.training.train import moving_average, one_cycle
from scan2sim.services.toolboxes import models
from scan2sim.services.toolboxes.detector.dataset import LabelledImage, augmented_crop, read
from scan2sim.services.toolboxes.detector.export import LICENCE, export
from scan2sim.services.toolboxes.detector.network import VehicleNet, detection_losses

PRETRAINED_WEIGHTS = STREET.with_suffix(".safetensors")
"""Initial weights of the backbone: those of the segmentation network, which was trained on similar images."""
OWN_WEIGHTS = models.FOLDER / "vehicles.safetensors"
"""Weights of the included detector."""
FINE_TUNING_RATE = 3e-4
"""Maximum learning rate when training continues from weights of the detector."""
CHECKPOINT_INTERVAL_S = 300.0
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
    folders: Sequence[Path],
    settings: TrainingSettings,
    start: Path | None = PRETRAINED_WEIGHTS,
    report: Report = silent,
    checkpoint: Path | None = None,
) -> VehicleNet:
    """Train on datasets and return the network with averaged weights.

    Args:
        folders: datasets with the same classes, each of which gives the same part of the samples.
        settings: settings of the training.
        start: weights (safetensors) to start from, of the backbone or the whole network; None: random weights.
        report: progress callback.
        checkpoint: safetensors file written every `CHECKPOINT_INTERVAL_S`, from which an interrupted training with the
            same settings and datasets is resumed; deleted at the end.

    Raises:
        DataError: a dataset is empty or malformed, or the datasets have different classes.
    """
    torch.manual_seed(settings.seed)
    datasets, names = _read_all(folders)
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
    state = _State(network, averaged_model, optimiser, _identity(settings, [len(images) for images in datasets]))
    step, earlier_s = state.load(checkpoint)
    begin, done, saved_s = time.monotonic() - earlier_s, 0.0, earlier_s
    batches = _prefetched(partial(_batch, datasets, settings), step)
    while done < 1:
        spent = time.monotonic() - begin
        done = max(step / settings.steps, spent / 60 / settings.minutes if settings.minutes else 0.0)
        for group in optimiser.param_groups:
            group["lr"] = settings.rate * one_cycle(min(done, 1.0))
        losses = batch_losses(network, next(batches))
        loss = torch.stack(list(losses.values())).sum()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        averaged_model.update_parameters(network)
        step += 1
        summary = ", ".join(f"{name} {value.item():.3f}" for name, value in losses.items())
        report(min(done, 0.99), f"step {step}, {summary}, {spent:.0f} s")
        if checkpoint is not None and spent - saved_s > CHECKPOINT_INTERVAL_S:
            saved_s = spent
            state.save(checkpoint, step, spent)
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    return averaged


def _read_all(folders: Sequence[Path]) -> tuple[list[list[LabelledImage]], list[str]]:
    """Images of each dataset, and the names of the classes.

    Raises:
        DataError: as of `read`, or the datasets have different classes.
    """
    found = [read(folder) for folder in folders]
    names = found[0][1]
    for folder, (_, others) in zip(folders, found, strict=True):
        if others != names:
            cause = f"has the classes {others}, {folders[0]} has {names}"
            raise DataError(folder / "classes.json", cause, "Train on datasets with the same classes")
    return [images for images, _ in found], names


def _identity(settings: TrainingSettings, counts: Sequence[int]) -> str:
    """Identifies a training: a checkpoint of another one is not used."""
    return json.dumps([asdict(settings), list(counts)])


class _State:
    """State of a training that a checkpoint contains: weights, averaged weights, optimiser."""

    def __init__(
        self,
        network: VehicleNet,
        averaged: torch.optim.swa_utils.AveragedModel,
        optimiser: torch.optim.Optimizer,
        identity: str,
    ) -> None:
        self._modules: dict[str, torch.nn.Module] = {"network": network, "averaged": averaged}
        self._optimiser, self._identity = optimiser, identity

    def save(self, path: Path, step: int, spent_s: float) -> None:
        """Write the checkpoint; an older one is replaced."""
        from safetensors.torch import save_file

        tensors = {
            f"{kind}.{name}": value for kind, one in self._modules.items() for name, value in one.state_dict().items()
        }
        for index, values in self._optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{index}.{name}": value for name, value in values.items()}
        metadata = {"identity": self._identity, "step": str(step), "spent_s": str(spent_s)}
        partial_file = path.with_suffix(".part")
        save_file({name: value.contiguous().clone() for name, value in tensors.items()}, partial_file, metadata)
        partial_file.replace(path)

    def load(self, path: Path | None) -> tuple[int, float]:
        """Continue from a checkpoint; returns its step and the seconds spent, zeros without one of this training."""
        from safetensors import safe_open

        if path is None or not path.is_file():
            return 0, 0.0
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("identity") != self._identity:
                return 0, 0.0
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        for kind, one in self._modules.items():
            one.load_state_dict(_below(tensors, f"{kind}."))
        optimiser: dict[int, dict[str, Any]] = {}
        for name, value in _below(tensors, "optimiser.").items():
            index, _, key = name.partition(".")
            optimiser.setdefault(int(index), {})[key] = value
        self._optimiser.load_state_dict(self._optimiser.state_dict() | {"state": optimiser})
        return int(metadata["step"]), float(metadata["spent_s"])


def _below(tensors: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def _batch(datasets: Sequence[Sequence[LabelledImage]], settings: TrainingSettings, step: int) -> list[Sample]:
    """Random samples of a training step."""
    rng = np.random.default_rng([settings.seed, step])
    crop = settings.crops[rng.integers(len(settings.crops))]
    count = max(1, round(settings.pixels / np.prod(crop)))
    chosen = [datasets[i % len(datasets)] for i in range(step, step + count)]
    return [augmented_crop(images[int(rng.integers(len(images)))], crop, rng) for images in chosen]


def _prefetched(make: Callable[[int], list[Sample]], first: int) -> Iterator[list[Sample]]:
    """Iterate over batches of the steps from `first` on; the next batch is prepared in a thread meanwhile."""
    with ThreadPoolExecutor(1) as pool:
        upcoming = pool.submit(make, first)
        for step in itertools.count(first + 1):
            current, upcoming = upcoming.result(), pool.submit(make, step)
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


def train_and_export(
    folders: Sequence[Path],
    out: Path,
    settings: TrainingSettings,
    start: Path | None,
    report: Report = silent,
    license_: str = LICENCE,
) -> None:
    """Train on datasets (see `train`) and write the network as ONNX, and its weights beside it."""
    names = json.loads((folders[0] / "classes.json").read_text(encoding="utf-8"))
    out.parent.mkdir(parents=True, exist_ok=True)
    network = train(folders, settings, start, report, out.with_suffix(".checkpoint"))
    export(network, out, names, {"recipe": asdict(settings), "license": license_})


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="+", help="dataset with images/, boxes.jsonl and classes.json")
    parser.add_argument("--out", type=Path, default=Path("vehicles.onnx"), help="ONNX file to write")
    parser.add_argument("--minutes", type=float, default=0, help="time limit of the training; 0: none")
    parser.add_argument("--steps", type=int, default=TrainingSettings.steps, help="number of optimiser steps")
    parser.add_argument("--rate", type=float, default=TrainingSettings.rate, help="maximum learning rate")
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="CPU threads")
    parser.add_argument("--start", type=Path, default=PRETRAINED_WEIGHTS, help="weights to start from (safetensors)")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    settings = TrainingSettings(
        steps=arguments.steps, rate=arguments.rate, minutes=arguments.minutes, seed=arguments.seed
    )

    def report(fraction: float, message: str = "") -> None:
        print(f"\r{fraction:6.1%}  {message:70}", end="", flush=True)

    train_and_export(arguments.folder, arguments.out, settings, arguments.start, report)
    print(f"\n{arguments.out}")


if __name__ == "__main__":
    main()

"""Training of the project's own detector. Import late: loads torch.

`python -m scan2sim.services.toolboxes.detector.train FOLDER --out vehicles.onnx [--minutes 60] [--start WEIGHTS]`: from
a folder as `labelled` reads it. Runs are repeatable for a seed, on one machine with one number of threads, unless a
time limit cuts them short. Every ten minutes the network is written as it is, to go on from with `--start`.
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
from scan2sim.segmentation.backends.street import OWN as STREET
from scan2sim.segmentation.training.train import averaged, one_cycle
from scan2sim.services.toolboxes.detector.dataset import Labelled, read, seen
from scan2sim.services.toolboxes.detector.export import export
from scan2sim.services.toolboxes.detector.network import VehicleNet, weighed

STREETS = STREET.with_suffix(".safetensors")
"""What the trunk starts from: the segmentation network, which has seen such pictures."""


KEPT = 600.0
"""Seconds between networks that are kept while training goes on."""

View = tuple[F32, F32, F32]
"""See `labelled.seen`."""


@dataclass(frozen=True)
class Recipe:
    """How the network is trained.

    Attributes:
        steps: of the optimiser.
        crops: height and width of what is seen of pictures, multiples of 64, one of them each step.
        pixels: of all pictures of a step together, about.
        rate: the highest learning rate, of one cycle.
        minutes: at most; the cycle is shortened to fit, 0: no limit.
        seed: of weights, crops and looks.
    """

    steps: int = 6000
    crops: tuple[tuple[int, int], ...] = ((256, 320), (320, 448), (384, 640))
    pixels: float = 1.3e6
    rate: float = 2e-3
    minutes: float = 0
    seed: int = 0


def train(
    folder: Path,
    recipe: Recipe,
    start: Path | None = STREETS,
    report: Report = silent,
    keep: Callable[[VehicleNet], None] | None = None,
) -> VehicleNet:
    """Train on a folder's pictures; with the trunk, or all, of weights (safetensors) that fit.

    Args:
        keep: given the network every `KEPT` seconds.
    """
    torch.manual_seed(recipe.seed)
    rng = np.random.default_rng(recipe.seed)
    pictures, names = read(folder)
    network = VehicleNet(len(names))
    if start is not None:
        begin_with(network, start)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimiser = torch.optim.AdamW(network.parameters(), recipe.rate, weight_decay=1e-2)
    smooth = torch.optim.swa_utils.AveragedModel(network, avg_fn=averaged, use_buffers=True).eval()
    best = smooth.module
    assert isinstance(best, VehicleNet)
    network.train()
    for early in (network.stem, network.stages[0]):  # they have learnt edges, and cost most
        early.requires_grad_(start is None).train(start is None)
    _mixed(network)
    begin, done, step, kept = time.monotonic(), 0.0, 0, 0
    views = _ahead(partial(_views, pictures, recipe, rng))
    while done < 1:
        spent = (time.monotonic() - begin) / 60
        done = max(step / recipe.steps, spent / recipe.minutes if recipe.minutes else 0.0)
        for group in optimiser.param_groups:
            group["lr"] = recipe.rate * one_cycle(done)
        losses = step_losses(network, next(views))
        loss = torch.stack(list(losses.values())).sum()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        smooth.update_parameters(network)
        step += 1
        told = ", ".join(f"{name} {value.item():.3f}" for name, value in losses.items())
        report(min(done, 0.99), f"step {step}, {told}, {60 * spent:.0f} s")
        if keep is not None and 60 * spent > KEPT * (kept + 1):
            kept += 1
            keep(best)
    return best


def _views(pictures: list[Labelled], recipe: Recipe, rng: np.random.Generator) -> list[View]:
    """What a step learns from."""
    crop = recipe.crops[rng.integers(len(recipe.crops))]
    count = max(1, round(recipe.pixels / np.prod(crop)))
    return [seen(pictures[i], crop, rng) for i in rng.integers(0, len(pictures), count)]


def _ahead(make: Callable[[], list[View]]) -> Iterator[list[View]]:
    """What `make` makes, again and again, the next while the last is worked on."""
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(make)
        while True:
            here, coming = coming.result(), pool.submit(make)
            yield here


def step_losses(network: VehicleNet, views: list[View]) -> dict[str, torch.Tensor]:
    """Losses of a step, by kind."""
    images = torch.from_numpy(np.stack([image for image, _, _ in views])).permute(0, 3, 1, 2)
    with torch.autocast("cpu", torch.bfloat16):
        raw = network(images.contiguous(memory_format=torch.channels_last))
    truth, ignored = ([torch.from_numpy(view[k]) for view in views] for k in (1, 2))
    return weighed(raw.float(), truth, ignored, views[0][0].shape[:2])


def _mixed(network: VehicleNet) -> None:
    """Keep convolutions by channel in single precision: in half their gradients take long."""
    for module in network.modules():
        if isinstance(module, torch.nn.Conv2d) and module.groups > 1:
            module.forward = partial(_single, module)  # type: ignore[method-assign]


def _single(module: torch.nn.Conv2d, x: torch.Tensor) -> torch.Tensor:
    with torch.autocast("cpu", enabled=False):
        return torch.nn.Conv2d.forward(module, x.float()).bfloat16()


def begin_with(network: VehicleNet, weights: Path) -> None:
    """Take weights over that have the same name, the first layer's of colours alone."""
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
    parser.add_argument("folder", type=Path, help="of images/, boxes.jsonl and classes.json")
    parser.add_argument("--out", type=Path, default=Path("vehicles.onnx"))
    parser.add_argument("--minutes", type=float, default=0, help="at most; 0: no limit")
    parser.add_argument("--steps", type=int, default=Recipe.steps)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--start", type=Path, default=STREETS, help="weights to go on from")
    a = parser.parse_args()
    torch.set_num_threads(a.threads)
    recipe = Recipe(steps=a.steps, minutes=a.minutes, seed=a.seed)

    def report(fraction: float, message: str = "") -> None:
        print(f"\r{fraction:6.1%}  {message:70}", end="", flush=True)

    names = json.loads((a.folder / "classes.json").read_text(encoding="utf-8"))

    def keep(network: VehicleNet) -> None:
        export(network, a.out, names, {"recipe": asdict(recipe)})

    keep(train(a.folder, recipe, a.start, report, keep))
    print(f"\n{a.out}")


if __name__ == "__main__":
    main()

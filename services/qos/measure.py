"""A toolbox's quality of service, measured: it serves a robot over an environment's network (D3.2, 2.1 and 2.2)."""

from __future__ import annotations

import json
import math
import os
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import psutil
from pydantic import Field

from scan2sim.pipeline.core.errors import InputError, StepError
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.core.step import Params, Report
from scan2sim.pipeline.core.types import U8
from scan2sim.services.qos import deployment, encoding, robot
from scan2sim.services.qos.deployment import Places
from scan2sim.services.qos.encoding import Jpeg
from scan2sim.services.qos.environments import Network, network
from scan2sim.services.qos.host_load import Machine, Usage, machine
from scan2sim.services.qos.probe import Seen
from scan2sim.services.qos.requirements import Environment, Requirements, Service
from scan2sim.services.qos.robot import Answers

ROOT = Path(__file__).resolve().parents[2]
STREET = ROOT / "data_samples" / "tile"
STARTS_WITHIN = 300.0
"""Seconds for a toolbox to be ready."""
PORT = 9000
"""Of a toolbox, where it has the place to itself."""
WARM = 3.0
"""Seconds that the robot asks before anything is measured: what comes first is slow."""
PICTURES = 16
"""That are sent in turn, at most."""
FREE = 0.8
"""Share of a network's rate that images may take: beyond it they wait for each other."""


class MeasureParams(Params):
    """Of a measurement."""

    toolbox: Annotated[str, Field(description="That is measured: detect, movement, classify or segment.")]
    environment: Annotated[Environment, Field(description="Where it runs: robot, edge or cloud.")] = Environment.EDGE
    rate: Annotated[float, Field(ge=0.01, le=1000, description="Images a second that the robot sends.")] = 2.0
    seconds: Annotated[float, Field(ge=1, le=86_400, description="Seconds that it is measured for.")] = 30.0
    images: Annotated[
        File | None, Field(description="Folder of pictures that are sent; default: photos of the synthetic street.")
    ] = None
    quality: Annotated[
        int | None, Field(ge=5, le=100, description="Quality of the JPEGs that are sent; default: the best that fits.")
    ] = None
    budget: Annotated[
        float | None,
        Field(ge=0.01, le=10_000, description="Mbit/s for images; default: as required, within the network's rate."),
    ] = None
    network: Annotated[
        File | None, Field(description="TOML of a network, in place of what the environment's is assumed to be.")
    ] = None
    requirements: Annotated[
        str | None, Field(description="TOML of requirements, or a name of those that come along; default: its own.")
    ] = None


@dataclass(frozen=True)
class Measured:
    """What was measured.

    Attributes:
        answers: what the robot got.
        seen: what the network did to packets; None: there is none.
        usage: what the toolbox took while it worked.
        machine: what it ran on.
        wire_bytes: that crossed the network for images and results, overhead and all.
        encoding: of the images.
    """

    answers: Answers
    seen: Seen | None
    usage: Usage
    machine: Machine
    wire_bytes: int
    encoding: Jpeg

    def values(self) -> dict[str, float | None]:
        """By the metrics of `requirements.Requirements`; None: there is no such thing here."""
        answers, seen = self.answers, self.seen
        return {
            "response_time": answers.response_p95,
            "delay": seen.delay if seen else None,
            "jitter": seen.jitter if seen else None,
            "data_rate": answers.sent * answers.image_bytes * 8e-6 / answers.seconds,
            "bandwidth": self.wire_bytes * 8e-6 / answers.seconds if seen else None,
            "loss_rate": seen.loss_rate if seen else None,
            "error_rate": seen.error_rate if seen else None,
            "cpu_cores": self.machine.cpu_cores,
            "cpu_frequency": self.machine.cpu_frequency,
            "cpu_usage": self.usage.cpu_percent,
            "gpu_cores": self.machine.gpu_cores,
            "gpu_frequency": self.machine.gpu_frequency,
            "gpu_memory": self.machine.gpu_memory,
            "gpu_usage": self.usage.gpu_percent,
            "memory": self.usage.memory_mb,
        }


def measure(params: MeasureParams, service: Service, report: Report) -> Measured:
    """Run a toolbox, and a robot that asks it, over the environment's network.

    Raises:
        InputError: there are no pictures, or the network is too slow for any.
        UnavailableError: no network can be made here (it takes root).
        StepError: the toolbox doesn't start, or the robot fails.
    """
    between = network(params.environment, params.network)
    with tempfile.TemporaryDirectory(prefix="scan2sim-qos-") as folder, deployment.between(between) as ends:
        chosen = _write_pictures(params, service, between, Path(folder))
        report(0.0, "the toolbox starts")
        with _serving(ends, params.toolbox, Path(folder)) as (server, port):
            _answers(_asking(ends, params, folder, port, WARM))
            usage, before = Usage.of(psutil.Process(server.pid)), ends.bytes()
            probing, asking = ends.probe(params.seconds), _asking(ends, params, folder, port, params.seconds)
            began = time.monotonic()
            while asking.poll() is None:
                report(min(1.0, (time.monotonic() - began) / params.seconds), "the robot asks")
                usage = usage.updated()
                time.sleep(0.2)
            answers, usage, seen = _answers(asking), usage.updated(), ends.seen(probing)
            crossed = ends.bytes() - before - (seen.bytes if seen else 0)
    return Measured(answers, seen, usage, machine(), crossed, chosen)


def _write_pictures(params: MeasureParams, service: Service, between: Network | None, folder: Path) -> Jpeg:
    """JPEGs that the robot sends, of the size that the requirements are for, as well as they allow."""
    images = _pictures(params, service.image)
    chosen = encoding_of(images, params, service.of(params.environment), between)
    for number, image in enumerate(images):
        (folder / f"{number:03}.jpg").write_bytes(chosen.encoded(image))
    return chosen


def encoding_of(images: Sequence[U8], params: MeasureParams, required: Requirements, between: Network | None) -> Jpeg:
    """The quality that is asked for, or the best that fits what is allowed, required and there.

    Raises:
        InputError: nothing fits.
    """
    if params.quality is not None:
        return encoding.as_jpeg(images, params.rate, params.quality)
    rate = between.there.rate if between else None
    allowed = (
        params.budget,
        None if params.budget or not required.bandwidth else required.bandwidth.value,
        None if rate is None else FREE * rate * 1e-6,
    )
    return encoding.choose_jpeg(images, params.rate, min((one for one in allowed if one is not None), default=math.inf))


def _pictures(params: MeasureParams, size: tuple[int, int] | None) -> list[U8]:
    """(H, W, 3) RGB."""
    import cv2

    place = params.images or STREET
    found = sorted(path for path in place.rglob("*") if path.suffix.lower() in (".jpg", ".jpeg", ".png"))
    step = max(1, len(found) // PICTURES)
    pictures = [image for path in found[::step][:PICTURES] if (image := cv2.imread(str(path))) is not None]
    if not pictures:
        raise InputError(place, "holds no pictures", "Give --images a folder of JPEGs or PNGs")
    loaded = (np.ascontiguousarray(image[..., ::-1]) for image in pictures)
    return [image if size is None else _fitted(image, size) for image in loaded]


def _fitted(image: U8, size: tuple[int, int]) -> U8:
    """The middle of an image, as large as asked."""
    import cv2

    width, height = size
    scale = max(width / image.shape[1], height / image.shape[0])
    scaled = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    top, left = (scaled.shape[0] - height) // 2, (scaled.shape[1] - width) // 2
    return np.asarray(scaled[top : top + height, left : left + width], np.uint8)


@contextmanager
def _serving(ends: Places, toolbox: str, folder: Path) -> Iterator[tuple[subprocess.Popen[Any], int]]:
    """A toolbox that serves, and its port."""
    local = ends.address == deployment.Here.address
    token = folder / robot.TOKEN
    token.write_text(secrets.token_hex(32), encoding="utf-8")  # beyond the loopback nothing is served without one
    command = [sys.executable, "-m", "scan2sim.flows.cli", "toolbox", "serve", toolbox, "--host", ends.address]
    command += ["--token", str(token)]
    with (folder / "toolbox.log").open("w+") as log:
        server = ends.service(*command, "--port", 0 if local else PORT, stdout=log, stderr=log, env=_environment())
        try:
            yield server, _port(server, folder / "toolbox.log")
        finally:
            server.terminate()
            server.wait()


def _port(server: subprocess.Popen[Any], log: Path) -> int:
    """Where it says that it listens, once it does."""
    limit = time.monotonic() + STARTS_WITHIN
    while server.poll() is None and time.monotonic() < limit:
        for word in log.read_text(encoding="utf-8").split():
            if word.startswith("http://") and word.count(":") >= 2:
                return int(word.split(":")[2].partition("/")[0])
        time.sleep(0.1)
    raise StepError("the toolbox", f"doesn't serve ({log.read_text().strip()[-300:]})", "Try `scan2sim toolbox serve`")


def _asking(ends: Places, params: MeasureParams, folder: str, port: int, seconds: float) -> subprocess.Popen[Any]:
    command = (sys.executable, "-m", robot.__name__, f"http://{ends.address}:{port}", params.toolbox, folder)
    return ends.robot(
        *command, params.rate, seconds, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=_environment()
    )


def _answers(asking: subprocess.Popen[Any]) -> Answers:
    line, errors = asking.communicate()
    if asking.returncode:
        raise StepError("the robot", f"failed ({errors.strip()[-300:]})", "Report it")
    return Answers(**json.loads(line))


def _environment() -> dict[str, str]:
    """This program's own search path for those that it starts."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}

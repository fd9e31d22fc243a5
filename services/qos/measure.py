"""Measure a toolbox's quality of service while it serves a robot over an environment's network (D3.2, 2.1 and 2.2)."""

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
from pydantic import Field

from scan2sim.pipeline.core.errors import InputError, StepError
from scan2sim.pipeline.core.parameters import File
from scan2sim.pipeline.core.step import Params, Report
from scan2sim.pipeline.core.types import U8
from scan2sim.services.qos import deployment, encoding, robot
from scan2sim.services.qos.confidence import trials_needed
from scan2sim.services.qos.deployment import MAX_PROBE_RATE, PROBE_RATE, Hosts
from scan2sim.services.qos.encoding import Jpeg
from scan2sim.services.qos.environments import Network, network
from scan2sim.services.qos.host_load import Machine, Usage, host_values, machine
from scan2sim.services.qos.probe import ProbeResult
from scan2sim.services.qos.requirements import Environment, Requirements, ServiceRequirements
from scan2sim.services.qos.robot import RequestStats

ROOT = Path(__file__).resolve().parents[2]
SAMPLE_IMAGES = ROOT / "data_samples" / "tile"
START_TIMEOUT_S = 300.0
"""Seconds to wait until a toolbox is ready."""
TOOLBOX_PORT = 9000
"""Port of the toolbox on a host of its own."""
WARM_UP_S = 3.0
"""Seconds of requests before the measurement, as the first ones are slow."""
MAX_IMAGES = 16
"""Maximum number of different images to send."""
MIN_SECONDS, MAX_SECONDS = 30.0, 3600.0
"""Shortest and longest default duration of a measurement."""
MAX_LINK_UTILIZATION = 0.8
"""Maximum share of the network's rate used for images; above it, images queue for each other."""


class MeasureParams(Params):
    """Settings of `scan2sim qos measure`."""

    service: Annotated[
        str,
        Field(
            description="Service to measure: detect, movement, classify, segment, teleoperation, or traffic (the event"
            " bus)."
        ),
    ]
    environment: Annotated[Environment, Field(description="Where the service runs: robot, edge or cloud.")] = (
        Environment.EDGE
    )
    rate: Annotated[float, Field(ge=0.01, le=1000, description="Images or events per second.")] = 2.0
    event_bytes: Annotated[
        int, Field(ge=100, le=10_000_000, description="Size of an event in bytes (traffic only; D3.2: about 1 MB).")
    ] = 1_000_000
    seconds: Annotated[
        float | None,
        Field(
            ge=1,
            le=86_400,
            description="Duration of the measurement in seconds. Default: 30, or as long as required loss and error"
            " rates need to be shown, up to an hour.",
        ),
    ] = None
    images: Annotated[
        File | None, Field(description="Folder of images to send. Default: photos of the synthetic street.")
    ] = None
    quality: Annotated[
        int | None, Field(ge=5, le=100, description="JPEG quality of the images. Default: the best that fits.")
    ] = None
    budget: Annotated[
        float | None,
        Field(ge=0.01, le=10_000, description="Mbit/s for images. Default: as required, within the network's rate."),
    ] = None
    network: Annotated[File | None, Field(description="TOML file that replaces the environment's assumed network.")] = (
        None
    )
    requirements: Annotated[
        str | None, Field(description="TOML file or name of built-in requirements. Default: the service's own.")
    ] = None


@dataclass(frozen=True)
class Measurement:
    """Results of a measurement.

    Attributes:
        requests: statistics of the robot's requests.
        probe: what the network did to packets; None: no network.
        usage: resources used by the toolbox.
        machine: hardware it ran on.
        wire_bytes: bytes transferred for images and results, including overhead.
        encoding: encoding of the images.
    """

    requests: RequestStats
    probe: ProbeResult | None
    usage: Usage
    machine: Machine
    wire_bytes: int
    encoding: Jpeg

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Confidence bounds of metrics that are shares of the packets."""
        return self.probe.bounds() if self.probe else {}

    def values(self) -> dict[str, float | None]:
        """Values of the metrics of `requirements.Requirements`; None: not applicable."""
        requests, probe = self.requests, self.probe
        return {
            "response_time": requests.response_p95,
            "delay": probe.delay if probe else None,
            "jitter": probe.jitter if probe else None,
            "data_rate": requests.sent * requests.image_bytes * 8e-6 / requests.seconds,
            "bandwidth": self.wire_bytes * 8e-6 / requests.seconds if probe else None,
            "loss_rate": probe.loss_rate if probe else None,
            "error_rate": probe.error_rate if probe else None,
            **host_values(self.machine, self.usage),
        }


def duration(params: MeasureParams, required: Requirements) -> tuple[float, float]:
    """Duration in seconds, and packets per second that probe the network.

    By default both are such that the confidence bounds of the loss and the error rate are on one side of their limits.
    """
    link = network(params.environment, params.network)
    packets = 0.0
    if link:
        limits = ((required.loss_rate, link.there.loss), (required.error_rate, 0.0))
        needed = [trials_needed(limit.value, expected) for limit, expected in limits if limit]
        packets = max((one for one in needed if math.isfinite(one)), default=0.0)
    rate = min(max(PROBE_RATE, packets / (params.seconds or MIN_SECONDS)), MAX_PROBE_RATE)
    return params.seconds or min(max(MIN_SECONDS, math.ceil(packets / rate)), MAX_SECONDS), rate


def measure(params: MeasureParams, service: ServiceRequirements, report: Report) -> Measurement:
    """Run a toolbox and a robot that sends it images over the environment's network.

    Raises:
        InputError: there are no images, or the network is too slow for any.
        UnavailableError: a network can't be created here (it requires root).
        StepError: the toolbox doesn't start, or the robot fails.
    """
    import psutil

    link = network(params.environment, params.network)
    seconds, probe_rate = duration(params, service.of(params.environment))
    with tempfile.TemporaryDirectory(prefix="scan2sim-qos-") as folder, deployment.open_hosts(link) as hosts:
        chosen = _write_images(params, service, link, Path(folder))
        report(0.0, "starting the toolbox")
        with _toolbox(hosts, params.service, Path(folder)) as (server, port):
            _robot_stats(_start_robot(hosts, params, folder, port, WARM_UP_S))
            usage, before = Usage.start(psutil.Process(server.pid)), hosts.wire_bytes()
            running_probe = hosts.start_probe(seconds, probe_rate)
            running_robot = _start_robot(hosts, params, folder, port, seconds)
            began = time.monotonic()
            while running_robot.poll() is None:
                report(min(1.0, (time.monotonic() - began) / seconds), f"the robot sends images for {seconds:.0f} s")
                usage = usage.updated()
                time.sleep(0.2)
            requests, usage, probe = _robot_stats(running_robot), usage.updated(), hosts.probe_result(running_probe)
            transferred = hosts.wire_bytes() - before - (probe.bytes if probe else 0)
    return Measurement(requests, probe, usage, machine(), transferred, chosen)


def _write_images(params: MeasureParams, service: ServiceRequirements, link: Network | None, folder: Path) -> Jpeg:
    """Write the JPEGs that the robot sends, with the required image size and the best quality that fits."""
    images = _read_images(params, service.image)
    chosen = encoding_of(images, params, service.of(params.environment), link)
    for number, image in enumerate(images):
        (folder / f"{number:03}.jpg").write_bytes(chosen.encoded(image))
    return chosen


def encoding_of(images: Sequence[U8], params: MeasureParams, required: Requirements, link: Network | None) -> Jpeg:
    """Encoding with the given quality, or the best that fits budget, requirements and link.

    Raises:
        InputError: no encoding fits.
    """
    if params.quality is not None:
        return encoding.jpeg_at_quality(images, params.rate, params.quality)
    rate = link.there.rate if link else None
    allowed = (
        params.budget,
        None if params.budget or not required.bandwidth else required.bandwidth.value,
        None if rate is None else MAX_LINK_UTILIZATION * rate * 1e-6,
    )
    return encoding.choose_jpeg(images, params.rate, min((one for one in allowed if one is not None), default=math.inf))


def _read_images(params: MeasureParams, size: tuple[int, int] | None) -> list[U8]:
    """(H, W, 3) RGB images to send."""
    import cv2

    folder = params.images or SAMPLE_IMAGES
    found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in (".jpg", ".jpeg", ".png"))
    step = max(1, len(found) // MAX_IMAGES)
    images = [image for path in found[::step][:MAX_IMAGES] if (image := cv2.imread(str(path))) is not None]
    if not images:
        raise InputError(folder, "contains no images", "Give --images a folder of JPEGs or PNGs")
    loaded = (np.ascontiguousarray(image[..., ::-1]) for image in images)
    return [image if size is None else _center_crop(image, size) for image in loaded]


def _center_crop(image: U8, size: tuple[int, int]) -> U8:
    """An image scaled and cropped around its center to a size."""
    import cv2

    width, height = size
    scale = max(width / image.shape[1], height / image.shape[0])
    scaled = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    top, left = (scaled.shape[0] - height) // 2, (scaled.shape[1] - width) // 2
    return np.asarray(scaled[top : top + height, left : left + width], np.uint8)


@contextmanager
def _toolbox(hosts: Hosts, toolbox: str, folder: Path) -> Iterator[tuple[subprocess.Popen[Any], int]]:
    """Start a toolbox; yields its process and port."""
    local = hosts.address == deployment.SameHost.address
    token = folder / robot.TOKEN_FILE
    token.write_text(secrets.token_hex(32), encoding="utf-8")  # required beyond the loopback interface
    command = [sys.executable, "-m", "scan2sim.flows.cli", "toolbox", "serve", toolbox, "--host", hosts.address]
    command += ["--token", str(token)]
    with (folder / "toolbox.log").open("w+") as log:
        port = 0 if local else TOOLBOX_PORT
        server = hosts.start_service(*command, "--port", port, stdout=log, stderr=log, env=module_environment())
        try:
            yield server, _port(server, folder / "toolbox.log")
        finally:
            server.terminate()
            server.wait()


def _port(server: subprocess.Popen[Any], log: Path) -> int:
    """Port of a toolbox, from its log; waits until it listens."""
    deadline = time.monotonic() + START_TIMEOUT_S
    while server.poll() is None and time.monotonic() < deadline:
        for word in log.read_text(encoding="utf-8").split():
            if word.startswith("http://") and word.count(":") >= 2:
                return int(word.split(":")[2].partition("/")[0])
        time.sleep(0.1)
    log_end = log.read_text().strip()[-300:]
    raise StepError("the toolbox", f"didn't start ({log_end})", "Try `scan2sim toolbox serve`")


def _start_robot(hosts: Hosts, params: MeasureParams, folder: str, port: int, seconds: float) -> subprocess.Popen[Any]:
    command = (sys.executable, "-m", robot.__name__, f"http://{hosts.address}:{port}", params.service, folder)
    return hosts.start_robot(
        *command,
        params.rate,
        seconds,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=module_environment(),
    )


def _robot_stats(process: subprocess.Popen[Any]) -> RequestStats:
    line, errors = process.communicate()
    if process.returncode:
        raise StepError("the robot", f"failed ({errors.strip()[-300:]})", "Report it as a bug")
    return RequestStats(**json.loads(line))


def module_environment() -> dict[str, str]:
    """Environment with this program's search path for Python modules."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}

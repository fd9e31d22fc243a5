"""Measures quality of service of teleoperation: a scripted drive over an environment's network (D3.2, 2.2, table 6).

Vehicle and station are processes at the ends of two identical links; cameras send frames with a drawn timecode.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from scan2sim.pipeline.core.errors import StepError
from scan2sim.pipeline.core.step import Report
from scan2sim.services.qos.confidence import share_bounds
from scan2sim.services.qos.emulated_link import Link
from scan2sim.services.qos.environments import network
from scan2sim.services.qos.host_load import Machine, Usage, host_values, machine
from scan2sim.services.qos.link_profile import LinkProfile
from scan2sim.services.qos.measure import MAX_LINK_UTILIZATION, SAMPLE_IMAGES
from scan2sim.services.qos.requirements import Requirements
from scan2sim.services.teleoperation.control.messages import Kind
from scan2sim.services.teleoperation.gateway.pki import certify
from scan2sim.services.teleoperation.qos import scripted_drive
from scan2sim.services.teleoperation.qos.route import cross_track_error
from scan2sim.services.teleoperation.qos.scripted_drive import HEIGHT, WIDTH, Setup
from scan2sim.services.teleoperation.settings import MeasureParams

LOCAL_HOSTS = ("127.0.0.1", "127.0.0.2")
VEHICLE_NAME, STATION_NAME = "car", "desk"
WIRE_COUNT = 2
BITRATE_MARGIN = 1.1
"""Encoders are given this multiple of the required bit rate, since they stay below their target."""
WIRE_OVERHEAD = 1.15
"""Bytes on the wire for each byte of video: headers of RTP, SRTP, UDP, IP and Ethernet."""
RECORDED_FRAMES, PAN_PX, NOISE_GREY_LEVELS = 60, 8, 4.0
"""Number of camera frames, shown forwards and backwards; shift between two frames; standard deviation of the noise."""


@dataclass(frozen=True)
class Measurement:
    """Results of a measurement; times are ms.

    Attributes:
        vehicle, station: results of the two processes (`scripted_drive`).
        seconds: duration; wire_bytes: transferred over the network, both ways, with overhead; None: no network.
        usage: of the vehicle process if measured on the robot, else of the station; machine: the machine it runs on.
    """

    vehicle: Mapping[str, Any]
    station: Mapping[str, Any]
    seconds: float
    wire_bytes: int | None
    usage: Usage
    machine: Machine

    def values(self) -> dict[str, float | None]:
        """Values of the metrics of `requirements.Requirements`; None: not applicable."""
        one_way = delays(self.vehicle["messages"], Kind.COMMAND)
        return {
            "response_time": percentile(list(response_times(self.vehicle["messages"], self.station["obeyed"])), 95),
            "delay": percentile(one_way, 95),
            "jitter": jitter(one_way),
            "data_rate": self.station["seen"].get("bytes", 0) * 8e-6 / self.seconds,
            "bandwidth": None if self.wire_bytes is None else self.wire_bytes * 8e-6 / self.seconds,
            "loss_rate": self.loss_rate,
            "error_rate": self.error_rate,
            **host_values(self.machine, self.usage),
        }

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Confidence bounds of the loss rate and the error rate."""
        counts = {"loss_rate": self._lost, "error_rate": self._corrupted}
        return {name: share_bounds(events, max(1, trials)) for name, (events, trials) in counts.items()}

    @property
    def loss_rate(self) -> float:
        """Share of all messages and video packets that arrived over no link, or only after retransmission."""
        return self._lost[0] / max(self._lost[1], 1)

    @property
    def _lost(self) -> tuple[int, int]:
        """Number of messages and packets that were lost, and of all."""
        received, missed, retransmitted = (
            self.station["frames"].get(what, 0) for what in ("received", "lost", "retransmitted")
        )
        received, lost = received - retransmitted, missed + retransmitted
        for end in (self.vehicle, self.station):
            received, lost = received + len(end["messages"]), lost + count_missing(end["messages"])
        return max(lost, 0), received + max(lost, 0)

    @property
    def error_rate(self) -> float:
        """Share of corrupted data: frames whose timecode can't be read, and malformed messages."""
        return self._corrupted[0] / max(self._corrupted[1], 1)

    @property
    def _corrupted(self) -> tuple[int, int]:
        """Number of corrupted frames and messages, and of all."""
        wrong = self.station["seen"].get("unreadable", 0)
        wrong += sum(end["counts"].get("malformed", 0) for end in (self.vehicle, self.station))
        received = len(self.station["glass"]) + sum(len(end["messages"]) for end in (self.vehicle, self.station))
        return wrong, max(received, wrong)

    @property
    def glass_to_glass(self) -> list[float]:
        """Latency of each frame from capture to decoding at the station, ms."""
        return [(seen - captured) / 1e6 for _, captured, seen in self.station["glass"]]

    @property
    def lost_frames(self) -> float:
        """Share of the frames that were not shown."""
        shown, broken = self.station["frames"].get("frames", 0), self.station["frames"].get("broken", 0)
        return float(broken / max(shown + broken, 1))

    @property
    def cross_track_error(self) -> list[float]:
        """Distance of the vehicle from its reference path, m, every 0.1 m; empty: it drove on a plain."""
        way = np.array(self.vehicle["way"])
        return np.abs(cross_track_error(way, self.vehicle["driven"])).tolist() if len(way) else []

    @property
    def command_gap(self) -> float:
        """Longest interval without a command at the onboard unit, ms."""
        return longest_gap(self.vehicle["messages"], Kind.COMMAND)


Times = Sequence[Sequence[int]]
"""Messages as rows: kind, number, time sent, time received (ns)."""


def delays(messages: Times, kind: Kind) -> list[float]:
    """One-way delays, ms, in sending order."""
    return [
        (received - sent) / 1e6 for one, _, sent, received in sorted(messages, key=lambda each: each[1]) if one == kind
    ]


def jitter(one_way: Sequence[float]) -> float:
    """Mean absolute difference of successive delays (RFC 3393)."""
    return float(np.abs(np.diff(one_way)).mean()) if len(one_way) > 1 else math.nan


def longest_gap(messages: Times, kind: Kind) -> float:
    """Longest interval between two received messages, ms."""
    received = sorted(each[3] for each in messages if each[0] == kind)
    return float(np.diff(received).max()) / 1e6 if len(received) > 1 else math.inf


def count_missing(messages: Times) -> int:
    """Number of messages between the first and the last number that were not received."""
    numbers = {each[1] for each in messages}
    return max(numbers) - min(numbers) + 1 - len(numbers) if numbers else 0


def response_times(messages: Times, obeyed: Sequence[tuple[int, int]]) -> Iterator[float]:
    """Times from sending each command to receiving the telemetry that first reports it, or a later one, ms.

    Args:
        messages: messages that the vehicle received.
        obeyed: command numbers reported by telemetry, and when each arrived.
    """
    reports = iter(sorted(obeyed, key=lambda one: one[1]))
    newest, received = -1, 0
    for kind, number, sent, _ in sorted(messages, key=lambda each: each[1]):
        if kind != Kind.COMMAND:
            continue
        while newest < number:
            try:
                newest, received = next(reports)
            except StopIteration:
                return
        yield max(0, received - sent) / 1e6


def percentile(values: Sequence[float], share: float) -> float:
    """Percentile; infinite for no values: what never arrived is late."""
    return float(np.percentile(values, share)) if len(values) else math.inf


class ScriptedProcess:
    """A process of `scripted_drive`."""

    def __init__(self, role: str, setup: Setup, link: Link | None, log: Path) -> None:
        """Start the process; `link`: the vehicle is at its near end, the station at its far end."""
        command = [sys.executable, "-m", scripted_drive.__name__, role, json.dumps(asdict(setup))]
        self._log, self._role = log, role
        with log.open("wb") as errors:
            arguments: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": errors}
            arguments |= {"text": True, "env": os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}}
            if link is None:
                self.process: subprocess.Popen[str] = subprocess.Popen(command, **arguments)
            else:
                self.process = (link.near if role == "vehicle" else link.far).popen(*command, **arguments)
        self.port = int(self._answer())

    def ask(self, request: str) -> Any:
        """Send a request, and return the answer.

        Raises:
            StepError: the process has failed.
        """
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(f"{request}\n")
            self.process.stdin.flush()
        except OSError:
            pass  # the process has ended: reading its answer reports that
        return self._answer()

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()

    def _answer(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            errors_text = self._log.read_text(errors="replace", encoding="utf-8").strip()[-600:]
            raise StepError(f"the scripted {self._role}", f"has failed: {errors_text}", "Report it")
        return json.loads(line)


def ignore_progress(fraction: float, message: str = "") -> None:
    """Progress callback that does nothing."""


class ScriptedPair:
    """A running vehicle and station, and the link between them; see `scripted_pair`."""

    def __init__(self, vehicle: ScriptedProcess, station: ScriptedProcess, link: Link | None) -> None:
        self.vehicle, self.station, self.link = vehicle, station, link

    def begin(self) -> None:
        """Start recording."""
        self.vehicle.ask("begin")
        self.station.ask("begin")

    def bytes(self) -> int | None:
        """Bytes transferred over the wires so far, both ways; None: there is no emulated network."""
        if self.link is None:
            return None
        counts = [self.link.near.counts(wire) for wire in range(WIRE_COUNT)]
        return sum(one.sent_bytes + one.received_bytes for one in counts)

    def measured(self, seconds: float, report: Report = ignore_progress, *, robot: bool = False) -> Measurement:
        """Measure from now on; `robot`: measure resource usage of the vehicle process instead of the station."""
        measured = self.vehicle if robot else self.station
        self.begin()
        usage, before, began = Usage.start(psutil.Process(measured.process.pid)), self.bytes(), time.monotonic()
        while (took := time.monotonic() - began) < seconds:
            report(took / seconds, "driving")
            usage = usage.updated()
            time.sleep(min(0.1, seconds - took))
        usage, after, took = usage.updated(), self.bytes(), time.monotonic() - began
        transferred = None if before is None or after is None else after - before
        return Measurement(
            self.vehicle.ask("results"), self.station.ask("results"), took, transferred, usage, machine()
        )


@contextmanager
def scripted_pair(
    shapes: tuple[LinkProfile, LinkProfile] | None, setup: Setup, folder: Path, wires: Sequence[int] = range(WIRE_COUNT)
) -> Iterator[ScriptedPair]:
    """Run a vehicle and a station that are not yet joined.

    Args:
        shapes: of each wire, from and to the vehicle; None: both processes on this machine, without a network.
        setup: of both; host, port, links and folder are filled in.
        folder: for certificates, state and logs.
        wires: wires that the vehicle has links over.

    Raises:
        UnavailableError: no network can be emulated here (this needs root).
        StepError: a process failed.
    """
    with ExitStack() as stack:
        link = None
        if shapes is not None:
            link = stack.enter_context(Link(*shapes, beside=[shapes] * (WIRE_COUNT - 1)))
        host = LOCAL_HOSTS[0] if link is None else link.far.address
        parties = folder / "parties"
        certify(parties, [host], [VEHICLE_NAME], [STATION_NAME])
        station = ScriptedProcess(
            "station", replace(setup, folder=str(parties), host=host), link, folder / "station.log"
        )
        stack.callback(station.close)
        # by interface, not by address: all of them lead to the same address of the station
        one_way = [f"wire{wire}={LOCAL_HOSTS[wire] if link is None else link.near.interface(wire)}" for wire in wires]
        vehicle_setup = replace(
            setup, folder=str(parties / f"vehicle-{VEHICLE_NAME}"), host=host, port=station.port, links=tuple(one_way)
        )  # fmt: skip
        vehicle = ScriptedProcess("vehicle", vehicle_setup, link, folder / "vehicle.log")
        stack.callback(vehicle.close)
        yield ScriptedPair(vehicle, station, link)


def measure(params: MeasureParams, required: Requirements, report: Report) -> Measurement:
    """Run a scripted drive over the environment's network.

    Raises:
        UnavailableError: no network can be emulated here (this needs root).
        StepError: a process failed, or they can't connect.
    """
    link_profile = network(params.environment, params.network)
    shapes = None if link_profile is None else (link_profile.there, link_profile.back)
    with tempfile.TemporaryDirectory(prefix="scan2sim-teleop-") as name:
        folder = Path(name)
        report(0.0, "rendering test images")
        setup = plan_setup(params, required, None if link_profile is None else link_profile.there.rate)
        setup = replace(setup, pictures=str(render_test_images(folder / "pictures")))
        with scripted_pair(shapes, setup, folder) as ends:
            report(0.0, "joining vehicle and station")
            ends.station.ask("join")
            ends.station.ask("drive")
            time.sleep(params.warm)
            return ends.measured(params.seconds, report, robot=link_profile is None)


def plan_setup(params: MeasureParams, required: Requirements, rate: float | None) -> Setup:
    """Video settings: the required bit rate; over all links if each can carry all video, else shared between them.

    Args:
        rate: bit/s of each wire from the vehicle; None: unlimited.
    """
    required_mbit = required.data_rate.value if required.data_rate is not None else 0.0
    bitrate = Setup.bitrate
    if params.bitrate is not None:
        bitrate = params.bitrate * 1e6
    elif required_mbit:
        bitrate = BITRATE_MARGIN * required_mbit * 1e6 / params.cameras
    share = rate is not None and WIRE_OVERHEAD * bitrate * params.cameras > MAX_LINK_UTILIZATION * rate
    world = "" if params.world is None else str(params.world)
    return Setup("", "", cameras=params.cameras, bitrate=bitrate, share=share, world=world)


def render_test_images(folder: Path) -> Path:
    """Write frames of the synthetic street as a camera driving past it sees them; returns the folder."""
    import cv2

    folder.mkdir(parents=True)
    panorama = cv2.imread(str(sorted(SAMPLE_IMAGES.rglob("*pano*.jpg"))[0]))
    assert panorama is not None
    scale, random = HEIGHT / panorama.shape[0], np.random.default_rng(0)
    wide = cv2.resize(panorama, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    for number in range(RECORDED_FRAMES):
        left = PAN_PX * min(number, RECORDED_FRAMES - number)
        image = wide[:HEIGHT, left : left + WIDTH] + random.normal(0.0, NOISE_GREY_LEVELS, (HEIGHT, WIDTH, 1))
        cv2.imwrite(str(folder / f"{number:03}.png"), image.clip(0, 255).astype(np.uint8))
    return folder

"""Experiment of D3.2, section 3.2 with real nodes: camera events of a Monday, and workers requested for them.

Each dataset talker replays ten cameras; one node queues their events and has local processes handle them, two events
per second each; another node requests workers. All are separate processes, started with `scan2sim monitor ...`. If
replayed faster than real time, all durations are divided by the speed, and workers are faster by the same factor.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.paths import ROOT
from scan2sim.services.monitoring.autoscale import traffic_model
from scan2sim.services.monitoring.autoscale.traffic_model import TrafficParams
from scan2sim.services.monitoring.example_nodes import worker

CAMERAS_PER_TALKER = 10
MAX_AGE_S = 5.0
"""Maximum age of an event in seconds (D3.2, table 3: delay)."""
CAPACITY, PERIOD, WINDOW, DELAY = 2.0, 10.0, 300.0, 4.0
"""Events per second of a worker; seconds of a record, of the average, and of tolerated waiting, in simulated time."""
TOPIC = "/vehicles"


@dataclass(frozen=True)
class Replay:
    """A replay: cameras, hours of Monday, speed, and whether messages have the real size of events.

    Attributes:
        kafka: Kafka servers that also receive records and events, as "host:port".
    """

    cameras: int
    speed: float
    hours: tuple[float, float] = (6.0, 10.0)
    real_sizes: bool = False
    min_workers: int = 1
    seed: int = 0
    kafka: str | None = None

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.cameras}-{'sizes' if self.real_sizes else 'fields'}-{self.speed:g}x"


def replays(speed: float) -> list[Replay]:
    """The three replays of D3.2: 10, 20 and 50 cameras from 6 to 10 h."""
    return [Replay(cameras, speed) for cameras in (10, 20, 50)]


@dataclass(frozen=True)
class Outcome:
    """Outcome of a replay, in simulated time.

    Attributes:
        series: for each record: seconds from the start, events received per second, their average, requested workers,
            running workers.
        sent, done: number of events.
        oldest: largest age of an event when it was done, seconds.
        late: number of records with an event older than `MAX_AGE_S`.
        bandwidth: largest bandwidth of a record, bytes per second.
    """

    series: list[tuple[float, float, float, int, int]]
    sent: int
    done: int
    oldest: float
    late: int
    bandwidth: float

    def result(self) -> dict[str, Any]:
        """Values for RESULT."""
        return {
            "workers_max": max(one[3] for one in self.series),
            "oldest_event_s": round(self.oldest, 2),
            "lost": self.sent - self.done,
            "events": self.sent,
        }


def replay(replays: Sequence[Replay], folder: Path, domain: int = 60) -> list[Outcome]:
    """Run replays at the same time, each in its own DDS domain, and return their outcomes."""
    runs = [_Run(one, folder / one.name, domain + number) for number, one in enumerate(replays)]
    try:
        for run in runs:
            run.start_talkers()
        for run in runs:
            run.wait()
    finally:
        for run in runs:
            run.close()
    return [run.outcome() for run in runs]


class _Run:
    def __init__(self, params: Replay, folder: Path, domain: int) -> None:
        self._params, self._folder, self._domain = params, folder, domain
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("scale.log", "work.log"):
            (folder / name).unlink(missing_ok=True)
        speed = params.speed
        serve = shlex.join(worker.command(1 / (CAPACITY * speed)))
        self._monitors = [
            self._start("scale", "--capacity", CAPACITY * speed, "--delay", DELAY / speed, "--window", WINDOW / speed,
                        "--cool-down", WINDOW / speed, "--min-workers", params.min_workers,
                        "--log", folder / "scale.log"),
            self._start("work", TOPIC, serve, "--period", PERIOD / speed, "--log", folder / "work.log"),
        ]  # fmt: skip
        self.sent = 0
        self._talkers: list[subprocess.Popen[bytes]] = []

    def start_talkers(self) -> None:
        """Start the talkers once the scaling node publishes records."""
        while not self._states():
            time.sleep(0.2)
        params, folder, speed = self._params, self._folder, self._params.speed
        for group in range(params.cameras // CAMERAS_PER_TALKER):
            data = folder / f"{group}.csv"
            self.sent += traffic_model.write(
                TrafficParams(out=data, cameras=CAMERAS_PER_TALKER, from_hour=params.hours[0], to_hour=params.hours[1],
                              seed=1000 * params.seed + group)
            )  # fmt: skip
            self._talkers.append(
                self._start("dataset-talker", TOPIC, data, "--name", f"cameras_{group}", "--speed", speed,
                            "--subscribers", 1, "--period", 1,
                            *([] if params.real_sizes else ["--size-as-field"]))
            )  # fmt: skip

    def _start(self, *arguments: Any) -> subprocess.Popen[bytes]:
        kafka = ["--kafka", self._params.kafka] if self._params.kafka else []
        command = [sys.executable, "-m", "scan2sim.flows.cli", "monitor", *map(str, arguments), *kafka]
        environment = os.environ | {"ROS_DOMAIN_ID": str(self._domain), "PYTHONPATH": str(ROOT)}
        log = (self._folder / f"{arguments[0]}.err").open("ab")
        return subprocess.Popen(command, env=environment, stderr=log)

    def wait(self) -> None:
        """Wait until all events are done, or nothing happens any more."""
        for talker in self._talkers:
            talker.wait()
        done = -1
        while (now := sum(one["done"] for one in self._states())) not in (done, self.sent):
            done = now
            time.sleep(2.0)

    def close(self) -> None:
        """Terminate all processes."""
        for process in (*self._talkers, *self._monitors):
            process.terminate()
        for process in (*self._talkers, *self._monitors):
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()

    def _states(self) -> list[dict[str, Any]]:
        try:
            return [json.loads(line) for line in (self._folder / "scale.log").read_text(encoding="utf-8").splitlines()]
        except FileNotFoundError:
            return []

    def outcome(self) -> Outcome:
        states, speed = self._states(), self._params.speed
        first = next(number for number, one in enumerate(states) if one["arrived"])
        began = states[first]["time"] - states[first]["seconds"]
        records = [json.loads(line) for line in (self._folder / "work.log").read_text(encoding="utf-8").splitlines()]
        flows = [flow for one in records for flow in one["flows"] if flow["topic"] == TOPIC]
        return Outcome(
            series=[
                ((one["time"] - began) * speed, one["arrived"] / one["seconds"] / speed, one["rate"] / speed,
                 one["wanted"], one["workers"])
                for one in states[first:]
            ],
            sent=self.sent,
            done=sum(one["done"] for one in states),
            oldest=max(one["oldest_done"] for one in states) * speed,
            late=sum(one["oldest_done"] * speed > MAX_AGE_S for one in states),
            bandwidth=max(flow["bandwidth"] for flow in flows) / speed,
        )  # fmt: skip

"""The experiment of D3.2, section 3.2, through real nodes: cameras' events of a Monday, workers asked for as they come.

Every ten cameras are a dataset talker; a node queues their events and has them worked on by local processes, each of
two events a second; another asks for workers. All are processes of their own, started by `scan2sim monitor ...`. Faster
than real time, all that is a time in the mission is divided by the speed, and a worker is as much faster.
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

GROUP = 10
"""Cameras of a talker."""
LIMIT = 5.0
"""Seconds that an event may be old (D3.2, table 3: delay)."""
CAPACITY, PERIOD, WINDOW, DELAY = 2.0, 10.0, 300.0, 4.0
"""Events a second of a worker, seconds of a record, of the average, for what waits: all of the mission's time."""
TOPIC = "/vehicles"


@dataclass(frozen=True)
class Replay:
    """What is replayed: cameras, hours of Monday, how fast, whether messages are as large as events.

    Attributes:
        kafka: servers that records and events go to, too, as "host:port".
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
        """Of its folder."""
        return f"{self.cameras}-{'sizes' if self.real_sizes else 'fields'}-{self.speed:g}x"


def replays(speed: float) -> list[Replay]:
    """D3.2's three: 10, 20 and 50 cameras, from 6 to 10 h."""
    return [Replay(cameras, speed) for cameras in (10, 20, 50)]


@dataclass(frozen=True)
class Outcome:
    """What came of it, in the mission's time.

    Attributes:
        series: by record: seconds from the start, events that came a second, their average, workers that were asked
            for, workers that ran.
        sent, done: events.
        oldest: seconds from sending to done, of the oldest.
        late: records in which one was older than `LIMIT`.
        bandwidth: largest of a record, bytes a second of the mission's time.
    """

    series: list[tuple[float, float, float, int, int]]
    sent: int
    done: int
    oldest: float
    late: int
    bandwidth: float

    def result(self) -> dict[str, Any]:
        """For RESULT."""
        return {
            "workers_max": max(one[3] for one in self.series),
            "oldest_event_s": round(self.oldest, 2),
            "lost": self.sent - self.done,
            "events": self.sent,
        }


def replay(replays: Sequence[Replay], folder: Path, domain: int = 60) -> list[Outcome]:
    """Run some at once, each in a DDS domain of its own, and read what came of them."""
    runs = [_Run(one, folder / one.name, domain + number) for number, one in enumerate(replays)]
    try:
        for run in runs:
            run.talk()
        for run in runs:
            run.wait()
    finally:
        for run in runs:
            run.close()
    return [run.outcome() for run in runs]


class _Run:
    def __init__(self, told: Replay, folder: Path, domain: int) -> None:
        self._told, self._folder, self._domain = told, folder, domain
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("scale.log", "work.log"):
            (folder / name).unlink(missing_ok=True)
        speed = told.speed
        serve = shlex.join(worker.command(1 / (CAPACITY * speed)))
        self._watching = [
            self._start("scale", "--capacity", CAPACITY * speed, "--delay", DELAY / speed, "--window", WINDOW / speed,
                        "--cool-down", WINDOW / speed, "--min-workers", told.min_workers,
                        "--log", folder / "scale.log"),
            self._start("work", TOPIC, serve, "--period", PERIOD / speed, "--log", folder / "work.log"),
        ]  # fmt: skip
        self.sent = 0
        self._talkers: list[subprocess.Popen[bytes]] = []

    def talk(self) -> None:
        """Start the talkers, once all is ready to be told of."""
        while not self._states():
            time.sleep(0.2)
        told, folder, speed = self._told, self._folder, self._told.speed
        for group in range(told.cameras // GROUP):
            data = folder / f"{group}.csv"
            self.sent += traffic_model.write(
                TrafficParams(out=data, cameras=GROUP, from_hour=told.hours[0], to_hour=told.hours[1],
                              seed=1000 * told.seed + group)
            )  # fmt: skip
            self._talkers.append(
                self._start("dataset-talker", TOPIC, data, "--name", f"cameras_{group}", "--speed", speed,
                            "--subscribers", 1, "--period", 1,
                            *([] if told.real_sizes else ["--size-as-field"]))
            )  # fmt: skip

    def _start(self, *arguments: Any) -> subprocess.Popen[bytes]:
        kafka = ["--kafka", self._told.kafka] if self._told.kafka else []
        command = [sys.executable, "-m", "scan2sim.flows.cli", "monitor", *map(str, arguments), *kafka]
        environment = os.environ | {"ROS_DOMAIN_ID": str(self._domain), "PYTHONPATH": str(ROOT)}
        log = (self._folder / f"{arguments[0]}.err").open("ab")
        return subprocess.Popen(command, env=environment, stderr=log)

    def wait(self) -> None:
        """Until all is sent and done, or nothing is done any more."""
        for talker in self._talkers:
            talker.wait()
        done = -1
        while (now := sum(one["done"] for one in self._states())) not in (done, self.sent):
            done = now
            time.sleep(2.0)

    def close(self) -> None:
        """End all."""
        for process in (*self._talkers, *self._watching):
            process.terminate()
        for process in (*self._talkers, *self._watching):
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
        states, speed = self._states(), self._told.speed
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
            late=sum(one["oldest_done"] * speed > LIMIT for one in states),
            bandwidth=max(flow["bandwidth"] for flow in flows) / speed,
        )  # fmt: skip

"""What is measured of a service agrees with what it does and with the network that lies between."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError, UnavailableError
from scan2sim.pipeline.core.step import silent
from scan2sim.services.qos import deployment, environments, robot
from scan2sim.services.qos.compare import needs, passed, rows
from scan2sim.services.qos.encoding import Jpeg
from scan2sim.services.qos.environments import Network, network
from scan2sim.services.qos.host_load import Machine, Usage
from scan2sim.services.qos.link_profile import Shape
from scan2sim.services.qos.measure import FREE, Measured, MeasureParams, encoding_of, measure
from scan2sim.services.qos.probe import Seen
from scan2sim.services.qos.requirements import NETWORK, Environment, Requirements, read
from scan2sim.services.qos.robot import Answers


class _Answering(BaseHTTPRequestHandler):
    """Says of every third image that it was dropped."""

    protocol_version = "HTTP/1.1"
    count = 0

    def do_POST(self) -> None:
        type(self).count += 1
        self.rfile.read(int(self.headers["Content-Length"]))
        body = b'{"state": "dropped"}' if type(self).count % 3 == 0 else b'{"state": "done"}'
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def address() -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Answering)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()


def test_a_robot_counts_what_isnt_answered_against_the_service(address: str) -> None:
    answers = robot.ask(address, "any", [b"abc", b"defgh"], rate=100, seconds=0.3)
    assert answers.sent == 30 and answers.states == {"done": 20, "dropped": 10}
    assert 0 < answers.response_p50 < 1000 and answers.response_p95 == float("inf") and answers.image_bytes == 4


def test_a_service_that_isnt_there_is_no_crash() -> None:
    answers = robot.ask("http://127.0.0.1:9", "any", [b"abc"], rate=100, seconds=0.05)
    assert answers.states == {"ConnectionRefusedError": 5}


def measured(seen: Seen | None, response: float = 100.0) -> Measured:
    answers = Answers(10, {"done": 10}, response, response, image_bytes=125_000, seconds=10)
    usage = Usage(process=None, began=0, before=0, cpu_seconds=5, memory_mb=300, seconds=10)
    return Measured(answers, seen, usage, Machine(2, 3000, None, None, None), 1_375_000, Jpeg(90, 1.0, 1.2))


SEEN = Seen(sent=1000, loss_rate=0.002, error_rate=0, delay=20, jitter=3, bytes=0)


def test_a_robot_that_gets_no_answers_doesnt_pass_though_no_time_is_asked() -> None:
    silent = rows(Requirements(), measured(None, response=math.inf))
    assert not passed(silent, NETWORK)
    assert passed(rows(Requirements(), measured(None)), NETWORK)


def test_what_was_asked_is_held_against_what_was_measured() -> None:
    required = Requirements.model_validate(
        {"response_time": "< 200", "bandwidth": "< 1", "cpu_cores": 4, "delay": "< 50"}
    )
    found = {row.metric: row for row in rows(required, measured(SEEN))}
    assert found["response_time"].passed and found["delay"].passed
    assert found["bandwidth"].measured == pytest.approx(1.1) and not found["bandwidth"].passed
    assert found["data_rate"].measured == pytest.approx(1.0) and found["data_rate"].passed is None
    assert not found["cpu_cores"].passed and not passed(list(found.values()), NETWORK)


@pytest.mark.parametrize(
    ("given", "budget"),
    [({}, 5.0), ({"budget": 3.0}, 3.0), ({"budget": 50.0}, 20 * FREE), ({"environment": Environment.EDGE}, 60.0)],
)
def test_images_are_as_good_as_what_is_required_and_there_allows(given: dict[str, Any], budget: float) -> None:
    """Of detection: 5 Mbit/s in the cloud, whose network has 20 there, and 60 at the edge."""
    grain = np.random.default_rng(0).integers(0, 255, (640, 640, 3), np.uint8)  # the worst that there is
    params = MeasureParams(**{"toolbox": "detect", "environment": Environment.CLOUD, "rate": 10, **given})
    required, between = read("detect").of(params.environment), network(params.environment)
    chosen = encoding_of([grain], params, required, between)
    assert 0.4 * min(budget, 30) < chosen.megabits <= budget
    asked = encoding_of([grain], params.model_copy(update={"quality": 95}), required, between)
    assert asked.quality == 95 and asked.scale == 1 and asked.megabits > chosen.megabits


def test_needs_grow_with_the_rate() -> None:
    at_one, at_ten = (needs(measured(SEEN), rate) for rate in (1, 10))
    assert at_one.bandwidth == pytest.approx(1.1) and at_ten.bandwidth == pytest.approx(11)
    assert at_ten.cores == pytest.approx(5 / 0.7) and needs(measured(None), 1).bandwidth is None


def test_networks_are_read_from_files(tmp_path: Path) -> None:
    assert network(Environment.ROBOT) is None
    cloud = network(Environment.CLOUD)
    assert cloud and cloud.there.rate and cloud.there.delay > 0.01
    (tmp_path / "mine.toml").write_text("[there]\nrate = 1\n[back]\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"there\.rate"):
        network(Environment.EDGE, tmp_path / "mine.toml")
    assert {path.stem for path in environments.FOLDER.glob("*.toml")} == {"edge", "cloud"}


needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root may make network namespaces")


@needs_root
def test_the_probe_sees_what_the_link_does() -> None:
    there = Shape(delay=0.03, loss=0.1)
    try:
        with deployment.between(Network(there=there, back=Shape(delay=0.01))) as ends:
            seen = ends.seen(ends.probe(5.0))
    except UnavailableError as error:
        pytest.skip(str(error))
    assert seen and seen.sent == 1000 and seen.error_rate == 0
    assert seen.delay == pytest.approx(30, abs=5) and seen.loss_rate == pytest.approx(0.1, abs=4 * np.sqrt(0.09 / 1000))


@needs_root
def test_a_toolbox_is_measured_over_a_link() -> None:
    pytest.importorskip("fastapi", reason="the extra bus isn't installed")
    params = MeasureParams(toolbox="segment", environment=Environment.CLOUD, rate=1, seconds=4)
    service = read("segment").model_copy(update={"image": (320, 180)})
    try:
        found = measure(params, service, silent)
    except UnavailableError as error:
        pytest.skip(str(error))
    assert found.answers.states.get("done", 0) >= 1 and found.answers.response_p50 > 50  # there and back, at least
    assert found.seen and found.seen.delay > 20
    assert found.encoding.megabits < 5 and found.wire_bytes * 8e-6 / found.answers.seconds < 5
    assert found.wire_bytes > found.answers.sent * found.answers.image_bytes
    assert found.usage.cpu_seconds > 0 and found.usage.memory_mb > 50

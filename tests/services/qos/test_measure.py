"""Measured quality of service agrees with the service's responses and with the emulated network."""

from __future__ import annotations

import json
import math
import os
import threading
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.flows.commands import qos_table
from scan2sim.pipeline.core.errors import InputError, UnavailableError
from scan2sim.pipeline.core.step import silent
from scan2sim.services.qos import deployment, environments, probe, robot
from scan2sim.services.qos.compare import compare_metrics, passed, resource_needs, summary
from scan2sim.services.qos.encoding import Jpeg
from scan2sim.services.qos.environments import Network, network
from scan2sim.services.qos.host_load import Machine, Usage
from scan2sim.services.qos.link_profile import LinkProfile
from scan2sim.services.qos.measure import MAX_LINK_UTILIZATION, Measurement, MeasureParams, encoding_of, measure
from scan2sim.services.qos.probe import ProbeResult
from scan2sim.services.qos.requirements import MACHINE_METRICS, NETWORK_METRICS, Environment, Requirements, read
from scan2sim.services.qos.robot import RequestStats
from tests.fakes.virtual_clock import VirtualClock


class _Server(ThreadingHTTPServer):
    """Counts its requests."""

    request_queue_size = 64  # the robot opens all its connections at once

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Toolbox)
        self._requests, self._lock = 0, threading.Lock()

    def next_number(self) -> int:
        """Number of the next request, from 1."""
        with self._lock:
            self._requests += 1
            return self._requests


class _Toolbox(BaseHTTPRequestHandler):
    """Responds that every third image was dropped."""

    protocol_version = "HTTP/1.1"
    server: _Server

    def do_POST(self) -> None:
        number = self.server.next_number()
        self.rfile.read(int(self.headers["Content-Length"]))
        body = b'{"state": "dropped"}' if number % 3 == 0 else b'{"state": "done"}'
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def address() -> Iterator[str]:
    with _Server() as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_requests_without_a_result_count_as_infinite_response_times(address: str) -> None:
    time = VirtualClock()
    images = [b"abc", b"defgh"]
    stats = robot.send_images(address, "any", images, rate=100, seconds=0.3, clock=time, sleep=time.sleep)
    assert stats.sent == 30 and stats.states == {"done": 20, "dropped": 10}
    assert 0 <= stats.response_p50 <= 300 and stats.response_p95 == float("inf") and stats.image_bytes == 4
    assert stats.seconds == pytest.approx(0.29)  # from the first image to the last


def test_an_unreachable_service_is_counted_as_errors() -> None:
    stats = robot.send_images("http://127.0.0.1:9", "any", [b"abc"], rate=100, seconds=0.05)
    assert stats.states == {"ConnectionRefusedError": 5}


def measurement(probe: ProbeResult | None, response: float = 100.0) -> Measurement:
    requests = RequestStats(10, {"done": 10}, response, response, image_bytes=125_000, seconds=10)
    usage = Usage(process=None, started_at=0, initial_cpu_seconds=0, cpu_seconds=5, memory_mb=300, seconds=10)
    return Measurement(requests, probe, usage, Machine(2, 3000, None, None, None), 1_375_000, Jpeg(90, 1.0, 1.2))


def test_what_cannot_be_measured_or_decided_neither_passes_nor_fails() -> None:
    required = Requirements.model_validate({"gpu_memory": 2048, "loss_rate": "< 0.003", "error_rate": "< 0.01"})
    found = {row.metric: row for row in compare_metrics(required, measurement(PROBE))}
    assert (found["gpu_memory"].passed, found["gpu_memory"].note) == (None, "not measured")
    low, high = found["loss_rate"].bounds or (1, 0)
    assert low < 0.002 < 0.003 < high and (found["loss_rate"].passed, found["loss_rate"].note) == (None, "not decided")
    assert found["error_rate"].passed, "none of 1000 packets was corrupted"
    rows = list(found.values())
    assert summary(rows, NETWORK_METRICS) == "passed; not decided: loss rate"
    assert summary(rows, MACHINE_METRICS) == "passed; not measured: gpu memory"
    lossy = replace(PROBE, loss_rate=0.02)
    assert summary(compare_metrics(required, measurement(lossy)), NETWORK_METRICS) == "FAILED"


def test_json_has_null_where_numbers_are_not_finite() -> None:
    found = qos_table.document(compare_metrics(Requirements(), measurement(PROBE, response=math.inf)), worst=math.inf)
    text = json.dumps(found, allow_nan=False)
    assert json.loads(text)["worst"] is None and not json.loads(text)["passed"]


PROBE = ProbeResult(sent=1000, loss_rate=0.002, error_rate=0, delay=20, jitter=3, bytes=0)


def test_missing_responses_fail_even_without_a_required_response_time() -> None:
    unanswered = compare_metrics(Requirements(), measurement(None, response=math.inf))
    assert not passed(unanswered, NETWORK_METRICS)
    assert passed(compare_metrics(Requirements(), measurement(None)), NETWORK_METRICS)


def test_measured_metrics_are_compared_with_requirements() -> None:
    required = Requirements.model_validate(
        {"response_time": "< 200", "bandwidth": "< 1", "cpu_cores": 4, "delay": "< 50"}
    )
    found = {row.metric: row for row in compare_metrics(required, measurement(PROBE))}
    assert found["response_time"].passed and found["delay"].passed
    assert found["bandwidth"].measured == pytest.approx(1.1) and not found["bandwidth"].passed
    assert found["data_rate"].measured == pytest.approx(1.0) and found["data_rate"].passed is None
    assert not found["cpu_cores"].passed and not passed(list(found.values()), NETWORK_METRICS)


@pytest.mark.parametrize(
    ("given", "budget"),
    [
        ({}, 5.0),
        ({"budget": 3.0}, 3.0),
        ({"budget": 50.0}, 20 * MAX_LINK_UTILIZATION),
        ({"environment": Environment.EDGE}, 60.0),
    ],
)
def test_the_encoding_fits_budget_requirements_and_link(given: dict[str, Any], budget: float) -> None:
    """Detection requires 5 Mbit/s in the cloud, whose uplink has 20 Mbit/s, and 60 Mbit/s at the edge."""
    noise = np.random.default_rng(0).integers(0, 255, (640, 640, 3), np.uint8)  # the worst case for compression
    params = MeasureParams(**{"service": "detect", "environment": Environment.CLOUD, "rate": 10, **given})
    required, link = read("detect").of(params.environment), network(params.environment)
    chosen = encoding_of([noise], params, required, link)
    assert 0.4 * min(budget, 30) < chosen.megabits <= budget
    fixed = encoding_of([noise], params.model_copy(update={"quality": 95}), required, link)
    assert fixed.quality == 95 and fixed.scale == 1 and fixed.megabits > chosen.megabits


def test_resource_needs_are_proportional_to_the_rate() -> None:
    at_one, at_ten = (resource_needs(measurement(PROBE), rate) for rate in (1, 10))
    assert at_one.bandwidth == pytest.approx(1.1) and at_ten.bandwidth == pytest.approx(11)
    assert at_ten.cores == pytest.approx(5 / 0.7) and resource_needs(measurement(None), 1).bandwidth is None


def test_networks_are_read_from_files(tmp_path: Path) -> None:
    assert network(Environment.ROBOT) is None
    cloud = network(Environment.CLOUD)
    assert cloud and cloud.there.rate and cloud.there.delay > 0.01
    (tmp_path / "mine.toml").write_text("[there]\nrate = 1\n[back]\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"there\.rate"):
        network(Environment.EDGE, tmp_path / "mine.toml")
    assert {path.stem for path in environments.FOLDER.glob("*.toml")} == {"edge", "cloud"}


def test_the_probe_measures_delay_jitter_loss_and_errors_exactly() -> None:
    statistics, sent = probe.ProbeStatistics(), 1000
    for number in range(sent):
        at = 5_000_000 * number
        data = probe.packet(number, at)
        if number % 10 == 9:
            continue  # lost
        if number % 100 == 50:
            data = data[:-1] + b"!"
        delay = 28 if number % 2 else 32  # ms
        assert statistics.receive(data, at + delay * 10**6) is None
    found = statistics.receive(probe.end_packet(sent), 0)
    assert found is not None and found.sent == 1000 and found.loss_rate == pytest.approx(0.1)
    assert found.error_rate == pytest.approx(10 / 900) and found.jitter == pytest.approx(4)
    assert found.delay == pytest.approx((500 * 32 + 400 * 28) / 900)


requires_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root may create network namespaces")


@requires_root
@pytest.mark.realtime
def test_the_probe_measures_delay_and_loss_of_the_link() -> None:
    there = LinkProfile(delay=0.03, loss=0.1)
    try:
        with deployment.open_hosts(Network(there=there, back=LinkProfile(delay=0.01))) as hosts:
            found = hosts.probe_result(hosts.start_probe(5.0))
    except UnavailableError as error:
        pytest.skip(str(error))
    assert found and found.sent == 1000 and found.error_rate == 0
    assert 29.5 < found.delay < 1000  # longer while a program stalls; exactly in virtual time above
    assert found.loss_rate == pytest.approx(0.1, abs=4 * np.sqrt(0.09 / 1000))


@requires_root
@pytest.mark.realtime
def test_the_event_bus_is_measured_over_a_link() -> None:
    pytest.importorskip("cyclonedds", reason="the extra bus isn't installed")
    from scan2sim.services.monitoring.qos import measure as bus

    try:
        found = bus.measure(Environment.CLOUD, None, 5, 5000, 4, silent)
    except UnavailableError as error:
        pytest.skip(str(error))
    assert (found.events.sent, found.events.received, found.events.corrupted) == (20, 20, 0)
    values = found.values()
    assert 25 < (values["delay"] or 0) < 2000 and values["data_rate"] == pytest.approx(0.2, rel=0.3)
    assert found.wire_bytes and found.wire_bytes > found.events.bytes and values["response_time"] is None
    assert found.bounds()["loss_rate"][1] == pytest.approx(3 / 20, rel=0.1)


@requires_root
@pytest.mark.realtime
def test_a_toolbox_is_measured_over_a_link() -> None:
    pytest.importorskip("fastapi", reason="the extra bus isn't installed")
    params = MeasureParams(service="segment", environment=Environment.CLOUD, rate=1, seconds=4)
    service = read("segment").model_copy(update={"image": (320, 180)})
    try:
        found = measure(params, service, silent)
    except UnavailableError as error:
        pytest.skip(str(error))
    requests = found.requests
    assert requests.states.get("done", 0) >= 1 and requests.response_p50 > 50  # at least the delay both ways
    assert found.probe and found.probe.delay > 20
    assert found.encoding.megabits < 5 and found.wire_bytes * 8e-6 / requests.seconds < 5
    assert found.wire_bytes > requests.sent * requests.image_bytes
    assert found.usage.cpu_seconds > 0 and found.usage.memory_mb > 50

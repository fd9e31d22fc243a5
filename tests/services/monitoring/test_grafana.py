"""The Grafana dashboard: each of its queries finds data in what `monitor` exports, evaluated by Prometheus itself."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import subprocess
import sys
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("prometheus_client", reason="the extra bus isn't installed")

from scan2sim.services.monitoring.export.sinks import PrometheusSink
from scan2sim.services.monitoring.record import TopicFlow
from tests.conftest import ROOT
from tests.fakes.ports import free_port
from tests.fakes.sample_records import record
from tests.waiting import until

DASHBOARD = json.loads((ROOT / "deploy/grafana/event-bus.json").read_text(encoding="utf-8"))
VARIABLES = {"$node": ".*", "$topic": ".*", "$__rate_interval": "20s", "$__range": "60s"}
PAGE_METRICS = "# TYPE scan2sim_page_alarms gauge\nscan2sim_page_alarms 2.0\n"


def queries() -> Iterator[tuple[str, str]]:
    """Title of a panel and query, with Grafana's variables replaced."""
    for panel in DASHBOARD["panels"]:
        for target in panel["targets"]:
            text = target["expr"]
            for name, value in VARIABLES.items():
                text = text.replace(name, value)
            assert "$" not in text, "a variable that the dashboard doesn't define"
            yield panel["title"], text


@pytest.fixture
def sink() -> Iterator[PrometheusSink]:
    made = PrometheusSink(0)
    yield made
    made.close()


def send(sink: PrometheusSink, number: int) -> None:
    """A record of a publisher, and one of a subscriber that receives half of it."""
    flow = TopicFlow(topic="/camera", direction="outgoing", type="t", bandwidth=1000.0, messages=10, size=100.0)
    half = {"direction": "incoming", "bandwidth": 500.0, "messages": 5, "lost": 5, "latency": 9, "latency_p95": 9}
    sink.send(record("camera", number, flows=[flow]))
    sink.send(record("fusion", number, flows=[flow.model_copy(update=half)]))


def exported(sink: PrometheusSink) -> set[str]:
    """Names of the metrics that nodes and the page export."""
    send(sink, 0)
    with urllib.request.urlopen(f"http://127.0.0.1:{sink.port}/metrics", timeout=10) as answer:
        names = set(re.findall(r"(?m)^(scan2sim_\w+)", answer.read().decode()))
    page = (ROOT / "services/monitoring/dashboard/app.py").read_text(encoding="utf-8")
    return names | set(re.findall(r'"(scan2sim_page_\w+)"', page))


def test_every_metric_of_the_dashboard_is_exported(sink: PrometheusSink) -> None:
    names = exported(sink)
    variables = [one["query"]["query"] for one in DASHBOARD["templating"]["list"] if one["type"] == "query"]
    for text in [*(text for _, text in queries()), *variables]:
        used = set(re.findall(r"scan2sim_\w+", text))
        assert used and used <= names, text


def test_the_dashboard_is_complete() -> None:
    assert DASHBOARD["schemaVersion"] >= 39 and DASHBOARD["title"] and DASHBOARD["uid"]
    assert [one["name"] for one in DASHBOARD["templating"]["list"]] == ["datasource", "node", "topic"]
    panels = DASHBOARD["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    taken = set[tuple[int, int]]()
    for panel in panels:
        assert panel["type"] in ("timeseries", "stat") and panel["title"] and panel["fieldConfig"]["defaults"]["unit"]
        assert {one["datasource"]["uid"] for one in panel["targets"]} == {"${datasource}"}
        place = panel["gridPos"]
        cells = {(place["x"] + i, place["y"] + j) for i in range(place["w"]) for j in range(place["h"])}
        assert place["x"] + place["w"] <= 24 and not cells & taken, "panels don't overlap"
        taken |= cells


def test_prometheus_finds_data_for_every_query(sink: PrometheusSink, tmp_path: Path) -> None:
    if shutil.which("prometheus") is None:
        pytest.skip("Prometheus isn't installed (tests/services/packages.txt)")
    port, page = free_port(), tmp_path / "page"
    page.mkdir()
    (page / "metrics").write_text(PAGE_METRICS, encoding="utf-8")
    files = free_port()
    config = tmp_path / "prometheus.yml"
    targets = f"127.0.0.1:{sink.port}", f"127.0.0.1:{files}"
    scrape = {"job_name": "bus", "static_configs": [{"targets": list(targets)}]}
    config.write_text(json.dumps({"global": {"scrape_interval": "1s"}, "scrape_configs": [scrape]}), encoding="utf-8")
    listen = f"--web.listen-address=127.0.0.1:{port}"
    with (
        subprocess.Popen([sys.executable, "-m", "http.server", str(files), "--bind", "127.0.0.1", "--directory", page],
                         stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server,
        subprocess.Popen(["prometheus", f"--config.file={config}", f"--storage.tsdb.path={tmp_path}/data", listen],
                         stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as prometheus,
    ):  # fmt: skip
        try:
            missing, numbers = dict(queries()), itertools.count(1)
            text = missing["Bandwidth that subscribers don't receive"]

            def is_complete() -> bool:
                send(sink, next(numbers))
                for title in [title for title, text in missing.items() if result(port, text)]:
                    del missing[title]
                return not missing and float(result(port, text)[0]["value"][1]) == pytest.approx(0.5, abs=0.1)

            until(is_complete, what="data for all queries", state=lambda: (missing, result(port, text)))
        finally:
            prometheus.kill()
            server.kill()


def result(port: int, text: str) -> list[dict[str, Any]]:
    """Series that Prometheus finds now; none while it starts."""
    query = urllib.parse.urlencode({"query": text})
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/v1/query?{query}", timeout=10) as answer:
            found: list[dict[str, Any]] = json.load(answer)["data"]["result"]
    except urllib.error.HTTPError as error:
        assert error.code == 503, f"{text}: {error.read().decode()}"
        return []
    except OSError:
        return []
    return found

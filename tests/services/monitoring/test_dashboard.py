"""The live page: plots, runs and alarms by Kafka, in a browser, dark and light, on a telephone; names stay text."""

from __future__ import annotations

import itertools
import json
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="the extra bus isn't installed")

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.http import factory
from scan2sim.services.kafka import Topic
from scan2sim.services.monitoring.dashboard.app import Sources, application
from scan2sim.services.monitoring.dashboard.history import History
from scan2sim.services.monitoring.events.schema import Event
from scan2sim.services.monitoring.settings.dashboard import PageParams
from scan2sim.services.monitoring.settings.limits import Limits
from scan2sim.services.outbox import Kept
from tests.browser import Page, chromium
from tests.fakes.broker import Broker
from tests.services.monitoring.sample_records import record

HOSTILE = "<img src=x onerror=document.title='hacked'>"
TOKEN = "0123456789abcdef"
NUMBERS = itertools.count(1)


@dataclass
class Shown:
    """A page that is served."""

    url: str
    sources: Sources

    @property
    def history(self) -> History:
        return self.sources.history

    def get(self, path: str, **headers: str) -> Any:
        with urllib.request.urlopen(urllib.request.Request(self.url + path, headers=headers), timeout=60) as answer:
            return json.load(answer)


def until(true: Callable[[], Any], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "never true"
        time.sleep(0.05)


@contextmanager
def shown(params: PageParams, *, reading: bool = True) -> Iterator[Shown]:
    """A page in a thread, of what comes from Kafka, or of what tests put into its sources."""
    sources, told = Sources.of(params), list[str]()
    app = application(params, sources)
    if reading:
        sources.start()
    threading.Thread(target=factory.run, args=(app, params, told.append), daemon=True).start()
    until(lambda: told)
    yield Shown(told[0], sources)
    if reading:
        sources.close()


def fill(history: History, names: list[str], seconds: int = 60, **changed: Any) -> None:
    """Records of the last so many seconds, a second each."""
    now = time.time()
    for name in names:
        for i in range(seconds):
            history.take(record(name, now - seconds + i, **changed).json_line().encode())


def records(names: list[str], seconds: int, **changed: Any) -> list[Kept]:
    """Of the last so many seconds."""
    now = time.time()
    told = [record(name, now - seconds + i, **changed) for i in range(seconds) for name in names]
    return [Kept(i, one.id, one.json_line().encode()) for i, one in enumerate(told)]


def open_page(page: Page, url: str, *, phone: bool = False, dark: bool = False) -> None:
    page.do("Emulation.setDeviceMetricsOverride", width=390 if phone else 1280, height=844 if phone else 1400,
            deviceScaleFactor=1, mobile=phone)  # fmt: skip
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    page.do("Emulation.setEmulatedMedia", features=[scheme])
    page.do("Page.navigate", url=url)
    page.until("document.readyState === 'complete' && document.querySelectorAll('figure canvas').length === 6")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium(tmp_path_factory.mktemp("browser"), "--disable-gpu") as opened:
        yield opened
        assert opened.errors == []


def event(kind: str, **body: Any) -> bytes:
    """An event as it comes from Kafka."""
    told = Event(id=f"0123:{next(NUMBERS)}", time=time.time(), sender="test", kind=kind, body=body)
    return told.json_line().encode()


def a_run(run: str, **changed: Any) -> bytes:
    fields = {"command": "survey", "source": "drive", "host": "edge", "state": "running", "steps": 100, "running": 1,
              "done": 40, "kept": 10, "failed": 1, "seconds": 3725.0}  # fmt: skip
    return event("run", run=run, **fields | changed)


def a_step(run: str, step: str, state: str, **more: Any) -> bytes:
    return event("step", **{"run": run, "tile": "street_1", "step": step, "state": state} | more)


def an_alarm(state: str, rule: str, since: float, subject: str = "/camera") -> bytes:
    return event("alarm", state=state, rule=rule, subject=subject, value=0.31, since=since)


def a_queue(name: str) -> bytes:
    counts = {"arrived": 10, "done": 6, "refused": 3, "waiting": 4, "workers": 1}
    return event("queue", queue=name, seconds=2.0, oldest=0.1, oldest_done=0.2, **counts)


def red(picture: np.ndarray, rgb: tuple[int, int, int] = (0xC8, 0x1E, 0x1E)) -> int:
    return int((np.abs(picture.astype(int) - rgb).max(axis=2) < 12).sum())


def figure_of(page: Page, title: str) -> np.ndarray:
    """(H, W, 3) of one plot, its caption left out."""
    box = f"[...document.querySelectorAll('figure')].find(f => f.querySelector('b').textContent === {title!r})"
    x, y, width, height = page.value(
        f"(b => [b.x, b.y + scrollY, b.width, b.height])({box}.querySelector('.uplot').getBoundingClientRect())"
    )
    return page.picture()[round(y) : round(y + height), round(x) : round(x + width)]


def test_records_come_from_kafka_to_the_page_once(broker: Broker, page: Page) -> None:
    params = PageParams(kafka_bootstrap_servers=broker.servers, port=0)
    topic = Topic(broker.servers, params.topic)
    topic.send(records(["early"], 30))  # before the page began
    with shown(params) as served:
        until(lambda: len(served.history.state()["nodes"]) == 1)
        assert served.get("health/ready") == {"failing": []}
        open_page(page, served.url)
        twice = records(["camera", "lidar"], 20, latency=150_000_000)
        topic.send(twice)
        topic.send(twice)
        page.until("document.querySelectorAll('#nodes tbody tr').length === 3")
        assert page.value("[...document.querySelectorAll('figcaption b')].map(b => b.textContent)") == [
            "Bandwidth by node", "Latency", "Sums", "Lost messages a period", "Messages a period",
            "Mean size of messages",
        ]  # fmt: skip
        assert "150 ms" in page.value("document.querySelector('#nodes tbody').textContent")
        page.until("document.getElementById('counts').textContent.startsWith('70 records')")
        broker.kill()
        until(lambda: not served.sources.is_connected())
        with pytest.raises(urllib.error.HTTPError, match="503"):
            served.get("health/ready")
        assert served.get("health/live") == {"failing": []}
        page.until("document.getElementById('status').textContent === 'Kafka is gone'")
        broker.start()  # which has forgotten all
        Topic(broker.servers, params.topic).send(records(["late"], 5))
        page.until("document.querySelectorAll('#nodes tbody tr').length === 4")
        page.until("document.getElementById('status').textContent === 'live'")


@pytest.fixture(scope="module")
def filled() -> Iterator[Shown]:
    """A page of 20 nodes, of which one loses more than the limit, and one has a hostile name."""
    with shown(PageParams(port=0, limit=Limits(lost=4)), reading=False) as served:
        fill(served.history, [f"node_{i:02d}" for i in range(18)], lost=4)
        fill(served.history, ["lossy"], lost=5)
        fill(served.history, [HOSTILE], hostname=HOSTILE, remarks=[HOSTILE], topics=[HOSTILE])
        served.history.take(json.dumps({"schema": HOSTILE}).encode())
        yield served


def test_values_beyond_a_limit_are_red_dots(filled: Shown, page: Page) -> None:
    open_page(page, filled.url)
    page.until("document.querySelectorAll('#nodes tbody tr').length === 20")
    assert red(figure_of(page, "Lost messages a period")) > 300
    assert red(figure_of(page, "Mean size of messages")) == red(figure_of(page, "Latency")) == 0
    assert "beyond 4" in page.value("document.getElementById('plots').textContent")


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("phone", [False, True], ids=["desk", "phone"])
def test_it_fits_the_screen_in_both_themes(dark: bool, phone: bool, filled: Shown, page: Page) -> None:
    open_page(page, filled.url, phone=phone, dark=dark)
    page.until("document.querySelectorAll('#nodes tbody tr').length === 20")
    assert page.value("document.documentElement.scrollWidth <= innerWidth"), "no sideways scroll"
    widths = page.value("[...document.querySelectorAll('.uplot canvas')].map(c => c.getBoundingClientRect().right)")
    assert len(widths) == 6 and max(widths) <= page.value("innerWidth")
    background = page.picture()[4, 4].mean()
    assert background < 60 if dark else background > 200
    page.value("document.getElementById('theme').click()")  # from the system's to light
    assert page.picture()[4, 4].mean() > 200
    page.value("document.getElementById('theme').click()")  # to dark
    assert page.picture()[4, 4].mean() < 60
    page.value("document.getElementById('theme').click()")


def test_names_never_become_html(filled: Shown, page: Page) -> None:
    open_page(page, filled.url)
    page.until("document.getElementById('remarks').textContent.includes('onerror')")
    assert page.value("document.querySelectorAll('img').length") == 0
    assert page.value("document.title").startswith("Event bus")
    for place in ("chips", "nodes", "remarks", "counts"):
        assert HOSTILE in page.value(f"document.getElementById({place!r}).textContent"), place
    assert page.value("fetch('https://example.org/').then(() => 'sent', () => 'refused')") == "refused"


def test_a_node_is_chosen_and_a_range_is_picked(filled: Shown, page: Page) -> None:
    open_page(page, filled.url)
    page.until("document.querySelectorAll('#chips button').length === 20")
    page.value("[...document.querySelectorAll('#chips button')].find(b => b.textContent === '/lossy').click()")
    page.until("held && held.nodes.length === 1")
    assert {one for one in page.value("held.sums.in") if one is not None} == {2000}
    x, y, width, height = page.value(
        "(b => [b.x, b.y, b.width, b.height])(document.querySelector('.u-over').getBoundingClientRect())"
    )
    page.do("Input.dispatchMouseEvent", type="mouseMoved", x=x + 0.9 * width, y=y + 0.1 * height)
    page.until("document.querySelector('figcaption output').textContent.includes('/lossy · 3 kB/s')", 20)
    page.value("[...document.querySelectorAll('#chips button')].find(b => b.textContent === '/lossy').click()")
    page.until("held && held.nodes.length === 20")
    x, y, width = page.value(
        "(b => [b.x, b.y + 60, b.width])(document.querySelector('.u-over').getBoundingClientRect())"
    )
    page.drag((x + 0.8 * width, y), (x + 0.9 * width, y))
    page.until("document.getElementById('status').textContent === 'past'")
    assert 25 < page.value("range.to - range.from") < 35
    page.value("document.querySelector('[data-seconds=\"900\"]').click()")
    page.until("document.getElementById('status').textContent !== 'past' && held && held.step === 5")


def test_a_live_window_moves_on_whole(filled: Shown, page: Page) -> None:
    open_page(page, filled.url)
    begin, end = page.value("[held.times[0], held.times.at(-1)]")
    fill(filled.history, ["late"], seconds=1)  # a 21st node
    page.until(f"held.times.at(-1) > {end + 2} && held.nodes.some(node => node.name === '/late')")
    times = page.value("held.times")
    assert times[0] > begin and set(np.diff(times)) == {1.0} and len(times) in (300, 301)
    lengths = page.value("held.nodes.flatMap(n => METRICS.flatMap(m => Object.values(n[m]).map(list => list.length)))")
    assert set(lengths) == {len(times)} == set(page.value("Object.values(held.sums).map(list => list.length)"))


def test_the_stream_goes_on_where_the_window_ends(filled: Shown) -> None:
    with urllib.request.urlopen(f"{filled.url}api/live?seconds=300&nodes=/lossy", timeout=60) as stream:
        events: list[dict[str, Any]] = []
        while len(events) < 2:
            line = stream.readline()
            if line.startswith(b"data: "):
                events.append(json.loads(line[6:]))
    first, second = events
    assert len(first["times"]) in (300, 301) and len(second["times"]) < 30
    assert second["times"][0] in first["times"], "the last buckets are told again"
    assert second["times"][-1] > first["times"][-1] and second["step"] == first["step"] == 1


def text(page: Page, place: str) -> str:
    return str(page.value(f"document.querySelector({place!r}).innerText"))


def test_runs_and_alarms_come_from_kafka_to_the_page(broker: Broker, page: Page) -> None:
    params = PageParams(kafka_bootstrap_servers=broker.servers, port=0, events_topic="happenings")
    topic = Topic(broker.servers, params.events_topic)

    def send(*bodies: bytes) -> None:
        topic.send([Kept(0, f"test:{next(NUMBERS)}", body) for body in bodies])

    send(a_run("r1"), a_step("r1", "poisson.terrain", "running", progress=0.25, seconds=12.0, host="gpu-1"))
    with shown(params) as served:
        page.do("Page.navigate", url=served.url)
        page.until("document.querySelector('.run')?.open")
        assert "survey drive" in text(page, ".run summary") and "50 of 100 steps" in text(page, ".run summary")
        assert "1:02 h on edge" in text(page, ".run summary") and "1 failed" in text(page, ".run summary")
        assert "street_1/poisson.terrain" in text(page, ".run table") and "gpu-1" in text(page, ".run table")
        assert page.value("document.querySelector('.run td progress').value") == 0.25
        assert page.value("document.getElementById('plots').hidden"), "no node has told anything"
        send(a_step("r1", "poisson.terrain", "done", progress=1.0, seconds=30.0, memory=1_500_000_000),
             a_step("r1", "texture", "failed", message="ran out of memory"))  # fmt: skip
        page.until("document.querySelector('.run tr.failed')?.innerText.includes('ran out of memory')")
        assert "1.5 GB" in text(page, ".run table") and "30 s" in text(page, ".run table")
        assert page.value("document.getElementById('alarm').hidden") and "None" in text(page, "#calm")
        send(an_alarm("raised", "images come late", time.time() - 5), b"no event")
        page.until("!document.getElementById('alarm').hidden")
        assert "Alarm: images come late, /camera, since" in text(page, "#alarm")
        page.until("document.getElementById('counts').innerText.includes('1 no event')")
        assert page.value("document.getElementById('queues').hidden")
        send(a_queue("detect"))
        page.until("!document.getElementById('queues').hidden")
        assert text(page, "#queues tbody").split() == ["detect", "live", "5/s", "3/s", "1.5/s", "4", "200", "ms", "1"]
        send(an_alarm("cleared", "images come late", time.time()),
             a_run("r1", state="failed", message="1 of 7 tiles failed"))  # fmt: skip
        page.until("document.getElementById('alarm').hidden")
        assert "cleared" in text(page, "#alarms")
        page.until("document.querySelector('.run .failure').innerText === '1 of 7 tiles failed'")


def test_runs_and_alarms_stay_text_and_fit_the_telephone(page: Page) -> None:
    with shown(PageParams(port=0), reading=False) as served:
        take = served.sources.noticed.take
        take(a_run(HOSTILE, command=HOSTILE, source=HOSTILE * 4, host=HOSTILE, message=HOSTILE, state="failed"))
        for number in range(40):
            take(a_step(HOSTILE, f"{HOSTILE}{number}", "failed", message=HOSTILE * 5, host=HOSTILE, tile=HOSTILE))
            take(an_alarm("raised", HOSTILE, time.time(), HOSTILE * number))
        take(a_queue(HOSTILE))
        fill(served.history, ["node"])
        for phone, dark in ((True, True), (False, False)):
            open_page(page, served.url, phone=phone, dark=dark)
            page.until("document.querySelectorAll('.run tbody tr').length === 16")
            assert page.value("document.documentElement.scrollWidth <= innerWidth"), "no sideways scroll"
            assert "40 alarms" in text(page, "#alarm") and "and 37 more" in text(page, "#alarm")
            assert "and 24 failed" in text(page, ".run")
            assert page.value("document.querySelectorAll('img').length") == 0
            for place in (".run summary", ".run table", ".run .failure", "#queues", "#alarm", "#alarms"):
                assert HOSTILE in text(page, place), place
        page.click(".run summary")
        page.until("!document.querySelector('.run').open")
        take(a_step(HOSTILE, "one more", "running"))
        page.until("details.get(Object.keys(Object.fromEntries(details))[0]).known === 41")
        assert not page.value("document.querySelector('.run').open"), "it stays folded"


def test_runs_that_have_not_changed_are_not_told_again() -> None:
    with shown(PageParams(port=0), reading=False) as served:
        served.sources.noticed.take(a_run("r1"))
        with urllib.request.urlopen(f"{served.url}api/live", timeout=60) as stream:
            told: list[dict[str, Any]] = []
            while len(told) < 3:
                line = stream.readline()
                if line.startswith(b"data: "):
                    told.append(json.loads(line[6:])["state"]["runs"][0])
                    if len(told) == 2:
                        served.sources.noticed.take(a_run("r1", done=41))
    assert [run.get("details", {}).get("last", {}).get("done") for run in told] == [40, None, 41]


@pytest.mark.parametrize(
    "query", ["from=5&to=4", "from=nan&to=4", "from=0&to=1e12", "from=0&to=1e10", "to=5", "from=0&to="]
)
def test_impossible_ranges_are_refused(query: str, filled: Shown) -> None:
    with pytest.raises(urllib.error.HTTPError, match="422") as caught:
        filled.get(f"api/history?{query}")
    assert set(json.load(caught.value)) == {"where", "cause", "remedy"}


def test_it_asks_for_the_token(tmp_path: Path, page: Page) -> None:
    (tmp_path / "token").write_text(TOKEN, encoding="utf-8")
    with shown(PageParams(port=0, token=tmp_path / "token"), reading=False) as served:
        with pytest.raises(urllib.error.HTTPError, match="401"):
            served.get("api/history?from=0&to=5")
        page.do("Page.navigate", url=served.url)
        page.until("document.getElementById('status')?.textContent === 'a token is wanted'")
        page.value(f"document.querySelector('#token input').value = {TOKEN!r}")
        page.value("document.querySelector('#token button').click()")
        page.until("document.querySelectorAll('figure canvas').length === 6")


@pytest.mark.parametrize("given", [["lost"], ["lost=x"], ["lost=-1"], ["lots=4"], ["latency=nan"], ["="]])
def test_limits_that_are_none_are_refused(given: list[str]) -> None:
    with pytest.raises(SettingError, match="--limit: must be KEY=VALUE"):
        PageParams.of("", {"limit": given})
    assert PageParams.of("", {"limit": ["latency=0.1", "lost=4"]}).limit.model_dump(exclude_none=True) == {
        "latency": 0.1,
        "lost": 4.0,
    }

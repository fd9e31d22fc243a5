"""Dashboard in a browser: plots, runs and alarms from Kafka; themes, phone layout, escaping of names."""

from __future__ import annotations

import itertools
import json
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="the extra bus isn't installed")

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.http import factory
from scan2sim.services.kafka import TopicProducer, read
from scan2sim.services.monitoring.dashboard.app import Sources, application
from scan2sim.services.monitoring.dashboard.history import History
from scan2sim.services.monitoring.events.schema import AlarmCommand, Event
from scan2sim.services.monitoring.record import TopicFlow
from scan2sim.services.monitoring.settings.dashboard import PageParams
from scan2sim.services.monitoring.settings.limits import Limits
from scan2sim.services.outbox import OutboxRecord
from tests.fakes.broker import Broker
from tests.fakes.browser import Page, chromium
from tests.fakes.sample_records import record
from tests.waiting import until

HOSTILE = "<img src=x onerror=document.title='hacked'>"
TOKEN = "0123456789abcdef"
NUMBERS = itertools.count(1)


@dataclass
class ServedPage:
    """A running dashboard."""

    url: str
    sources: Sources

    @property
    def history(self) -> History:
        return self.sources.history

    def get(self, path: str, **headers: str) -> Any:
        with urllib.request.urlopen(urllib.request.Request(self.url + path, headers=headers), timeout=60) as answer:
            return json.load(answer)


@contextmanager
def serve_page(params: PageParams, *, reading: bool = True) -> Iterator[ServedPage]:
    """Serve the dashboard in a thread; its data come from Kafka, or from the test if not `reading`."""
    sources, addresses = Sources.of(params), list[str]()
    app = application(params, sources)
    if reading:
        sources.start()
    threading.Thread(target=factory.run, args=(app, params, addresses.append), daemon=True).start()
    until(lambda: addresses)
    yield ServedPage(addresses[0], sources)
    if reading:
        sources.close()


def fill(history: History, names: list[str], seconds: int = 60, **changed: Any) -> None:
    """Add records of the last `seconds` seconds, one per second."""
    now = time.time()
    for name in names:
        for i in range(seconds):
            history.add(record(name, now - seconds + i, **changed).json_line().encode())


@contextmanager
def live(history: History, nodes: Mapping[str, Mapping[str, Any]]) -> Iterator[None]:
    """Add a record per second of each node, for the last minute and as time passes; `nodes`: changed fields by name."""
    ended, due = threading.Event(), time.time() - 60

    def catch_up() -> None:
        nonlocal due
        while due < time.time():
            for name, changed in nodes.items():
                history.add(record(name, due, **changed).json_line().encode())
            due += 1

    def tick() -> None:
        while not ended.wait(0.5):
            catch_up()

    catch_up()
    thread = threading.Thread(target=tick, name="nodes", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def records(names: list[str], seconds: int, **changed: Any) -> list[OutboxRecord]:
    """Records of the last `seconds` seconds, one per second and node."""
    now = time.time()
    made = [record(name, now - seconds + i, **changed) for i in range(seconds) for name in names]
    return [OutboxRecord(i, one.id, one.json_line().encode()) for i, one in enumerate(made)]


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
    """A serialized event, as read from Kafka."""
    made = Event(id=f"0123:{next(NUMBERS)}", time=time.time(), sender="test", kind=kind, body=body)
    return made.json_line().encode()


def a_run(run: str, **changed: Any) -> bytes:
    fields = {"command": "survey", "source": "drive", "host": "edge", "state": "running", "steps": 100, "running": 1,
              "done": 40, "cached": 10, "failed": 1, "seconds": 3725.0}  # fmt: skip
    return event("run", run=run, **fields | changed)


def a_step(run: str, step: str, state: str, **more: Any) -> bytes:
    return event("step", **{"run": run, "tile": "street_1", "step": step, "state": state} | more)


def an_alarm(state: str, rule: str, since: float, subject: str = "/camera", **more: Any) -> bytes:
    return event("alarm", state=state, rule=rule, subject=subject, value=0.31, since=since, **more)


def a_queue(name: str) -> bytes:
    counts = {"arrived": 10, "done": 6, "rejected": 3, "waiting": 4, "workers": 1}
    return event("queue", queue=name, seconds=2.0, oldest=0.1, oldest_done=0.2, **counts)


def count_red_pixels(picture: np.ndarray, rgb: tuple[int, int, int] = (0xC8, 0x1E, 0x1E)) -> int:
    return int((np.abs(picture.astype(int) - rgb).max(axis=2) < 12).sum())


def figure_of(page: Page, title: str) -> np.ndarray:
    """(H, W, 3) image of a plot without its caption."""
    box = f"[...document.querySelectorAll('figure')].find(f => f.querySelector('b').textContent === {title!r})"
    x, y, width, height = page.value(
        f"(b => [b.x, b.y + scrollY, b.width, b.height])({box}.querySelector('.uplot').getBoundingClientRect())"
    )
    return page.screenshot()[round(y) : round(y + height), round(x) : round(x + width)]


def test_records_from_kafka_appear_once_on_the_page(broker: Broker, page: Page) -> None:
    params = PageParams(kafka_bootstrap_servers=broker.servers, port=0)
    topic = TopicProducer(broker.cluster, params.topic)
    topic.send(records(["early"], 30))  # before the page was started
    with serve_page(params) as served:
        until(lambda: len(served.history.state()["nodes"]) == 1)
        assert served.get("health/ready") == {"failing": []}
        open_page(page, served.url)
        twice = records(["camera", "lidar"], 20, latency=150_000_000)
        topic.send(twice)
        topic.send(twice)
        page.until("document.querySelectorAll('#nodes tbody tr, #gone tbody tr').length === 3")
        assert page.value("[...document.querySelectorAll('figcaption b')].map(b => b.textContent)") == [
            "Bandwidth by node", "Latency", "Total bandwidth", "Lost messages per period", "Messages per period",
            "Mean message size",
        ]  # fmt: skip
        assert "150 ms" in page.value("document.getElementById('nodes').closest('section').textContent")
        page.until("document.getElementById('counts').textContent.startsWith('70 records')")
        broker.kill()
        until(lambda: not served.sources.is_connected())
        with pytest.raises(urllib.error.HTTPError, match="503"):
            served.get("health/ready")
        assert served.get("health/live") == {"failing": []}
        page.until("document.getElementById('status').textContent === 'Kafka is unreachable'")
        broker.start()  # it has lost all records
        TopicProducer(broker.cluster, params.topic).send(records(["late"], 5))
        page.until("document.querySelectorAll('#nodes tbody tr, #gone tbody tr').length === 4")
        page.until("document.getElementById('status').textContent === 'live'")


@pytest.fixture(scope="module")
def filled() -> Iterator[ServedPage]:
    """Dashboard of 20 live nodes; one loses more messages than the limit, and one has a hostile name."""
    nodes: dict[str, dict[str, Any]] = {f"node_{i:02d}": {"lost": 4} for i in range(18)} | {
        "lossy": {"lost": 5},
        HOSTILE: {"hostname": HOSTILE, "warnings": [HOSTILE], "topics": [HOSTILE]},
    }
    with serve_page(PageParams(port=0, limit=Limits(lost=4)), reading=False) as served, live(served.history, nodes):
        served.history.add(json.dumps({"schema": HOSTILE}).encode())
        yield served


def test_values_above_a_limit_are_red_dots(filled: ServedPage, page: Page) -> None:
    open_page(page, filled.url)
    page.until("document.querySelectorAll('#nodes tbody tr, #gone tbody tr').length === 20")
    assert count_red_pixels(figure_of(page, "Lost messages per period")) > 300
    for title in ("Mean message size", "Latency"):
        assert count_red_pixels(figure_of(page, title)) == 0
    assert "above 4" in page.value("document.getElementById('plots').textContent")


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("phone", [False, True], ids=["desk", "phone"])
def test_page_fits_the_screen_in_both_themes(dark: bool, phone: bool, filled: ServedPage, page: Page) -> None:
    open_page(page, filled.url, phone=phone, dark=dark)
    page.until("document.querySelectorAll('#nodes tbody tr, #gone tbody tr').length === 20")
    assert page.value("document.documentElement.scrollWidth <= innerWidth"), "no sideways scroll"
    widths = page.value("[...document.querySelectorAll('.uplot canvas')].map(c => c.getBoundingClientRect().right)")
    assert len(widths) == 6 and max(widths) <= page.value("innerWidth")
    background = page.screenshot()[4, 4].mean()
    assert background < 60 if dark else background > 200
    page.value("document.getElementById('theme').click()")  # from the system's to light
    assert page.screenshot()[4, 4].mean() > 200
    page.value("document.getElementById('theme').click()")  # to dark
    assert page.screenshot()[4, 4].mean() < 60
    page.value("document.getElementById('theme').click()")


def test_names_are_escaped(filled: ServedPage, page: Page) -> None:
    open_page(page, filled.url)
    page.until("document.getElementById('warnings').textContent.includes('onerror')")
    assert page.value("document.querySelectorAll('img').length") == 0
    assert page.value("document.title").startswith("Event bus")
    assert HOSTILE in page.value("document.getElementById('nodes').closest('section').textContent")
    for place in ("chips", "warnings", "counts"):
        assert HOSTILE in page.value(f"document.getElementById({place!r}).textContent"), place
    assert page.value("fetch('https://example.org/').then(() => 'sent', () => 'refused')") == "refused"


def test_user_selects_a_node_and_a_time_range(filled: ServedPage, page: Page) -> None:
    open_page(page, filled.url)
    page.until("document.querySelectorAll('#chips button').length === 20")
    page.value("[...document.querySelectorAll('#chips button')].find(b => b.textContent === '/lossy').click()")
    page.until("shownWindow && shownWindow.nodes.length === 1")
    assert {one for one in page.value("shownWindow.sums.in") if one is not None} == {2000}
    x, y, width, height = page.value(
        "(b => [b.x, b.y, b.width, b.height])(document.querySelector('.u-over').getBoundingClientRect())"
    )
    page.do("Input.dispatchMouseEvent", type="mouseMoved", x=x + 0.9 * width, y=y + 0.1 * height)
    page.until(
        "document.querySelector('.values:not([hidden])')?.innerText.split('\\n').join(' ') === '/lossy 3 kB/s'", 20
    )
    page.value("[...document.querySelectorAll('#chips button')].find(b => b.textContent === '/lossy').click()")
    page.until("shownWindow && shownWindow.nodes.length === 20")
    x, y, width = page.value(
        "(b => [b.x, b.y + 60, b.width])(document.querySelector('.u-over').getBoundingClientRect())"
    )
    page.drag((x + 0.8 * width, y), (x + 0.9 * width, y))
    page.until("document.getElementById('status').textContent === 'past'")
    assert 25 < page.value("range.to - range.from") < 35
    page.value("document.querySelector('[data-seconds=\"900\"]').click()")
    page.until("document.getElementById('status').textContent !== 'past' && shownWindow && shownWindow.step === 5")


def test_live_window_advances_without_gaps(filled: ServedPage, page: Page) -> None:
    open_page(page, filled.url)
    begin, end = page.value("[shownWindow.times[0], shownWindow.times.at(-1)]")
    fill(filled.history, ["late"], seconds=1)  # a 21st node
    page.until(f"shownWindow.times.at(-1) > {end + 2} && shownWindow.nodes.some(node => node.name === '/late')")
    of_node = "METRICS.flatMap(m => Object.values(n[m]).map(list => list.length))"
    times, of_nodes, of_sums = page.value(  # at once: the window advances
        f"[shownWindow.times, shownWindow.nodes.flatMap(n => {of_node}),"
        " Object.values(shownWindow.sums).map(list => list.length)]"
    )
    assert times[0] > begin and set(np.diff(times)) == {1.0} and len(times) in (300, 301)
    assert set(of_nodes) == {len(times)} == set(of_sums)


def test_stream_updates_continue_the_initial_window(filled: ServedPage) -> None:
    with urllib.request.urlopen(f"{filled.url}api/live?seconds=300&nodes=/lossy", timeout=60) as stream:
        events: list[dict[str, Any]] = []
        while len(events) < 2:
            line = stream.readline()
            if line.startswith(b"data: "):
                events.append(json.loads(line[6:]))
    first, second = events
    assert len(first["times"]) in (300, 301) and len(second["times"]) < 30
    assert second["times"][0] in first["times"], "the last buckets are resent"
    assert second["times"][-1] > first["times"][-1] and second["step"] == first["step"] == 1


def text(page: Page, place: str) -> str:
    return str(page.value(f"document.querySelector({place!r}).innerText"))


def test_runs_and_alarms_from_kafka_appear_on_the_page(broker: Broker, page: Page) -> None:
    params = PageParams(kafka_bootstrap_servers=broker.servers, port=0, events_topic="happenings")
    topic = TopicProducer(broker.cluster, params.events_topic)

    def send(*bodies: bytes) -> None:
        topic.send([OutboxRecord(0, f"test:{next(NUMBERS)}", body) for body in bodies])

    send(a_run("r1"), a_step("r1", "poisson.terrain", "running", progress=0.25, seconds=12.0, host="gpu-1"))
    with serve_page(params) as served:
        page.do("Page.navigate", url=served.url)
        page.until("document.querySelector('.run')?.open && !!document.querySelector('.run td progress')")
        assert "survey drive" in text(page, ".run summary") and "50 of 100 tasks" in text(page, ".run summary")
        assert "1:02 h on edge" in text(page, ".run summary") and "1 failed" in text(page, ".run summary")
        assert "street_1/poisson.terrain" in text(page, ".run table") and "gpu-1" in text(page, ".run table")
        assert page.value("document.querySelector('.run td progress').value") == 0.25
        assert page.value("document.getElementById('plots').hidden"), "no records of nodes"
        send(a_step("r1", "poisson.terrain", "done", progress=1.0, seconds=30.0, memory=1_500_000_000),
             a_step("r1", "texture", "failed", message="ran out of memory"))  # fmt: skip
        page.until("document.querySelector('.run tr.failed')?.innerText.includes('ran out of memory')")
        page.until("!document.querySelector('.run td progress')")
        assert "1.5 GB" in text(page, ".run table") and "30 s" in text(page, ".run table")
        assert page.value("document.getElementById('alarm').hidden") and "None" in text(page, "#calm")
        send(an_alarm("raised", "images come late", time.time() - 5), b"not an event")
        page.until("!document.getElementById('alarm').hidden")
        assert "Alarm: images come late, /camera, since" in text(page, "#alarm")
        page.until("document.getElementById('counts').innerText.includes('rejected events: 1 invalid JSON')")
        assert page.value("document.getElementById('queues').hidden")
        send(a_queue("detect"))
        page.until("!document.getElementById('queues').hidden")
        assert text(page, "#queues tbody").split() == ["detect", "live", "5/s", "3/s", "1.5/s", "4", "200", "ms", "1"]
        send(an_alarm("raised", "images come late", time.time() - 5, acknowledged_by="Ada"))
        page.until("document.getElementById('alarm').hidden")
        assert "acknowledged by Ada" in text(page, "#alarms")
        send(an_alarm("cleared", "images come late", time.time()),
             a_run("r1", state="failed", message="1 of 7 tiles failed"))  # fmt: skip
        page.until("document.getElementById('alarms').innerText.includes('cleared')")
        page.until("document.querySelector('.run .failure').innerText === '1 of 7 tiles failed'")


def test_runs_and_alarms_are_escaped_and_fit_a_phone(page: Page) -> None:
    with serve_page(PageParams(port=0), reading=False) as served:
        add = served.sources.bus_state.add
        add(a_run(HOSTILE, command=HOSTILE, source=HOSTILE * 4, host=HOSTILE, message=HOSTILE, state="failed"))
        for number in range(40):
            add(a_step(HOSTILE, f"{HOSTILE}{number}", "failed", message=HOSTILE * 5, host=HOSTILE, tile=HOSTILE))
            add(an_alarm("raised", HOSTILE, time.time(), HOSTILE * number))
        add(a_queue(HOSTILE))
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
        add(a_step(HOSTILE, "one more", "running"))
        page.until("details.get(Object.keys(Object.fromEntries(details))[0]).known === 41")
        assert not page.value("document.querySelector('.run').open"), "it stays folded"


def a_flow(topic: str, messages: int) -> TopicFlow:
    kind = "sensor_msgs/msg/Image"
    return TopicFlow(
        topic=topic, direction="outgoing", type=kind, bandwidth=1e3 * messages, messages=messages, size=1e3
    )


def test_topics_are_sorted_by_the_chosen_column_and_past_nodes_fold_away(page: Page) -> None:
    first = "document.querySelector('#topics tbody td').innerText"
    with serve_page(PageParams(port=0), reading=False) as served:
        fill(served.history, ["camera"], period=60.0, flows=[a_flow("/a", 1), a_flow("/b", 9), a_flow("/c", 5)])
        served.history.add(record("past", time.time() - 100).json_line().encode())
        open_page(page, served.url)
        page.until(f"{first} === '/b'")
        for column, topic in (("topic", "/a"), ("topic", "/c"), ("published", "/b"), ("published", "/a")):
            page.click(f"#topics th[data-key='{column}'] button")
            page.until(f"{first} === {topic!r}")
        assert page.value("document.querySelectorAll('#nodes tbody tr').length") == 1
        page.until("document.querySelector('#gone summary').innerText === '1 gone'")
        assert page.value("document.documentElement.scrollWidth <= innerWidth")


def test_crosshair_lists_all_values_at_a_time(filled: ServedPage, page: Page) -> None:
    open_page(page, filled.url)
    page.until("shownWindow && shownWindow.nodes.length >= 20")
    x, y, width, height = page.value(
        "(b => [b.x, b.y, b.width, b.height])(document.querySelectorAll('.u-over')[3].getBoundingClientRect())"
    )
    page.do("Input.dispatchMouseEvent", type="mouseMoved", x=x + 0.9 * width, y=y + 0.2 * height)
    lists = "[...document.querySelectorAll('.values')].map(one => one.hidden ? '' : one.innerText)"
    page.until(f"{lists}.every(text => text)")
    values = page.value(lists)
    assert values[3].split("\n")[:2] == ["/lossy", "5"] and values[3].count("node_") == 18, "the largest first"
    assert "difference" in values[2] and "lower ones" in values[0], "the others at the same time, shorter"
    right = page.value(
        "Math.max(...[...document.querySelectorAll('.values')].map(v => v.getBoundingClientRect().right))"
    )
    assert right <= page.value("innerWidth")
    page.do("Input.dispatchMouseEvent", type="mouseMoved", x=2, y=2)
    page.until(f"{lists}.every(text => !text)")


def test_user_plots_by_topic(page: Page) -> None:
    titles = "[...document.querySelectorAll('figcaption b')].map(b => b.textContent).join()"
    camera = {"flows": [a_flow(HOSTILE, 1), a_flow("/b", 9), a_flow("/c", 5)]}
    params = PageParams(port=0, limit=Limits(bandwidth=10))
    with serve_page(params, reading=False) as served, live(served.history, {"camera": camera}):
        served.history.add(record("past", time.time() - 100).json_line().encode())
        open_page(page, served.url)
        page.until("shownWindow?.nodes.length === 2")
        page.until("document.querySelector('#chips summary').innerText === '1 gone'")
        page.click("[data-by='topic']")
        page.until("shownWindow?.topics?.length === 3")
        assert "Bandwidth by topic" in page.value(titles) and "Messages per second" in page.value(titles)
        assert count_red_pixels(figure_of(page, "Bandwidth by topic")) == 0, "limits are those of nodes"
        assert HOSTILE in text(page, "#chips") and page.value("document.querySelectorAll('img').length") == 0
        page.value("[...document.querySelectorAll('#chips button')].find(b => b.textContent === '/b').click()")
        page.until("shownWindow?.topics.length === 1")
        assert {one for one in page.value("shownWindow.topics[0].messages.mean") if one is not None} == {9}
        page.click("[data-by='node']")
        page.until("shownWindow?.nodes.length === 2 && !shownWindow.topics")
        assert "Bandwidth by node" in page.value(titles)


def test_alarms_are_acknowledged_and_muted_on_the_page(broker: Broker, page: Page) -> None:
    params = PageParams(kafka_bootstrap_servers=broker.servers, port=0, events_topic="handled")
    topic = TopicProducer(broker.cluster, params.events_topic)
    alarm = "raised", "images come late", time.time() - 5, "/camera/image at /fusion"

    def send(**more: Any) -> None:
        topic.send([OutboxRecord(0, f"test:{next(NUMBERS)}", an_alarm(*alarm, **more))])

    def commands(count: int) -> list[AlarmCommand]:
        """All commands, of which there are at least `count`."""
        bodies, found = read(broker.cluster, params.events_topic, group="test", since=0, wait=0.5), list[Event]()

        def are_complete() -> bool:
            if (body := next(bodies)) is None:
                return len(found) >= count
            if (one := Event.model_validate_json(body)).kind == "alarm_command":
                found.append(one)
            return False

        until(are_complete, what=f"{count} commands", state=lambda: found)
        found.sort(key=lambda one: one.time)  # they are in different partitions
        return [AlarmCommand.model_validate(one.body) for one in found]

    def press(name: str) -> None:
        page.value(f"[...document.querySelectorAll('#alarms button')].find(b => b.innerText === {name!r}).click()")

    with serve_page(params) as served:
        page.do("Page.navigate", url=served.url)
        page.until("document.readyState === 'complete' && byId('status').textContent === 'live'")
        send()
        page.until("document.querySelectorAll('#alarms button').length === 2")
        page.value("localStorage.clear()")
        assert page.value("[...document.querySelectorAll('#alarms button')].every(b => b.disabled)"), "no name yet"
        page.value("handling.by.value = 'Ada'; handling.by.dispatchEvent(new Event('input'))")
        page.until("!document.querySelector('#alarms button').disabled")
        press("Acknowledge")
        page.until("document.getElementById('answer').innerText.startsWith('Sent')")
        page.value("handling.seconds.value = '900'")
        press("Mute")
        page.until("document.getElementById('answer').innerText.startsWith('Sent to the alarm node: mute')")
        acknowledged, muted = commands(2)
        assert (acknowledged.action, acknowledged.rule, acknowledged.subject) == ("acknowledge", alarm[1], alarm[3])
        assert (muted.action, muted.by) == ("mute", "Ada") and 800 < muted.until - time.time() < 900
        send(acknowledged_by="Ada", muted_until=time.time() + 900)
        page.until("document.querySelector('#alarms button')?.disabled && document.getElementById('alarm').hidden")
        assert "Unmute" in text(page, "#alarms")
        for origin, status in (("https://evil.example", "403"), (served.url.rstrip("/"), "422")):
            headers = {"Origin": origin, "Content-Type": "application/json"}
            request = urllib.request.Request(f"{served.url}api/alarms/mute", b"{}", headers)
            with pytest.raises(urllib.error.HTTPError, match=status):
                urllib.request.urlopen(request, timeout=60)
        page.value("localStorage.clear()")


def test_node_that_is_gone_for_good_is_retired_on_the_page(broker: Broker, page: Page) -> None:
    params = PageParams(kafka_bootstrap_servers=broker.servers, port=0, topic="retired_records", events_topic="retired")
    TopicProducer(broker.cluster, params.events_topic).send([OutboxRecord(0, f"test:{next(NUMBERS)}", a_queue("q"))])
    listed = "[...document.querySelectorAll('#gone tbody tr')].map(r => r.cells[0].innerText)"
    with serve_page(params) as served:
        for name in ("lost", "past"):
            served.history.add(record(name, time.time() - 100).json_line().encode())
        page.do("Page.navigate", url=served.url)
        page.until("document.readyState === 'complete' && byId('status').textContent === 'live'")
        page.value("localStorage.clear(); byId('gone').open = true")
        page.until("document.querySelectorAll('#gone tbody button').length === 2")
        assert page.value("document.querySelector('#gone tbody button').disabled"), "no name yet"
        page.value("handling.by.value = 'Ada'; handling.by.dispatchEvent(new Event('input'))")
        page.until("!document.querySelector('#gone tbody button').disabled")
        page.click("#gone tbody button")
        page.until("document.getElementById('answer').innerText.startsWith('Sent to the alarm node: retire /lost')")
        page.until(f"JSON.stringify({listed}) === '[\"/past\"]'")
        served.history.add(record("lost", time.time(), period=60.0).json_line().encode())
        page.until("document.querySelector('#nodes tbody').innerText.includes('/lost')")
        page.value("localStorage.clear()")
    bodies = read(broker.cluster, params.events_topic, group="test-retired", since=0, wait=0.5)
    events = (Event.model_validate_json(one) for one in bodies if one is not None)
    command = AlarmCommand.model_validate(next(one.body for one in events if one.kind == "alarm_command"))
    assert (command.action, command.subject, command.by) == ("retire", "/lost", "Ada")


def test_alarms_are_not_handled_by_strangers(tmp_path: Path) -> None:
    from starlette.testclient import TestClient

    for name in ("certificate", "key"):
        (tmp_path / name).touch()
    params = PageParams(port=0, host="0.0.0.0", certificate=tmp_path / "certificate", key=tmp_path / "key")
    client = TestClient(application(params, Sources.of(params)))
    answer = client.post("/api/alarms/mute", json={"rule": "*", "subject": "/camera", "by": "stranger"})
    assert answer.status_code == 403 and "--token" in answer.json()["cause"]
    assert client.post("/api/nodes/retire", json={"node": "/camera", "by": "stranger"}).status_code == 403


def test_details_of_unchanged_runs_are_not_resent() -> None:
    with serve_page(PageParams(port=0), reading=False) as served:
        served.sources.bus_state.add(a_run("r1"))
        with urllib.request.urlopen(f"{served.url}api/live", timeout=60) as stream:
            done: list[int | None] = []  # of each update; None: without details
            while 41 not in done:
                line = stream.readline()
                if line.startswith(b"data: "):
                    (run,) = json.loads(line[6:])["state"]["runs"]
                    done.append(run["details"]["last"]["done"] if "details" in run else None)
                    if len(done) == 2:
                        served.sources.bus_state.add(a_run("r1", done=41))
    assert done[:2] == [40, None] and set(done[2:-1]) <= {None}


@pytest.mark.parametrize(
    "query", ["from=5&to=4", "from=nan&to=4", "from=0&to=1e12", "from=0&to=1e10", "to=5", "from=0&to="]
)
def test_invalid_ranges_are_rejected(query: str, filled: ServedPage) -> None:
    with pytest.raises(urllib.error.HTTPError, match="422") as caught:
        filled.get(f"api/history?{query}")
    assert set(json.load(caught.value)) == {"where", "cause", "remedy", "error"}


def test_page_prompts_for_the_token(tmp_path: Path, page: Page) -> None:
    (tmp_path / "token").write_text(TOKEN, encoding="utf-8")
    with serve_page(PageParams(port=0, token=tmp_path / "token"), reading=False) as served:
        with pytest.raises(urllib.error.HTTPError, match="401"):
            served.get("api/history?from=0&to=5")
        page.do("Page.navigate", url=served.url)
        page.until("document.getElementById('status')?.textContent === 'a token is required'")
        page.value(f"document.querySelector('#token input').value = {TOKEN!r}")
        page.value("document.querySelector('#token button').click()")
        page.until("document.querySelectorAll('figure canvas').length === 6")


@pytest.mark.parametrize("given", [["lost"], ["lost=x"], ["lost=-1"], ["lots=4"], ["latency=nan"], ["="]])
def test_malformed_limits_are_rejected(given: list[str]) -> None:
    with pytest.raises(SettingError, match="--limit: must be KEY=VALUE"):
        PageParams.of("", {"limit": given})
    assert PageParams.of("", {"limit": ["latency=0.1", "lost=4"]}).limit.model_dump(exclude_none=True) == {
        "latency": 0.1,
        "lost": 4.0,
    }

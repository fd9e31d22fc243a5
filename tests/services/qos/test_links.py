"""A link does what it is asked to, whichever backend makes it, and is gone with who made it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError, UnavailableError
from scan2sim.pipeline.core.plugins import Lacking
from scan2sim.services.qos import links, namespaces
from scan2sim.services.qos.counters import Counter
from scan2sim.services.qos.emulated_link import Link
from scan2sim.services.qos.link_profile import Shape
from tests.services.qos.needed import need_link

each = pytest.mark.parametrize("backend", plugins.names(links.__name__))
FLOOD = """
import socket, sys, time
address, size, count, pause = sys.argv[1], *map(float, sys.argv[2:])
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for _ in range(int(count) // 4):
    for _ in range(4):
        out.sendto(bytes(int(size)), (address, 9999))
    time.sleep(pause)
"""
"""Sends so many packets of a size, four at once."""


def pinged(link: Link, count: int, pause: float, wire: int = 0) -> tuple[int, float]:
    """Answers, and seconds there and back: of the quickest, as a busy machine's processors add to the others."""
    said = link.near.run(
        "ping", "-q", "-c", count, "-i", pause, "-W", "1", link.far.address_on(wire), capture_output=True, text=True
    ).stdout
    least = re.search(r"= ([\d.]+)/", said)
    answers = re.search(r"(\d+) received", said)
    assert least and answers, said
    return int(answers[1]), float(least[1]) / 1e3


def delayed(link: Link, seconds: float) -> bool:
    """Whether packets take so long there and back: none is quicker, and one no slower, once the machine has time."""
    for _ in range(20):
        if (least := pinged(link, 50, 0.02)[1]) < 1.05 * seconds:
            return least > 0.95 * seconds
    return False


@each
def test_packets_are_delayed_each_way_as_asked_and_that_changes_while_it_runs(backend: str) -> None:
    need_link(backend, "ping")
    with Link(Shape(delay=0.03), Shape(delay=0.01), backend=backend) as link:
        assert delayed(link, 0.04)
        link.shape(Shape(delay=0.05))
        assert delayed(link, 0.1)


@each
def test_losses_are_as_many_as_asked_and_the_kernel_counts_what_the_link_lost(backend: str) -> None:
    need_link(backend, "nft")
    sent = 4000
    for shape, spread in ((Shape(loss=0.1), 0.25), (Shape(loss=0.1, burst=3), 0.5)):  # five standard deviations
        with Link(shape, backend=backend) as link:
            left, came = Counter(link.near, "output", 300, 400), Counter(link.far, "input", 300, 400)
            link.near.run(sys.executable, "-c", FLOOD, link.far.address, 300, sent, 0.001, check=True)
            time.sleep(0.3)
            assert left.read().packets == sent
            assert 1 - came.read().packets / sent == pytest.approx(0.1, rel=spread)


@each
def test_no_more_passes_than_the_rate(backend: str) -> None:
    need_link(backend)
    rate = 4e6
    with Link(Shape(rate=rate, queue=0.05), backend=backend) as link:
        flood = link.near.popen(sys.executable, "-c", FLOOD, link.far.address, 1000, 1e6, 0.002)
        while link.far.counts().received_bytes < rate / 8 * 0.1:  # Python starts
            assert flood.poll() is None
            time.sleep(0.05)
        before, began = link.far.counts(), time.monotonic()
        time.sleep(1.5)
        after, ended = link.far.counts(), time.monotonic()
        assert flood.poll() is None
    assert 8 * (after.received_bytes - before.received_bytes) / (ended - began) == pytest.approx(rate, rel=0.05)


def test_all_is_gone_when_its_maker_is_killed(tmp_path: Path) -> None:
    need_link()
    code = (
        "import sys, time\nfrom scan2sim.services.qos.emulated_link import Link\n"
        "from scan2sim.services.qos.link_profile import Shape\n"
        "with Link(Shape()) as link:\n    sleeping = link.far.popen('sleep', '600')\n"
        "    print(sleeping.pid, link.near.name, link.far.name, flush=True)\n    time.sleep(600)\n"
    )
    maker = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert maker.stdout
    pid, *names = maker.stdout.readline().split()
    os.killpg(maker.pid, signal.SIGKILL)
    maker.communicate()
    end = time.monotonic() + 10
    while Path(f"/proc/{pid}/cmdline").exists() and Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8"):
        assert time.monotonic() < end
        time.sleep(0.05)
    while set(names) & {*namespaces.ip("netns", "list").split()}:
        assert time.monotonic() < end
        time.sleep(0.05)


def test_an_error_inside_leaves_nothing_behind() -> None:
    need_link()
    with pytest.raises(ZeroDivisionError), Link(Shape()) as link:
        name, started = link.near.name, link.near.popen("sleep", "600")
        raise ZeroDivisionError
    assert started.poll() == -signal.SIGKILL
    assert name not in namespaces.ip("netns", "list")


def test_what_a_link_needs_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with (
        pytest.raises(UnavailableError, match=r"only root may make network namespaces\. Run it as root"),
        Link(Shape()),
    ):
        pass
    with pytest.raises(SettingError, match="there is no 'tin can'"):
        links.find("tin can")
    for name in plugins.names(links.__name__):
        monkeypatch.setattr(plugins.module(links.__name__, name), "lacking", lambda: Lacking("lacks it", "Get it"))
    with pytest.raises(UnavailableError, match=r"netem lacks it; wirefilter lacks it\. Get it"):
        links.find()
    assert links.programs(sh="dash", no_such_program="its-package") == Lacking(
        "needs no_such_program, not installed here", "apt-get install its-package"
    )


@pytest.mark.parametrize("wrong", [{"loss": 1.0}, {"rate": 0}, {"delay": -1}, {"burst": 0.5}, {"speed": 1}])
def test_what_no_link_can_do_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(SettingError):
        Shape.of("link", wrong)


def test_wires_beside_each_other_are_shaped_each_for_itself() -> None:
    need_link(None, "ping")
    slow, fast = Shape(delay=0.04), Shape(delay=0.001)
    with Link(fast, beside=[(slow, slow)]) as link:
        assert pinged(link, 20, 0.02)[1] < 0.04 < 0.075 < pinged(link, 20, 0.02, wire=1)[1]
        link.shape(slow)
        assert pinged(link, 20, 0.02)[1] > 0.075

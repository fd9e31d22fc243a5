"""Emulated links have the given properties with every backend, and are removed with their creator."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError, UnavailableError
from scan2sim.pipeline.core.plugins import Unavailable
from scan2sim.services.qos import links, namespaces
from scan2sim.services.qos.counters import Counter
from scan2sim.services.qos.emulated_link import Link
from scan2sim.services.qos.link_profile import LinkProfile
from tests.services.qos.needed import need_link
from tests.waiting import until

each_backend = pytest.mark.parametrize("backend", plugins.names(links.__name__))
FLOOD = """
import socket, sys, time
address, size, count, pause = sys.argv[1], *map(float, sys.argv[2:])
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for _ in range(int(count) // 4):
    for _ in range(4):
        out.sendto(bytes(int(size)), (address, 9999))
    time.sleep(pause)
"""
"""Sends packets of a given size, four at once."""


def ping(link: Link, count: int, pause: float, wire: int = 0) -> tuple[int, float]:
    """Number of responses, and shortest round-trip time in seconds (the load of the machine adds to the others)."""
    output = link.near.run(
        "ping", "-q", "-c", count, "-i", pause, "-W", "1", link.far.address_on(wire), capture_output=True, text=True
    ).stdout
    shortest = re.search(r"= ([\d.]+)/", output)
    responses = re.search(r"(\d+) received", output)
    assert shortest and responses, output
    return int(responses[1]), float(shortest[1]) / 1e3


def has_round_trip_time(link: Link, seconds: float) -> bool:
    """Whether the shortest round-trip time is as given; tries again while the machine is busy."""
    for _ in range(20):
        if (shortest := ping(link, 50, 0.02)[1]) < 1.05 * seconds:
            return shortest > 0.95 * seconds
    return False


@each_backend
@pytest.mark.realtime
def test_delays_of_both_directions_add_up_and_can_be_changed(backend: str) -> None:
    need_link(backend, "ping")
    with Link(LinkProfile(delay=0.03), LinkProfile(delay=0.01), backend=backend) as link:
        assert has_round_trip_time(link, 0.04)
        link.shape(LinkProfile(delay=0.05))
        assert has_round_trip_time(link, 0.1)


@each_backend
@pytest.mark.realtime
def test_the_loss_rate_is_as_given_and_counted_by_the_kernel(backend: str) -> None:
    need_link(backend, "nft", "ping")
    sent = 4000
    for profile, spread in ((LinkProfile(loss=0.1), 0.25), (LinkProfile(loss=0.1, burst=3), 0.5)):  # 5 sigma
        with Link(profile, backend=backend) as link:
            outgoing, incoming = Counter(link.near, "output", 300, 400), Counter(link.far, "input", 300, 400)
            link.near.run(sys.executable, "-c", FLOOD, link.far.address, 300, sent, 0.001, check=True)
            assert ping(link, 20, 0.02)[0], "behind the last packet"
            assert outgoing.read().packets == sent
            assert 1 - incoming.read().packets / sent == pytest.approx(0.1, rel=spread)


class ReceivedBytes(NamedTuple):
    """Bytes received by the far side at a time between `earliest` and `latest`."""

    earliest: float
    total: int
    latest: float

    @staticmethod
    def read(link: Link) -> ReceivedBytes:
        return ReceivedBytes(time.monotonic(), link.far.counts().received_bytes, time.monotonic())


@each_backend
@pytest.mark.realtime
def test_the_rate_is_limited(backend: str) -> None:
    need_link(backend)
    rate = 4e6
    with Link(LinkProfile(rate=rate, queue=0.05), backend=backend) as link:
        flood = link.near.popen(sys.executable, "-c", FLOOD, link.far.address, 1000, 1e6, 0.002)
        until(lambda: link.far.counts().received_bytes > rate / 8 * 0.1)

        def reaches_the_rate() -> bool:
            """Whether the rate is reached for 1.5 s, unless a program stalls meanwhile; it is never exceeded."""
            before = ReceivedBytes.read(link)
            time.sleep(1.5)
            after = ReceivedBytes.read(link)
            assert flood.poll() is None
            bits = 8 * (after.total - before.total)
            assert bits / (after.latest - before.earliest) < 1.05 * rate
            return bits / (after.latest - before.earliest) > 0.95 * rate

        until(reaches_the_rate)


def test_everything_is_removed_when_the_creator_is_killed(tmp_path: Path) -> None:
    need_link()
    code = (
        "import sys, time\nfrom scan2sim.services.qos.emulated_link import Link\n"
        "from scan2sim.services.qos.link_profile import LinkProfile\n"
        "with Link(LinkProfile()) as link:\n    sleeping = link.far.popen('sleep', '600')\n"
        "    print(sleeping.pid, link.near.name, link.far.name, flush=True)\n    time.sleep(600)\n"
    )
    maker = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert maker.stdout
    pid, *names = maker.stdout.readline().split()
    os.killpg(maker.pid, signal.SIGKILL)
    maker.communicate()

    def command_line() -> str:
        try:
            return Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8")
        except (FileNotFoundError, ProcessLookupError):
            return ""

    until(lambda: not command_line())
    until(lambda: not {*names} & {*namespaces.ip("netns", "list").split()})


def test_an_error_inside_the_context_leaves_nothing_behind() -> None:
    need_link()
    with pytest.raises(ZeroDivisionError), Link(LinkProfile()) as link:
        name, started = link.near.name, link.near.popen("sleep", "600")
        raise ZeroDivisionError
    assert started.poll() == -signal.SIGKILL
    assert name not in namespaces.ip("netns", "list")


def test_a_program_that_has_not_entered_its_namespace_yet_ends_with_the_link(monkeypatch: pytest.MonkeyPatch) -> None:
    need_link()
    with Link(LinkProfile()) as link:
        monkeypatch.setattr(namespaces.Namespace, "command_inside", lambda _, *command: [*command])
        started = link.near.popen("sleep", "600")
    assert started.poll() == -signal.SIGKILL


def test_missing_requirements_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with (
        pytest.raises(UnavailableError, match=r"only root may create network namespaces\. Run it as root"),
        Link(LinkProfile()),
    ):
        pass
    with pytest.raises(SettingError, match="unknown value 'tin can'"):
        links.find("tin can")
    for name in plugins.names(links.__name__):
        module = plugins.module(links.__name__, name)
        monkeypatch.setattr(module, "unavailable", lambda: Unavailable("needs a tool", "Get it"))
    with pytest.raises(UnavailableError, match=r"netem needs a tool; wirefilter needs a tool\. Get it"):
        links.find()
    assert links.programs(sh="dash", no_such_program="its-package") == Unavailable(
        "needs no_such_program, not installed here", "apt-get install its-package"
    )


@pytest.mark.parametrize("wrong", [{"loss": 1.0}, {"rate": 0}, {"delay": -1}, {"burst": 0.5}, {"speed": 1}])
def test_impossible_profiles_are_rejected(wrong: dict[str, Any]) -> None:
    with pytest.raises(SettingError):
        LinkProfile.of("link", wrong)


@pytest.mark.realtime
def test_parallel_wires_have_separate_profiles() -> None:
    need_link(None, "ping")
    slow, fast = LinkProfile(delay=0.04), LinkProfile(delay=0.001)
    with Link(fast, beside=[(slow, slow)]) as link:
        assert ping(link, 20, 0.02)[1] < 0.04 < 0.075 < ping(link, 20, 0.02, wire=1)[1]
        link.shape(slow)
        assert ping(link, 20, 0.02)[1] > 0.075

"""Drives by a script over shaped links (parts of `bench.teleop`): glass to glass, cuts, joining, table 6."""

from __future__ import annotations

import random
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from scan2sim.services.qos import requirements
from scan2sim.services.qos.compare import passed, rows
from scan2sim.services.qos.link_profile import Shape
from scan2sim.services.qos.requirements import MACHINE, NETWORK, UNITS, Environment
from scan2sim.services.teleoperation.control.messages import Kind
from scan2sim.services.teleoperation.qos.measure import (
    WIRES,
    Measured,
    Pair,
    delays,
    film,
    measure,
    pair,
    percentile,
    quiet,
)
from scan2sim.services.teleoperation.qos.scripted_drive import Setup
from scan2sim.services.teleoperation.settings import MeasureParams

Say = Callable[[str], None]
MOBILE = Shape(delay=0.04, jitter=0.01, loss=0.01)
CUT, WORSE = MOBILE.model_copy(update={"loss": 0.9999}), MOBILE.model_copy(update={"loss": 0.05})
SINGLE = 0.2
"""Of the time that two links are tried for, a single one is."""
GROWN = 10.0
"""Seconds until video has grown to what links carry."""
CALM = 3.0
"""Seconds without events at the end, so that what was lost is known."""


@contextmanager
def mobile(wires: Sequence[int] = range(WIRES), cameras: int = 4) -> Iterator[Pair]:
    """A pair over the mobile link's wires; not yet joined."""
    with tempfile.TemporaryDirectory(prefix="bench-teleop-") as name:
        folder = Path(name)
        setup = replace(Setup("", ""), cameras=cameras, pictures=str(film(folder / "pictures")))
        with pair((MOBILE, MOBILE), setup, folder, wires) as ends:
            yield ends


def told(what: str, measured: Measured, say: Say) -> None:
    """A line of a drive."""
    glass, ways = measured.glass_to_glass, delays(measured.vehicle["messages"], Kind.COMMAND)
    say(
        f"{what}: {len(glass) / measured.seconds:.0f} pictures/s, "
        f"{measured.station['seen'].get('bytes', 0) * 8e-6 / measured.seconds:.1f} Mbit/s, glass to glass "
        f"{percentile(glass, 50):.0f} ms, p95 {percentile(glass, 95):.0f}; {measured.lost_frames:.3%} of frames lost, "
        f"{measured.station['seen'].get('unseen', 0)} not decoded; commands {percentile(ways, 95):.0f} ms p95, "
        f"longest gap {measured.command_gap:.0f} ms; stopped {max(len(measured.station['stops']) - 1, 0)} times "
        f"{measured.station['reasons']}"
    )


def glass(scale: float, say: Say) -> dict[str, Any]:
    """Four cameras over the mobile link."""
    with mobile() as ends:
        ends.station.ask("join")
        ends.station.ask("drive")
        time.sleep(GROWN)
        measured = ends.measured(max(5.0, 60.0 * scale))
    told("glass", measured, say)
    return {"glass_to_glass_p95_ms": round(percentile(measured.glass_to_glass, 95), 1)}


class Event(NamedTuple):
    """A wire is another from a moment on, seconds."""

    at: float
    wire: int
    shape: Shape


def schedule(seconds: float, chance: random.Random) -> list[Event]:
    """One of two wires is cut, or loses more, for a while, then is as it was; the other is left alone meanwhile."""
    events, at = list[Event](), 1.0
    while True:
        wire, cut = chance.randrange(WIRES), chance.random() < 0.6
        lasts = chance.uniform(0.3, 5.0) if cut else chance.uniform(2.0, 6.0)
        if at + lasts > seconds - CALM:
            return events
        events += [Event(at, wire, CUT if cut else WORSE), Event(at + lasts, wire, MOBILE)]
        at += lasts + chance.uniform(2.0, 5.0)  # a link that was cut takes about two seconds to be back


def shaken(seconds: float, wires: Sequence[int], say: Say) -> Measured:
    """A drive over some of two wires that are cut and restored."""
    with mobile(wires) as ends:
        assert ends.link is not None
        ends.station.ask("join")
        ends.station.ask("drive")
        time.sleep(3.0)
        events = schedule(seconds, random.Random(21))
        say(f"{len(events)} events in {seconds:.0f} s, {len(wires)} links")
        began = time.monotonic()

        def happen(fraction: float, message: str = "") -> None:
            while events and events[0].at <= time.monotonic() - began:
                event = events.pop(0)
                assert ends.link is not None
                ends.link.shape(event.shape, wire=event.wire)

        return ends.measured(seconds, happen)


def cuts(scale: float, say: Say) -> dict[str, Any]:
    """One of two links cut, restored, degraded; and the same with a single link."""
    seconds = max(20.0, 600.0 * scale)
    two = shaken(seconds, range(WIRES), say)
    told("two links", two, say)
    one = shaken(max(20.0, SINGLE * seconds), [0], say)
    told("a single link", one, say)
    ratio = two.lost_frames / one.lost_frames if one.lost_frames else None
    return {
        "command_gap_max_ms": round(two.command_gap, 1),
        "lost_frames_ratio": None if ratio is None else round(ratio, 4),
    }


def join(scale: float, say: Say) -> dict[str, Any]:
    """Joined and parted, again and again: until it can be driven, and all cameras are seen."""
    times, hands, ready = list[float](), list[float](), list[float]()
    with mobile() as ends:
        for _ in range(max(3, round(20 * scale))):
            found = ends.station.ask("join")
            times.append(found["pictures_s"])
            ready.append(found["ready_s"])
            hands += found["handshakes_s"]
            ends.station.ask("release")
            time.sleep(0.5)
    say(
        f"join: {len(times)} times, half within {median(times):.2f} s, all within {max(times):.2f} s with pictures, "
        f"{max(ready):.2f} s until it may be driven; handshakes {max(hands):.2f} s at most; {found['ciphers']}"
    )
    return {"join_s": round(max(times), 2)}


def qos(scale: float, say: Say) -> dict[str, Any]:
    """Table 6, in all environments."""
    service, verdicts = requirements.read("teleoperation"), dict[str, bool]()
    for environment in Environment:
        required = service.of(environment)
        params = MeasureParams(environment=environment, seconds=max(5.0, 30.0 * scale), warm=GROWN)
        found = rows(required, measure(params, required, quiet))
        verdicts[environment] = passed(found, NETWORK)
        for row in found:
            value = "-" if row.measured is None else f"{row.measured:.4g}"
            verdict = {True: "pass", False: "FAIL", None: ""}[row.passed]
            asked = "-" if row.required is None else row.required
            say(f"{environment:<6} {row.metric:<14} {asked!s:<16} {value:>9} {UNITS.get(row.metric, ''):<7} {verdict}")
        say(f"{environment:<6} machine: {'passed' if passed(found, MACHINE) else 'FAILED'}")
    return {"qos": verdicts}

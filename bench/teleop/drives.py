"""Scripted drives over emulated links (parts of `bench.teleop`): glass to glass, cuts, joining, table 6."""

from __future__ import annotations

import multiprocessing
import os
import random
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.services.qos import requirements
from scan2sim.services.qos.compare import compare_metrics, passed
from scan2sim.services.qos.link_profile import LinkProfile
from scan2sim.services.qos.requirements import MACHINE_METRICS, NETWORK_METRICS, UNITS, Environment
from scan2sim.services.teleoperation.control.messages import Kind
from scan2sim.services.teleoperation.qos.measure import (
    WIRE_COUNT,
    Measurement,
    ScriptedPair,
    delays,
    ignore_progress,
    measure,
    percentile,
    render_test_images,
    scripted_pair,
)
from scan2sim.services.teleoperation.qos.scripted_drive import Setup
from scan2sim.services.teleoperation.settings import MeasureParams
from tests.fakes.video_link import SimulatedLink, SimulatedVideo

Report = Callable[[str], None]
MOBILE = LinkProfile(delay=0.04, jitter=0.01, loss=0.01)
CUT, DEGRADED = MOBILE.model_copy(update={"loss": 0.9999}), MOBILE.model_copy(update={"loss": 0.05})
SINGLE_LINK_SHARE = 0.2
"""Duration with a single link, as a share of that with two."""
RAMP_UP_S = 10.0
"""Seconds until the video's bit rate has grown to the capacity of the links."""
QUIET_S = 3.0
"""Seconds without events at the end, until all losses are known."""


@contextmanager
def mobile(wires: Sequence[int] = range(WIRE_COUNT), cameras: int = 4) -> Iterator[ScriptedPair]:
    """Vehicle and station at the ends of the mobile link's wires; not yet joined."""
    with tempfile.TemporaryDirectory(prefix="bench-teleop-") as name:
        folder = Path(name)
        setup = replace(Setup("", ""), cameras=cameras, pictures=str(render_test_images(folder / "pictures")))
        with scripted_pair((MOBILE, MOBILE), setup, folder, wires) as ends:
            yield ends


def report_drive(what: str, measured: Measurement, report: Report) -> None:
    """Report the results of a drive in one line."""
    glass, one_way = measured.glass_to_glass, delays(measured.vehicle["messages"], Kind.COMMAND)
    report(
        f"{what}: {len(glass) / measured.seconds:.0f} frames/s, "
        f"{measured.station['seen'].get('bytes', 0) * 8e-6 / measured.seconds:.1f} Mbit/s, glass to glass "
        f"{percentile(glass, 50):.0f} ms, p95 {percentile(glass, 95):.0f}; {measured.lost_frames:.3%} of frames lost, "
        f"{measured.station['seen'].get('unseen', 0)} not decoded; commands {percentile(one_way, 95):.0f} ms p95, "
        f"longest gap {measured.command_gap:.0f} ms; stopped {max(len(measured.station['stops']) - 1, 0)} times "
        f"{measured.station['reasons']}"
    )


def glass(scale: float, report: Report) -> dict[str, Any]:
    """Glass-to-glass latency of four cameras over the mobile link."""
    with mobile() as ends:
        ends.station.ask("join")
        ends.station.ask("drive")
        time.sleep(RAMP_UP_S)
        measured = ends.measured(max(5.0, 60.0 * scale))
    report_drive("glass", measured, report)
    return {"glass_to_glass_p95_ms": round(percentile(measured.glass_to_glass, 95), 1)}


def _spin() -> None:
    while True:
        pass


def busy(scale: float, report: Report) -> dict[str, Any]:
    """Glass-to-glass latency while another process keeps each core busy."""
    spawn = multiprocessing.get_context("spawn")
    others = [spawn.Process(target=_spin, daemon=True) for _ in range(os.cpu_count() or 1)]
    for one in others:
        one.start()
    try:
        found = glass(scale, report)
    finally:
        for one in others:
            one.kill()
            one.join()
    return {"glass_to_glass_busy_p95_ms": found["glass_to_glass_p95_ms"]}


def two(scale: float, report: Report) -> dict[str, Any]:
    """Video rate over two links that don't carry it alone."""
    profile = LinkProfile(delay=0.01, rate=12e6)
    with tempfile.TemporaryDirectory(prefix="bench-teleop-") as name:
        folder = Path(name)
        setup = replace(
            Setup("", ""), cameras=4, bitrate=5e6, share=True, pictures=str(render_test_images(folder / "pictures"))
        )
        with scripted_pair((profile, LinkProfile(delay=0.01)), setup, folder) as ends:
            ends.station.ask("join")
            ends.station.ask("drive")
            time.sleep(2 * RAMP_UP_S)
            measured = ends.measured(max(5.0, 60.0 * scale))
    report_drive("two links of 12 Mbit/s", measured, report)
    return {"two_links_mbit": round(measured.station["seen"].get("bytes", 0) * 8e-6 / measured.seconds, 1)}


FULL, NARROW = (LinkProfile(delay=0.03, rate=rate, queue=1.0) for rate in (20e6, 5e6))
"""D3.2's data rate (table 6), and what remains of it; a second of queue, as mobile networks have it."""
DROP_S, BEFORE_DROP_S, DROPS = 15.0, 5.0, 4
"""Seconds for which the rate is low, and for which it is measured before; number of drops."""
EXTRA_LATENCY_MS = 100.0
"""Latency above that before the drop up to which the video's rate fits the link."""


def picture_age(measured: Measurement, camera: int, times: F64) -> F64:
    """Age in ms of a camera's newest decoded frame at times, seconds of the monotonic clock."""
    frames = np.array(
        sorted((decoded, captured) for one, captured, decoded in measured.station["glass"] if one == camera)
    )
    newest = np.maximum.accumulate(frames[:, 1])
    return np.asarray(1e3 * times - newest[np.searchsorted(frames[:, 0], times * 1e9) - 1] / 1e6)


def drop(scale: float, report: Report) -> dict[str, Any]:
    """The only link's rate drops from 20 to 5 Mbit/s: extra picture age, and time until the video's rate fits."""
    found = [_drop(report) for _ in range(max(1, round(DROPS * scale)))]
    peak, settled = (median(one) for one in zip(*found, strict=True))
    return {"drop_extra_latency_ms": round(peak), "drop_fits_s": round(settled, 1)}


def _drop(report: Report) -> tuple[float, float]:
    with tempfile.TemporaryDirectory(prefix="bench-teleop-") as name:
        folder = Path(name)
        setup = replace(Setup("", ""), cameras=4, bitrate=4.4e6, pictures=str(render_test_images(folder / "pictures")))
        with scripted_pair((FULL, FULL), setup, folder, [0]) as ends:
            assert ends.link is not None
            ends.station.ask("join")
            ends.station.ask("drive")
            time.sleep(RAMP_UP_S)
            began = time.monotonic()
            timer = threading.Timer(BEFORE_DROP_S, ends.link.shape, (NARROW,))
            timer.start()
            measured = ends.measured(BEFORE_DROP_S + DROP_S)
            timer.join()
    report_drive("drop", measured, report)
    dropped = began + BEFORE_DROP_S
    before, after = np.arange(began + 1, dropped, 0.01), np.arange(dropped, dropped + DROP_S - 1, 0.01)
    extra = np.max(
        [picture_age(measured, n, after) - np.median(picture_age(measured, n, before)) for n in range(4)], axis=0
    )
    late = np.flatnonzero(extra > EXTRA_LATENCY_MS)
    peak, settled = float(extra.max()), float(after[late[-1]] - dropped) if len(late) else 0.0
    report(f"  at most {peak:.0f} ms older; older by {EXTRA_LATENCY_MS:.0f} ms until {settled:.1f} s after the drop")
    return peak, settled


def congestion(scale: float, report: Report) -> dict[str, Any]:
    """The same in simulated time (`tests.fakes.video_link`), with reports of congestion and without."""
    found = dict[str, float]()
    for suffix, detect in (("_before", False), ("", True)):
        link = SimulatedLink(lambda at: 20e6 if at < RAMP_UP_S + BEFORE_DROP_S else 5e6, queue=1.0)
        video = SimulatedVideo(link, RAMP_UP_S + BEFORE_DROP_S + DROP_S, detect=detect)
        peak, settled = video.peak(RAMP_UP_S + BEFORE_DROP_S, RAMP_UP_S)
        rate = video.mean_rate(RAMP_UP_S + BEFORE_DROP_S + 5) / 1e6
        report(
            f"{'with' if detect else 'without'} reports: {peak:.0f} ms older, {settled:.1f} s; then {rate:.1f} Mbit/s"
        )
        found |= {f"simulated_drop_extra_latency_ms{suffix}": round(peak), f"simulated_drop_fits_s{suffix}": settled}
    return found


class Event(NamedTuple):
    """Change of a wire's profile at a time, seconds."""

    at: float
    wire: int
    profile: LinkProfile


def schedule(seconds: float, chance: random.Random) -> list[Event]:
    """Cut or degrade one of two wires at a time for a while, then restore it."""
    events, at = list[Event](), 1.0
    while True:
        wire, cut = chance.randrange(WIRE_COUNT), chance.random() < 0.6
        lasts = chance.uniform(0.3, 5.0) if cut else chance.uniform(2.0, 6.0)
        if at + lasts > seconds - QUIET_S:
            return events
        events += [Event(at, wire, CUT if cut else DEGRADED), Event(at + lasts, wire, MOBILE)]
        at += lasts + chance.uniform(2.0, 5.0)  # a cut link takes about two seconds to reconnect


def drive_with_cuts(seconds: float, wires: Sequence[int], report: Report) -> Measurement:
    """Drive over some of two wires that are cut and restored."""
    with mobile(wires) as ends:
        assert ends.link is not None
        ends.station.ask("join")
        ends.station.ask("drive")
        time.sleep(3.0)
        events = schedule(seconds, random.Random(21))
        report(f"{len(events)} events in {seconds:.0f} s, {len(wires)} links")
        began = time.monotonic()

        def apply_events(fraction: float, message: str = "") -> None:
            while events and events[0].at <= time.monotonic() - began:
                event = events.pop(0)
                assert ends.link is not None
                ends.link.shape(event.profile, wire=event.wire)

        return ends.measured(seconds, apply_events)


def cuts(scale: float, report: Report) -> dict[str, Any]:
    """Cut, restore and degrade one of two links; then the same with a single link."""
    seconds = max(20.0, 600.0 * scale)
    two = drive_with_cuts(seconds, range(WIRE_COUNT), report)
    report_drive("two links", two, report)
    one = drive_with_cuts(max(20.0, SINGLE_LINK_SHARE * seconds), [0], report)
    report_drive("a single link", one, report)
    ratio = two.lost_frames / one.lost_frames if one.lost_frames else None
    return {
        "command_gap_max_ms": round(two.command_gap, 1),
        "lost_frames_ratio": None if ratio is None else round(ratio, 4),
    }


def join(scale: float, report: Report) -> dict[str, Any]:
    """Join and release repeatedly: time until pictures of all cameras arrive, and until driving is possible."""
    times, hands, ready = list[float](), list[float](), list[float]()
    with mobile() as ends:
        for _ in range(max(3, round(20 * scale))):
            found = ends.station.ask("join")
            times.append(found["pictures_s"])
            ready.append(found["ready_s"])
            hands += found["handshakes_s"]
            ends.station.ask("release")
            time.sleep(0.5)
    report(
        f"join: {len(times)} times, half within {median(times):.2f} s, all within {max(times):.2f} s with pictures, "
        f"{max(ready):.2f} s until ready to drive; handshakes at most {max(hands):.2f} s; {found['ciphers']}"
    )
    return {"join_s": round(max(times), 2)}


def qos(scale: float, report: Report) -> dict[str, Any]:
    """D3.2, table 6 in all environments."""
    service, verdicts = requirements.read("teleoperation"), dict[str, bool]()
    for environment in Environment:
        required = service.of(environment)
        params = MeasureParams(environment=environment, seconds=max(5.0, 30.0 * scale), warm=RAMP_UP_S)
        found = compare_metrics(required, measure(params, required, ignore_progress))
        verdicts[environment] = passed(found, NETWORK_METRICS)
        for row in found:
            value = "-" if row.measured is None else f"{row.measured:.4g}"
            verdict = {True: "pass", False: "FAIL", None: ""}[row.passed]
            required_text = "-" if row.required is None else row.required
            unit = UNITS.get(row.metric, "")
            report(f"{environment:<6} {row.metric:<14} {required_text!s:<16} {value:>9} {unit:<7} {verdict}")
        report(f"{environment:<6} machine: {'passed' if passed(found, MACHINE_METRICS) else 'FAILED'}")
    return {"qos": verdicts}

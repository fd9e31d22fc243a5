"""Benchmarks of monitoring and autoscaling.

`python -m bench.bus [--parts experiment sizes forecast overhead broker alarms nodes link] [--speed 25] [--out DIR]`

- experiment: D3.2, section 3.2 with real nodes (bench/bus/experiment.py): Monday from 6 to 10 h with 10, 20 and 50
  cameras at once, replayed at `--speed`, with message sizes sent as a field; plots are written to DIR.
- sizes: half an hour of the rush hour with 50 cameras and messages of real size, at 20 times the speed; starts with
  four workers, as it begins in the rush.
- forecast: error of forecasts on simulated Mondays (bench/bus/forecast.py).
- overhead: a publisher and a subscriber, monitored and plain (bench/bus/overhead.py); needs an idle machine.
- broker: records of ten nodes while the broker is down for a minute (bench/bus/broker_outage.py).
- alarms: alarms of living nodes while the broker is down, and of one with a slow clock (bench/bus/alarms.py).
- nodes: a hundred nodes on one machine, monitored by one page (bench/bus/many_nodes.py).
- link: reported bandwidth, loss and latency, compared with emulated links (bench/bus/link.py); requires root.

Ends with `RESULT {json}` with the keys of `KEYS` and some more; null for parts that were not run.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bench.bus import alarms, broker_outage, link, many_nodes, overhead
from bench.bus import experiment as bus_experiment
from bench.bus import forecast as bus_forecast
from bench.bus.experiment import MAX_AGE_S, Outcome, Replay

RUSH_HOURS = (7.5, 8.0)
"""Hours of the part with real sizes, and its replay speed."""
RUSH_SPEED = 20.0


def experiment(given: argparse.Namespace) -> dict[str, Any]:
    """By number of cameras: workers, age of the oldest event and lost events."""
    replays = bus_experiment.replays(given.speed)
    outcomes = bus_experiment.replay(replays, given.out)
    _print(replays, outcomes)
    _plot(replays, outcomes, given.out / "event-bus.png")
    return {str(one.cameras): outcome.result() for one, outcome in zip(replays, outcomes, strict=True)}


def sizes(given: argparse.Namespace) -> dict[str, Any]:
    """The same with messages of real size."""
    replay = Replay(50, RUSH_SPEED, RUSH_HOURS, real_sizes=True, min_workers=4)
    outcomes = bus_experiment.replay([replay], given.out)
    _print([replay], outcomes)
    return outcomes[0].result() | {"peak_mb_s": round(outcomes[0].bandwidth * RUSH_SPEED / 1e6, 1)}


def forecast(_: argparse.Namespace) -> dict[str, Any]:
    """Mean error in workers by lead time and kind of forecast."""
    return bus_forecast.compare()


PARTS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "experiment": experiment,
    "sizes": sizes,
    "forecast": forecast,
    "overhead": lambda _: overhead.overhead(),
    "broker": lambda _: broker_outage.broker_down(),
    "alarms": lambda _: alarms.false_alarms(),
    "nodes": lambda _: many_nodes.nodes_watched(),
    "link": lambda _: link.link(),
}
KEYS = ("experiment", "overhead_p50_1kb", "overhead_throughput_1kb", "overhead_p50_6mb", "broker_down_lost",
        "broker_down_duplicates", "bandwidth_error", "loss_error", "latency_error", "nodes_watched", "false_alarms",
        "flaps")  # fmt: skip
"""Keys that the result always has."""
FLAT = ("overhead", "broker", "alarms", "nodes", "link")
"""Parts whose results are merged into the top level."""


def _print(replays: Sequence[Replay], outcomes: Sequence[Outcome]) -> None:
    for replay, outcome in zip(replays, outcomes, strict=True):
        requested = [one[3] for one in outcome.series]
        shares = ", ".join(
            f"{count}: {100 * requested.count(count) / len(requested):.0f} %" for count in sorted(set(requested))
        )
        begin, end = replay.hours
        peak = outcome.bandwidth * replay.speed / 1e6
        print(
            f"{replay.cameras} cameras, {begin:g} to {end:g} h at {replay.speed:g}x: {outcome.sent} events, "
            f"{outcome.sent - outcome.done} lost, at most {max(one[2] for one in outcome.series):.1f} per second on "
            f"average; workers {shares} of the time; oldest event {outcome.oldest:.2f} s, over {MAX_AGE_S:g} s in "
            f"{outcome.late} of {len(outcome.series)} records; at most {peak:.1f} MB/s",
            flush=True,
        )


def _plot(replays: Sequence[Replay], outcomes: Sequence[Outcome], path: Path) -> None:
    """Plot like D3.2, figure 5: events per second in red, their average in blue, workers in green."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.2), layout="constrained")
    for axes, replay, outcome in zip(figure.subplots(1, len(replays)), replays, outcomes, strict=True):
        begin, end = replay.hours
        series = [one for one in outcome.series if begin + one[0] / 3600 <= end]
        hours = [begin + one[0] / 3600 for one in series]
        axes.plot(hours, [one[1] for one in series], color="tab:red", lw=0.4, label="events per second, 10 s")
        axes.plot(hours, [one[2] for one in series], color="tab:blue", lw=1.2, label="5 min average")
        axes.step(hours, [one[3] for one in series], color="tab:green", lw=1.5, label="requested workers")
        axes.set(title=f"{replay.cameras} cameras", xlabel="hour of Monday", xlim=replay.hours, ylim=(0, None))
        axes.grid(alpha=0.3)
    axes.legend(fontsize="small", loc="lower right")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    print(f"plot: {path}", flush=True)


def main() -> None:
    """Run the parts and print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--speed", type=float, default=25.0)
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "scan2sim-bus")
    given = parser.parse_args()
    found = {name: part(given) if name in given.parts else None for name, part in PARTS.items()}
    result = dict.fromkeys(KEYS) | {name: figures for name, figures in found.items() if name not in FLAT}
    for name in FLAT:
        result |= found[name] or {}
    print("RESULT " + json.dumps(result))

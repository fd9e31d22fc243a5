"""Teleoperation under delays, losses, link failures and attacks (docs/teleoperation.md).

`python -m bench.teleop [--parts stale,brakes,open,glass,busy,two,...] [--minutes 10] [--world demo-out]`, as
root, since it creates network namespaces. Takes 45 minutes; `--minutes` is the duration of `cuts`, and the other parts
scale with it. Ends with a line `RESULT {json}`.

- stale: station, page, vehicle and link hang, 200 times: hangs after which something old looked live, or that the page
  noticed later than 300 ms after the last sign of life. brakes: pairs of input devices of which a brake was ignored.
- open: commands that start although nothing protects them.
- glass: four cameras over a mobile link of two wires (40 ms one way, 10 ms jitter, 1 % loss): latency from capture to
  decoding at the station, by a timecode drawn into each frame.
- busy: the same with all cores busy. two: data rate over two links of 12 Mbit/s; 20 Mbit/s required.
- drop: the only link's rate drops from 20 to 5 Mbit/s: how much older pictures get, and how long until the rate fits.
- congestion: the same in simulated time, which doesn't depend on this machine's load, before and after.
- cuts: one of two such links is cut, restored and degraded at random; lost frames relative to a single link.
- stops: all links of a vehicle are cut, a thousand times: time until its adapter brakes.
- nodes: the velocity smoother, and the collision monitor, before a ROS 2 vehicle hang: longest time until it brakes.
- clocks: a wall clock is wrong by 10 s: whether both sides warn before the vehicle drives.
- hostile: intruders, malformed and replayed datagrams, replayed video, a flood.
- join: time to join a vehicle and a station.
- qos: table 6 of D3.2 on the robot, the edge and the cloud, see `scan2sim teleop measure`.
- route: a drive along the street of a finished world (`make demo`): cross-track error by network.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
import traceback
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from bench.teleop import cockpit, drives, hostile, nodes, route, stops

DEFAULT_MINUTES = 10.0


class Part(NamedTuple):
    """Function of a part, keys of its results, and its time limit at the default duration, seconds."""

    do: Callable[[float, Callable[[str], None]], dict[str, Any]]
    gives: tuple[str, ...]
    limit: float


WORLD = Path("demo-out")
PARTS = {
    "stale": Part(cockpit.stale, ("stale_shown", "stale_after_1_s", "hangs"), 1200),
    "brakes": Part(cockpit.brakes, ("brakes_ignored", "brake_pairs"), 400),
    "open": Part(cockpit.open_starts, ("open_starts", "open_starts_tried"), 200),
    "glass": Part(drives.glass, ("glass_to_glass_p95_ms",), 150),
    "busy": Part(drives.busy, ("glass_to_glass_busy_p95_ms",), 150),
    "two": Part(drives.two, ("two_links_mbit",), 150),
    "drop": Part(drives.drop, ("drop_extra_latency_ms", "drop_fits_s"), 240),
    "congestion": Part(
        drives.congestion,
        (
            "simulated_drop_extra_latency_ms_before",
            "simulated_drop_fits_s_before",
            "simulated_drop_extra_latency_ms",
            "simulated_drop_fits_s",
        ),
        60,
    ),
    "cuts": Part(drives.cuts, ("command_gap_max_ms", "lost_frames_ratio"), 840),
    "stops": Part(stops.stops, ("stops", "stops_in_time"), 420),
    "nodes": Part(nodes.nodes, ("nodes_stop_ms",), 150),
    "clocks": Part(stops.clocks, ("wrong_clocks", "wrong_clocks_noticed"), 60),
    "hostile": Part(hostile.hostile, ("intruders_in", "replayed_shown", "memory_growth"), 240),
    "join": Part(drives.join, ("join_s",), 120),
    "qos": Part(drives.qos, ("qos",), 330),
    "route": Part(partial(route.route, WORLD), ("off_way_m",), 180),
}
MIN_LIMIT_S = 150.0
"""Minimum time limit of a part."""


def run_part(name: str, part: Part, scale: float) -> dict[str, Any]:
    """Run a part in a process with a time limit; missing results are None."""
    spawn = multiprocessing.get_context("spawn")
    parent_end, child_end = spawn.Pipe(duplex=False)
    process = spawn.Process(target=_run, args=(part, scale, child_end))
    began = time.monotonic()
    process.start()
    child_end.close()
    limit, found = max(MIN_LIMIT_S, part.limit * scale), dict[str, Any]()
    try:
        if parent_end.poll(limit):
            found = parent_end.recv()
        else:
            print(f"{name}: not finished after {limit:.0f} s", flush=True)
    except EOFError:
        print(f"{name}: failed", flush=True)
    process.join(10.0)
    process.kill()
    process.join()
    print(f"{name}: {time.monotonic() - began:.0f} s, {json.dumps(found)}", flush=True)
    return {key: found.get(key) for key in part.gives}


def _run(part: Part, scale: float, pipe: Connection) -> None:
    try:
        pipe.send(part.do(scale, lambda text: print(f"  {text}", flush=True)))
    except Exception:  # continue with the other parts, whatever it is
        traceback.print_exc()
    finally:
        pipe.close()


def main() -> None:
    """Run all parts, or some."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", default=",".join(PARTS), help="parts to run, separated by commas")
    parser.add_argument(
        "--minutes", type=float, default=DEFAULT_MINUTES, help="duration of `cuts`; others scale with it"
    )
    parser.add_argument("--world", type=Path, default=WORLD, help="finished world for `route`")
    given = parser.parse_args()
    parts = PARTS | {"route": PARTS["route"]._replace(do=partial(route.route, given.world))}
    chosen = given.parts.split(",")
    if unknown := set(chosen) - set(PARTS):
        parser.error(f"unknown parts: {', '.join(sorted(unknown))}")
    result: dict[str, Any] = {key: None for part in PARTS.values() for key in part.gives}
    for name in chosen:
        result |= run_part(name, parts[name], given.minutes / DEFAULT_MINUTES)
    print("RESULT", json.dumps(result))
    sys.exit(any(result[key] is None for name in chosen for key in PARTS[name].gives))

"""Teleoperation under what the world does to it: delays, losses, cuts, intruders (docs/teleoperation.md).

`python -m bench.teleop [--parts glass,cuts,stops,clocks,hostile,join,qos,route] [--minutes 10] [--world demo-out]`, as
root: it makes networks. It takes 25 minutes; `--minutes` is how long links are cut and restored, and all else in
proportion. It ends with a line `RESULT {json}`.

- glass: four cameras over a mobile link of two wires (40 ms one way, 10 ms jitter, 1 % loss): from a picture's taking
  to its being decoded at the station, by the time that is drawn into it.
- cuts: one of two such links is cut, restored, degraded at random; lost frames against those of a single link.
- stops: all links of a vehicle are cut, a thousand times: when its translator brakes.
- clocks: a wall clock is wrong by 10 s: whether both sides notice before anybody drives.
- hostile: intruders, malformed and replayed datagrams, video sent once more by others, a flood.
- join: how long it takes to join a vehicle and a station.
- qos: table 6 of D3.2 on the robot, the edge and the cloud, as `scan2sim teleop measure` tells.
- route: a drive along the street of a finished world (`make demo`): how far off its way, by what network.
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

from bench.teleop import drives, hostile, route, stops

FULL = 10.0
"""Minutes."""


class Part(NamedTuple):
    """What is done, the results that it gives, and the seconds that it may take at full length."""

    do: Callable[[float, Callable[[str], None]], dict[str, Any]]
    gives: tuple[str, ...]
    limit: float


WORLD = Path("demo-out")
PARTS = {
    "glass": Part(drives.glass, ("glass_to_glass_p95_ms",), 150),
    "cuts": Part(drives.cuts, ("command_gap_max_ms", "lost_frames_ratio"), 840),
    "stops": Part(stops.stops, ("stops", "stops_in_time"), 420),
    "clocks": Part(stops.clocks, ("wrong_clocks", "wrong_clocks_noticed"), 60),
    "hostile": Part(hostile.hostile, ("intruders_in", "replayed_shown", "memory_growth"), 240),
    "join": Part(drives.join, ("join_s",), 120),
    "qos": Part(drives.qos, ("qos",), 330),
    "route": Part(partial(route.route, WORLD), ("off_way_m",), 180),
}
LEAST = 150.0
"""Seconds that each part may take, however short it is."""


def done(name: str, part: Part, scale: float) -> dict[str, Any]:
    """A part, in a process of its own, which is ended at its limit; what it didn't give is None."""
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe(duplex=False)
    process = spawn.Process(target=_run, args=(part, scale, there))
    began = time.monotonic()
    process.start()
    there.close()
    limit, found = max(LEAST, part.limit * scale), dict[str, Any]()
    try:
        if here.poll(limit):
            found = here.recv()
        else:
            print(f"{name}: isn't done after {limit:.0f} s", flush=True)
    except EOFError:
        print(f"{name}: has failed", flush=True)
    process.join(10.0)
    process.kill()
    process.join()
    print(f"{name}: {time.monotonic() - began:.0f} s, {json.dumps(found)}", flush=True)
    return {key: found.get(key) for key in part.gives}


def _run(part: Part, scale: float, pipe: Connection) -> None:
    try:
        pipe.send(part.do(scale, lambda text: print(f"  {text}", flush=True)))
    except Exception:  # whatever it is, other parts go on
        traceback.print_exc()
    finally:
        pipe.close()


def main() -> None:
    """Do all parts, or some."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", default=",".join(PARTS), help="of them, with commas between")
    parser.add_argument("--minutes", type=float, default=FULL, help="that links are cut and restored")
    parser.add_argument("--world", type=Path, default=WORLD, help="whose street is driven along")
    given = parser.parse_args()
    parts = PARTS | {"route": PARTS["route"]._replace(do=partial(route.route, given.world))}
    chosen = given.parts.split(",")
    if unknown := set(chosen) - set(PARTS):
        parser.error(f"no such parts: {', '.join(sorted(unknown))}")
    result: dict[str, Any] = {key: None for part in PARTS.values() for key in part.gives}
    for name in chosen:
        result |= done(name, parts[name], given.minutes / FULL)
    print("RESULT", json.dumps(result))
    sys.exit(any(result[key] is None for name in chosen for key in PARTS[name].gives))

"""A ROS 2 vehicle behind nodes that hang: time until the vehicle is commanded to stop."""

from __future__ import annotations

import math
import os
import sys
import threading
from collections.abc import Callable
from typing import Any

from scan2sim.services.teleoperation import adapter_key
from scan2sim.services.teleoperation.vehicle import adapters
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams, AdapterServer
from tests.fakes.nav2_nodes import Nodes
from tests.fakes.ports import free_dds_domain
from tests.fakes.vehicle import LIMIT_MS, OnboardPeer, adapter_key_file

HANGS = 10
"""Hangs of each node."""


def nodes(scale: float, notify: Callable[[str], None]) -> dict[str, Any]:
    """Hang Nav2's velocity smoother and collision monitor (stand-ins, `tests.fakes.nav2_nodes`) while driving.

    Returns: `nodes_stop_ms`: longest time until the vehicle was commanded to stop, ms.
    """
    os.environ |= {"ROS_DOMAIN_ID": str(free_dds_domain()), "SCAN2SIM_TRANSPORT": "cyclone"}
    roles = dict.fromkeys(("smoother", "monitor", "base"), "cyclone")
    found, ended, delays = adapters.find("ros"), threading.Event(), dict[str, list[float]]()
    vehicle: Any = found.connect(found.Params.of("", {"topic": "cmd_vel_teleop", "output": "cmd_vel"}))
    server = AdapterServer(vehicle, AdapterParams(port=0, limit=LIMIT_MS, key=adapter_key_file()))
    thread = threading.Thread(target=server.run, args=(ended,))
    thread.start()
    peer = OnboardPeer(server.address, adapter_key.read(adapter_key_file()))
    with Nodes(roles, {"cyclone": sys.executable}) as chain:
        peer.until(lambda: math.isfinite(vehicle._output._received))
        for role in ("smoother", "monitor"):
            for _ in range(max(2, round(HANGS * scale))):
                peer.start()
                peer.until(lambda: chain.moves and (vehicle.state().speed or 0) > 0.9)
                began = chain.hang(role)
                peer.until(lambda: not chain.moves)
                delays.setdefault(role, []).append(1e3 * (chain.since - began))
                peer.until(lambda: not peer.driven)
                chain.wake(role)
            notify(f"{role} hangs: stop after {min(delays[role]):.0f} to {max(delays[role]):.0f} ms")
    ended.set()
    thread.join()
    return {"nodes_stop_ms": round(max(map(max, delays.values())))}

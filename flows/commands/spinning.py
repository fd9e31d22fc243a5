"""Nodes of ROS 2 that a command runs."""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any

from scan2sim.services import transport


def spin(made: Callable[[], Any], finished: Callable[[Any], bool] = lambda _: False) -> None:
    """Run a node until it has finished, or is told to end, by Ctrl-C or SIGTERM."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # what ends services ends them as Ctrl-C does
    ros = transport.load()
    ros.init()
    try:
        node = made()
        try:
            while not finished(node):
                ros.spin_once(node, 0.2)
        finally:
            node.destroy_node()
    finally:
        ros.shutdown()

"""What a command runs until it is told to end: nodes of ROS 2, services."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


@contextmanager
def ends(stop: threading.Event) -> Iterator[None]:
    """Ctrl-C, or the machine's end, lets what is begun come to where it can be left."""
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

"""Runs ROS 2 nodes and services until they finish, or until Ctrl-C or SIGTERM."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from scan2sim.flows.commands.display import print_line
from scan2sim.services import transport
from scan2sim.services.supervision import end_process_with_threads


def spin(create: Callable[[], Any], finished: Callable[[Any], bool] = lambda _: False) -> None:
    """Create a ROS 2 node, report that it runs, and spin it until it has `finished`, or until Ctrl-C or SIGTERM."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # service managers stop services by SIGTERM
    ros = transport.load()
    ros.init()
    try:
        node = create()
        try:
            with end_process_with_threads(), suppress(KeyboardInterrupt):
                name = f"{node.get_namespace().rstrip('/')}/{node.get_name()}"
                print_line(f"{name} is running (stop with Ctrl-C)")
                while not finished(node):
                    ros.spin_once(node, 0.2)
        finally:
            node.destroy_node()
    finally:
        ros.shutdown()


@contextmanager
def stop_on_signal(stop: threading.Event) -> Iterator[None]:
    """Set `stop` on Ctrl-C or SIGTERM instead of interrupting, so that work in progress ends in a clean state."""
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with end_process_with_threads():
            yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

"""Node at one end of an emulated link, for `tests.fakes.link_monitor`: publishes or monitors until it is terminated.

`python -m tests.fakes.link_node talk|watch LOG [--machine NAME] [--ahead SECONDS] [--size N] [--interval SECONDS]`:
with `--machine` it acts as a node on another machine and synchronizes its clock; with `--ahead` its clock is offset
(only as seen from Python: rclpy's own clock isn't affected).
"""

from __future__ import annotations

import argparse
import signal
import time
from pathlib import Path

TOPIC = "/link"
WINDOW_SIZE = 100_000
"""Number of latencies averaged by a record: all of them."""

DEPTH = 1000
"""Messages that wait for the monitor; it may stall."""


def main() -> None:
    """Run the node."""
    parser = argparse.ArgumentParser()
    parser.add_argument("role", choices=("talk", "watch"))
    parser.add_argument("log", type=Path)
    parser.add_argument("--machine")
    parser.add_argument("--ahead", type=float, default=0.0)
    parser.add_argument("--size", type=int, default=1000)
    parser.add_argument("--interval", type=float, default=0.01)
    given = parser.parse_args()

    from scan2sim.services.monitoring.node import clock_sync

    if given.ahead:
        true_time, ahead = time.time_ns, round(given.ahead * 1e9)
        time.time_ns = lambda: true_time() + ahead
    if given.machine:
        clock_sync.this_host = lambda: given.machine  # type: ignore[assignment]
    _spin(given)


def _spin(given: argparse.Namespace) -> None:
    from scan2sim.services.monitoring.example_nodes.talker import Talker
    from scan2sim.services.monitoring.node.monitor import STRING, ros
    from scan2sim.services.monitoring.node.topic_monitor import TopicMonitor
    from scan2sim.services.monitoring.settings.monitor import TalkerParams, TopicParams

    signals: list[int] = []
    ros.init()
    signal.signal(signal.SIGTERM, lambda number, _: signals.append(number))  # after rclpy has set its handler
    if given.role == "talk":
        node = Talker(TalkerParams(topic=TOPIC, size=given.size, interval=given.interval, log_file=given.log))
    else:
        node = TopicMonitor(
            TopicParams(
                topics=[TOPIC], type=STRING, best_effort=True, depth=DEPTH, window_size=WINDOW_SIZE, log_file=given.log
            )
        )
    while not signals:
        ros.spin_once(node, 0.1)
    node.destroy_node()
    ros.shutdown()


if __name__ == "__main__":
    main()

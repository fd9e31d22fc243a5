"""Programs with ROS 2 nodes that tests start: they report that they are ready, and run until their input is closed."""

from __future__ import annotations

import json
import re
import select
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

READY = "ready"
"""Line that a program prints when its nodes are complete."""
RUNNING = r".* is running \(stop with Ctrl-C\)"
"""Pattern of the line that commands print instead."""
END_S = 90.0
"""Time for a program to end."""


def spin_until_closed(ros: Any, *nodes: Any, each: Callable[[], None] = lambda: None) -> None:
    """Spin nodes until the standard input is closed; `each` is called in every round. Called by the program itself."""
    print(READY, flush=True)
    while not select.select([sys.stdin], [], [], 0)[0]:
        for node in nodes:
            ros.spin_once(node, 0.05)
        each()


def wait_until_ready(process: subprocess.Popen[str]) -> None:
    """Wait until a program prints that it is ready."""
    assert process.stdout
    wait_for_line(process, f"{READY}|{RUNNING}")


def wait_for_line(process: subprocess.Popen[str], pattern: str) -> None:
    """Wait until a program prints a line that is a regular expression's match as a whole."""
    assert process.stdout
    while not re.fullmatch(pattern, (line := process.stdout.readline()).rstrip()):
        assert line, f"the program ended before it printed {pattern}: {end(process)[1]}"


def end(process: subprocess.Popen[str]) -> tuple[str, str]:
    """Close a program's input and wait until it has ended; returns what it has printed since, and its errors.

    Unlike `communicate` it finds what was buffered by a `readline` before.
    """
    assert process.stdin and process.stdout and process.stderr
    process.stdin.close()
    watchdog = threading.Timer(END_S, process.kill)
    watchdog.start()
    errors: list[str] = []
    reader = threading.Thread(target=lambda: errors.append(process.stderr.read()))  # type: ignore[union-attr]
    reader.start()
    output = process.stdout.read()
    reader.join()
    process.wait()
    watchdog.cancel()
    return output, errors[0]


def end_well(*processes: subprocess.Popen[str]) -> list[str]:
    """`end` programs one after the other, which must not fail; returns their outputs."""
    outputs = []
    for process in processes:
        output, errors = end(process)
        assert process.returncode == 0, errors
        outputs.append(output)
    return outputs


def json_lines(path: Path) -> list[dict[str, Any]]:
    """Complete lines of a log, which its program may still be writing or not have created yet."""
    lines = path.read_text(encoding="utf-8").split("\n") if path.exists() else [""]
    return [json.loads(line) for line in lines[:-1]]


def flows(path: Path, topic: str, direction: str = "incoming") -> list[dict[str, Any]]:
    """Statistics of a topic in a log of monitoring records."""
    return [
        flow
        for one in json_lines(path)
        for flow in one["flows"]
        if (flow["topic"], flow["direction"]) == (topic, direction)
    ]

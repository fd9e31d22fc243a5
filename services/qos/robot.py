"""A robot that asks a toolbox for results: images at a rate by HTTP, and how long each takes.

`python -m scan2sim.services.qos.robot ADDRESS TOOLBOX FOLDER RATE SECONDS` sends a folder's JPEGs in turn, with the
token in its file `token` if there is one, and prints a line of JSON (`Answers`).
"""

from __future__ import annotations

import http.client
import json
import queue
import sys
import threading
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

CONNECTIONS = 8
"""Requests that are on their way at once, at most."""
PATIENCE = 30.0
"""Seconds for an answer."""
TOKEN = "token"
"""File with the toolbox's token, in the folder of images."""


@dataclass(frozen=True)
class Answers:
    """What was sent and answered.

    Attributes:
        sent: images; states: how they ended, by the result's state or the kind of error.
        response_p50, response_p95: ms from when an image is due to its result; infinite, where there is none.
        image_bytes: of an image, mean.
        seconds: from the first to the last.
    """

    sent: int
    states: dict[str, int]
    response_p50: float
    response_p95: float
    image_bytes: float
    seconds: float


def ask(address: str, toolbox: str, images: list[bytes], rate: float, seconds: float, token: str = "") -> Answers:
    """Send `rate` images a second for `seconds`; one that finds all connections busy waits for one."""
    line: queue.Queue[tuple[float, bytes] | None] = queue.Queue()
    states: Counter[str] = Counter()
    responses: list[float] = []
    lock = threading.Lock()
    headers = {"Content-Type": "image/jpeg", "Source": "robot", "Host": "localhost"}
    headers |= {"Authorization": f"Bearer {token}"} if token else {}

    def work() -> None:
        place = urlsplit(address)
        connection = http.client.HTTPConnection(place.hostname or "", place.port or 80, timeout=PATIENCE)
        while (taken := line.get()) is not None:
            due, image = taken
            try:
                state = _state(connection, toolbox, image, headers)
            except (OSError, http.client.HTTPException, ValueError) as error:
                connection.close()
                state = type(error).__name__
            with lock:
                states[state] += 1
                responses.append(1000 * (time.monotonic() - due) if state == "done" else float("inf"))

    workers = [threading.Thread(target=work, daemon=True) for _ in range(CONNECTIONS)]
    for worker in workers:
        worker.start()
    began, count = time.monotonic(), max(1, round(rate * seconds))
    for number in range(count):
        due = began + number / rate
        time.sleep(max(0.0, due - time.monotonic()))
        line.put((due, images[number % len(images)]))
    for _ in workers:
        line.put(None)
    for worker in workers:
        worker.join()
    return Answers(
        sent=count,
        states=dict(states),
        response_p50=float(np.percentile(responses, 50, method="higher")),
        response_p95=float(np.percentile(responses, 95, method="higher")),
        image_bytes=float(np.mean([len(image) for image in images])),
        seconds=time.monotonic() - began,
    )


def _state(connection: http.client.HTTPConnection, toolbox: str, image: bytes, headers: dict[str, str]) -> str:
    """How a request ends; asked again where the server closed a connection that lay idle."""
    idle = connection.sock is not None
    try:
        return _asked(connection, toolbox, image, headers)
    except ConnectionError:
        if not idle:
            raise
        connection.close()
        return _asked(connection, toolbox, image, headers)


def _asked(connection: http.client.HTTPConnection, toolbox: str, image: bytes, headers: dict[str, str]) -> str:
    connection.request("POST", f"/v2/models/{toolbox}/infer", image, headers)
    return str(json.loads(connection.getresponse().read()).get("state", "refused"))


def main() -> None:
    """Ask, as the arguments say."""
    address, toolbox, folder, rate, seconds = sys.argv[1:]
    images = [path.read_bytes() for path in sorted(Path(folder).glob("*.jpg"))]
    token = path.read_text(encoding="utf-8").strip() if (path := Path(folder) / TOKEN).exists() else ""
    print(json.dumps(asdict(ask(address, toolbox, images, float(rate), float(seconds), token))), flush=True)


if __name__ == "__main__":
    main()

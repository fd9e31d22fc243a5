"""A robot that sends images to a toolbox by HTTP at a fixed rate and measures response times.

`python -m scan2sim.services.qos.robot ADDRESS TOOLBOX FOLDER RATE SECONDS` sends a folder's JPEGs in turn, with the
token in its file `token` if there is one, and prints a line of JSON (`RequestStats`).
"""

from __future__ import annotations

import http.client
import json
import queue
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

MAX_CONNECTIONS = 8
"""Maximum number of concurrent requests."""
RESPONSE_TIMEOUT_S = 30.0
"""Seconds to wait for a response."""
TOKEN_FILE = "token"
"""Name of the file with the toolbox's token, in the folder of images."""


@dataclass(frozen=True)
class RequestStats:
    """Statistics of the requests.

    Attributes:
        sent: number of images sent.
        states: number of requests by state of the result, or by name of the error.
        response_p50, response_p95: percentiles of the response time in ms, counted from when an image is due; infinite
            without a response.
        image_bytes: mean size of an image.
        seconds: duration.
    """

    sent: int
    states: dict[str, int]
    response_p50: float
    response_p95: float
    image_bytes: float
    seconds: float


def send_images(
    address: str,
    toolbox: str,
    images: list[bytes],
    rate: float,
    seconds: float,
    token: str = "",
    *,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> RequestStats:
    """Send `rate` images per second for `seconds`; images queue while all connections are busy."""
    pending: queue.Queue[tuple[float, bytes] | None] = queue.Queue()
    states: Counter[str] = Counter()
    responses: list[float] = []
    lock = threading.Lock()
    headers = {"Content-Type": "image/jpeg", "Source": "robot", "Host": "localhost"}
    headers |= {"Authorization": f"Bearer {token}"} if token else {}

    def work() -> None:
        url = urlsplit(address)
        connection = http.client.HTTPConnection(url.hostname or "", url.port or 80, timeout=RESPONSE_TIMEOUT_S)
        while (item := pending.get()) is not None:
            due, image = item
            try:
                state = _state(connection, toolbox, image, headers)
            except (OSError, http.client.HTTPException, ValueError) as error:
                connection.close()
                state = type(error).__name__
            with lock:
                states[state] += 1
                responses.append(1000 * (clock() - due) if state == "done" else float("inf"))

    workers = [threading.Thread(target=work, daemon=True) for _ in range(MAX_CONNECTIONS)]
    for worker in workers:
        worker.start()
    began, count = clock(), max(1, round(rate * seconds))
    for number in range(count):
        due = began + number / rate
        sleep(max(0.0, due - clock()))
        pending.put((due, images[number % len(images)]))
    for _ in workers:
        pending.put(None)
    for worker in workers:
        worker.join()
    return RequestStats(
        sent=count,
        states=dict(states),
        response_p50=float(np.percentile(responses, 50, method="higher")),
        response_p95=float(np.percentile(responses, 95, method="higher")),
        image_bytes=float(np.mean([len(image) for image in images])),
        seconds=clock() - began,
    )


def _state(connection: http.client.HTTPConnection, toolbox: str, image: bytes, headers: dict[str, str]) -> str:
    """State of a request's result; retries once if the server has closed the idle connection."""
    idle = connection.sock is not None
    try:
        return _request(connection, toolbox, image, headers)
    except ConnectionError:
        if not idle:
            raise
        connection.close()
        return _request(connection, toolbox, image, headers)


def _request(connection: http.client.HTTPConnection, toolbox: str, image: bytes, headers: dict[str, str]) -> str:
    connection.request("POST", f"/v2/models/{toolbox}/infer", image, headers)
    return str(json.loads(connection.getresponse().read()).get("state", "rejected"))


def main() -> None:
    """Run the robot according to the arguments."""
    address, toolbox, folder, rate, seconds = sys.argv[1:]
    images = [path.read_bytes() for path in sorted(Path(folder).glob("*.jpg"))]
    token = path.read_text(encoding="utf-8").strip() if (path := Path(folder) / TOKEN_FILE).exists() else ""
    stats = send_images(address, toolbox, images, float(rate), float(seconds), token)
    print(json.dumps(asdict(stats)), flush=True)


if __name__ == "__main__":
    main()

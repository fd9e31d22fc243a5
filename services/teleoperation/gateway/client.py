"""A party's connection to its gateway: orders come in, how the party is goes out, once a second."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Protocol

from scan2sim.services.teleoperation.control.messages import Malformed
from scan2sim.services.teleoperation.gateway.identity import Identity
from scan2sim.services.teleoperation.gateway.json_stream import Client, Stream, Told
from scan2sim.services.teleoperation.gateway.protocol import (
    Address,
    Ask,
    Hello,
    Join,
    Refused,
    Release,
    Status,
    from_gateway,
)

log = logging.getLogger(__name__)

EVERY = 1.0
"""Seconds between two statuses."""


class Party(Protocol):
    """What a vehicle or a station is to its connection."""

    def hello(self) -> Hello:
        """What it says first."""

    def status(self) -> Status:
        """How it is now."""

    def obey(self, order: Join | Release | Refused) -> None:
        """Do what the gateway says."""


class Membership:
    """Connected, or about to be, from its making to `close`; a party's methods are called in its two threads."""

    def __init__(
        self, identity: Identity, gateway: Address, party: Party, say: Callable[[str], None] = log.warning
    ) -> None:
        """`say` is told, once each, when the gateway is reached, and when and why it isn't."""
        self._party, self._say, self._lost = party, say, ""
        self._where = f"the gateway {gateway.host}:{gateway.port}"
        self._ended = threading.Event()
        self._client = Client(
            identity, gateway.host, gateway.port,
            opened=self._opened, received=self._received, closed=self._closed,
        )  # fmt: skip
        self._teller = threading.Thread(target=self._tell, name="status for the gateway", daemon=True)
        self._teller.start()

    def connected(self) -> bool:
        """Whether the gateway is reached now."""
        return self._client.connected

    def alive(self) -> bool:
        """Whether its threads live."""
        return self._client.is_alive() and self._teller.is_alive()

    def ask(self, ask: Ask) -> bool:
        """Ask the gateway; False: it isn't reached."""
        return self._client.send(ask.wire())

    def close(self) -> None:
        """End the connection."""
        self._ended.set()
        self._client.close()
        self._teller.join(5.0)

    def _opened(self, stream: Stream) -> None:
        self._lost = ""
        self._say(f"{self._where} is reached")
        stream.send(self._party.hello().wire())

    def _received(self, stream: Stream, told: Told) -> None:
        try:
            order = from_gateway(told)
        except Malformed as error:
            stream.close(f"it says what can't be understood ({error}): is it of another version?")
        else:
            self._party.obey(order)

    def _closed(self, why: str) -> None:
        if why != self._lost and not self._ended.is_set():
            self._say(f"{self._where} isn't reached: {why}")
        self._lost = why

    def _tell(self) -> None:
        while not self._ended.wait(EVERY):
            self._client.send(self._party.status().wire())

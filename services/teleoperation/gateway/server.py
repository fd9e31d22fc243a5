"""The gateway: vehicles and stations connect to it, prove who they are, tell how they are, and get orders."""

from __future__ import annotations

from collections.abc import Callable

from scan2sim.pipeline.core.errors import ScanError
from scan2sim.services.teleoperation.control.messages import Malformed
from scan2sim.services.teleoperation.gateway.fleet import Fleet, Order
from scan2sim.services.teleoperation.gateway.identity import Identity
from scan2sim.services.teleoperation.gateway.json_stream import Server, Stream, Told
from scan2sim.services.teleoperation.gateway.protocol import VERSION, Ask, Hello, Refused, Status, to_gateway

CAUSES = 200
"""Characters of what a party is told, at most."""


class Gateway:
    """Listens from its making to `close`; what is said goes to a `Fleet`."""

    def __init__(self, identity: Identity, host: str, port: int, fleet: Fleet, say: Callable[[str], None]) -> None:
        """Listen.

        Args:
            identity: its own.
            host, port: where; port 0 for any that is free.
            fleet: who is there.
            say: is told who comes and goes.

        Raises:
            SettingError: it can't listen there. BusyError: something else does.
        """
        self._fleet, self._say = fleet, say
        self._sends: dict[Stream, Callable[[Order], None]] = {}  # of parties that have said hello
        self._server = Server(
            identity, host, port, opened=lambda party: None, received=self._received, closed=self._closed
        )
        self.port = self._server.port

    def alive(self) -> bool:
        """Whether it listens."""
        return self._server.is_alive()

    def close(self) -> None:
        """End all connections; pairs go on driving."""
        self._server.close()

    def _received(self, party: Stream, told: Told) -> None:
        try:
            said = to_gateway(told)
            if party in self._sends:
                self._obey(party, said)
            else:
                self._greet(party, said)
        except Malformed as error:
            self._refuse(party, f"it says what can't be understood ({error})")

    def _greet(self, party: Stream, said: Hello | Status | Ask) -> None:
        if not isinstance(said, Hello) or said.version != VERSION:
            self._refuse(party, f"it doesn't speak version {VERSION} of the protocol")
            return

        def send(order: Order) -> None:
            party.send(order.wire())

        self._sends[party] = send
        self._say(f"{party.peer} is there, from {party.address}")
        self._fleet.came(party.peer, said, party.address, send)

    def _obey(self, party: Stream, said: Hello | Status | Ask) -> None:
        if isinstance(said, Status):
            self._fleet.told(party.peer, said)
        elif isinstance(said, Ask):
            try:
                self._fleet.asked(party.peer, said)
            except ScanError as error:
                party.send(Refused(cause=str(error)[:CAUSES]).wire())

    def _refuse(self, party: Stream, why: str) -> None:
        self._say(f"{party.peer} is sent away: {why}")
        party.send(Refused(cause=why[:CAUSES]).wire())
        party.close(why)

    def _closed(self, party: Stream, why: str) -> None:
        send = self._sends.pop(party, None)
        if send is None:
            self._say(f"{party.address} is sent away: {why}")
        else:
            self._say(f"{party.peer} is gone: {why}")
            self._fleet.left(party.peer, send)

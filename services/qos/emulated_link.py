"""Emulated network link between two network namespaces of this machine, with given rate, delay and loss.

```
with Link(LinkProfile(rate=8e6, delay=0.02, loss=0.01)) as link:
    link.far.popen("iperf3", "-s")
    link.near.run("iperf3", "-c", link.far.address)
```
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Self

from scan2sim.services.qos import links, namespaces
from scan2sim.services.qos.link_profile import LinkProfile
from scan2sim.services.qos.namespaces import Namespace


class Link:
    """Two namespaces and the link between them, a context manager; processes in them are killed at its end.

    Attributes:
        near, far: the namespaces; both share this machine's files, clock and host name.
    """

    near: Namespace
    far: Namespace

    def __init__(
        self,
        there: LinkProfile,
        back: LinkProfile | None = None,
        *,
        beside: Sequence[tuple[LinkProfile, LinkProfile]] = (),
        backend: str | None = None,
    ) -> None:
        """Prepare a link of one wire or several.

        Args:
            there: profile of the direction from the near side to the far side.
            back: profile of the other direction; None: the same.
            beside: profiles, there and back, of further parallel wires.
            backend: backend that shapes the traffic, a module in `links`; None: the best available.
        """
        self._profiles, self._backend = ((there, back or there), *beside), backend
        self._open = ExitStack()

    def __enter__(self) -> Self:
        """Create the namespaces and wires.

        Raises:
            SettingError: there is no such backend.
            UnavailableError: a link can't be created here; the message says what is missing.
        """
        with ExitStack() as made:
            self.near, self.far, folder = made.enter_context(namespaces.pair())
            backend = links.find(self._backend)
            self._wires = [backend.connect(self.near, self.far, folder, wire) for wire in range(len(self._profiles))]
            for wire, profiles in enumerate(self._profiles):
                for side in (self.near, self.far):
                    side.bring_up(wire)
                self.near.add_static_neighbour(self.far, wire)
                self.far.add_static_neighbour(self.near, wire)
                self._wires[wire].shape(*profiles)
            self._open = made.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def shape(self, there: LinkProfile, back: LinkProfile | None = None, *, wire: int = 0) -> None:
        """Change the profiles of a wire."""
        self._wires[wire].shape(there, back or there)

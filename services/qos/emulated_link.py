"""A link between two machines that are made up of this one: as fast, late and lossy as it is asked to be.

```
with Link(Shape(rate=8e6, delay=0.02, loss=0.01)) as link:
    link.far.popen("iperf3", "-s")
    link.near.run("iperf3", "-c", link.far.address)
```
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Self

from scan2sim.services.qos import links, namespaces
from scan2sim.services.qos.link_profile import Shape
from scan2sim.services.qos.namespaces import Namespace


class Link:
    """Two namespaces and what is between them, from `with` to its end; then all that runs in them is killed.

    Attributes:
        near, far: the namespaces; both have this machine's files, clock and name.
    """

    near: Namespace
    far: Namespace

    def __init__(
        self,
        there: Shape,
        back: Shape | None = None,
        *,
        beside: Sequence[tuple[Shape, Shape]] = (),
        backend: str | None = None,
    ) -> None:
        """A link of one wire, or of several.

        Args:
            there: what becomes of packets from the near side to the far one.
            back: of those the other way; None: the same.
            beside: likewise, there and back, of further wires beside the first.
            backend: what shapes it, a file in `links`; None: what is best here.
        """
        self._shapes, self._backend = ((there, back or there), *beside), backend
        self._open = ExitStack()

    def __enter__(self) -> Self:
        """Make it.

        Raises:
            SettingError: there is no such backend.
            UnavailableError: a link can't be made here; it says what to do.
        """
        with ExitStack() as made:
            self.near, self.far, folder = made.enter_context(namespaces.pair())
            backend = links.find(self._backend)
            self._wires = [backend.connect(self.near, self.far, folder, wire) for wire in range(len(self._shapes))]
            for wire, shapes in enumerate(self._shapes):
                for side in (self.near, self.far):
                    side.up(wire)
                self.near.know(self.far, wire)
                self.far.know(self.near, wire)
                self._wires[wire].shape(*shapes)
            self._open = made.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def shape(self, there: Shape, back: Shape | None = None, *, wire: int = 0) -> None:
        """A wire is another from now on."""
        self._wires[wire].shape(there, back or there)

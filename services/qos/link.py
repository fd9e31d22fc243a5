"""A link between two machines that are made up of this one: as fast, late and lossy as it is asked to be.

```
with Link(Shape(rate=8e6, delay=0.02, loss=0.01)) as link:
    link.far.popen("iperf3", "-s")
    link.near.run("iperf3", "-c", link.far.address)
```
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Self

from scan2sim.services.qos import links, namespaces
from scan2sim.services.qos.namespaces import Namespace
from scan2sim.services.qos.shape import Shape


class Link:
    """Two namespaces and what is between them, from `with` to its end; then all that runs in them is killed.

    Attributes:
        near, far: the namespaces; both have this machine's files, clock and name.
    """

    near: Namespace
    far: Namespace

    def __init__(self, there: Shape, back: Shape | None = None, *, backend: str | None = None) -> None:
        """A link.

        Args:
            there: what becomes of packets from the near side to the far one.
            back: of those the other way; None: the same.
            backend: what shapes it, a file in `links`; None: what is best here.
        """
        self._shapes, self._backend = (there, back or there), backend
        self._open = ExitStack()

    def __enter__(self) -> Self:
        """Make it.

        Raises:
            SettingError: there is no such backend.
            UnavailableError: a link can't be made here; it says what to do.
        """
        with ExitStack() as made:
            self.near, self.far, folder = made.enter_context(namespaces.pair())
            self._wire = links.find(self._backend).connect(self.near, self.far, folder)
            for side in (self.near, self.far):
                side.up()
            self.near.know(self.far)
            self.far.know(self.near)
            self._wire.shape(*self._shapes)
            self._open = made.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def shape(self, there: Shape, back: Shape | None = None) -> None:
        """Be another from now on."""
        self._wire.shape(there, back or there)

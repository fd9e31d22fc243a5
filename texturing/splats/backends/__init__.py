"""Rasterizer: renders splats and computes gradients of losses by their parameters.

One module per kind of processor (`pipeline.core.plugins`), selected by `splats.backend`. Training and views know only
this interface: arrays go in and come out, and everything else (photos, exposure, losses, background, descent) is the
same for all of them.
"""

from __future__ import annotations

from typing import Protocol

from scan2sim.pipeline.core import optional_deps, plugins
from scan2sim.pipeline.core.plugins import Unavailable
from scan2sim.pipeline.core.types import F32, I32
from scan2sim.texturing.splats.projection import Pinhole

SETTING = "splats.backend"
AUTO = "auto"


class Rendered(Protocol):
    """Splats in an image."""

    @property
    def colour(self) -> F32:
        """(H, W, 3) sRGB 0 to 1, times alpha: the background isn't added."""

    @property
    def depth(self) -> F32:
        """(H, W) metres along the optical axis to where half of the light is stopped (median), inf where less is."""

    @property
    def deviation(self) -> F32:
        """(H, W) deviation of the inverse depth from the known one.

        It is relative to the known one, at most `blending.MAX_DEVIATION`, and times alpha; 0 where none is known.
        """

    @property
    def transmittance(self) -> F32:
        """(H, W) share of the background that is seen."""

    @property
    def seen(self) -> I32:
        """(M,) indices of the splats that may be in the image."""

    def over(self, background: F32) -> F32:
        """(H, W, 3) the colour over a background (H, W, 3)."""

    def gradients(
        self, background: F32, by_colour: F32, by_deviation: F32 | None = None, by_alpha: F32 | None = None
    ) -> F32:
        """Gradients (M, 14) of the parameters of the splats `seen`.

        Args:
            background: (H, W, 3) the background.
            by_colour: (H, W, 3) derivatives of the loss by `over(background)`.
            by_deviation: (H, W) by `deviation`; None: 0.
            by_alpha: (H, W) by 1 - `transmittance`, apart from the effect on the colour; None: 0.
        """


class Scene(Protocol):
    """Splats that a backend has loaded."""

    def render(self, camera: Pinhole, known: F32 | None = None) -> Rendered:
        """Render the image of a camera.

        Args:
            camera: the camera.
            known: (H, W) depths along the optical axis that are known, metres, 0 where none is; None: none.
        """


class Backend(Protocol):
    """Interface of a module.

    Attributes:
        RANK: the backend with the lowest is chosen automatically if it can run.
    """

    RANK: int

    def unavailable(self) -> Unavailable | None:
        """Why it can't run on this machine; None: it can."""

    def description(self) -> str:
        """What renders, for the log."""

    def scene(self, parameters: F32) -> Scene:
        """Load splats (N, 14) (`Splats.parameters`), which mustn't change while the scene is in use."""


def choose(name: str) -> Backend:
    """Load a backend: the named one, or for "auto" the best that can run on this machine.

    Raises:
        SettingError: there is no backend of that name.
        UnavailableError: it can't run on this machine.
    """
    backend: Backend = plugins.best(__name__, None if name == AUTO else name, SETTING, SETTING)
    return backend


def require(name: str) -> None:
    """Check that the packages of a backend are installed, without importing them.

    Raises:
        UnavailableError: packages are missing.
    """
    if name != AUTO:
        plugins.find(__name__, name, SETTING)


def rejected(name: str, chosen: Backend) -> str | None:
    """Why "auto" didn't choose an installed backend that would be better, a sentence with the remedy; None: it did."""
    for other in plugins.names(__name__) if name == AUTO else ():
        backend = plugins.module(__name__, other)
        if backend.RANK < chosen.RANK and not optional_deps.missing(*plugins.needs(backend)):
            reason: Unavailable | None = backend.unavailable()
            if reason is not None:
                return f"splats are trained on the CPU, as {other} {reason.cause}: {reason.remedy}"
    return None

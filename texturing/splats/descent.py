"""Gradient descent of splats: Adam (Kingma and Ba, 2015) of those that pixels of a photo show."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from scan2sim.pipeline.core.splats import MAX_COLOUR, MIN_COLOUR, WIDTH
from scan2sim.pipeline.core.types import F32, I32

FIRST_MOMENT, SECOND_MOMENT, MIN_ROOT = 0.9, 0.99, 1e-12
FIRST_COLOUR = 11
"""First column of the colour."""
FASTMATH = {"reassoc", "contract", "nsz", "arcp", "afn"}
"""Without "nnan" and "ninf": what isn't finite stays so, and is found."""


class Descent:
    """State of the descent.

    Attributes:
        parameters: (N, 14) of the splats, changed in place.
        size: (N,) metres by which positions are scaled: a splat moves by its own size, wherever it is.
    """

    def __init__(self, parameters: F32, size: F32) -> None:
        self.parameters, self.size = parameters, size
        self._first, self._second = np.zeros_like(parameters), np.zeros_like(parameters)
        self._visits = np.zeros(len(parameters), np.float32)

    def step(self, index: I32, gradients: F32, rates: F32) -> None:
        """Take a step. Splats without any gradient, as they are hidden or masked, stay as they are.

        Args:
            index: (M,) splats.
            gradients: (M, 14) of their parameters.
            rates: (14,) step per parameter; of positions in units of `size`.
        """
        limits = np.float32(MIN_COLOUR), np.float32(MAX_COLOUR)
        _step(self.parameters, self.size, self._first, self._second, self._visits, index, gradients, rates, *limits)

    def save(self) -> dict[str, F32]:
        """State, for `load`."""
        names = ("parameters", "size", "_first", "_second", "_visits")
        return {name.lstrip("_"): getattr(self, name) for name in names}

    @classmethod
    def load(cls, state: dict[str, F32]) -> Descent:
        """The descent that `save` describes."""
        loaded = cls(state["parameters"].copy(), state["size"].copy())
        loaded._first, loaded._second, loaded._visits = (state[k].copy() for k in ("first", "second", "visits"))
        return loaded


def rates(position: float, scale: float, rotation: float, opacity: float, colour: float) -> F32:
    """(14,) step of each parameter."""
    each = ((position, 3), (scale, 3), (rotation, 4), (opacity, 1), (colour, 3))
    made = np.concatenate([np.full(count, rate) for rate, count in each]).astype(np.float32)
    assert len(made) == WIDTH
    return made


@njit(cache=True, parallel=True, fastmath=FASTMATH, error_model="numpy")
def _step(  # type: ignore[no-untyped-def]
    parameters, size, first, second, visits, index, gradients, rates, darkest, brightest
):
    columns = parameters.shape[1]
    for m in prange(len(index)):
        i = index[m]
        shown = False
        for k in range(columns):
            shown |= gradients[m, k] != 0
        if not shown:
            continue
        visits[i] += 1
        unbiased_first = 1 - np.float32(FIRST_MOMENT) ** visits[i]
        unbiased_second = 1 - np.float32(SECOND_MOMENT) ** visits[i]
        for k in range(columns):
            g = gradients[m, k] * (size[i] if k < 3 else np.float32(1))
            first[i, k] += np.float32(1 - FIRST_MOMENT) * (g - first[i, k])
            second[i, k] += np.float32(1 - SECOND_MOMENT) * (g * g - second[i, k])
            root = np.sqrt(second[i, k] / unbiased_second) + np.float32(MIN_ROOT)
            step = rates[k] * first[i, k] / unbiased_first / root
            parameters[i, k] -= step * (size[i] if k < 3 else np.float32(1))
        for k in range(FIRST_COLOUR, columns):
            parameters[i, k] = min(max(parameters[i, k], darkest), brightest)

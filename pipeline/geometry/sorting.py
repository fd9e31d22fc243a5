"""Many numbers in order, and where each came from."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import I64, Bools


def ordered(codes: I64) -> tuple[I64, I64]:
    """The stable order (N,) of codes (N,), not below 0, and the codes (N,) in that order.

    Numbers are sorted several times as fast as their places: where both fit into 63 bits, they are sorted as one.
    """
    bits = len(codes).bit_length()
    if int(codes.max(initial=0)).bit_length() + bits > 63:
        order = np.argsort(codes, kind="stable")
        return order, codes[order]
    packed = np.sort(codes << bits | np.arange(len(codes)))
    return packed & ((1 << bits) - 1), packed >> bits


def first_of_each(codes: I64) -> Bools:
    """(N,) which of codes in order aren't like the one before."""
    return np.concatenate([np.ones(min(1, len(codes)), bool), codes[1:] != codes[:-1]])

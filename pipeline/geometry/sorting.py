"""Stable argsort of integer keys."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import I64, Bools


def stable_argsort(codes: I64) -> tuple[I64, I64]:
    """Stable sort order (N,) of non-negative codes (N,), and the sorted codes (N,).

    Sorting values is several times faster than an argsort: if code and index fit into 63 bits, they are packed into one
    integer and sorted.
    """
    bits = len(codes).bit_length()
    if int(codes.max(initial=0)).bit_length() + bits > 63:
        order = np.argsort(codes, kind="stable")
        return order, codes[order]
    packed = np.sort(codes << bits | np.arange(len(codes)))
    return packed & ((1 << bits) - 1), packed >> bits


def first_of_each(codes: I64) -> Bools:
    """(N,) bool, True for sorted codes that differ from their predecessor."""
    return np.concatenate([np.ones(min(1, len(codes)), bool), codes[1:] != codes[:-1]])

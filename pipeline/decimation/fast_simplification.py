"""fast-simplification, by the authors of PyVista: the same algorithm as pyfqmr."""

from __future__ import annotations

from scan2sim.pipeline.core.types import F64, I32

NEEDS = ("fast_simplification",)
KEEPS_BORDER = True
AGGRESSIVENESS = 5.0
"""See `pipeline.decimation.pyfqmr`."""


def simplify(vertices: F64, faces: I32, target: int, keep_border: bool) -> tuple[F64, I32]:
    """See `pipeline.decimation.Backend`."""
    import fast_simplification

    return fast_simplification.simplify(
        vertices, faces, target_count=target, agg=AGGRESSIVENESS, preserve_border=keep_border
    )

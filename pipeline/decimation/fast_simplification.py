"""fast-simplification: passes over all edges with an increasing error threshold; rejects collapses that flip a face."""

from __future__ import annotations

from scan2sim.pipeline.core.types import F64, I32

AGGRESSIVENESS = 5.0
"""Growth of the error threshold: lower values are more accurate and slower."""


def simplify(vertices: F64, faces: I32, target: int, keep_border: bool) -> tuple[F64, I32]:
    """See `pipeline.decimation.Backend`."""
    import fast_simplification

    return fast_simplification.simplify(
        vertices, faces, target_count=target, agg=AGGRESSIVENESS, preserve_border=keep_border
    )

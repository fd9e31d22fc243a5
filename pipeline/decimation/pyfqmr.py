"""pyfqmr: passes over all edges with an increasing error threshold; rejects collapses that flip a face."""

from __future__ import annotations

from scan2sim.pipeline.core.types import F64, I32

KEEPS_BORDER = True
AGGRESSIVENESS = 5
"""Growth of the error threshold: lower values are more accurate and slower."""


def simplify(vertices: F64, faces: I32, target: int, keep_border: bool) -> tuple[F64, I32]:
    """See `pipeline.decimation.Backend`."""
    import pyfqmr

    simplifier = pyfqmr.Simplify()
    simplifier.setMesh(vertices, faces)
    simplifier.simplify_mesh(target_count=target, aggressiveness=AGGRESSIVENESS, preserve_border=keep_border, verbose=0)
    left, triangles, _ = simplifier.getMesh()
    return left, triangles

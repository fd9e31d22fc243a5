"""3D Gaussian splats in OpenUSD (`UsdVol.ParticleField3DGaussianSplat`), beside a tile's textured surfaces."""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.splats import Splats
from scan2sim.pipeline.io.splat_files import SH_C0

APPEARANCE, SPLATS, SURFACES = "appearance", "splats", "surfaces"
"""Variant set of a tile with splats, and its variants; collision is the same in both."""
EXTENT_DEVIATIONS = 3.0
"""Standard deviations of a splat that belong to its extent."""


def add(stage: Any, root: Any, splats: Splats, scopes: tuple[str, ...]) -> None:
    """Add splats to a tile, and the variants that show either them or its surfaces, the default.

    Surfaces are the default as they have the classes, and programs that don't draw splats would show nothing else.

    Args:
        stage: the tile's layer.
        root: the tile's prim.
        splats: N splats, local metres, z up.
        scopes: names of the prims below `root` that hold what cameras see of the surfaces.
    """
    from pxr import UsdVol, Vt

    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, root.GetPath().AppendChild("Splats"))
    values = {
        "positions": Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(splats.xyz)),
        "scales": Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(splats.scale)),
        "orientations": _quaternions(splats),
        "opacities": Vt.FloatArray.FromNumpy(np.ascontiguousarray(splats.opacity)),
        "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(
            ((splats.display_rgb - 0.5) / SH_C0).astype(np.float32)
        ),
        "radiance:sphericalHarmonicsDegree": 0,
        "extent": Vt.Vec3fArray.FromNumpy(_extent(splats)),
    }
    for name, value in values.items():
        prim.GetPrim().GetAttribute(name).Set(value)
    variants = root.GetPrim().GetVariantSets().AddVariantSet(APPEARANCE)
    for variant, hidden in ((SPLATS, scopes), (SURFACES, ("Splats",))):
        variants.AddVariant(variant)
        variants.SetVariantSelection(variant)
        with variants.GetVariantEditContext():
            for name in hidden:
                stage.GetPrimAtPath(root.GetPath().AppendChild(name)).GetAttribute("visibility").Set("invisible")
    variants.SetVariantSelection(SURFACES)


def _quaternions(splats: Splats) -> Any:
    """Unit quaternions; USD's arrays hold x y z w."""
    from pxr import Vt

    return Vt.QuatfArray.FromNumpy(np.ascontiguousarray(splats.quaternion[:, [1, 2, 3, 0]]))


def _extent(splats: Splats) -> np.ndarray:
    """(2, 3) lowest and highest corner of all splats."""
    reach = EXTENT_DEVIATIONS * splats.scale.max(axis=1, keepdims=True)
    return np.stack([(splats.xyz - reach).min(axis=0), (splats.xyz + reach).max(axis=0)]).astype(np.float32)

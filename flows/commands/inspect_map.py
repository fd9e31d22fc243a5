"""What `scan2sim inspect` prints of a robot's map or a mesh: what `scan2sim run` would find in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, Frame, PointCloud
from scan2sim.pipeline.importers.robot_map import UNIT_M, axis_name, is_surveyed, map_files
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.tile import MIN_POINTS

Facts = list[tuple[str, str]]
MAX_POINTS = 2_000_000
"""Points of a map that are inspected; the spacing is measured on all."""
MESH_POINTS = 30_000
"""Points of a mesh that are inspected: fewer, as they have no noise."""


def map_facts(cloud: PointCloud, most: int = MAX_POINTS, usual: F64 | None = None, unit: str = "") -> Facts:
    """Unit, outliers, up axis and tilt, spacing, noise, surfaces and scene; empty for fewer points than a map has.

    Args:
        cloud: the map.
        most: number of points that are inspected.
        usual, unit: see `_facts`.
    """
    from scan2sim.pipeline.geometry.height_map import exact_point_spacing

    xyz = cloud.xyz[np.isfinite(cloud.xyz).all(axis=1)]
    if len(xyz) < MIN_POINTS:
        return []
    start = -np.asarray(cloud.frame.origin)
    return _facts(xyz[:: max(1, len(xyz) // most)], exact_point_spacing(xyz), start, usual, unit)


def _facts(xyz: F32, spacing: float, start: F64, usual: F64 | None = None, unit: str = "") -> Facts:
    """Facts of points (N, 3) from a map with a spacing.

    Args:
        xyz: points in the axes and unit of the map.
        spacing: of all its points, in the same unit.
        start: (3,) position of the sensor, likewise.
        usual: (3, 3) rotation to z up by the specification of the map's format; None: z is up.
        unit: by the specification; empty: guessed.
    """
    from scan2sim.pipeline.geometry.height_map import exact_point_spacing
    from scan2sim.pipeline.geometry.upright import find_up, rotation_to_z
    from scan2sim.pipeline.robot_maps.describe import guess_unit
    from scan2sim.pipeline.robot_maps.outliers import far_outliers

    usual, unit = np.eye(3) if usual is None else usual, unit or guess_unit(xyz, spacing)
    xyz, start, spacing = xyz * np.float32(UNIT_M[unit]), start * UNIT_M[unit], spacing * UNIT_M[unit]
    outliers = far_outliers(xyz, exact_point_spacing(xyz))
    xyz, start = xyz[~outliers] @ usual.T.astype(np.float32), usual @ start
    facts = [("units", f"{unit} (assumed)"), ("outliers", f"{outliers.mean():.1%} isolated or far points")]
    if is_surveyed(start):
        return [
            *facts,
            ("up axis", f"{axis_name(usual[2])}: coordinates of a survey"),
            *_scene_facts(xyz, np.eye(3), start, spacing),
        ]
    up = find_up(xyz, start)
    if up is None:
        return [*facts, ("up axis", "not found: no flat surfaces; name it with --up")]
    found = up.up @ usual  # in the map's axes
    tilt = np.degrees(np.arccos(min(1.0, float(np.abs(found).max()))))
    doubt = ", ambiguous: check it, or name it with --up" if up.ambiguous else ""
    axis_fact = ("up axis", f"{axis_name(found)}, tilted by {tilt:.1f} degrees{doubt}")
    return [*facts, axis_fact, *_scene_facts(xyz, rotation_to_z(up.up), start, spacing)]


def _scene_facts(xyz: F32, R: F64, start: F64, spacing: float) -> Facts:
    """Facts of the surfaces of points (N, 3), metres, by their rotation (3, 3) to a level world."""
    from scan2sim.pipeline.robot_maps.describe import describe

    found = describe(xyz @ R.T.astype(np.float32), R @ start)
    return [
        ("spacing", f"{100 * spacing:.1f} cm between neighbouring points"),
        ("noise", f"{100 * found.noise:.1f} cm around planes"),
        ("surfaces", f"{found.level_share:.0%} level (ground, floors), {found.upright_share:.0%} upright (walls)"),
        (
            "scene",
            f"{found.scene} (walls in {found.enclosed_share:.0%} of the directions from the start, "
            f"a ceiling above {found.ceiling_share:.0%} of the floor)",
        ),
    ]


def colour_fact(cloud: PointCloud) -> str:
    """Which colours the points have, and whether they look like semantic labels."""
    from scan2sim.pipeline.robot_maps.label_colours import are_labels, matching_legend

    if cloud.rgb is None:
        return "intensity" if cloud.intensity is not None else "no"
    if not are_labels(cloud.rgb):
        return "yes"
    legend = matching_legend(cloud.rgb)
    of = f"those of {legend}" if legend else "of an unknown legend"
    return f"yes, like semantic labels ({of}): classes with --classes-from-colours {legend or 'LEGEND'}"


def folder_of_clouds(folder: Path) -> tuple[str, Facts]:
    """Facts of a map that consists of several clouds in one frame."""
    files = map_files(folder)
    headers = [clouds.read_header(file) for file in files]
    low = np.min([header.low for header in headers], axis=0)
    high = np.max([header.high for header in headers], axis=0)
    x, y, z = np.floor(low).tolist()
    cloud = PointCloud.join([clouds.read(file, Frame(origin=(x, y, z))) for file in files])
    size = " x ".join(f"{v:,.2f}" for v in high - low)
    facts = [
        ("files", f"{len(files)}"),
        ("points", f"{len(cloud):,}"),
        ("extent", f"{size}   from " + ", ".join(f"{v:,.2f}" for v in low)),
        ("colours", colour_fact(cloud)),
    ]
    has_crs = any(header.crs is not None for header in headers)
    return "map", facts if has_crs else facts + map_facts(cloud)


def mesh_facts(path: Path) -> Facts:
    """Facts of points sampled from a mesh."""
    from scan2sim.pipeline.importers.mesh_model import is_gltf, surface_points, usual_rotation
    from scan2sim.pipeline.io.mesh_models import read

    source, notes = read(path)
    cloud = surface_points(source.mesh)
    facts = map_facts(cloud, MESH_POINTS, usual_rotation(path), "m" if is_gltf(path) else "")
    if is_gltf(path):
        facts = [fact for fact in facts if fact[0] != "units"]
    return [*(("warning", note) for note in notes), *(f for f in facts if f[0] not in ("outliers", "spacing", "noise"))]

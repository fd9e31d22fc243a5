"""Classes that a run gave to points, compared with the true ones: indoors, and ground on a coarse grid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from bench.maps.chain import World
from bench.maps.command import Missing
from bench.maps.inputs import KITTI_SENSOR_HEIGHT_M, TRUE_UP_TOLERANCE_DEG, BenchMap, folder, thinned
from scan2sim.data_samples.building import Surface
from scan2sim.pipeline.core.classes import CODE, GROUPS, NOISE, UNKNOWN, group_of
from scan2sim.pipeline.core.types import F64, I64, U8, Bools, Frame
from scan2sim.pipeline.io.navigation import pcd
from scan2sim.pipeline.steps.ghosts import ghosts_in

INDOOR: dict[str, tuple[tuple[Surface, ...], tuple[str, ...]]] = {
    "floor": ((Surface.FLOOR,), ("floor", "terrain", "road", "sidewalk")),
    "wall": ((Surface.WALL, Surface.PILLAR, Surface.WINDOW), ("wall", "building", "wall_or_fence")),
    "ceiling": ((Surface.CEILING,), ("ceiling",)),
    "furniture": ((Surface.FURNITURE,), ("furniture",)),
}
"""Compared kinds: true surfaces, and names of the product's classes."""
MATCH_DISTANCE_M = 0.02
"""Maximum distance between a point of the map and the same point in the run."""
GROUND_GRID_M = 0.5
SEMANTIC_KITTI_GROUND = (40, 44, 48, 49, 60, 72)
"""Road, parking, sidewalk, other ground, lane marking, terrain."""
STREET = {"length": 60.0, "points": 6e5, "photos": 0, "seed": 4}


def indoor_iou(one: BenchMap, world: World) -> dict[str, float]:
    """IoU of each kind in `INDOOR` over the points of a simulated map.

    Raises:
        Missing: the product has no class for a kind.
    """
    assert one.truth is not None
    codes = {}
    for kind, (_, names) in INDOOR.items():
        codes[kind] = [CODE[name] for name in names if name in CODE]
        if not codes[kind]:
            raise Missing(f"scan2sim.pipeline.core.classes has no class for {kind} (sought: {', '.join(names)})")
    found = classes_of(one.xyz, world)
    result = {}
    for kind, (surfaces, _) in INDOOR.items():
        true, said = np.isin(one.truth.surface, surfaces), np.isin(found, codes[kind])
        scored = one.truth.surface <= Surface.WINDOW  # not people, outliers and reflections
        result[kind] = float((true & said & scored).sum() / max(((true | said) & scored).sum(), 1))
    return result


def ghost_shares(one: BenchMap, world: World, spacing: float) -> tuple[float, float]:
    """Share of people's points that are ghosts, and share of the ghosts' points that are people's.

    Ghosts are the points of proposed trails and those of the class `person`, which has no surface.
    """
    from scipy.spatial import cKDTree

    assert one.truth is not None
    cloud = world.points()
    far, near = cKDTree(cloud.xyz).query(world.place(one.xyz), distance_upper_bound=MATCH_DISTANCE_M, workers=2)
    assert cloud.classification is not None
    proposed = np.append(cloud.classification == CODE["person"], False)
    for ghost in ghosts_in(cloud, spacing):
        proposed[ghost.points] = True
    found, person = proposed[np.where(np.isfinite(far), near, len(cloud))], one.truth.surface == Surface.PERSON
    both = (found & person).sum()
    return float(both / max(person.sum(), 1)), float(both / max(found.sum(), 1))


def classes_of(xyz: F64, world: World) -> U8:
    """(N,) class of each point of a map in the run; 0 where the run dropped the point."""
    from scipy.spatial import cKDTree

    cloud = world.points()
    assert cloud.classification is not None
    far, near = cKDTree(cloud.xyz).query(world.place(xyz), distance_upper_bound=MATCH_DISTANCE_M, workers=2)
    return np.where(np.isfinite(far), cloud.classification[np.minimum(near, len(cloud) - 1)], 0).astype(np.uint8)


def ground_mislabelled(one: BenchMap, ground: Bools, world: World) -> float:
    """Share of ground points (N,) that the run labelled as something standing on the ground."""
    found = classes_of(one.xyz, world)
    code = np.arange(256)
    standing = (group_of() != GROUPS.index("terrain")) & ~np.isin(code, (*UNKNOWN, *NOISE))
    return float(standing[found[ground]].mean())


def semantic_kitti(out: Path) -> tuple[BenchMap, Bools]:
    """The labelled sweep of SemanticKITTI on a grid, and which of its points are ground."""
    source = folder() / "semkitti"
    sweep, labels = (next(source.glob(f"*.{suffix}"), None) for suffix in ("bin", "label"))
    if sweep is None or labels is None:
        raise Missing(f"{source} has no sweep with labels")
    points = np.fromfile(sweep, np.float32).reshape(-1, 4)
    ground = np.isin(np.fromfile(labels, np.uint32) & 0xFFFF, SEMANTIC_KITTI_GROUND)
    return _coarse("semkitti", points[:, :3].astype(np.float64), 255 * points[:, 3], ground, np.zeros(3), out)


def street(out: Path) -> tuple[BenchMap, Bools]:
    """A synthetic street on a grid, in the axes of the scanner at its start, and which of its points are ground."""
    from scan2sim.data_samples.street import generate
    from scan2sim.pipeline.io import clouds
    from scan2sim.pipeline.io.tile import read_tile

    tile = out / "street" / "tile"
    if not (tile / "tile.toml").is_file():
        generate(tile, **STREET)  # type: ignore[arg-type]
    read = read_tile(tile / "tile.toml")
    assert read.trajectory is not None
    cloud = clouds.read(read.clouds[0], read.frame)
    assert cloud.classification is not None and cloud.intensity is not None
    ground = group_of()[cloud.classification] == GROUPS.index("terrain")
    xyz = cloud.xyz.astype(np.float64) - read.trajectory.positions[0]
    return _coarse("street", xyz, cloud.intensity / 256, ground, np.zeros(3), out)


def _coarse(
    name: str, xyz: F64, intensity: npt.NDArray[np.floating], ground: Bools, sensor: F64, out: Path
) -> tuple[BenchMap, Bools]:
    """Map of points on `GROUND_GRID_M`; its ground points are those of voxels with ground only."""
    thin, strength, (order, begin) = thinned(xyz, intensity.astype(np.float32), GROUND_GRID_M)
    pure: I64 = np.add.reduceat((~ground[order]).astype(np.int64), begin)
    path = out / name / "map.pcd"
    path.parent.mkdir(parents=True, exist_ok=True)
    pcd.write(path, thin, strength)
    from scan2sim.pipeline.io import clouds

    read = clouds.read(path, Frame()).xyz.astype(np.float64)  # as the run reads it
    up, tolerance = np.array([0.0, 0.0, 1.0]), 6 * TRUE_UP_TOLERANCE_DEG
    return BenchMap(name, path, read, up, tolerance, sensor, KITTI_SENSOR_HEIGHT_M), pure == 0

"""Visibility by depth maps, compared with the truth of a generated street: leaks and false hiding.

`python -m bench.visibility [--length 40 --points 1.5e6 --photos 16 --width 1024 --seed 0] [--out bench-out]`.

The pipeline builds meshes, clouds and depth maps of the street. The meshes are sampled evenly, like texels, within
range of each photo; the visibility of each sample according to the depth map is compared with rays cast in the true
street, including parked cars and the moving car (at its position at that time). Other kinds of depth maps are
evaluated for comparison.

- leak: share of truly hidden samples that are classified as visible.
- false hiding: share of truly visible samples that are classified as hidden.
- wrong: share of samples classified as visible that are truly hidden: they get a wrong texture.

The mesh is some centimetres off the true surface, so at the edges of occluders the truth is ambiguous. Therefore the
shares are printed twice: for samples with the same truth all around (clear), and for all. Ends with `RESULT {json}`,
totals over the classes.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.paths import ROOT
from scan2sim.data_samples.layout import FRAME, lay_out
from scan2sim.data_samples.scanner import plan_drive
from scan2sim.data_samples.scene import Scene
from scan2sim.data_samples.street import generate
from scan2sim.flows.engine.execution import execute
from scan2sim.flows.engine.planning import plan
from scan2sim.flows.pipelines.graph import TaskId, required_tasks
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.camera import depth_map
from scan2sim.pipeline.camera.depth_map import DepthMap
from scan2sim.pipeline.camera.projection import pixels
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.classes import CLASSES, GROUPS
from scan2sim.pipeline.core.types import F32, F64, I64, U8, Bools, Frame, Mesh, PointCloud, Tile, View
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.visibility import VisibilityParams

OURS = "mesh + discs (ours)"
SPLAT_PX = 8
"""Size of the boxes of splatted points, for comparison."""
SPLAT_BIAS_M = 0.3
"""Depth tolerance behind such a box, whose depth is that of the point in its centre."""
PHOTO_RANGE_M = 40.0
"""Maximum distance from which a photo is used."""
MIN_INCIDENCE_COS = 0.08
"""Minimum cosine of the angle between normal and ray."""
MAX_TRUTH_DISTANCE_M = 0.15
"""Maximum distance to the true surface; samples beyond it are ignored."""
EDGE_SHIFT_M = 0.05
"""About the error of the mesh; where such a shift of the ray changes the visibility, the truth is ambiguous."""
ROUGHNESS_M = 0.10
"""Voxel size; smaller relief around a sample is roughness and hides nothing."""

Method = Callable[[View], DepthMap]


@dataclass(frozen=True)
class Made:
    """Results of the pipeline: a mesh per class, the whole thinned cloud, the views."""

    meshes: dict[str, Mesh]
    cloud: PointCloud
    views: tuple[View, ...]


@dataclass(frozen=True)
class Samples:
    """Points on a mesh that a view would texture if nothing occluded them.

    Attributes:
        points, normals: (N, 3) local metres, and unit vectors.
        hidden: (N,) whether the true street occludes them.
        clear: (N,) whether the same holds around the sample; other samples lie at an edge of the occluder.
        blocker: (N,) LAS class of the occluder; 0 if visible.
    """

    points: F32
    normals: F32
    hidden: Bools
    clear: Bools
    blocker: U8


def main() -> None:
    """Generate the street and its meshes, compute depth maps with all methods, and print shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--length", type=float, default=40.0)
    parser.add_argument("--points", type=float, default=1.5e6)
    parser.add_argument("--photos", type=int, default=16)
    parser.add_argument("--width", type=int, default=1024)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samples", type=int, default=60_000, help="number of samples per class and view")
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out")
    a = parser.parse_args()
    street = a.out / f"seen_{a.length:g}_{a.points:g}_{a.photos}_{a.width}_{a.seed}"
    if not (street / "tile.toml").is_file():
        generate(street, length=a.length, points=a.points, photos=a.photos, photo_width=a.width, seed=a.seed)
    tile = read_tile(street / "tile.toml")
    made = make(tile, street / "steps")
    truth = Truth(a.length, a.points, a.seed, tile.frame)

    methods = methods_of(made)
    counts: dict[str, dict[str, I64]] = {
        name: {group: np.zeros((2, 4), np.int64) for group in GROUPS} for name in methods
    }
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    blockers = np.zeros((2, 256), np.int64)
    for i, view in enumerate(made.views):
        samples = {g: truth.judge(*drawn, view) for g, drawn in draw(made.meshes, view, a.samples, seed=i)}
        for name, method in methods.items():
            began = time.perf_counter()
            depth = method(view)
            seconds[name].append(time.perf_counter() - began)
            for group, s in samples.items():
                seen = depth_map.visible(depth, s.points, s.normals)
                counts[name][group] += [tally(seen[k], s.hidden[k]) for k in (s.clear, slice(None))]
                if name == OURS:
                    of = s.hidden & s.clear
                    blockers += [np.bincount(s.blocker[of & m], minlength=256) for m in (of, seen)]
    print_methods(counts, {name: float(np.median(s)) for name, s in seconds.items()})
    print_blockers(*blockers)
    (leak, false_hiding, _), (leak_all, hiding_all, _) = (shares(tallied) for tallied in total(counts[OURS]))
    result = {
        "leak": leak,
        "false_hiding": false_hiding,
        "leak_edges_too": leak_all,
        "false_hiding_edges_too": hiding_all,
    }
    print("RESULT " + json.dumps({name: round(share, 4) for name, share in result.items()}))


def make(tile: Tile, out: Path) -> Made:
    """Run the pipeline up to the inputs of depth maps; results of an earlier run are reused."""
    meshes, clouds = [TaskId("decimate", g) for g in GROUPS], [TaskId("voxel", part) for part in (*GROUPS, "rest")]
    store = Store(out)
    planned = plan(required_tasks(build_graph(tile, Settings()), [*meshes, *clouds]), store)
    execute(planned, store, jobs=2, on_event=lambda task, event, fraction, message: None)
    folder = {p.task.id: store.folder(p.task.full_name, p.key) for p in planned}
    return Made(
        {g: Mesh.load(folder[task] / "mesh.npz") for g, task in zip(GROUPS, meshes, strict=True)},
        PointCloud.join([PointCloud.load(folder[task] / "cloud.npz") for task in clouds]),
        tile.views,
    )


def draw(meshes: dict[str, Mesh], view: View, count: int, seed: int) -> Iterator[tuple[str, tuple[F32, F32]]]:
    """Class, points and normals (N, 3) of samples spread evenly over its mesh that the view could texture."""
    rng = np.random.default_rng(seed)
    for group, mesh in meshes.items():
        area = np.cumsum(mesh.face_area, dtype=np.float64)
        face = np.searchsorted(area, rng.uniform(0, area[-1], count)).clip(max=len(mesh) - 1)
        u, v = np.sqrt(rng.uniform(size=(count, 1))), rng.uniform(size=(count, 1))
        a, b, c = np.moveaxis(mesh.corners[face].astype(np.float64), 1, 0)
        points, normals = (1 - u) * a + u * (1 - v) * b + u * v * c, mesh.face_normal[face]
        to = view.centre - points
        distance = np.linalg.norm(to, axis=1)
        _, shown = pixels(view.camera, view.T_world_cam, points)
        facing = np.einsum("ij,ij->i", to, normals) > MIN_INCIDENCE_COS * distance
        keep = shown & facing & (distance < PHOTO_RANGE_M)
        yield group, (points[keep].astype(np.float32), normals[keep])


class Truth:
    """The true street.

    Args:
        length, points, seed: parameters of its generation.
        frame: frame of the samples and views.
    """

    def __init__(self, length: float, points: float, seed: int, frame: Frame) -> None:
        import open3d as o3d

        layout = lay_out(length, seed)
        self.scene, self.drive = Scene(layout), plan_drive(layout, points)
        self._shift = np.subtract(frame.origin, FRAME.origin)
        still = self.scene.truth_mesh()
        self._still = o3d.t.geometry.RaycastingScene()
        self._still.add_triangles(still.vertices, still.faces.astype(np.uint32))

    def judge(self, points: F32, normals: F32, view: View) -> Samples:
        """True visibility of points (N, 3) with normals (N, 3) in a view; points far from the true surface are dropped.

        A sample's true position is the nearest on the true static surface. Lifted by `ROUGHNESS_M` along the sample's
        normal, it is hidden if the camera ray meets something more than `ROUGHNESS_M` before it. The result is clear if
        four rays, shifted by `EDGE_SHIFT_M`, agree.
        """
        moved = (points + self._shift).astype(np.float32)
        true = self._still.compute_closest_points(moved)["points"].numpy()
        near = np.linalg.norm(true - moved, axis=1) < MAX_TRUTH_DISTANCE_M
        points, normals = points[near], normals[near]
        to = true[near] + ROUGHNESS_M * normals - (view.centre + self._shift)
        right = np.cross(to, [0.0, 0.0, 1.0])
        right *= EDGE_SHIFT_M / np.linalg.norm(right, axis=1, keepdims=True)
        up = np.cross(right, to / np.linalg.norm(to, axis=1, keepdims=True))
        blocker, *around = (self._blocker(view, to + aside) for aside in (0, right, -right, up, -up))
        clear = np.all([(other > 0) == (blocker > 0) for other in around], axis=0)
        return Samples(points, normals, blocker > 0, clear, blocker)

    def _blocker(self, view: View, to: F64) -> U8:
        """(N,) LAS class of the first hit of rays from the camera by `to` (N, 3), before their ends; 0: none."""
        distance = np.linalg.norm(to, axis=1)
        assert view.time is not None
        car = self.drive.car(self.scene, np.array([view.time])).repeated(len(to))
        origins = np.broadcast_to((view.centre + self._shift).astype(np.float32), to.shape)
        hits = self.scene.cast(origins, (to / distance[:, None]).astype(np.float32), car)
        hidden = hits.distance < distance - ROUGHNESS_M
        return np.where(hidden, self.scene.surface.classification[hits.face], 0).astype(np.uint8)


def methods_of(made: Made) -> dict[str, Method]:
    """Functions by name that compute the depth map of a view."""
    p, meshes = VisibilityParams.model_validate({}), list(made.meshes.values())

    def of(hides: depth_map.Scene) -> Method:
        return lambda view: depth_map.depth_map(view.camera, view.T_world_cam, hides, time=view.time, pixels=p.pixels)

    return {
        f"boxes of points, {SPLAT_PX} px": lambda view: boxes(made.cloud, view),
        "discs of points": of(depth_map.scene([], made.cloud, radius=p.radius)),
        "mesh": of(depth_map.scene(meshes)),
        OURS: of(depth_map.scene(meshes, made.cloud, radius=p.radius, mesh_distance=p.mesh_distance)),
    }


def boxes(cloud: PointCloud, view: View) -> DepthMap:
    """A depth map of the photo's size: each point as a box of `SPLAT_PX` pixels at its distance, the nearest wins."""
    import cv2

    camera = view.camera
    uv, keep = pixels(camera, view.T_world_cam, cloud.xyz)
    column, row = np.floor(uv[keep] + 0.5).astype(int).T
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    np.minimum.at(depth, (row, column), np.linalg.norm(cloud.xyz[keep] - view.centre, axis=1).astype(np.float32))
    splats = np.asarray(cv2.erode(depth, np.ones((SPLAT_PX, SPLAT_PX))), np.float32)
    return DepthMap(camera, view.T_world_cam, splats + np.float32(SPLAT_BIAS_M))


def tally(seen: Bools, hidden: Bools) -> I64:
    """(4,) number of samples: hidden but seen, hidden, visible but not seen, visible."""
    return np.array([(hidden & seen).sum(), hidden.sum(), (~hidden & ~seen).sum(), (~hidden).sum()])


def total(counts: dict[str, I64]) -> I64:
    """Tallies summed over all classes: (2, 4), of clear samples and of all."""
    return np.sum(list(counts.values()), axis=0)


def shares(tallied: I64) -> tuple[float, float, float]:
    """Leak, false hiding and wrong, see the module's docstring."""
    leaked, hidden, missed, visible = (int(n) for n in tallied)
    seen = leaked + visible - missed
    return leaked / max(1, hidden), missed / max(1, visible), leaked / max(1, seen)


def print_methods(counts: dict[str, dict[str, I64]], seconds: dict[str, float]) -> None:
    """Print shares in percent by method and class: of clear samples, and of all including edges."""
    print(f"{'':<34}{'clear samples':>33}{'':>18} |{'those at edges too':>27}")
    titles = f"{'leak %':>8}{'false hiding %':>16}{'wrong %':>9}"
    print(f"{'method':<22}{'class':<12}{titles}{'hidden':>9}{'visible':>9} |{titles}{'edges %':>9}")
    for name, of in counts.items():
        for group, (clear, every) in {**of, "all": total(of)}.items():
            columns = [f"{100 * a:>8.2f}{100 * b:>16.2f}{100 * c:>9.2f}" for a, b, c in (shares(clear), shares(every))]
            edges = 100 * (1 - (clear[1] + clear[3]) / max(1, every[1] + every[3]))
            print(f"{name:<22}{group:<12}{columns[0]}{clear[1]:>9,}{clear[3]:>9,} |{columns[1]}{edges:>9.1f}")
        print(f"{'':<22}{seconds[name]:.2f} s per view")


def print_blockers(hidden: I64, leaked: I64) -> None:
    """Print for each class of occluders what it hides, and what leaks through it."""
    print(f"\n{'hidden by':<22}{'samples':>10}{'leaked':>9}{'leak %':>8}{'of all leaks %':>16}")
    for c in CLASSES:
        if hidden[c.code]:
            leak, part = 100 * leaked[c.code] / hidden[c.code], 100 * leaked[c.code] / max(1, leaked.sum())
            print(f"{c.name:<22}{hidden[c.code]:>10,}{leaked[c.code]:>9,}{leak:>8.2f}{part:>16.1f}")


if __name__ == "__main__":
    main()

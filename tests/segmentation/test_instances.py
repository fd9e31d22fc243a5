"""Detection of complete vehicles and people on a synthetic street with partly wrong classes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.pipeline.core.classes import CODE, group_of
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F32, Frame, PointCloud, Trajectory
from scan2sim.segmentation.steps.instances import INSTANCES
from scan2sim.segmentation.steps.segment import SOURCE_CLOUD, SOURCE_PHOTO
from scan2sim.segmentation.vehicle_boxes import Scan, passing_points
from tests.conftest import ROOT
from tests.present import present

FRAME = Frame("EPSG:25832", (500_000.0, 5_400_000.0, 100.0))
VEHICLE, BUILDING, ROAD, HEDGE = (CODE[n] for n in ("vehicle", "building", "road", "low_vegetation"))


def shell(size: tuple[float, float, float], at: tuple[float, float], clear: float = 0.25, turn: float = 0.0) -> F32:
    """Points every 7 cm on the sides and the top of a box (length, width, height), `clear` metres above the ground."""
    length, width, height = size
    u, v, w = (np.arange(0, s + 0.01, 0.07) for s in (length, width, height - clear))
    sides: list[tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]] = [(u[:, None], v[None], height - clear)]
    sides += [(u[:, None], side, w[None]) for side in (0.0, width)]
    sides += [(end, v[:, None], w[None]) for end in (0.0, length)]
    faces = [np.stack(np.broadcast_arrays(x, y, z), axis=-1).reshape(-1, 3) for x, y, z in sides]
    xyz = np.concatenate(faces) + [-length / 2, -width / 2, clear]
    c, s = np.cos(turn), np.sin(turn)
    return (xyz @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [*at, 0]).astype(np.float32)


def ground() -> F32:
    x, y = np.meshgrid(np.arange(-20, 20, 0.1), np.arange(-10, 10, 0.1), indexing="ij")
    z = np.random.default_rng(0).normal(0, 0.01, x.size)
    return np.column_stack([x.ravel(), y.ravel(), z]).astype(np.float32)


CAR = shell((4.4, 1.8, 1.5), (0, 4), turn=0.2)
SCENE: dict[str, tuple[F32, int]] = {
    "ground": (ground(), ROAD),
    "car": (CAR, VEHICLE),
    "hedge": (shell((6, 0.8, 1.3), (0.4, 5.75), 0.0, turn=0.2), HEDGE),  # almost touches the car's far side
    "container": (shell((4.4, 1.8, 1.7), (-12, 4), 0.0), BUILDING),
    "fence": (shell((8, 0.12, 1.4), (12, 6), 0.0), VEHICLE),
    "van": (shell((5.4, 2.0, 2.4), (9, -5)), VEHICLE),
}


def street(out: Path, wrong: dict[str, float] | None = None, kind: int = SOURCE_PHOTO, **more: F32) -> dict[str, Path]:
    """Inputs of the step; of objects in `wrong` the given share of points, at one end, is classified as building."""
    parts = {**{name: xyz for name, (xyz, _) in SCENE.items()}, **more}
    classification = {
        name: np.full(len(xyz), SCENE.get(name, (None, HEDGE))[1], np.uint8) for name, xyz in parts.items()
    }
    for name, share in (wrong or {}).items():
        x = parts[name][:, 0]
        classification[name][x < np.quantile(x, share)] = BUILDING
    cloud = PointCloud(
        FRAME, np.concatenate(list(parts.values())), classification=np.concatenate(list(classification.values()))
    )
    cloud.save(out / "in.npz")
    n = len(cloud)
    sure, source = np.full(n, 200, np.uint8), np.full(n, kind, np.uint8)
    np.savez(out / "sure.npz", confidence=sure, source=source, alternative=np.zeros(n, np.uint8))
    Trajectory(np.arange(2.0), np.array([[-20, 0, 1.8], [20, 0, 1.8]], float)).save(out / "path.npz")
    return {"cloud": out / "in.npz", "confidence": out / "sure.npz", "path": out / "path.npz"}


def run(inputs: dict[str, Path], out: Path, **params: Any) -> Done:
    (out / "out").mkdir()
    return INSTANCES.run(inputs, INSTANCES.params(**params), out / "out", silent)


def classified(done: Done, *more: F32) -> dict[str, np.ndarray]:
    """Classes of the points of every object."""
    classification = PointCloud.load(done.files["cloud"]).classification
    assert classification is not None
    ends = np.cumsum([len(xyz) for xyz, _ in SCENE.values()] + [len(xyz) for xyz in more])
    return dict(zip([*SCENE, *map(str, range(len(more)))], np.split(classification, ends[:-1]), strict=True))


def features(done: Done) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(done.files["instances"].read_text(encoding="utf-8"))["features"]
    return found


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Done:
    out = tmp_path_factory.mktemp("instances")
    return run(street(out, {"car": 0.4, "van": 0.3}), out)


def test_partly_classified_vehicles_are_completed(done: Done) -> None:
    after = classified(done)
    assert (after["car"] == VEHICLE).mean() > 0.995 and (after["van"] == VEHICLE).mean() > 0.995


def test_objects_beside_a_vehicle_keep_their_classes(done: Done) -> None:
    after = classified(done)
    assert (after["hedge"] == HEDGE).mean() > 0.97
    assert (after["container"] == BUILDING).all()
    assert (after["ground"] == ROAD).mean() > 0.9999


def test_fence_classified_as_vehicle_is_rejected(done: Done) -> None:
    assert (classified(done)["fence"] != VEHICLE).mean() > 0.95


def relabelled(out: Path, labelled: float, alternative: str, xyz: F32) -> Done:
    """Run with an object of which a share, at one end, is classified as vehicle, and the rest as low vegetation."""
    inputs = street(out, thing=xyz)
    cloud = PointCloud.load(inputs["cloud"])
    code = present(cloud.classification).copy()
    code[-len(xyz) :][xyz[:, 0] < np.quantile(xyz[:, 0], labelled)] = VEHICLE
    replace(cloud, classification=code).save(inputs["cloud"])
    n, second = len(cloud), np.zeros(len(cloud), np.uint8)
    second[-len(xyz) :] = CODE[alternative]
    sure, photos = np.full(n, 200, np.uint8), np.full(n, SOURCE_PHOTO, np.uint8)
    np.savez(out / "sure.npz", confidence=sure, source=photos, alternative=second)
    return run(inputs, out)


def test_mostly_mislabelled_shrub_stays_a_shrub(tmp_path: Path) -> None:
    shrub = shell((3.2, 2.6, 0.8), (-5, -5), 0.0, turn=0.5)
    done = relabelled(tmp_path, 0.67, "low_vegetation", shrub)
    assert (classified(done, shrub)["0"][shrub[:, 2] > 0.15] == HEDGE).mean() > 0.98
    assert {one["kind"] for one in done.metrics["removed"]} == {"car", "van"}


def test_slab_labelled_vehicle_gets_the_second_class_of_photos(tmp_path: Path) -> None:
    slab = shell((3.0, 0.25, 1.9), (-5, -6), 0.0)
    done = relabelled(tmp_path, 1.0, "building", slab)
    assert (classified(done, slab)["0"][slab[:, 2] > 0.15] == BUILDING).mean() > 0.95


def test_removed_objects_are_listed_with_position_size_and_reason(done: Done) -> None:
    car = next(one for one in done.metrics["removed"] if one["kind"] == "car")
    assert (car["x"], car["y"]) == pytest.approx((500_000, 5_400_004), abs=0.1)
    assert car["length_m"] == pytest.approx(4.4, abs=0.15) and not car["moved"]
    assert "probability" in car["why"]


def test_boxes_of_vehicles_are_listed(done: Done) -> None:
    found = {f["properties"]["kind"]: f for f in features(done)}
    assert set(found) == {"car", "van"} and done.metrics["vehicles"] == 2
    car = found["car"]["properties"]
    assert car["length_m"] == pytest.approx(4.4, abs=0.15) and car["width_m"] == pytest.approx(1.8, abs=0.15)
    assert car["height_m"] == pytest.approx(1.5, abs=0.1) and car["ground_z"] == pytest.approx(100, abs=0.1)
    assert abs(car["heading_deg"] - np.degrees(0.2)) < 3
    ring = np.array(found["car"]["geometry"]["coordinates"][0])
    assert np.allclose(ring[:4].mean(axis=0), (500_000, 5_400_004), atol=0.1)


def test_car_scanned_from_one_side_is_completed(tmp_path: Path) -> None:
    """The scanner passes at y = 0: the near side is scanned, and the far one only through the windows."""
    near = CAR[(CAR[:, 1] < 3.6 + 0.2 * CAR[:, 0]) | (np.arange(len(CAR)) % 40 == 0)]
    old = SCENE["car"]
    SCENE["car"] = (near, VEHICLE)
    try:
        after = classified(run(street(tmp_path), tmp_path))
    finally:
        SCENE["car"] = old
    assert (after["car"] == VEHICLE).mean() > 0.98 and (after["hedge"] == HEDGE).mean() > 0.95


def test_points_inside_a_trail_of_removed_points_become_vehicle(tmp_path: Path) -> None:
    rest = shell((3.0, 0.4, 1.2), (-6, -3))
    inputs = street(tmp_path, rest=rest)
    PointCloud(FRAME, rest[::2] + np.float32(0.1)).save(tmp_path / "moving.npz")
    done = run(inputs | {"moving": tmp_path / "moving.npz"}, tmp_path)
    assert (classified(done, rest)["0"] == VEHICLE).mean() > 0.95


def test_end_of_a_trail_of_removed_points_becomes_vehicle(tmp_path: Path) -> None:
    """No ray passes through the last position of a van, so it is not removed; unlike a bush, it is scanned briefly."""
    end, bush = shell((4.5, 2.0, 2.0), (-6, -3)), shell((4.5, 2.0, 2.0), (4, -1))
    inputs = street(tmp_path, end=end, bush=bush)
    cloud = PointCloud.load(inputs["cloud"])
    time = np.random.default_rng(0).uniform(0, 5, len(cloud))
    time[-len(end) - len(bush) : -len(bush)] /= 20
    replace(cloud, time=time).save(inputs["cloud"])
    before = [xyz[xyz[:, 0] < xyz[:, 0].min() + 0.1] - np.array([0.15, 0, 0], np.float32) for xyz in (end, bush)]
    PointCloud(FRAME, np.concatenate(before)).save(tmp_path / "moving.npz")
    after = classified(run(inputs | {"moving": tmp_path / "moving.npz"}, tmp_path), end, bush)
    assert (after["0"] == VEHICLE).mean() > 0.97 and (after["1"] == HEDGE).all()


def test_van_seen_only_by_the_last_sweeps_is_removed(tmp_path: Path) -> None:
    """Rays of earlier sweeps passed through its position; a hedge of this size blocks rays in most sweeps."""
    end, bush = shell((4.5, 2.0, 2.0), (-6, -3)), shell((4.5, 2.0, 2.0), (4, -1))
    scan = scan_of(end, bush)
    own = np.arange(len(scan.xyz)) >= len(scan.xyz) - len(end) - len(bush)
    van = own & (np.arange(len(scan.xyz)) < len(scan.xyz) - len(bush))
    scan = replace(scan, brief=own, seen=np.where(van, 2, 8), passed=np.where(van, 3, 1))
    (found,) = passing_points(scan)
    assert van[found].all() and len(found) > 0.95 * len(end)


def scan_of(*objects: F32) -> Scan:
    """Scan of ground and objects above it, of low vegetation."""
    xyz = np.concatenate([ground(), *objects])
    none, no = np.zeros(len(xyz), np.int64), np.zeros(len(xyz), bool)
    on_ground = np.arange(len(xyz)) < len(ground())
    code = np.where(on_ground, ROAD, HEDGE).astype(np.uint8)
    flat = np.zeros(len(xyz), np.float32)
    return Scan(
        xyz, xyz[:, 2], on_ground, code, flat, flat, no, no, none, none, np.array([[-20, 0, 1.8], [20, 0, 1.8]])
    )


def test_classes_of_the_input_cloud_are_kept(tmp_path: Path) -> None:
    inputs = street(tmp_path, {"car": 0.2}, SOURCE_CLOUD)
    done = run(inputs, tmp_path)
    before, after = (present(PointCloud.load(path).classification) for path in (inputs["cloud"], done.files["cloud"]))
    assert np.array_equal(before, after)
    assert {f["properties"]["kind"] for f in features(done)} >= {"car", "van"}, "vehicles are listed nevertheless"


def test_partly_classified_people_are_completed(tmp_path: Path) -> None:
    person = shell((0.5, 0.4, 1.75), (4, -3), 0.0)
    inputs = street(tmp_path, person=person)
    cloud = PointCloud.load(inputs["cloud"])
    assert cloud.classification is not None
    classification = cloud.classification.copy()
    classification[len(classification) - len(person) + len(person) // 3 :] = CODE["person"]
    replace(cloud, classification=classification).save(inputs["cloud"])
    done = run(inputs, tmp_path)
    assert done.metrics["people"] == 1
    assert (classified(done, person)["0"][person[:, 2] > 0.25] == CODE["person"]).mean() > 0.98


def test_post_partly_classified_as_person_is_rejected(tmp_path: Path) -> None:
    post = shell((0.4, 0.3, 1.05), (4, -3), 0.0)
    inputs = street(tmp_path, person=post)
    cloud = PointCloud.load(inputs["cloud"])
    assert cloud.classification is not None
    classification = cloud.classification.copy()
    classification[-len(post) :][post[:, 2] > 0.7] = CODE["person"]
    replace(cloud, classification=classification).save(inputs["cloud"])
    done = run(inputs, tmp_path)
    assert done.metrics["people"] == 0
    assert (classified(done, post)["0"] == HEDGE).mean() > 0.95


def test_cloud_is_unchanged_without_a_path(tmp_path: Path) -> None:
    inputs = street(tmp_path)
    done = run({"cloud": inputs["cloud"], "confidence": inputs["confidence"]}, tmp_path)
    assert done.metrics["vehicles"] == 0 and done.files["cloud"].stat().st_ino == inputs["cloud"].stat().st_ino


def test_static_points_of_the_synthetic_street_are_kept(tmp_path: Path) -> None:
    """Every other metre of the sample street that isn't a vehicle is classified as one; the truth is known."""
    path = ROOT / "data_samples" / "tile"
    las = laspy.read(path / "cloud.laz")
    poses = np.genfromtxt(path / "trajectory.csv", delimiter=",", names=True)
    truth, time = np.asarray(las.classification), np.asarray(las.gps_time)
    xyz = np.stack([las.x, las.y, las.z], axis=1)
    origin = np.floor(xyz.mean(axis=0))
    local = (xyz - origin).astype(np.float32)
    movable, ground = np.isin(truth, (VEHICLE, CODE["person"])), group_of()[truth] == 0
    wrong = ~movable & ~ground & (np.floor(local[:, :2]).astype(int).sum(axis=1) % 2 == 0)
    code = np.where(wrong, VEHICLE, truth).astype(np.uint8)
    PointCloud(FRAME, local, classification=code, time=time).save(tmp_path / "in.npz")
    at = np.column_stack([poses[axis] for axis in "xyz"]) - origin
    Trajectory(poses["time"], at).save(tmp_path / "path.npz")
    sure, source = np.full(len(code), 200, np.uint8), np.full(len(code), SOURCE_PHOTO, np.uint8)
    np.savez(tmp_path / "sure.npz", confidence=sure, source=source, alternative=np.where(movable, 0, truth))
    files = {"cloud": tmp_path / "in.npz", "confidence": tmp_path / "sure.npz", "path": tmp_path / "path.npz"}
    after = present(PointCloud.load(run(files, tmp_path).files["cloud"]).classification)
    static_lost = np.isin(after[~movable], (VEHICLE, CODE["person"])).mean()
    assert wrong.mean() > 0.2
    assert static_lost < 0.005
    assert (after[movable] == truth[movable]).mean() > 0.95

"""Detection of complete vehicles and people on a synthetic street with partly wrong classes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F32, Frame, PointCloud, Trajectory
from scan2sim.segmentation.steps.instances import INSTANCES
from scan2sim.segmentation.steps.segment import SOURCE_CLOUD, SOURCE_PHOTO
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
    np.savez(out / "sure.npz", confidence=np.full(n, 200, np.uint8), source=np.full(n, kind, np.uint8))
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


def test_points_inside_a_carved_trail_become_vehicle(tmp_path: Path) -> None:
    rest = shell((3.0, 0.4, 1.2), (-6, -3))
    inputs = street(tmp_path, rest=rest)
    PointCloud(FRAME, rest[::2] + np.float32(0.1)).save(tmp_path / "moving.npz")
    done = run(inputs | {"moving": tmp_path / "moving.npz"}, tmp_path)
    assert (classified(done, rest)["0"] == VEHICLE).mean() > 0.95


def test_end_of_a_carved_trail_becomes_vehicle(tmp_path: Path) -> None:
    """No ray passes through the last position of a van, so it isn't carved; unlike a bush, it is scanned briefly."""
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

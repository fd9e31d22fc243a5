"""Reflectance from intensities: that of the material at all ranges and angles; and its export."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.data_samples import scanner
from scan2sim.data_samples.layout import lay_out
from scan2sim.data_samples.scene import Scene
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F32, F64, U8, PointCloud, Trajectory
from scan2sim.pipeline.lidar.reflectance import reflectance
from scan2sim.pipeline.steps.export import EXPORT, ExportParams
from scan2sim.pipeline.steps.reflectance import REFLECTANCE
from tests.fakes import synthetic
from tests.fakes.steps import step_params
from tests.present import present

TRUE = {"road": 0.15, "terrain": 0.3, "building": 0.45, "high_vegetation": 0.4, "road_sign": 0.9}
SCANNER_HEIGHT_M = 2.0


def street() -> tuple[PointCloud, Trajectory, F32]:
    """Road, lawn beside it, walls to the left, a sloping hedge to the right, and signs; and true reflectances (N,).

    The scanner drives 60 m along x; each point is seen from up to 30 m before or behind it.
    """
    rng = np.random.default_rng(4)
    parts: list[tuple[str, F64, F64]] = []

    def add(name: str, count: int, low: tuple[float, ...], high: tuple[float, ...], normal: F64) -> None:
        xyz = rng.uniform(low, high, (count, 3))
        parts.append((name, xyz, np.broadcast_to(normal, xyz.shape)))

    up, left, ahead = np.eye(3)[2], np.eye(3)[1], np.eye(3)[0]
    add("road", 30_000, (0, -4, 0), (60, 4, 0), up)
    add("terrain", 20_000, (0, -12, 0), (60, -4, 0), up)
    add("building", 30_000, (0, 9, 0), (60, 9, 8), left)
    leaves = rng.normal(size=(15_000, 3))
    add("high_vegetation", 15_000, (0, -16, 0), (60, -12, 4), leaves / np.linalg.norm(leaves, axis=1)[:, None])
    for x in (10.0, 30.0, 50.0):
        add("road_sign", 300, (x, -5, 2), (x, -4, 3), ahead)
    name = np.repeat([name for name, _, _ in parts], [len(xyz) for _, xyz, _ in parts])
    xyz, normal = (np.concatenate([part[i] for part in parts]) for i in (1, 2))
    times = np.linspace(100, 106, 61)
    positions = np.column_stack([np.linspace(0, 60, 61), np.zeros(61), np.full(61, SCANNER_HEIGHT_M)])
    path = Trajectory(times, positions)
    time = np.clip(100 + xyz[:, 0] / 10 + rng.uniform(-3, 3, len(xyz)), 100, 106)
    ray = path.at(time) - xyz
    distance = np.linalg.norm(ray, axis=1)
    facing = np.abs(np.einsum("ij,ij->i", ray, normal)) / distance
    true = np.array([TRUE[one] for one in name.tolist()], np.float32)
    value = true * rng.normal(1, 0.08, len(true)) * (0.3 + 0.7 * facing) / (1 + (distance / 12) ** 1.5)
    code = np.array([CODE[one] for one in name.tolist()], np.uint8)
    intensity = np.clip(60_000 * value, 0, 65_535).astype(np.uint16)
    cloud = PointCloud(synthetic.UTM, xyz.astype(np.float32), classification=code, time=time, intensity=intensity)
    return cloud, path, true


def medians(value: F32, code: U8) -> dict[str, float]:
    return {name: float(np.median(value[code == CODE[name]])) for name in TRUE}


def test_reflectance_is_that_of_the_material_at_all_ranges() -> None:
    cloud, path, true = street()
    code = present(cloud.classification)
    value = reflectance(cloud, path)
    assert value.min() >= 0 and value.max() == 1
    found = medians(value, code)
    assert sorted(found, key=found.__getitem__) == sorted(TRUE, key=TRUE.__getitem__)
    for name in TRUE.keys() - {"road_sign"}:
        assert found[name] / found["building"] == pytest.approx(TRUE[name] / TRUE["building"], rel=0.05), name
    assert found["road_sign"] > 0.9  # the brightest percent of the points is saturated
    far = np.linalg.norm(path.at(present(cloud.time)) - cloud.xyz, axis=1)
    for name in ("road", "building"):
        own = code == CODE[name]
        near, distant = (np.median(value[own & part]) for part in (far < 12, far > 20))
        assert distant == pytest.approx(near, rel=0.1), name
    raw = present(cloud.intensity).astype(np.float32)
    assert np.median(raw[(code == CODE["road"]) & (far > 20)]) < 0.4 * np.median(
        raw[(code == CODE["road"]) & (far < 12)]
    )
    assert np.corrcoef(value, true)[0, 1] > np.corrcoef(raw, true)[0, 1] + 0.2


def test_points_without_intensity_have_no_reflectance() -> None:
    cloud, path, _ = street()
    far = np.linalg.norm(path.at(present(cloud.time)) - cloud.xyz, axis=1) > 25
    weak = replace(cloud, intensity=np.where(far, 0, present(cloud.intensity)).astype(np.uint16))
    value = reflectance(weak, path)
    assert np.isnan(value[far]).all() and np.isfinite(value[~far]).all()
    np.testing.assert_allclose(value[~far], reflectance(cloud, path)[~far], rtol=0.1)


def test_reflectance_of_the_synthetic_street_is_that_of_its_materials(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(lay_out(12.0, 5))
    drive = scanner.plan_drive(scene.layout, 40_000)
    cloud = scanner.scan(scene, drive, 40_000)
    monkeypatch.setattr(scanner, "_intensity", lambda scene, face, *_: scanner.reflectivity(scene.surface)[face])
    true = present(scanner.scan(scene, drive, 40_000).intensity)
    raw, code = present(cloud.intensity), present(cloud.classification)

    def error(value: npt.NDArray[Any]) -> float:
        """Median relative error of values, scaled to the true ones."""
        ratio = value / true
        return float(np.median(np.abs(ratio / np.median(ratio) - 1)))

    value = reflectance(cloud, drive.trajectory())
    assert error(value) < 0.12 < 0.18 < error(raw)
    scale = np.median(value / true)
    for name in ("road", "sidewalk", "building", "high_vegetation"):
        own = code == CODE[name]
        assert np.median(value[own]) / scale == pytest.approx(np.median(true[own]), rel=0.25), name


def test_intensities_are_only_scaled_without_a_path() -> None:
    cloud, _, _ = street()
    value, raw = reflectance(cloud, None), present(cloud.intensity)
    inner = value < 1
    assert np.corrcoef(value[inner], raw[inner])[0, 1] == pytest.approx(1, abs=1e-3)


def scanned() -> PointCloud:
    """Points on the synthetic tile: dark ground, and a house with three times its reflectance."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-10, 10, (2, 20_000))
    ground = np.column_stack([x, y, synthetic.height(x, y)])
    corner = synthetic.HOUSE
    wall = np.column_stack(
        [corner[0] + rng.uniform(0, 3, 4000), np.full(4000, corner[1]), rng.uniform(-0.5, 4.5, 4000)]
    )
    roof = np.column_stack(
        [corner[0] + rng.uniform(0, 3, 4000), corner[1] + rng.uniform(0, 2, 4000), np.full(4000, 4.5)]
    )
    xyz = np.concatenate([ground, wall, roof]).astype(np.float32)
    code = np.repeat(np.array([CODE["terrain"], CODE["building"]], np.uint8), [20_000, 8000])
    level = np.where(code == CODE["building"], 30_000, 10_000) * rng.normal(1, 0.05, len(xyz))
    return PointCloud(synthetic.UTM, xyz, classification=code, intensity=level.astype(np.uint16))


def run(tmp_path: Path, cloud: PointCloud, with_path: bool = False) -> tuple[Done, dict[str, Path]]:
    """Run the step on the synthetic tile; also returns the inputs of the export."""
    meshes = {"terrain": synthetic.ground(), "building": synthetic.house()}
    folders = {group: synthetic.textured(tmp_path / group, mesh) for group, mesh in meshes.items()}
    cloud.save(tmp_path / "cloud.npz")
    out = tmp_path / "out"
    out.mkdir()
    textured = {f"textured.{group}": folder for group, folder in folders.items()}
    inputs = {"cloud": tmp_path / "cloud.npz", **textured}
    if with_path:
        inputs["path"] = tmp_path / "path.npz"
        Trajectory(np.arange(2.0), np.array([[-8.0, 0, 2], [8, 0, 2]])).save(inputs["path"])
    done = REFLECTANCE.run(inputs, REFLECTANCE.params(), out, silent)
    synthetic.collided().save(tmp_path / "collision.npz")
    return done, {**folders, "collision": tmp_path / "collision.npz", "reflectance": done.files["reflectance"]}


def retros(world: Path) -> dict[str, int | None]:
    """`<laser_retro>` of each visual in Gazebo's model."""
    visuals = ET.parse(world / "models" / "tile" / "model.sdf").getroot().iter("visual")
    texts = {present(visual.get("name")): visual.findtext("laser_retro") for visual in visuals}
    return {name: None if text is None else int(text) for name, text in texts.items()}


def exported(tmp_path: Path, inputs: dict[str, Path], **params: bool) -> Path:
    out = tmp_path / "export"
    out.mkdir()
    return EXPORT.run(inputs, step_params(ExportParams, formats=("gazebo",), **params), out, silent).files["world"]


def test_visuals_have_the_reflectance_of_their_surface(tmp_path: Path) -> None:
    done, inputs = run(tmp_path, scanned())
    assert done.metrics["source"] == "intensity" and done.metrics["measured"] > 0.9
    found = retros(exported(tmp_path, inputs))
    assert found.keys() == {"terrain", "building"}
    ground, house = present(found["terrain"]), present(found["building"])
    assert house == pytest.approx(3 * ground, rel=0.08) and 200 < house <= 255


def test_reflectance_can_be_omitted(tmp_path: Path) -> None:
    _, inputs = run(tmp_path, scanned())
    assert set(retros(exported(tmp_path, inputs, reflectance=False)).values()) == {None}


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("none", "the cloud has no intensities"),
        ("constant", "the intensities are constant"),
        ("weak", "most intensities are 0"),
    ],
)
def test_clouds_without_usable_intensities_give_no_reflectance(tmp_path: Path, kind: str, reason: str) -> None:
    cloud = scanned()
    levels = {
        "constant": np.full(len(cloud), 7),
        "weak": np.where(np.arange(len(cloud)) % 3, 0, present(cloud.intensity)),
    }
    intensity = levels[kind].astype(np.uint16) if kind in levels else None
    done, inputs = run(tmp_path, replace(cloud, intensity=intensity), kind == "weak")
    assert done.metrics == {"source": "none", "reason": reason}
    assert set(retros(exported(tmp_path, inputs)).values()) == {None}

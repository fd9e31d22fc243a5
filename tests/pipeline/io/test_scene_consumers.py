"""Exports in simulators and validators; each is skipped with a reason if it is not installed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.camera import renderer
from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.geodata import crs
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds import glb
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.texturing.levels_of_detail import with_levels
from tests.fakes import cesium, synthetic, threejs
from tests.fakes.consumers import gltf_validator, omniverse, usd
from tests.present import present

RADIUS = 0.2  # of the ball that is dropped, metres
PLACES = [(-4.7, 0.3), (3.0, -6.0), (12.6, 1.0), (25.0, 8.0), (31.0, -4.0)]
"""Of balls, metres from the scene's origin: on both tiles, and where they meet (from 10 to 15 m there is neither)."""


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return synthetic.scene(tmp_path_factory.mktemp("town"))


def module(name: str) -> Any:
    return pytest.importorskip(name, reason=f"{name} is not installed")


def export(scene: Scene, name: str, folder: Path, **params: Any) -> Path:
    world_formats.write(scene, [name], folder, SceneParams(**params), silent)
    return folder


def ground(x: float, y: float) -> float:
    """Ground height of the synthetic scene, whose mesh has cells of 2 m."""
    tile = 0 if x < 12.5 else 1
    return float(synthetic.height(np.array(x - 25 * tile), np.array(y - 3 * tile))) - tile


def test_balls_rest_on_the_ground_in_mujoco(town: Scene, tmp_path: Path) -> None:
    mujoco = module("mujoco")
    path = export(town, "mujoco", tmp_path) / "town.xml"
    spec = mujoco.MjSpec.from_file(str(path))
    on = [(x, y) for x, y in PLACES if not 10 < x < 15]
    for i, (x, y) in enumerate(on):
        ball = spec.worldbody.add_body(name=f"ball{i}", pos=[x, y, 2.0])
        ball.add_freejoint()
        ball.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[RADIUS] * 3, mass=10)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=int(2 / model.opt.timestep))
    for i, (x, y) in enumerate(on):
        assert data.body(f"ball{i}").xpos[2] == pytest.approx(ground(x, y) + RADIUS, abs=0.12)


def test_walls_and_poles_are_solid_in_mujoco(town: Scene, tmp_path: Path) -> None:
    mujoco = module("mujoco")
    model = mujoco.MjModel.from_xml_path(str(export(town, "mujoco", tmp_path) / "town.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hit = np.zeros(1, np.int32)
    solid = np.array([0, 0, 0, 1, 0, 0], np.uint8)  # geom group of collision shapes

    def reach(start: tuple[float, float, float], along: tuple[float, float, float]) -> float:
        return float(mujoco.mj_ray(model, data, np.array(start), np.array(along), solid, 1, -1, hit))

    x, y = synthetic.HOUSE
    assert reach((x - 3, y + 1, 2), (1, 0, 0)) == pytest.approx(3, abs=0.25)  # the west wall
    assert reach((x + 1.5, y + 1, 8), (0, 0, -1)) == pytest.approx(3.5, abs=0.3)  # the roof
    assert reach((-7, -5, 2), (1, 0, 0)) == pytest.approx(1.9, abs=0.01)  # the pole


def test_ball_rests_and_camera_returns_classes_in_pybullet(town: Scene, tmp_path: Path) -> None:
    bullet = module("pybullet")
    path = export(town, "urdf", tmp_path) / "town.urdf"
    client = bullet.connect(bullet.DIRECT)
    try:
        bullet.setGravity(0, 0, -9.8)
        body = bullet.loadURDF(str(path), useFixedBase=True)
        names = {i: bullet.getJointInfo(body, i)[12].decode() for i in range(bullet.getNumJoints(body))}
        assert set(names.values()) >= {"tile0", "tile1", "tile0/terrain/2", "tile1/road_sign/64"}
        shape = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=RADIUS)
        on = [(x, y) for x, y in PLACES if not 10 < x < 15]
        balls = [bullet.createMultiBody(10, shape, basePosition=[x, y, ground(x, y) + 0.5]) for x, y in on]
        for ball in balls:
            bullet.changeDynamics(ball, -1, rollingFriction=0.1, spinningFriction=0.1)
        for _ in range(240):
            bullet.stepSimulation()
        for ball in balls:
            x, y, z = bullet.getBasePositionAndOrientation(ball)[0]
            assert z == pytest.approx(ground(x, y) + RADIUS, abs=0.12)
        x, y = synthetic.HOUSE
        view = bullet.computeViewMatrix([x - 4, y + 1, 2], [x, y + 1, 2], [0, 0, 1])
        lens = bullet.computeProjectionMatrixFOV(60, 1, 0.1, 100)
        flag = bullet.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX
        picture = bullet.getCameraImage(64, 64, view, lens, flags=flag, renderer=bullet.ER_TINY_RENDERER)
        mask = np.reshape(picture[4], (64, 64))
        assert names[int(mask[32, 32] >> 24) - 1] == "tile0/building/6"
        assert names[int(mask[60, 32] >> 24) - 1] == "tile0/terrain/2"
    finally:
        bullet.disconnect(client)


def test_usd_is_valid_and_tiles_load_separately(town: Scene, tmp_path: Path) -> None:
    module("pxr")
    from pxr import Usd, UsdGeom, UsdPhysics

    path = str(export(town, "usd", tmp_path) / "town.usdc")
    count, faults = usd.faults(Path(path))
    assert count > 20 and not faults
    bare = Usd.Stage.Open(path, Usd.Stage.LoadNone)
    assert not [prim for prim in bare.Traverse() if prim.IsA(UsdGeom.Mesh)]  # tiles load one by one
    bare.Load("/World/tile1")
    solids = bare.GetPrimAtPath("/World/tile1/Collision").GetChildren()
    assert {prim.GetName(): prim.GetTypeName() for prim in solids} == {
        "terrain": "Mesh", "building": "Mesh", "pole_1": "Cylinder",
    }  # fmt: skip
    for prim in solids:
        assert prim.HasAPI(UsdPhysics.CollisionAPI) and UsdGeom.Imageable(prim).ComputePurpose() == "guide"
    place = bare.GetDefaultPrim().GetCustomDataByKey("scan2sim")
    assert place["crs"] == "EPSG:32632" and tuple(place["worldOriginMetres"]) == synthetic.UTM.origin


def test_usd_tiles_have_their_coarser_levels_as_variants(town: Scene, tmp_path: Path) -> None:
    module("pxr")
    from pxr import Usd, UsdGeom, UsdValidation

    levels = with_levels(town, 2, tmp_path / "levels", silent)
    stage = Usd.Stage.Open(str(export(levels, "usd", tmp_path / "out") / "town.usdc"))
    every = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert not [fault.GetErrorAsString() for fault in UsdValidation.ValidationContext(every).Validate(stage)]

    def triangles(kind: str) -> int:
        meshes = [UsdGeom.Mesh(prim) for prim in stage.GetPrimAtPath(f"/World/tile0/{kind}").GetChildren()]
        return sum(len(mesh.GetFaceVertexCountsAttr().Get() or ()) for mesh in meshes)

    fine, solid = triangles("Visual"), triangles("Collision")
    choice = stage.GetPrimAtPath("/World/tile0").GetVariantSet("levelOfDetail")
    assert choice.GetVariantNames() == ["finest", "level1"] and choice.GetVariantSelection() == "finest"
    choice.SetVariantSelection("level1")
    assert 0 < triangles("Visual") < 0.5 * fine and triangles("Collision") == solid


def test_omniverse_validator_reports_no_failures(town: Scene, tmp_path: Path) -> None:
    if why := omniverse.missing():
        pytest.skip(why)
    found = omniverse.found(export(town, "usd", tmp_path) / "town.usdc")
    assert not [text for severity, text in found if severity in omniverse.FAILED]


PACKED = [{}, {"glb_lit": True}, {"glb_texture": "webp"}, {"glb_mesh": "meshopt"}, {"glb_mesh": "draco"}]


@pytest.mark.parametrize("params", PACKED, ids=lambda params: "_".join(map(str, params.values())) or "plain")
def test_khronos_validator_reports_no_issues_in_glbs(town: Scene, tmp_path: Path, params: dict[str, Any]) -> None:
    why = gltf_validator.missing()
    missing = plugins.missing("scan2sim.pipeline.io.worlds.gltf.geometry", params.get("glb_mesh", "plain"))
    if why or missing:
        pytest.skip(why or f"{missing} is not installed (pip install 'scan2sim[gltf]')")
    for path in export(town, "glb", tmp_path, **params).glob("*.glb"):
        issues = gltf_validator.issues(path)
        assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


def test_three_js_renders_all_tiles_like_the_project_renderer(town: Scene, tmp_path: Path) -> None:
    if why := threejs.missing():
        pytest.skip(why)
    folder = export(town, "glb", tmp_path / "out")
    view = town.tiles[0].views()[0]
    with threejs.viewer(folder, ["tile0.glb", "tile1.glb"], tmp_path / "page", (640, 480)) as page:
        picture = page.render(view.camera, view.T_world_cam)
    triangles = sum(len(surface.shape) for tile in town.tiles for surface in tile.surfaces())
    assert page.statistics == {"triangles": triangles, "textures": 8, "features": 8}
    bodies = [renderer.placed(tile.folder / group, tile.offset) for tile in town.tiles for group in tile.groups]
    own = renderer.Renderer(bodies).view(view.camera, view.T_world_cam, background=threejs.SKY, samples=2)
    both = own.hit & (picture != threejs.SKY).any(axis=2)
    assert both.sum() > 0.98 * own.hit.sum() > 0.3 * own.hit.size
    assert np.abs(picture[both].astype(int) - own.rgb[both]).mean() < 6


@pytest.mark.parametrize("params", [{"glb_mesh": "meshopt"}, {"glb_mesh": "draco"}, {"glb_texture": "ktx2"}], ids=str)
def test_three_js_reads_compressed_files(town: Scene, tmp_path: Path, params: dict[str, str]) -> None:
    package = cesium.node_module("three")
    try:
        glb.find_encoders(glb.GlbParams(**params))
    except UnavailableError as error:
        pytest.skip(str(error))
    if why := threejs.missing() or ("" if package else "three is not installed (npm install -g three)"):
        pytest.skip(why)
    view = town.tiles[0].views()[0]
    pictures = []
    for name, packed in (("plain", {}), ("packed", params)):
        folder = export(town, "glb", tmp_path / name, **packed)
        with threejs.viewer(folder, ["tile0.glb", "tile1.glb"], tmp_path / f"{name}-page", (640, 480), package) as page:
            pictures.append(page.render(view.camera, view.T_world_cam).astype(int))
            assert page.statistics["textures"] == page.statistics["features"] == 8
    apart = np.abs(pictures[0] - pictures[1]).max(axis=2)
    assert (pictures[0] != threejs.SKY).any(axis=2).mean() > 0.3
    assert np.mean(apart > 40) < 0.01 and apart.mean() < 4


def test_cesium_shows_all_tiles_at_their_positions_on_the_earth(town: Scene, tmp_path: Path) -> None:
    folder = export(town, "tiles3d", tmp_path / "out")
    with cesium.viewer(folder, tmp_path / "view", (320, 240)) as view:
        shown = view.look(*above(town, 60), focal=200)
        assert shown == [f"tiles3d/{tile.name}.glb" for tile in town.tiles]
        triangles = sum(len(surface.shape) for tile in town.tiles for surface in tile.surfaces())
        assert view.page.value("tiles.statistics.numberOfTrianglesSelected") == triangles
        place = "Cesium.Cartographic.fromCartesian(tiles.boundingSphere.center)"
        latitude, longitude = view.page.value(f"(p => [p.latitude, p.longitude])({place})")
        here = present(crs.to_wgs84(town.frame))
        assert np.degrees([latitude, longitude]) == pytest.approx(here[:2], abs=5e-4)


def test_cesium_returns_the_photo_of_a_picked_face(town: Scene, tmp_path: Path) -> None:
    folder = export(town, "tiles3d", tmp_path / "out")
    with cesium.viewer(folder, tmp_path / "view", (320, 240)) as view:
        view.look(*above(town, 60), focal=200)
        properties = "['source', 'photo', 'taken'].map((name) => picked.getProperty(name))"
        found = view.page.value(f"(picked => {properties})(widget.scene.pick(new Cesium.Cartesian2(100, 120)))")
        assert found == ["photo", "front", "2018-06-01T00:00:00+00:00"]


def test_cesium_loads_finer_levels_when_closer(town: Scene, tmp_path: Path) -> None:
    levels = with_levels(town, 2, tmp_path / "levels", silent)
    folder = export(levels, "tiles3d", tmp_path / "out")
    with cesium.viewer(folder, tmp_path / "view", (320, 240)) as view:
        far = view.look(*above(town, 400), focal=200)
        assert far == ["tiles3d/level2/tile0.glb"]
        near = view.look(*above(town, 40), focal=480)
        assert near == ["tiles3d/tile0.glb", "tiles3d/tile1.glb"]
        picture = view.screenshot()
        assert (picture[120, 40] != cesium.SKY).any() and (picture[120, 160] == cesium.SKY).all()


def above(scene: Scene, height: float) -> np.ndarray:
    """Position of a camera above a scene, viewing direction, and up direction of its image, (3, 3), earth-centred."""
    middle = np.mean([tile.offset for tile in scene.tiles], axis=0) + (0, 0, height)
    places = crs.to_ecef(scene.frame, middle + np.array([(0, 0, 0), (0, 0, -1), (0, 1, 0)]))
    return places - np.array([[0, 0, 0], places[0], places[0]])

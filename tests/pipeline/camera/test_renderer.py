"""Renderer: known textures at the correct pixels, maps to scale, wireframe and shading."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.camera import renderer
from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.camera.renderer import Body, Renderer, look_at, pinhole
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Camera, Frame, Mesh


def square(size: float = 4.0, z: float = 0.0) -> Mesh:
    half = size / 2
    vertices = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]], np.float32)
    uv = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], np.float32)
    return Mesh(Frame(), vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32), uv=uv, page=np.zeros(2, np.int16))


@pytest.fixture
def painted(tmp_path: Path) -> Body:
    """A square whose texture is red in the north west, green north east, blue south west, white south east."""
    page = np.zeros((64, 64, 3), np.uint8)
    page[:32, :32], page[:32, 32:] = (255, 0, 0), (0, 255, 0)
    page[32:, :32], page[32:, 32:] = (0, 0, 255), (255, 255, 255)
    mask = np.full((64, 64), 255, np.uint8)
    mask[:32] = 128
    cv2.imwrite(str(tmp_path / "page_0.png"), page[..., ::-1])
    cv2.imwrite(str(tmp_path / "page_0_seen.png"), mask)
    return Body(square(), (tmp_path / "page_0.png",))


def test_map_from_above_is_north_up(painted: Body) -> None:
    image = Renderer([painted]).above((-4, -4, 0), (4, 4, 1), width=80)
    assert image.rgb.shape == (80, 80, 3)
    assert image.rgb[30, 30].tolist() == [255, 0, 0]
    assert image.rgb[30, 50].tolist() == [0, 255, 0]
    assert image.rgb[50, 30].tolist() == [0, 0, 255]
    assert image.hit.sum() == 40 * 40
    assert (image.rgb[~image.hit] == 255).all()
    assert image.seen[30, 30] == 128 and image.seen[50, 30] == 255 and image.seen[0, 0] == 0


def test_rendering_is_identical_with_little_memory(painted: Body, monkeypatch: pytest.MonkeyPatch) -> None:
    pages = [painted.pages[0]]
    for k in (1, 2):
        for end in ("", "_seen"):
            image = cv2.imread(str(pages[0].with_name(f"page_0{end}.png")), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(pages[0].with_name(f"page_{k}{end}.png")), image // (k + 1))
        pages.append(pages[0].with_name(f"page_{k}.png"))
    mesh = square()
    mesh = Mesh(mesh.frame, mesh.vertices, mesh.faces, uv=mesh.uv, page=np.array([1, 2], np.int16))
    pose = look_at((0, -3, 3), (0, 0, 0))
    known = Renderer([Body(mesh, tuple(pages)), painted])
    expected = known.view(pinhole(160, 120), pose, samples=2)
    monkeypatch.setattr(renderer, "PAGES_MAX_BYTES", 1)
    monkeypatch.setattr(renderer, "RAY_CHUNK", 5000)
    poor = Renderer([Body(mesh, tuple(pages)), painted])
    np.testing.assert_array_equal(poor.view(pinhole(160, 120), pose, samples=2).rgb, expected.rgb)
    assert poor.covers(pinhole(160, 120), pose) == expected.hit.mean()


@pytest.mark.parametrize(
    "camera", [pinhole(160, 120), Camera("fisheye", 120, 120, 60, 60, 59.5, 59.5), Camera("equirectangular", 200, 100)]
)
def test_rendered_colours_are_at_their_projected_pixels(painted: Body, camera: Camera) -> None:
    pose = look_at((0, -3, 3), (0, 0, 0))
    image = Renderer([painted]).view(camera, pose, background=(1, 2, 3))
    points = np.array([[-1.0, 1, 0], [1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    uv, valid = project(camera, (points - pose[:3, 3]) @ pose[:3, :3])
    assert valid.all()
    at = np.round(uv).astype(int)
    colours = image.rgb[at[:, 1], at[:, 0]].tolist()
    assert colours == [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]]
    distance = np.linalg.norm(points - pose[:3, 3], axis=1)
    np.testing.assert_allclose(image.range[at[:, 1], at[:, 0]], distance, rtol=0.03)


def test_nearest_mesh_occludes_others_and_faces_are_numbered(painted: Body) -> None:
    cover = Body(square(1.0, 1.0), colour=np.array([[10, 20, 30], [40, 50, 60]], np.uint8))
    image = Renderer([painted, Body(square(0.5, 5.0).keep(np.zeros(2, bool))), cover]).above(
        (-2, -2, 0), (2, 2, 2), width=80
    )
    assert set(np.unique(image.body)) == {0, 2}
    assert sorted(map(tuple, np.unique(image.rgb[image.body == 2], axis=0).tolist())) == [(10, 20, 30), (40, 50, 60)]


def test_shading_and_wireframe_are_drawn(painted: Body) -> None:
    plain = Body(square(), colour=(200, 200, 200))
    camera, pose = pinhole(160, 120), look_at((0, -3, 3), (0, 0, 0))
    lit = Renderer([plain]).view(camera, pose, shaded=True)
    lines = Renderer([plain]).view(camera, pose, wireframe=True)
    assert len(np.unique(lit.rgb[lit.hit], axis=0)) == 1
    assert (lit.rgb[lit.hit] != 200).all()
    assert 0 < (lines.rgb[lines.hit] < 100).all(axis=1).mean() < 0.2


def test_empty_scene_is_rendered_as_background() -> None:
    image = Renderer([]).view(pinhole(20, 10), np.eye(4), background=(9, 9, 9))
    assert (image.rgb == 9).all() and not image.hit.any()


def test_unreadable_texture_page_is_reported(tmp_path: Path) -> None:
    (tmp_path / "page_0.png").write_bytes(b"no image")
    with pytest.raises(InputError, match="page_0.png"):
        Renderer([Body(square(), (tmp_path / "page_0.png",))]).above((-1, -1, 0), (1, 1, 1), width=10)


def checkered(folder: Path, texels: int = 256) -> Body:
    """A square of 4 m with a black and white checkerboard, one texel per field."""
    page = np.indices((texels, texels)).sum(axis=0) % 2 * 255
    cv2.imwrite(str(folder / "page_0.png"), np.repeat(page[..., None], 3, axis=2).astype(np.uint8))
    return Body(square(), (folder / "page_0.png",))


def test_supersampling_filters_detail_finer_than_a_pixel(tmp_path: Path) -> None:
    renderer = Renderer([checkered(tmp_path)])
    camera, pose = pinhole(60, 40, field=40), look_at((0, -6, 5), (0, 0, 0))
    coarse, fine = renderer.view(camera, pose), renderer.view(camera, pose, samples=6)
    assert coarse.rgb[coarse.hit].astype(float).std() > 40
    assert abs(fine.rgb[fine.hit].astype(float) - 127.5).mean() < 15
    for name in ("hit", "seen", "face", "body", "range", "barycentric"):
        np.testing.assert_array_equal(getattr(coarse, name), getattr(fine, name))


def test_rendering_in_parts_is_identical(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera, pose = pinhole(60, 40, field=90), look_at((0, -6, 1), (0, 0, 1))  # no ray of the upper rows hits a mesh
    whole = Renderer([checkered(tmp_path)]).view(camera, pose, samples=3)
    monkeypatch.setattr("scan2sim.pipeline.camera.renderer.RAY_CHUNK", 600)
    pieces = Renderer([checkered(tmp_path)]).view(camera, pose, samples=3)
    np.testing.assert_array_equal(whole.rgb, pieces.rgb)
    np.testing.assert_array_equal(whole.face, pieces.face)


@pytest.mark.parametrize("samples", [2, 3])
def test_supersampling_does_not_mix_background_into_edges(samples: int) -> None:
    plain = Body(square(), colour=(10, 20, 30))
    image = Renderer([plain]).view(
        pinhole(61, 41), look_at((0, -6, 5), (0, 0, 0)), background=(250, 0, 0), samples=samples
    )
    assert (image.rgb[image.hit] == (10, 20, 30)).all() and (image.rgb[~image.hit] == (250, 0, 0)).all()
    assert image.hit.any() and not image.hit.all()


def test_closest_points_and_their_colours_lie_on_the_mesh(painted: Body) -> None:
    points = np.array([[-1, 1, 0.3], [1, -1, -0.2]], np.float32)
    rgb, seen, distance = Renderer([painted]).nearest(points)
    assert rgb.tolist() == [[255, 0, 0], [255, 255, 255]] and seen.tolist() == [128, 255]
    np.testing.assert_allclose(distance, [0.3, 0.2], rtol=1e-5)
    places, normals = Renderer([painted]).closest_points(points)
    np.testing.assert_allclose(places, [[-1, 1, 0], [1, -1, 0]], atol=1e-6)
    np.testing.assert_allclose(abs(normals), [[0, 0, 1], [0, 0, 1]], atol=1e-6)

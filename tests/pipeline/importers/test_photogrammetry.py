"""Posed photos of other programs, written by the formulas of each format: points project to their true pixels."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import F64, Frame, PointCloud
from scan2sim.pipeline.importers.photogrammetry import import_model
from scan2sim.pipeline.io import clouds, photogrammetry
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.photogrammetry import Model, read
from scan2sim.pipeline.io.tile import read_tile
from tests.conftest import ROOT

TILE = ROOT / "data_samples" / "tile"
W, H = 800, 600
Lens = Callable[[F64], F64]  # points in camera axes to pixels, the middle of the top left one at (0.5, 0.5)


def shots(size: tuple[int, int] = (W, H)) -> list[tuple[str, F64]]:
    """Names and poses, camera to local coordinates, of the sample street's photos of a size."""
    tile = read_tile(TILE)
    return [(v.photo.name, v.T_world_cam) for v in tile.views if (v.camera.width, v.camera.height) == size]


def images(size: tuple[int, int] = (W, H)) -> Path:
    tile = read_tile(TILE)
    return next(v.photo.parent for v in tile.views if v.camera.width == size[0])


def seen(pose: F64, wide: float = 0.7) -> F64:
    """(50, 3) points, local coordinates, in front of a camera."""
    rng = np.random.default_rng(4)
    depth = rng.uniform(3, 60, 50)
    rays = np.column_stack([rng.uniform(-wide, wide, 50), rng.uniform(-wide * 0.7, wide * 0.7, 50), np.ones(50)])
    return (rays * depth[:, None]) @ pose[:3, :3].T + pose[:3, 3]


def in_camera(points: F64, pose: F64) -> F64:
    return (points - pose[:3, 3]) @ pose[:3, :3]


def agrees(model: Model, lens: Lens, size: tuple[int, int] = (W, H), wide: float = 0.7) -> None:
    """Compare the pose and projected pixels of every photo of the sample street."""
    poses = dict(shots(size))
    assert len(model.shots) == len(poses)
    for shot in model.shots:
        pose = next(pose for name, pose in poses.items() if Path(name).stem == Path(shot.file).stem)
        points = seen(pose, wide)
        uv, valid = project(model.cameras[shot.camera], in_camera(points, shot.pose))
        assert valid.all()
        assert np.abs(uv + 0.5 - lens(in_camera(points, pose))).max() < 1e-3


def brown(
    f: tuple[float, float], c: tuple[float, float], k: tuple[float, ...], p: tuple[float, float], skew: float = 0
) -> Lens:
    """Brown's lens model as in photogrammetry: k of r2, r4, ...; p[0] is the factor of r2 + 2 x2 in x."""

    def lens(xyz: F64) -> F64:
        x, y = (xyz[:, :2] / xyz[:, 2:]).T
        r2 = x * x + y * y
        radial = 1 + sum(value * r2 ** (i + 1) for i, value in enumerate(k))
        u = x * radial + p[0] * (r2 + 2 * x * x) + 2 * p[1] * x * y
        v = y * radial + p[1] * (r2 + 2 * y * y) + 2 * p[0] * x * y
        return np.column_stack([c[0] + f[0] * u + skew * v, c[1] + f[1] * v])

    return lens


def equidistant(f: float, c: tuple[float, float], k: tuple[float, ...]) -> Lens:
    def lens(xyz: F64) -> F64:
        angle = np.arctan2(np.hypot(xyz[:, 0], xyz[:, 1]), xyz[:, 2])
        far = angle * (1 + sum(value * angle ** (2 * i + 2) for i, value in enumerate(k)))
        return np.array(c) + f * far[:, None] * xyz[:, :2] / np.hypot(xyz[:, 0], xyz[:, 1])[:, None]

    return lens


def sphere(width: int, height: int) -> Lens:
    def lens(xyz: F64) -> F64:
        east, down = np.arctan2(xyz[:, 0], xyz[:, 2]), np.arctan2(xyz[:, 1], np.hypot(xyz[:, 0], xyz[:, 2]))
        return np.column_stack([width * (0.5 + east / (2 * np.pi)), height * (0.5 + down / np.pi)])

    return lens


# --- OpenSfM


OPENSFM = {
    "perspective": ({"focal": 0.62, "k1": -0.12, "k2": 0.03}, brown((496, 496), (400, 300), (-0.12, 0.03), (0, 0))),
    "brown": (
        {"focal_x": 0.62, "focal_y": 0.63, "c_x": 0.01, "c_y": -0.02}
        | {"k1": -0.12, "k2": 0.03, "k3": 0.002, "p1": 0.0006, "p2": -0.0004},
        brown((496, 504), (408, 284), (-0.12, 0.03, 0.002), (-0.0004, 0.0006)),  # p1 belongs to y there, as in OpenCV
    ),
    "fisheye": ({"focal": 0.5, "k1": 0.01, "k2": -0.002}, equidistant(400, (400, 300), (0.01, -0.002))),
    "fisheye_opencv": (
        {"focal_x": 0.5, "focal_y": 0.5, "c_x": 0.01, "c_y": 0.0, "k1": 0.01, "k2": -0.002, "k3": 0.001, "k4": 1e-4},
        equidistant(400, (408, 300), (0.01, -0.002, 0.001, 1e-4)),
    ),
    "spherical": ({}, sphere(1024, 512)),
}


def opensfm(path: Path, kind: str, reference: dict[str, float] | None = None, turn: Rotation | None = None) -> Path:
    size = (1024, 512) if kind == "spherical" else (W, H)
    entries = {}
    for name, pose in shots(size):
        R = pose[:3, :3].T  # world to camera
        entries[name] = {"rotation": Rotation.from_matrix(R).as_rotvec().tolist(), "camera": "v2 lens"}
        entries[name]["translation"] = (-R @ pose[:3, 3]).tolist()
    camera = {"projection_type": kind, "width": size[0], "height": size[1], **OPENSFM[kind][0]}
    points = {str(i): {"coordinates": [i, 2 * i, 3], "color": [i, 20, 30]} for i in range(9)}
    part = {"cameras": {"v2 lens": camera}, "shots": entries, "points": points}
    small = {"cameras": {"v2 lens": camera}, "shots": {"other.jpg": entries[name]}, "points": {}}
    path.write_text(json.dumps([small, part | ({"reference_lla": reference} if reference else {})]), encoding="utf-8")
    return path


@pytest.mark.parametrize("kind", OPENSFM)
def test_points_of_opensfm_project_to_their_pixels(tmp_path: Path, kind: str) -> None:
    size = (1024, 512) if kind == "spherical" else (W, H)
    model = read("opensfm", opensfm(tmp_path / "reconstruction.json", kind), images(size))
    agrees(model, OPENSFM[kind][1], size)
    assert model.xyz[3].tolist() == [3, 6, 3] and model.rgb is not None and model.rgb[3].tolist() == [3, 20, 30]
    assert model.T_earth is None and "1 photos of 1 smaller parts" in model.notes[0]


REFERENCE = {"latitude": 52.52, "longitude": 13.4, "altitude": 40.0}


def on_earth(xyz: F64, crs: str = "EPSG:32633") -> F64:
    """East, north, up of the reference to the CRS, by PROJ's topocentric conversion."""
    steps = "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0=52.52 +lon_0=13.4 +h_0=40 "
    steps += "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    x, y, z = xyz.T
    lon, lat, height = Transformer.from_pipeline(steps).transform(x, y, z)
    return np.column_stack([*Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat), height])


@pytest.mark.parametrize("crs", [None, "EPSG:25833", "odm"])
def test_opensfm_model_is_placed_by_its_reference(tmp_path: Path, crs: str | None) -> None:
    """Centres to a centimetre of the exact conversion, angles to a hundredth of a degree, photos to the pixel."""
    path = tmp_path / "opensfm" / "reconstruction.json"
    path.parent.mkdir()
    opensfm(path, "brown", REFERENCE)
    code = {None: "EPSG:32633", "odm": "EPSG:32632"}.get(crs, crs)
    if crs == "odm":
        (tmp_path / "odm_georeferencing").mkdir()
        (tmp_path / "odm_georeferencing" / "coords.txt").write_text("WGS84 UTM 32N\n390000 5800000\n", encoding="utf-8")
    tile = read_tile(import_model("opensfm", tmp_path, images(), tmp_path / "t", crs=None if crs == "odm" else crs))
    assert tile.frame.crs == code
    poses = {Path(name).stem: pose for name, pose in shots()}
    for view in tile.views:
        pose = poses[view.photo.stem]
        assert np.abs(tile.frame.to_crs(view.centre) - on_earth(pose[None, :3, 3], code)).max() < 0.01
        ends = on_earth(np.array([pose[:3, 3], pose[:3, 3] + 10 * pose[:3, 2]]), code)
        ahead = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        assert np.arccos(min(1, ahead @ view.T_world_cam[:3, 2])) < np.radians(0.01)
        assert abs(np.linalg.det(view.T_world_cam[:3, :3]) - 1) < 1e-9
    cloud = clouds.read(tile.clouds[0], tile.frame)
    assert np.abs(tile.frame.to_crs(cloud.xyz)[3] - on_earth(np.array([[3.0, 6.0, 3.0]]), code)).max() < 0.05


@pytest.mark.parametrize("named", ["", "opensfm/reconstruction.json"])
def test_projected_reconstruction_of_odm_is_not_taken_for_a_topocentric_one(tmp_path: Path, named: str) -> None:
    """ODM's reconstruction.json is in the CRS minus an offset; photos are placed by the topocentric file beside it."""
    folder = tmp_path / "opensfm"
    (folder / "undistorted").mkdir(parents=True)
    opensfm(folder / "reconstruction.topocentric.json", "brown", REFERENCE)
    projected = opensfm(folder / "reconstruction.json", "brown", REFERENCE)
    body = json.loads(projected.read_text(encoding="utf-8"))
    for shot in body[1]["shots"].values():
        shot["translation"][0] += 5
    projected.write_text(json.dumps(body), encoding="utf-8")
    (folder / "undistorted" / "reconstruction.json").write_bytes(projected.read_bytes())
    tile = read_tile(import_model("opensfm", tmp_path / named, images(), tmp_path / "t"))
    poses = {Path(name).stem: pose for name, pose in shots()}
    for view in tile.views:
        exact = on_earth(poses[view.photo.stem][None, :3, 3])
        assert np.abs(tile.frame.to_crs(view.centre) - exact).max() < 0.01
    with pytest.raises(InputError, match=r"undistorted photos, in projected coordinates.*topocentric\.json"):
        read("opensfm", folder / "undistorted" / "reconstruction.json", images())


# --- Metashape


def metashape(path: Path, kind: str, values: dict[str, float], transform: str = "", reference: str = "") -> Path:
    size = (1024, 512) if kind == "spherical" else (W, H)
    tags = "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items())
    resolution = f'<resolution width="{size[0]}" height="{size[1]}"/>'
    rows = "".join(
        f'<camera id="{i}" sensor_id="0" component_id="0" label="{Path(name).stem}">'
        f"<transform>{' '.join(map(repr, pose.ravel().tolist()))}</transform></camera>"
        for i, (name, pose) in enumerate(shots(size))
    )
    path.write_text(
        f'<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="c" enabled="true"><sensors>'
        f'<sensor id="0" label="lens" type="{kind}">{resolution}'
        f'<calibration type="{kind}" class="initial"><f>1</f></calibration>'
        f'<calibration type="{kind}" class="adjusted">{resolution}{tags}</calibration></sensor></sensors>'
        f'<cameras><group id="0">{rows}</group><camera id="99" sensor_id="0" label="lost"/>'
        f'<camera id="98" sensor_id="0" label="off" enabled="false"><transform>1</transform></camera></cameras>'
        f"{f'<reference>{reference}</reference>' if reference else ''}{transform}</chunk></document>",
        encoding="utf-8",
    )
    return path


BROWN = {"f": 496.0, "cx": 2.5, "cy": -3.5, "b1": 1.5, "k1": -0.12, "k2": 0.03, "k3": 0.002, "p1": 0.0006, "p2": -4e-4}
METASHAPE: dict[str, tuple[str, dict[str, float], Lens]] = {
    "frame": ("frame", BROWN, brown((497.5, 496), (402.5, 296.5), (-0.12, 0.03, 0.002), (0.0006, -4e-4))),
    "k4": (
        "frame",
        BROWN | {"k3": -0.02, "k4": 0.006},
        brown((497.5, 496), (402.5, 296.5), (-0.12, 0.03, -0.02, 0.006), (0.0006, -4e-4)),
    ),
    "fisheye": (
        "fisheye",
        {"f": 400.0, "cx": 8.0, "cy": 0.0, "k1": 0.01, "k2": -0.002, "k3": 0.001, "k4": 1e-4},
        equidistant(400, (408, 300), (0.01, -0.002, 0.001, 1e-4)),
    ),
    "spherical": ("spherical", {"f": 1024 / (2 * np.pi)}, sphere(1024, 512)),
}


@pytest.mark.parametrize("case", METASHAPE)
def test_points_of_metashape_project_to_their_pixels(tmp_path: Path, case: str) -> None:
    kind, values, lens = METASHAPE[case]
    size = (1024, 512) if kind == "spherical" else (W, H)
    model = read("metashape", metashape(tmp_path / "cameras.xml", kind, values), images(size))
    agrees(model, lens, size)
    assert model.notes == ("1 photos without a pose are left out",)


@pytest.mark.parametrize(
    ("kind", "values", "cause"),
    [
        ("frame", BROWN | {"b2": 3.0}, r"b2 \(up to 1\.8\d pixels\)"),
        ("fisheye", {"f": 400.0, "p1": 0.001}, "p1, p2 of a fisheye"),
        ("cylindrical", BROWN, "type 'cylindrical'"),
        ("frame", {"f": -1.0}, "its focal length"),
    ],
)
def test_unsupported_metashape_lens_is_rejected(
    tmp_path: Path, kind: str, values: dict[str, float], cause: str
) -> None:
    with pytest.raises(InputError, match=cause):
        read("metashape", metashape(tmp_path / "cameras.xml", kind, values), images())


def similarity(scale: float, R: F64, t: F64) -> str:
    rows = [" ".join(map(repr, np.ravel(value).tolist())) for value in (R, t, scale)]
    parts = zip(("rotation", "translation", "scale"), rows, strict=True)
    return f"<transform>{''.join(f'<{tag}>{row}</{tag}>' for tag, row in parts)}</transform>"


def test_largest_metashape_component_is_imported(tmp_path: Path) -> None:
    moved = similarity(3.0, np.eye(3), np.array([1.0, 2, 3]))
    parts = f'<components><component id="0">{moved}</component><component id="1"/></components>'
    path = metashape(tmp_path / "cameras.xml", "frame", BROWN, f"{parts}{similarity(9.0, np.eye(3), np.zeros(3))}")
    text = path.read_text(encoding="utf-8")
    first = text.index('component_id="0"')
    path.write_text(text[:first] + 'component_id="1"' + text[first + len('component_id="0"') :], encoding="utf-8")
    model = read("metashape", path, images())
    assert len(model.shots) == len(shots()) - 1 and "1 photos of 1 smaller components" in model.notes[0]
    assert np.allclose(model.centres, [3 * pose[:3, 3] + [1, 2, 3] for _, pose in shots()[1:]])


def test_cloud_without_a_crs_is_placed_near_the_photos(tmp_path: Path) -> None:
    """With a georeferenced model, it is in model coordinates or in the CRS; the note reports which."""
    path = opensfm(tmp_path / "reconstruction.json", "brown", REFERENCE)
    near = np.array([pose[:3, 3] for _, pose in shots()]) + [1.0, 2.0, 0.0]
    for name, points, where in (("model", near, "model coordinates"), ("crs", on_earth(near), "the CRS already")):
        np.savetxt(tmp_path / f"{name}.xyz", points, "%.4f")
        warned: list[str] = []
        cloud = tmp_path / f"{name}.xyz"
        tile = read_tile(
            import_model("opensfm", path, images(), tmp_path / f"t_{name}", cloud=cloud, warn=warned.append)
        )
        read_back = clouds.read(tile.clouds[0], tile.frame)
        assert np.abs(tile.frame.to_crs(read_back.xyz) - on_earth(near)).max() < 0.02
        assert any(where in line for line in warned) and not any(
            "units away from the photos" in line for line in warned
        )
    np.savetxt(tmp_path / "far.xyz", near + [90_000.0, 0, 0], "%.4f")
    warned = []
    import_model("opensfm", path, images(), tmp_path / "t", cloud=tmp_path / "far.xyz", warn=warned.append)
    assert any("units away from the photos: check that both are in the same coordinates" in line for line in warned)


def test_metashape_chunks_are_placed_by_their_transform(tmp_path: Path) -> None:
    """Geocentric where the reference is a CRS of the Earth, local coordinates where it is local."""
    turn = Rotation.from_rotvec([0.4, -0.2, 1.1]).as_matrix()
    path = metashape(
        tmp_path / "local.xml", "frame", BROWN, similarity(2.0, turn, np.array([5.0, 6, 7])), 'LOCAL_CS["l"]'
    )
    cloud = tmp_path / "cloud.laz"
    las.write(cloud, PointCloud(Frame(), np.ones((9, 3), np.float32)))
    tile = read_tile(import_model("metashape", path, images(), tmp_path / "a", cloud=cloud))
    poses = {Path(name).stem: pose for name, pose in shots()}
    for view in tile.views:
        pose = poses[view.photo.stem]
        assert np.allclose(tile.frame.to_crs(view.centre), 2 * turn @ pose[:3, 3] + [5, 6, 7], atol=1e-6)
        assert np.allclose(view.T_world_cam[:3, :3], turn @ pose[:3, :3], atol=1e-9)

    # the chunk's axes are those of the reference's place, half as large
    there = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    origin = np.array(there.transform(13.4, 52.52, 40.0))
    a, b = np.radians([52.52, 13.4])
    R = np.array(
        [[-np.sin(b), np.cos(b), 0], [-np.sin(a) * np.cos(b), -np.sin(a) * np.sin(b), np.cos(a)]]
        + [[np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)]]
    ).T
    placed = tmp_path / "utm.laz"
    las.write(placed, PointCloud(Frame("EPSG:32632", (7.9e5, 5.82e6, 40.0)), np.ones((9, 3), np.float32)))
    utm_32, utm_33 = "EPSG:32632", "EPSG:32633"
    for reference, code, with_ in (
        ("EPSG:4326", utm_33, cloud),
        (utm_32, utm_32, cloud),
        ("EPSG:4326", utm_32, placed),
    ):
        path = metashape(tmp_path / "earth.xml", "frame", BROWN, similarity(0.5, R, origin), reference)
        tile = read_tile(import_model("metashape", path, images(), tmp_path / "b", cloud=with_, overwrite=True))
        assert tile.frame.crs == code
        for view in tile.views:
            exact = on_earth(0.5 * poses[view.photo.stem][None, :3, 3], code)
            assert np.abs(tile.frame.to_crs(view.centre) - exact).max() < 0.01
    with pytest.raises(SettingError, match="is already georeferenced"):
        import_model("metashape", path, images(), tmp_path / "c", cloud=cloud, gps=True)


@pytest.mark.parametrize("bound", [False, True])
def test_a_metashape_chunk_in_a_national_crs_is_geocentric_in_its_own_datum(tmp_path: Path, bound: bool) -> None:
    """DHDN (Bessel's ellipsoid): read as WGS 84, heights would be 700 m off."""
    cart = "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=bessel"
    origin = np.array(Transformer.from_pipeline(cart).transform(9.0, 50.0, 200.0))
    a, b = np.radians([50.0, 9.0])
    R = np.array(
        [[-np.sin(b), np.cos(b), 0], [-np.sin(a) * np.cos(b), -np.sin(a) * np.sin(b), np.cos(a)]]
        + [[np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)]]
    ).T
    reference = CRS("EPSG:31467").to_wkt("WKT1_GDAL")
    if bound:
        shift = "TOWGS84[598.1,73.7,418.2,0.202,0.045,-2.455,6.7],"
        at = reference.index('AUTHORITY["EPSG","6314"]')
        reference = reference[:at] + shift + reference[at:]
    path = metashape(tmp_path / "c.xml", "frame", BROWN, similarity(1.0, R, origin), reference)
    cloud = tmp_path / "cloud.laz"
    las.write(cloud, PointCloud(Frame(), np.ones((9, 3), np.float32)))
    warned: list[str] = []
    tile = read_tile(import_model("metashape", path, images(), tmp_path / "t", cloud=cloud, warn=warned.append))
    back = f"+proj=pipeline +step +inv {cart.partition('+step ')[2].partition('+step ')[2]}"
    back += " +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    poses = {Path(name).stem: pose for name, pose in shots()}
    for view in tile.views:
        lon, lat, height = Transformer.from_pipeline(back).transform(*(R @ poses[view.photo.stem][:3, 3] + origin))
        east, north = Transformer.from_crs("EPSG:4314", "EPSG:31467", always_xy=True).transform(lon, lat)
        assert np.abs(tile.frame.to_crs(view.centre) - [east, north, height]).max() < 0.01
    assert not any("ellipsoid" in line for line in warned)


# --- Bundler, VisualSFM


def bundler(folder: Path, f: float, k1: float, k2: float) -> Path:
    flip = np.diag([1.0, -1.0, -1.0])
    rows = ["# Bundle file v0.3", f"{len(shots()) + 1} 2", "0 0 0", "0 0 0", "0 0 0", "0 0 0", "0 0 0"]
    for _, pose in shots():
        R = flip @ pose[:3, :3].T
        rows.append(f"{f} {k1} {k2}")
        rows += [" ".join(map(repr, row)) for row in R.tolist()]
        rows.append(" ".join(map(repr, (-R @ pose[:3, 3]).tolist())))
    rows += ["1.5 2.5 3.5", "255 0 9", "2 0 5 1.0 2.0 1 7 3.0 4.0", "4 5 6", "1 2 3", "0"]
    folder.mkdir(parents=True)
    (folder / "bundle.out").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (folder / "list.txt").write_text(
        "\n".join(["lost.jpg", *(f"./{name} 0 {f}" for name, _ in shots())]) + "\n", encoding="utf-8"
    )
    return folder / "bundle.out"


def test_points_of_bundler_project_to_their_pixels(tmp_path: Path) -> None:
    model = read("bundler", bundler(tmp_path / "bundle", 500.0, -0.11, 0.02), images())
    agrees(model, brown((500, 500), (400, 300), (-0.11, 0.02), (0, 0)))
    assert model.xyz.tolist() == [[1.5, 2.5, 3.5], [4, 5, 6]] and model.notes == (
        "1 photos without a pose are left out",
    )


@pytest.mark.parametrize("name", ["bundle.list.txt", "bundle.out.list.txt", "imagelist.lst"])
def test_list_of_bundler_has_the_name_of_any_program(tmp_path: Path, name: str) -> None:
    path = bundler(tmp_path / "bundle", 500.0, -0.11, 0.02)
    (path.parent / "list.txt").rename(path.parent / name)
    assert len(read("bundler", path, images()).shots) == len(shots())


def test_names_of_bundler_may_contain_blanks(tmp_path: Path) -> None:
    path = bundler(tmp_path / "bundle", 500.0, -0.11, 0.02)
    listed = (path.parent / "list.txt").read_text(encoding="utf-8")
    (path.parent / "list.txt").write_text(listed.replace("./", "C:/my photos 2/"), encoding="utf-8")
    assert len(read("bundler", path, images()).shots) == len(shots())


def nvm(path: Path, f: float, r: float, fixed: str = "") -> Path:
    rows = [f"NVM_V3{fixed}", "", str(len(shots()))]
    for name, pose in shots():
        x, y, z, w = Rotation.from_matrix(pose[:3, :3].T).as_quat().tolist()
        rows.append(f"{name}\t{f} {w!r} {x!r} {y!r} {z!r} {' '.join(map(repr, pose[:3, 3].tolist()))} {r} 0")
    rows += ["", "1", "1.5 2.5 3.5 255 0 9 2 0 5 1.0 2.0 1 7 3.0 4.0", "", "0"]
    path.write_text("\n".join(rows), encoding="utf-8")
    return path


@pytest.mark.parametrize("r", [0.0, 0.08, -0.15])
def test_points_of_visualsfm_project_to_their_pixels(tmp_path: Path, r: float) -> None:
    model = read("nvm", nvm(tmp_path / "m.nvm", 500.0, r), images())

    def lens(xyz: F64) -> F64:
        straight = xyz[:, :2] / xyz[:, 2:]
        measured = straight.copy()
        for _ in range(200):  # measured (1 + r measured2) = straight
            measured = straight / (1 + r * (measured**2).sum(axis=1, keepdims=True))
        return [400, 300] + 500 * measured

    agrees(model, lens)
    assert model.xyz.tolist() == [[1.5, 2.5, 3.5]] and model.rgb is not None and model.rgb.tolist() == [[255, 0, 9]]
    with pytest.raises(InputError, match="with an error of"):
        read("nvm", nvm(tmp_path / "m.nvm", 500.0, -3.0), images())


# --- all of them


def nerfstudio(path: Path) -> Path:
    frames = []
    for name, pose in shots():
        matrix = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
    values = {"fl_x": 496.0, "cx": 408.0, "cy": 284.0, "k1": -0.12, "w": W, "h": H, "frames": frames}
    path.write_text(json.dumps(values), encoding="utf-8")
    return path


WRITERS: dict[str, Callable[[Path], Path]] = {
    "opensfm": lambda folder: opensfm(folder / "reconstruction.json", "brown"),
    "metashape": lambda folder: metashape(folder / "cameras.xml", "frame", BROWN),
    "bundler": lambda folder: bundler(folder / "bundle", 500.0, -0.11, 0.02),
    "nvm": lambda folder: nvm(folder / "m.nvm", 500.0, 0.05),
    "nerfstudio": lambda folder: nerfstudio(folder / "transforms.json"),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_command_creates_a_tile(tmp_path: Path, kind: str) -> None:
    model = WRITERS[kind](tmp_path)
    cloud = tmp_path / "dense.xyz"
    np.savetxt(cloud, np.random.default_rng(0).uniform(0, 9, (50, 3)), "%.3f")
    options = [
        "import",
        kind,
        str(model),
        str(images()),
        "-o",
        str(tmp_path / "t"),
        "--cloud",
        str(cloud),
        "--scale",
        "2",
    ]
    done = CliRunner().invoke(app, options)
    assert done.exit_code == 0, done.output
    tile = read_tile(tmp_path / "t")
    poses = {Path(name).stem: pose for name, pose in shots()}
    assert len(tile.views) == len(poses)
    for view in tile.views:
        assert np.allclose(tile.frame.to_crs(view.centre), 2 * poses[view.photo.stem][:3, 3], atol=1e-6)


def test_infinite_and_huge_numbers_of_opensfm_are_rejected(tmp_path: Path) -> None:
    path = WRITERS["opensfm"](tmp_path)
    for number in ("Infinity", "1" + 400 * "0"):
        path.write_text(
            re.sub(r'"width": [^,]+', f'"width": {number}', path.read_text(encoding="utf-8")), encoding="utf-8"
        )
        with pytest.raises(InputError, match="has missing or invalid values"):
            read("opensfm", path, images())


@pytest.mark.parametrize("kind", WRITERS)
def test_damaged_file_is_rejected_without_a_partial_model(tmp_path: Path, kind: str) -> None:
    """Truncated, or with changed bytes: an error message, or a complete model."""
    path = WRITERS[kind](tmp_path)
    whole, random = path.read_bytes(), np.random.default_rng(1)
    damaged = [whole[: int(len(whole) * share)] for share in (0.0, 0.01, 0.3, 0.7, 0.95)]
    for _ in range(60):
        bytes_ = bytearray(whole)
        for at in random.integers(0, len(whole), 3):
            bytes_[at] = random.integers(0, 256)
        damaged.append(bytes(bytes_))
    refused = 0
    for body in damaged:
        path.write_bytes(body)
        try:
            model = read(kind, path, images())
        except InputError as error:
            refused += bool(error.remedy)
        else:
            assert all(np.isfinite(shot.pose).all() for shot in model.shots)
    assert refused >= 5


def test_every_program_has_a_help_page() -> None:
    for kind in plugins.names(photogrammetry.__name__):
        assert CliRunner().invoke(app, ["import", kind, "--help"]).exit_code == 0


def test_missing_photo_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.jpg: file not found"):
        import_model("opensfm", opensfm(tmp_path / "reconstruction.json", "brown"), tmp_path, tmp_path / "t")
    assert not (tmp_path / "t").exists()

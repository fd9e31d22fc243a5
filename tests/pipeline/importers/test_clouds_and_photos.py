"""Import of clouds with a CSV table of photos."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import Frame, PointCloud
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile

CAMERA = "model,width,height,fx,cx,cy,k1"
VALUES = "opencv,64,48,50,31,23,-0.1"


def cloud(path: Path, crs: str = "EPSG:32632", at: float = 500_000.0) -> Path:
    frame = Frame(crs, (at, 5_400_000.0, 100.0))
    xyz = np.random.default_rng(0).uniform(0, 20, (50, 3)).astype(np.float32)
    las.write(path, PointCloud(frame, xyz, classification=np.full(50, 2, np.uint8)))
    return path


def photos(folder: Path, heading: str, *rows: str) -> Path:
    for row in rows:
        file = folder / row.split(",")[0]
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), np.zeros((48, 64, 3), np.uint8))
    path = folder / "photos.csv"
    path.write_text("\n".join([heading, *rows]) + "\n", encoding="utf-8")
    return path


def test_clouds_of_one_crs_become_one_tile(tmp_path: Path) -> None:
    files = [cloud(tmp_path / "a.laz"), cloud(tmp_path / "b.las", at=500_050.0)]
    tile = read_tile(import_las(files, tmp_path / "tile", name="two clouds"))
    assert (tile.name, tile.frame.crs, len(tile.views)) == ("two_clouds", "EPSG:32632", 0)
    assert [path.name for path in tile.clouds] == ["a.laz", "b.las"]
    assert all(path.parent == tmp_path / "tile" and not path.is_symlink() for path in tile.clouds)


def test_tile_with_photos_has_the_name_of_its_folder(tmp_path: Path) -> None:
    pose = "500010,5400005,102,1,0,0,0"
    sheet = photos(tmp_path, f"file,x,y,z,qw,qx,qy,qz,{CAMERA}", f"{'deep/' * 20}1.png,{pose},{VALUES}")
    for folder, name in (("main street", "main_street"), ("long" * 40, "long" * 25)):
        tile = read_tile(import_las([cloud(tmp_path / "c.laz")], tmp_path / folder, photos=sheet))
        assert (tile.name, len(tile.views)) == (name, 1)


def test_three_rotation_conventions_agree(tmp_path: Path) -> None:
    """A camera that looks north: x east, y down, z north; omega = 90 degrees tilts it from nadir to the horizon."""
    where = "x,y,z"
    forms = {
        "r11,r12,r13,r21,r22,r23,r31,r32,r33": "1,0,0,0,0,1,0,-1,0",
        "qw,qx,qy,qz": f"{np.sqrt(0.5)},{-np.sqrt(0.5)},0,0",
        "omega,phi,kappa": "90,0,0",
    }
    for i, (heading, values) in enumerate(forms.items()):
        folder = tmp_path / str(i)
        sheet = photos(
            folder, f"file,{where},{heading},{CAMERA},time", f"p/1.png,500010,5400005,102,{values},{VALUES},7.5"
        )
        tile = read_tile(import_las([cloud(folder / "c.laz")], folder / "tile", photos=sheet))
        view = tile.views[0]
        assert np.allclose(view.T_world_cam[:3, :3], [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-9), heading
        assert np.allclose(tile.frame.to_crs(view.centre), [500010, 5400005, 102])
        assert view.time == 7.5 and view.photo.is_file()
        assert (view.camera.fy, view.camera.distortion) == (50.0, (-0.1, 0.0, 0.0, 0.0))


def test_photo_with_zero_angles_looks_down_with_north_up(tmp_path: Path) -> None:
    sheet = photos(tmp_path, f"file,x,y,z,omega,phi,kappa,{CAMERA}", f"1.png,500010,5400005,150,0,0,0,{VALUES}")
    tile = read_tile(import_las([cloud(tmp_path / "c.laz")], tmp_path / "tile", photos=sheet))
    assert np.allclose(tile.views[0].T_world_cam[:3, :3] @ [0, 0, 1], [0, 0, -1])  # it looks down
    assert np.allclose(tile.views[0].T_world_cam[:3, :3] @ [0, -1, 0], [0, 1, 0])  # image up is north


def test_cameras_are_read_from_a_separate_file_and_masks_are_imported(tmp_path: Path) -> None:
    sheet = photos(
        tmp_path,
        "file,x,y,z,qw,qx,qy,qz,camera,mask",
        "a/1.png,500010,5400005,102,1,0,0,0,left,a/1.png",
        "b/1.png,500011,5400005,102,1,0,0,0,ball,",
    )
    cameras = tmp_path / "cameras.csv"
    cameras.write_text(f"camera,{CAMERA}\nleft,{VALUES}\nball,equirectangular,64,32,,,,\n", encoding="utf-8")
    tile = read_tile(
        import_las([cloud(tmp_path / "c.laz")], tmp_path / "tile", photos=sheet, cameras=cameras, link=True)
    )
    assert [view.camera.model for view in tile.views] == ["opencv", "equirectangular"]
    assert tile.views[0].mask == tmp_path / "tile" / "masks" / "a" / "1.png" and tile.views[1].mask is None
    assert tile.views[0].photo.is_symlink() and tile.clouds[0].is_symlink()


def test_cloud_without_crs_needs_the_crs_option(tmp_path: Path) -> None:
    bare = cloud(tmp_path / "bare.las", crs="local")
    with pytest.raises(InputError, match=r"bare\.las: has no CRS.*--crs EPSG:32633.*--crs local"):
        import_las([bare], tmp_path / "tile")
    assert not (tmp_path / "tile").exists()
    assert read_tile(import_las([bare], tmp_path / "tile", crs="local")).frame.crs == "local"
    assert read_tile(import_las([bare], tmp_path / "tile2", crs="EPSG:32632")).frame.crs == "EPSG:32632"


ROW = "1.png,500010,5400005,102,1,0,0,0"


@pytest.mark.parametrize(
    ("heading", "row", "message"),
    [
        (f"file,x,y,qw,qx,qy,qz,{CAMERA}", f"1.png,1,2,1,0,0,0,{VALUES}", r"no column `z`.*Add it to the header line"),
        (f"file,x,y,z,roll,{CAMERA}", f"1.png,1,2,3,0,{VALUES}", r"row 2: no rotation.*omega,phi,kappa"),
        (f"file,x,y,z,{CAMERA}", f"1.png,1,2,3,{VALUES}", r"row 2: no rotation.*omega,phi,kappa"),
        (f"file,x,y,z,qw,qx,qy,qz,{CAMERA}", f"1.png,1,2,up,1,0,0,0,{VALUES}", r"row 2: `z` is 'up'.*Fix that cell"),
        (f"file,x,y,z,qw,qx,qy,qz,{CAMERA}", f"1.png,1,2,3,2,0,0,0,{VALUES}", r"quaternion is not normalized"),
        (f"file,x,y,z,omega,phi,kappa,{CAMERA}", f"1.png,1,2,3,nan,0,0,{VALUES}", r"NaN or infinity.*Fix the pose"),
        ("file,x,y,z,qw,qx,qy,qz,model,width,height", f"{ROW},fish,64,48", r"unknown model `fish`.*Use pinhole"),
        ("file,x,y,z,qw,qx,qy,qz,width,height,fx,k1", f"{ROW},64,48,50,0.1", r"pinhole camera has no `k1`"),
        ("file,x,y,z,qw,qx,qy,qz,width,height", f"{ROW},64,48", r"row 2: `fx` is ''.*Fix that cell"),
    ],
)
def test_errors_in_the_csv_are_reported_with_row_and_remedy(
    tmp_path: Path, heading: str, row: str, message: str
) -> None:
    sheet = photos(tmp_path, heading, row)
    with pytest.raises(InputError, match=rf"photos\.csv: .*{message}"):
        import_las([cloud(tmp_path / "c.laz")], tmp_path / "tile", photos=sheet)
    assert not (tmp_path / "tile").exists() and not list(tmp_path.glob(".tile*"))


def test_missing_photo_is_reported_and_existing_tile_kept_without_overwrite(tmp_path: Path) -> None:
    file = cloud(tmp_path / "c.laz")
    first = import_las([file], tmp_path / "tile", name="first")
    sheet = photos(tmp_path, f"file,x,y,z,qw,qx,qy,qz,{CAMERA}", f"{ROW},{VALUES}")
    (tmp_path / "1.png").unlink()
    with pytest.raises(InputError, match=r"1\.png: file not found"):
        import_las([file], tmp_path / "tile", photos=sheet, overwrite=True)
    assert read_tile(first).name == "first"
    with pytest.raises(SettingError, match="exists and is not empty"):
        import_las([file], tmp_path / "tile", name="second")
    import_las([file], tmp_path / "tile", name="second", overwrite=True)
    assert read_tile(first).name == "second"


def test_files_of_equal_name_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    with pytest.raises(InputError, match=r"other/c\.laz: is the second file with the name c\.laz.*Rename"):
        import_las([cloud(tmp_path / "c.laz"), cloud(tmp_path / "other" / "c.laz")], tmp_path / "tile")


def test_real_tiles_of_one_survey_are_joined(real_data: Path, tmp_path: Path) -> None:
    files = sorted((real_data / "las").glob("ign_77*.laz"))
    tile = read_tile(import_las(files, tmp_path / "tile"))
    assert tile.frame.crs == "EPSG:2154" and len(tile.clouds) == 4
    parts = [clouds.read(path, tile.frame) for path in tile.clouds]
    assert sum(map(len, parts)) == 273_982
    low, high = (f([f(part.xyz, axis=0) for part in parts], axis=0) for f in (np.min, np.max))
    assert np.abs(high[:2] - low[:2] - 100).max() < 0.1

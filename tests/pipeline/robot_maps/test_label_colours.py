"""Maps coloured by semantic labels: recognized, and converted to classes even where voxels average colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F32, U8, Frame
from scan2sim.pipeline.geometry.voxel_grid import voxel_groups
from scan2sim.pipeline.importers.robot_map import MapParams, import_map
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.robot_maps.label_colours import (
    SEMANTIC_KITTI,
    are_labels,
    classes_of_colours,
    matching_legend,
    parse_legend,
    read_legend,
)
from tests.present import present

ROAD, BUILDING, TREE, CAR = (255, 0, 255), (255, 200, 0), (0, 175, 0), (100, 150, 245)


def town(voxel: float = 0.4) -> tuple[F32, U8, U8]:
    """Points, mean colours of voxels, and true classes of a road between two facades, with trees and a car."""
    rng = np.random.default_rng(0)
    low = np.array([[0, 0, 0], [0, 8, 0], [0, -0.1, 0], [10, 4, 2], [20, 3, 0]])
    size = np.array([[40, 8, 0.05], [40, 0.1, 6], [40, 0.1, 6], [3, 3, 3], [4, 2, 1.4]])
    colours = np.array([ROAD, BUILDING, BUILDING, TREE, CAR], np.float64)
    kind = np.repeat(np.arange(5), [40_000, 25_000, 25_000, 4000, 3000])
    xyz = (low[kind] + rng.random((len(kind), 3)) * size[kind]).astype(np.float32)
    order, starts = voxel_groups(xyz, voxel)
    count = np.diff(np.append(starts, len(order)))[:, None]
    mean = np.add.reduceat(xyz[order].astype(np.float64), starts) / count
    rgb = np.add.reduceat(colours[kind][order], starts) / count
    codes = np.array([CODE[name] for name in ("road", "building", "building", "high_vegetation", "vehicle")], np.uint8)
    truth = codes[kind][order][starts]
    return mean.astype(np.float32), np.rint(rgb).astype(np.uint8), truth


@pytest.mark.parametrize("bgr", [False, True])
def test_semantic_kitti_colours_in_either_channel_order(bgr: bool) -> None:
    xyz, rgb, truth = town()
    rgb = rgb[:, ::-1] if bgr else rgb
    assert are_labels(rgb) and matching_legend(rgb) == "semantickitti"
    code, share = classes_of_colours(xyz, rgb, SEMANTIC_KITTI)
    assert share > 0.7
    assert np.mean(code == truth) > 0.97  # voxels with two classes have either


def test_photos_height_ramps_and_grey_levels_are_not_labels() -> None:
    rng = np.random.default_rng(0)
    photo = rng.normal((110, 100, 90), 25, (5000, 3)).clip(0, 255).astype(np.uint8)
    grey = np.repeat(rng.choice([20, 90, 200, 255], 5000)[:, None], 3, axis=1).astype(np.uint8)
    rainbow = np.stack([np.linspace(0, 255, 5000), np.linspace(255, 0, 5000), np.full(5000, 80)], axis=1).astype(
        np.uint8
    )
    assert not any(map(are_labels, (photo, grey, rainbow, np.full((5000, 3), 7, np.uint8))))


def test_import_warns_of_labels_and_uses_them(tmp_path: Path) -> None:
    xyz, rgb, truth = town()
    source = tmp_path / "map.ply"
    write_ply(source, xyz, rgb)
    warnings: list[str] = []
    import_map([source], tmp_path / "plain", MapParams(), warn=warnings.append)
    assert any("--classes-from-colours semantickitti" in text for text in warnings)
    params = MapParams(classes_from_colours="semantickitti")
    tile = read_tile(import_map([source], tmp_path / "classes", params))
    cloud = clouds.read(tile.clouds[0], Frame())
    assert cloud.rgb is None or not cloud.coloured.any()
    found = present(cloud.classification)
    assert abs(np.mean(found == CODE["road"]) - np.mean(truth == CODE["road"])) < 0.03


def write_ply(path: Path, xyz: F32, rgb: U8) -> None:
    rows = np.empty(len(xyz), [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")])
    for k in range(3):
        rows["xyz"[k]], rows[("red", "green", "blue")[k]] = xyz[:, k], rgb[:, k]
    colours = ("red", "green", "blue")
    fields = [f"property float {name}\n" for name in "xyz"] + [f"property uchar {name}\n" for name in colours]
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n{''.join(fields)}end_header\n"
    path.write_bytes(header.encode() + rows.tobytes())


def test_legend_is_read_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "legend.txt"
    file.write_text("# colours of my network\n255,0,0 = road\n0, 255, 0 = vegetation  # trees\n", encoding="utf-8")
    assert parse_legend(read_legend(str(file))) == {(255, 0, 0): CODE["road"], (0, 255, 0): CODE["high_vegetation"]}


@pytest.mark.parametrize("text", ["255,0=road", "300,0,0=road", "1,2,3=unicorn", ""])
def test_invalid_legend_is_rejected(tmp_path: Path, text: str) -> None:
    file = tmp_path / "legend.txt"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(SettingError, match="classes-from-colours"):
        read_legend(str(file))


def test_unknown_legend_lists_available_ones() -> None:
    with pytest.raises(SettingError, match="semantickitti"):
        read_legend("nuscenes")

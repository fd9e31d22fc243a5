"""Multi-camera systems of Metashape: slave cameras are placed by their master and the offset of their sensor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.photogrammetry import Photos
from scan2sim.pipeline.io.photogrammetry.metashape import read

CALIBRATION = '<resolution width="800" height="600"/><f>500</f>'


def transform(seed: int) -> F64:
    random = np.random.default_rng(seed)
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.random(random_state=seed).as_matrix(), random.normal(0, 5, 3)
    return out


def numbers(values: F64) -> str:
    return " ".join(map(repr, np.ravel(values).tolist()))


def project(path: Path, *, component: str = 'component_id="0"', offset: bool = True) -> Path:
    """A cameras.xml of two positions of a rig of three cameras; sensor 0 is the master."""
    sensors, cameras = "", ""
    for key in range(3):
        T = transform(100 + key)
        placed = f"<rotation>{numbers(T[:3, :3])}</rotation><translation>{numbers(T[:3, 3])}</translation>"
        master = ' master_id="0"' if key else ""
        sensors += (
            f'<sensor id="{key}" type="frame"{master}><resolution width="800" height="600"/>'
            f'<calibration type="frame" class="adjusted">{CALIBRATION}</calibration>{placed if key and offset else ""}'
            "</sensor>"
        )
    for position in range(2):
        first = 3 * position
        cameras += (
            f'<camera id="{first}" sensor_id="0" component_id="0" label="{position}_0">'
            f"<transform>{numbers(transform(position))}</transform></camera>"
        )
        for key in (1, 2):
            cameras += (
                f'<camera id="{first + key}" sensor_id="{key}" {component} master_id="{first}" '
                f'label="{position}_{key}"/>'
            )
    path.write_text(
        f"<document><chunk><sensors>{sensors}</sensors>"
        f'<cameras><group id="0">{cameras}</group></cameras></chunk></document>',
        encoding="utf-8",
    )
    return path


@pytest.mark.parametrize("component", ['component_id="0"', ""])
def test_photos_of_slaves_are_placed(tmp_path: Path, component: str) -> None:
    found = read(project(tmp_path / "cameras.xml", component=component), Photos(tmp_path))
    assert len(found.shots) == 6 and set(found.cameras) == {"sensor_0", "sensor_1", "sensor_2"}
    assert found.notes == ("4 photos of multi-camera systems are placed by their master's pose and sensor's offset",)
    for shot in found.shots:
        position, key = map(int, shot.file.split("_"))
        expected = transform(position) @ (transform(100 + key) if key else np.eye(4))
        assert np.allclose(shot.pose, expected) and shot.camera == f"sensor_{key}"


def test_slaves_without_an_offset_are_left_out_with_a_note(tmp_path: Path) -> None:
    found = read(project(tmp_path / "cameras.xml", offset=False), Photos(tmp_path))
    assert len(found.shots) == 2 and found.notes == ("4 photos without a pose are left out",)

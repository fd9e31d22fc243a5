"""Splats in scripts of web pages: nothing visible is lost in 32 bytes."""

from __future__ import annotations

import base64
import io
import json

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.splats import MAX_COLOUR, RGB, SplatLayer
from scan2sim.pipeline.io.worlds.packed_splats import RECORD, pack, script_arguments
from tests.fakes import splat_scenes


def test_records_are_the_splats() -> None:
    splats = splat_scenes.layer().splats
    packed = pack(splats)
    assert len(packed) == 32 * len(splats)
    read = np.frombuffer(packed, RECORD)
    assert np.array_equal(read["xyz"], splats.xyz)
    np.testing.assert_allclose(read["scale"], splats.scale, rtol=1e-3)
    np.testing.assert_allclose(read["opacity"] / 65535, splats.opacity, atol=1e-5)
    rgb = [(read["rgb"] >> shift & 1023) * MAX_COLOUR / 1023 for shift in (0, 10, 20)]
    np.testing.assert_allclose(np.stack(rgb, axis=-1), splats.rgb, atol=0.501 * MAX_COLOUR / 1023)
    axes = [Rotation.from_quat(q[:, [1, 2, 3, 0]]) for q in (read["quaternion"] / 32767, splats.quaternion)]
    assert (axes[0] * axes[1].inv()).magnitude().max() < 1e-3


def test_what_a_record_cannot_hold_is_clipped() -> None:
    splats = splat_scenes.layer(count=2).splats
    splats.parameters[:, 3:6] = np.log([1e-7, 1.0, 1e6])
    splats.parameters[:, RGB] = -0.1, 0.5, MAX_COLOUR + 0.7
    read = np.frombuffer(pack(splats), RECORD)
    assert (read["scale"] > 0).all() and np.isfinite(read["scale"]).all()
    assert (read["rgb"] & 1023 == 0).all() and (read["rgb"] >> 20 == 1023).all()


def test_script_has_records_and_background() -> None:
    layer = splat_scenes.layer(count=20)
    packed, jpeg, max_colour, scale = json.loads(f"[{script_arguments(layer)}]")
    assert base64.b64decode(packed) == pack(layer.splats) and max_colour == MAX_COLOUR
    image = np.asarray(Image.open(io.BytesIO(base64.b64decode(jpeg)))) * (scale / 255)
    assert image.shape == layer.background.shape and layer.background.max() > 1.2
    assert np.abs(image - layer.background).mean() < 0.01 and np.abs(image - layer.background).max() < 0.1


def test_a_background_darker_than_white_keeps_its_levels() -> None:
    scale = json.loads(f"[{script_arguments(SplatLayer.nothing())}]")[-1]
    assert scale == 1


def test_an_empty_layer_has_no_records() -> None:
    assert script_arguments(SplatLayer.nothing()).startswith('"", "')

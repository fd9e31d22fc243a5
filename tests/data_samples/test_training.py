"""Synthetic training data: labelled photos of all classes, with matching lidar channels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.data_samples.layout import lay_out
from scan2sim.data_samples.scene import Scene
from scan2sim.data_samples.training import street
from scan2sim.data_samples.variety import varied
from scan2sim.pipeline.core.classes import CODE
from scan2sim.segmentation.labels import CLASSES
from scan2sim.segmentation.lidar_channels import DOWNSAMPLING
from scan2sim.segmentation.training.dataset import pairs, read_channels


@pytest.fixture(scope="module")
def training_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("set")
    for folder in ("images", "labels", "channels"):
        (out / folder).mkdir()
    street(out, 1004, 2)
    return out


def test_training_streets_contain_all_classes_and_differ_by_seed() -> None:
    labels = []
    for seed in (3, 4):
        layout = lay_out(30.0, seed)
        varied_layout = varied(layout, 30.0)
        assert not layout.extras and not layout.walks
        scene = Scene(varied_layout)
        labels.append(np.bincount(scene.surface.classification, minlength=256))
        world = scene.truth_mesh().classification
        assert world is not None and CODE["person"] not in world, "worlds contain no people"
    found = {name for name in CLASSES if name != "sky" and np.sum(labels, axis=0)[CODE[name]] > 0}
    assert found == set(CLASSES) - {"sky"}
    assert (labels[0] != labels[1]).any()


def test_objects_of_a_street_are_reproducible() -> None:
    layout = varied(lay_out(20.0, 5), 20.0)
    again = varied(lay_out(20.0, 5), 20.0)
    for a, b in zip(layout.extras, again.extras, strict=True):
        assert replace(a, make=b.make) == b
        np.testing.assert_array_equal(a.make().vertices, a.make().vertices)
        np.testing.assert_array_equal(a.make().seed, b.make().seed)


def test_lidar_channels_agree_with_the_labels(training_set: Path) -> None:
    for image, truth in pairs(training_set):
        codes = cv2.imread(str(truth), cv2.IMREAD_GRAYSCALE)
        channels = read_channels(image, codes.shape)
        assert channels.shape == (codes.shape[0] // DOWNSAMPLING, codes.shape[1] // DOWNSAMPLING, 4)
        coarse = codes[DOWNSAMPLING // 2 :: DOWNSAMPLING, DOWNSAMPLING // 2 :: DOWNSAMPLING]
        measured = channels[..., 3] == 255
        assert (channels[~measured] == 0).all()
        assert measured[coarse == 0].mean() < 0.1, "the sky has no points"
        ground = measured & np.isin(coarse, [CODE[name] for name in ("road", "sidewalk")])
        if ground.sum() > 50:
            assert np.median(channels[ground][:, 2]) > 240, "the ground isn't horizontal"
            assert abs(np.median(channels[ground][:, 0].astype(float)) - 128) < 25, "more than 17 cm off ground level"

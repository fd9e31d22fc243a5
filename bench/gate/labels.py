"""Class labels of a world rendered from its photos' poses, compared with the photos' true labels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scan2sim.pipeline.camera.renderer import Body, Renderer
from scan2sim.pipeline.core.classes import CODE, CODE_OF_SURFACE, GROUPS, group_of
from scan2sim.pipeline.core.types import U8, Mesh
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.io.worlds.scene import Scene

PHOTO_STRIDE = 4
"""Every Nth photo is compared."""
SKY = 0
SEPARATE_CLASSES = (CODE["road_sign"], CODE["pole"])
"""Classes with a label of their own in worlds, apart from their group's."""
MOVABLE_CLASSES = (CODE["vehicle"], CODE["person"])
"""Classes that are in photos but not in worlds; their pixels are ignored."""


def label_agreement(scene: Scene, street: Path) -> dict[str, float]:
    """Shares of the photos' pixels at which the world shows the true class.

    Args:
        scene: world of a generated street.
        street: the generated tile, with `truth/labels` of its photos.

    Returns:
        `labels_agree` of all pixels except vehicles and people; `labels_agree_surface` of those of them that aren't
        sky; and the share of each class's pixels, `labels_agree.building` and so on.
    """
    tile = read_tile(street)
    codes, renderer = _world(scene)
    table = np.zeros((256, 256), np.int64)  # true class, shown class
    shift = np.asarray(tile.frame.origin) - np.asarray(scene.origin)
    for view in tile.views[::PHOTO_STRIDE]:
        truth = cv2.imread(str(street / "truth" / "labels" / f"{view.photo.stem}.png"), cv2.IMREAD_UNCHANGED)
        pose = np.array(view.T_world_cam, np.float64)
        pose[:3, 3] += shift
        image = renderer.view(view.camera, pose)
        shown = np.where(image.hit, codes[image.face.clip(0)], SKY)
        np.add.at(table, (_label(truth), shown), 1)
    table[list(MOVABLE_CLASSES)] = 0
    whole, surface = table.sum(), table[1:].sum()
    agree = {"labels_agree": np.trace(table) / whole, "labels_agree_surface": np.trace(table[1:, 1:]) / surface}
    names = {CODE_OF_SURFACE[group]: group for group in GROUPS} | {CODE["road_sign"]: "road_sign", CODE["pole"]: "pole"}
    agree |= {f"labels_agree.{name}": table[c, c] / table[c].sum() for c, name in names.items() if table[c].sum()}
    return {name: round(float(value), 4) for name, value in agree.items()}


def _world(scene: Scene) -> tuple[U8, Renderer]:
    """Labels (F,) of all faces of a world, and a renderer of the world."""
    vertices, faces, codes, first = [], [], [], 0
    for tile in scene.tiles:
        for surface in tile.surfaces():
            mesh = surface.shape.mesh
            vertices.append(mesh.vertices + np.asarray(tile.offset, np.float32))
            faces.append(mesh.faces + first)
            codes.append(np.full(len(mesh), surface.code, np.uint8))
            first += len(mesh.vertices)
    whole = Mesh(scene.frame, np.concatenate(vertices), np.concatenate(faces).astype(np.int32))
    return np.concatenate(codes), Renderer([Body(whole)])


def _label(truth: U8) -> U8:
    """True classes of a photo, mapped to the labels of worlds."""
    group = group_of()
    table = np.zeros(256, np.uint8)
    for code in range(256):
        if code in (*SEPARATE_CLASSES, *MOVABLE_CLASSES):
            table[code] = code
        elif group[code] >= 0:
            table[code] = CODE_OF_SURFACE[GROUPS[group[code]]]
    return np.asarray(table[truth], np.uint8)

"""Outlines of sign panels in photos: contrast by hand, and panels rendered at known places."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.types import F64, U8, Camera, View
from scan2sim.pipeline.furniture.sign_panels import Shape, SignPanel, inside
from scan2sim.segmentation.sign_panels import fit_outline
from scan2sim.segmentation.sign_panels.fit_outline import NOISE_LEVELS, CloseUps, close_ups

CENTRE = np.array([12.0, -2.0, 2.5])
NORMAL = np.array([-np.cos(0.3), np.sin(0.3), 0.0])
EYES = np.array([(2.0, 0.0, 1.6), (3.5, -0.8, 1.6), (5.0, 0.3, 2.0), (4.0, -4.0, 1.6)])
RESOLUTION, SIZE = 80.0, 257
"""Pixels per metre at the panel, and width of the close-ups."""
RED, GREY = np.array([200.0, 30.0, 40.0]), np.array([90.0, 100.0, 95.0])


def panel(shape: Shape) -> SignPanel:
    """The true panel."""
    return SignPanel(CENTRE, NORMAL, shape, 0.7, 0.5 if shape == "rectangle" else 0.7)


def looking_at(eye: F64, target: F64) -> F64:
    """(4, 4) pose of an upright camera."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0, 0, 1)) / np.linalg.norm(np.cross(forward, (0, 0, 1)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(forward, right), forward], axis=1), eye
    return pose


def rendered(pose: F64, focal: float, size: int, shown: SignPanel, face: F64, behind: F64) -> F64:
    """(size, size, 3) image of a panel of one colour in front of another; 9 rays per pixel."""
    fine = (np.arange(3 * size) + 0.5) / 3 - 0.5 - (size - 1) / 2
    column, row = np.meshgrid(fine, fine)
    rays = np.stack([column / focal, row / focal, np.ones_like(row)], axis=-1) @ pose[:3, :3].T
    eye = pose[:3, 3]
    at = eye + rays * (((shown.centre - eye) @ shown.normal) / (rays @ shown.normal))[..., None]
    flat = np.stack([(at - shown.centre) @ shown.across, at[..., 2] - shown.centre[2]], axis=-1)
    colours = np.where(inside(flat.reshape(-1, 2), shown.outline, 0).reshape(row.shape)[..., None], face, behind)
    return np.asarray(colours.reshape(size, 3, size, 3, 3).mean(axis=(1, 3)))


def photographed(shown: SignPanel, faces: F64, behind: F64) -> CloseUps:
    """Close-ups of a panel, whose face and background have a colour (J, 3) of their own in each photo."""
    images, projections, focals = [], [], []
    for eye, face, back in zip(EYES, faces, behind, strict=True):
        pose, focal = looking_at(eye, CENTRE), RESOLUTION * float(np.linalg.norm(CENTRE - eye))
        K = np.array([[focal, 0, (SIZE - 1) / 2], [0, focal, (SIZE - 1) / 2], [0, 0, 1]])
        images.append(rendered(pose, focal, SIZE, shown, face, back).astype(np.float32))
        projections.append(K @ np.linalg.inv(pose)[:3])
        focals.append(focal)
    return CloseUps(np.array(images), np.array(projections), np.array(focals), CENTRE, NORMAL)


def row_of(shown: SignPanel) -> F64:
    """(1, 6) row of `CloseUps.contrast`."""
    heading = np.arctan2(shown.normal[1], shown.normal[0])
    return np.array([[*shown.centre, heading, shown.width, shown.height]])


@pytest.mark.parametrize("shape", ["rectangle", "disc", "octagon"])
def test_contrast_and_agreement_are_those_of_the_colours(shape: Shape) -> None:
    behind = GREY + np.array([[0.0], [20.0], [-30.0], [5.0]])
    photos = photographed(panel(shape), np.tile(RED, (4, 1)), behind)
    across = np.linalg.norm(RED - behind, axis=1).mean()
    edge = across / (across + 3 * NOISE_LEVELS)
    found = photos.contrast(shape, row_of(panel(shape)), offset=3.0)[0]
    assert found == pytest.approx([edge, edge, 1.0], abs=1e-4)

    faces = RED + np.array([[0.0], [8.0], [-8.0], [0.0]])  # exposures differ: the photos disagree
    photos = photographed(panel(shape), faces, behind)
    across = np.linalg.norm(faces - behind, axis=1).mean()
    variance = 3 * 32.0
    edge = across / (across + np.sqrt(variance) + 3 * NOISE_LEVELS)
    agreement = 3 * NOISE_LEVELS**2 / (3 * NOISE_LEVELS**2 + variance)
    found = photos.contrast(shape, row_of(panel(shape)), offset=3.0)[0]
    assert found == pytest.approx([edge, edge, agreement], abs=1e-4)


def test_only_the_true_outline_has_contrast_all_around() -> None:
    true = panel("rectangle")
    photos = photographed(true, np.tile(RED, (4, 1)), np.tile(GREY, (4, 1)))
    others = [
        replace(true, width=0.5, height=0.3), replace(true, width=0.9, height=0.7),
        true.moved(np.array([0.0, 0.0, 0.1])), true.moved(0.1 * true.across),
    ]  # fmt: skip
    weakest = [photos.contrast("rectangle", row_of(one))[0, 1] for one in (true, *others)]
    assert weakest[0] > 0.85 and max(weakest[1:]) < 0.01
    assert photos.shows(true) and not any(photos.shows(one) for one in others)
    outside = true.moved(4 * true.across)  # beyond the images
    assert not photos.contrast("rectangle", row_of(outside)).any()


@pytest.mark.parametrize("shape", ["rectangle", "triangle", "disc"])
def test_a_nearby_outline_is_refined_to_the_true_one(shape: Shape) -> None:
    true = panel(shape)
    photos = photographed(true, np.tile(RED, (4, 1)), GREY + np.array([[0.0], [20.0], [-30.0], [5.0]]))
    start = replace(true.moved(np.array([0.02, 0.015, -0.02])), width=1.03 * true.width, height=1.03 * true.height)
    found = fit_outline._refined(photos, start, fit_outline.HEADING_STARTS)
    assert np.abs(found.centre - true.centre).max() < 0.5 / RESOLUTION
    assert found.width == pytest.approx(true.width, abs=1.5 / RESOLUTION)
    assert found.height == pytest.approx(true.height, abs=1.5 / RESOLUTION)
    assert found.normal @ true.normal > np.cos(np.radians(3))


def test_close_ups_show_what_a_camera_there_would_see() -> None:
    true, camera = panel("disc"), Camera("pinhole", 401, 401, 450.0, 450.0, 200.0, 200.0)
    poses = [looking_at(eye, CENTRE + (0.0, 0.4, -0.3)) for eye in EYES]  # none looks straight at the panel
    views = [View(f"{i}", camera, pose, Path(f"{i}.png")) for i, pose in enumerate(poses)]
    photos: list[U8] = [rendered(pose, 450.0, 401, true, RED, GREY).round().astype(np.uint8) for pose in poses]
    found = close_ups(CENTRE, views, photos.__getitem__)
    assert found is not None and len(found.images) == 4
    size = found.images.shape[1]
    for image, project, focal in zip(found.images, found.project, found.focal, strict=True):
        u, v, w = project @ [*CENTRE, 1.0]
        assert (u / w, v / w) == pytest.approx(((size - 1) / 2, (size - 1) / 2))
        eye = EYES[np.argmin(np.abs(np.linalg.norm(project[:, :3] @ EYES.T + project[:, 3:], axis=0)))]
        expected = rendered(looking_at(eye, CENTRE), focal, size, true, RED, GREY)
        middle = slice(size // 4, -(size // 4))
        assert np.abs(image - expected)[middle, middle].mean() < 1.0
    assert close_ups(CENTRE, views[:2], photos.__getitem__) is None
    assert close_ups(EYES[0] - (30.0, 0.0, 0.0), views, photos.__getitem__) is None  # behind all cameras

"""Vehicle models: parked vehicles as simple closed models in place of half a scanned one (`split.vehicles=assets`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.scenario.shapes import faces_of
from scan2sim.pipeline.tracking.tracks import read_frame, read_tracks

VEHICLES = ("car", "van", "truck", "bus", "motorcycle")
SQUARE_PX = 8
"""Side of the square of one colour on the texture page."""
COLUMNS = 16
"""Squares in a row of the page."""
SOURCE_POINTS = 128
"""Value of the colour source mask for point colours, as in the step `texture`."""


class VehicleModelsParams(Params):
    """Categories, sizes and colours are those of the tracks.

    Attributes:
        context: the tile's cell, if it has neighbours: only vehicles with their middle in it are modelled.
    """

    context: TileCell | None = None


def vehicle_models(inputs: Inputs, params: VehicleModelsParams, out: Path, report: Report) -> Done:
    """Write models (`pipeline.scenario.shapes`) of the parked vehicles among `tracks`, wheels on the ground.

    Files: `textured`, a folder with a textured mesh (`pipeline.io.worlds.textured_mesh`), and its `mesh`, local metres,
    every face of class vehicle. Metrics: number of `vehicles` and `faces`.
    """
    frame = read_frame(inputs["tracks"])
    tracks = [one for one in read_tracks(inputs["tracks"]) if not one.moving and one.category in VEHICLES]
    if params.context and tracks:
        middles = np.array([track.poses[0, :2] for track in tracks]) + np.asarray(frame.origin[:2])
        outside = params.context.cell.outside(middles)
        tracks = [track for track, beyond in zip(tracks, outside, strict=True) if beyond <= 0]
    corners, colours = [np.zeros((0, 3, 3))], [np.zeros((0, 3), np.uint8)]
    for track in tracks:
        x, y, z, yaw = track.poses[0]
        c, s = np.cos(yaw), np.sin(yaw)
        own, rgb = faces_of(track)
        corners.append(own @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + (x, y, z))
        colours.append(rgb)
    faces = np.concatenate(corners)
    palette, square = np.unique(np.concatenate(colours), axis=0, return_inverse=True)
    rows = -(-max(len(palette), 1) // COLUMNS)
    page = np.zeros((rows * COLUMNS, 3), np.uint8)
    page[: len(palette)] = palette
    page = page.reshape(rows, COLUMNS, 3).repeat(SQUARE_PX, axis=0).repeat(SQUARE_PX, axis=1)
    folder = out / "models"
    folder.mkdir()
    image.write(folder / "page_0.png", page)
    image.write(folder / "page_0_seen.png", np.full(page.shape[:2], SOURCE_POINTS, np.uint8))
    row, column = np.divmod(square.reshape(-1), COLUMNS)
    middle = np.stack(
        [(column + 0.5) / COLUMNS, 1 - (row + 0.5) / rows], axis=1
    )  # the origin of uv is at the lower left
    mesh = Mesh(
        frame,
        faces.reshape(-1, 3).astype(np.float32),
        np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3),
        uv=np.repeat(middle[:, None], 3, axis=1).astype(np.float32),
        page=np.zeros(len(faces), np.int16),
        classification=np.full(len(faces), CODE["vehicle"], np.uint8),
    )
    mesh.save(folder / "mesh.npz")
    files = {"textured": folder, "mesh": folder / "mesh.npz"}
    return Done(files, {"vehicles": len(tracks), "faces": len(faces)})


VEHICLE_MODELS = Step("vehicle_models", 1, vehicle_models, VehicleModelsParams, memory=(0.2, 0))

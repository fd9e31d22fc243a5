"""Output of SLAM: the trajectory in all formats, and the map as a COLMAP model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scan2sim.pipeline.core.types import Camera, Frame, Trajectory
from scan2sim.pipeline.io import colmap_writer
from scan2sim.pipeline.io import file_checks as files_io
from scan2sim.pipeline.io import trajectory as trajectory_io


def write(
    folder: Path,
    trajectory: Trajectory,
    frame: Frame | None = None,
    *,
    camera: Camera | None = None,
    names: Sequence[str] = (),
    sparse: colmap_writer.SparseMap | None = None,
) -> list[Path]:
    """Write `trajectory.csv`, `.tum`, `.kitti`, `.geojson` (if georeferenced), and with a camera and names `colmap/`.

    Args:
        folder: output folder.
        trajectory: in local coordinates of `frame`; camera to world for COLMAP.
        frame: coordinate frame; None: local.
        camera: camera of the COLMAP model.
        names: names of the photos, one per pose.
        sparse: points and observations of the COLMAP model.

    Returns:
        The files written.

    Raises:
        DataError: names, poses and observations don't match in number.
        SpaceError: the disk is full or write-protected.
    """
    frame = frame or Frame()
    suffixes = [".csv"]
    if trajectory.rotations is not None:
        suffixes += [".tum", ".kitti"]
    if frame.crs != "local":
        suffixes.append(".geojson")
    files_io.make_folder(folder)
    files = [folder / f"trajectory{suffix}" for suffix in suffixes]
    for file in files:
        trajectory_io.write(file, trajectory, frame)
    if camera is not None and names:
        files += colmap_writer.write(folder / "colmap", trajectory, camera, names, sparse, frame)
    return files

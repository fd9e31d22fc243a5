"""Files of other programs that aren't read: what they are, by their suffix, and what to export instead."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.errors import InputError

_E57 = "Export it as E57 or LAZ"
_GPX = "Export the recorded track as GPX (.gpx) or CSV (time,latitude,longitude,altitude)"
_MESH = "Export the mesh as GLB, or as OBJ with its textures"
_PATH = "Export it as text: time,x,y,z[,qx,qy,qz,qw] in the clouds' CRS; for --gps time,latitude,longitude,altitude"
_PROJECT = "Export its point cloud (LAZ, E57) or textured mesh (OBJ, GLB), and its cameras"
_RAW = "Convert it with the receiver's program or RTKLIB, and export GPX, NMEA or CSV"
_SCANNER = "Register and export it as E57 with the scanner's program"
_SPLATS = "Give a point cloud or mesh of the scene: splats aren't points on surfaces"
KNOWN: dict[tuple[str, ...], tuple[str, str]] = {
    (".usdz", ".usd", ".usda", ".usdc"): ("a USD scene", _MESH),
    (".fbx", ".dae", ".stl", ".3ds", ".x3d", ".wrl", ".blend", ".3dm", ".skp", ".off",
     ".3mf", ".amf", ".ctm", ".zae", ".3dxml", ".xaml", ".msh"): ("a mesh or scene", _MESH),
    (".osgb", ".b3dm", ".i3s", ".slpk", ".3mx", ".3sm"): ("a tiled mesh", _MESH),
    (".ifc", ".dwg", ".dxf", ".rvt", ".step", ".stp", ".iges", ".igs"): (
        "a CAD or BIM model", "Export its surfaces as OBJ or GLB",
    ),
    (".ptg", ".pod", ".rcp", ".rcs", ".zlas", ".npy", ".bpf", ".drc", ".fbi", ".parquet", ".feather"): (
        "a cloud of another kind", _E57,
    ),
    (".bin",): (
        "a lidar sweep of KITTI, or a cloud of CloudCompare",
        "Import sweeps with scan2sim import sweeps; save a cloud of CloudCompare as E57 or LAZ",
    ),
    (".fls", ".fws", ".lsproj", ".flsproj"): ("a scan of FARO", _SCANNER),
    (".rdbx", ".rdb", ".rxp", ".zfs", ".zfprj", ".lgs", ".lgsx", ".imp", ".rtc", ".tzf", ".clr", ".cl3", ".xbin"): (
        "a scan in its scanner's own format", _SCANNER,
    ),
    (".splat", ".ksplat", ".spz", ".sog", ".lcc"): ("a file of Gaussian splats", _SPLATS),
    (".psx", ".psz", ".rcproj", ".rsproj", ".p4d", ".p4m", ".opf", ".mvs", ".sfm"): (
        "the project of a photogrammetry program", _PROJECT,
    ),
    (".r3d",): ("a capture of Record3D", "Export it from the app as a point cloud (PLY), mesh or nerfstudio data set"),
    (".db",): (
        "a database, perhaps of RTAB-Map", "Export the cloud or mesh and the poses: `rtabmap-export map.db`",
    ),
    (".srt",): ("a file of subtitles, in which drones of DJI log GPS", _GPX),
    (".mrk",): ("a table of a DJI drone's exposures", "Use the GPS in the photos' EXIF, or write it as CSV"),
    (".kml", ".kmz", ".fit", ".tcx"): ("a track of another kind", _GPX),
    (".pos",): ("a solution of RTKLIB", "Write it as NMEA instead (`rnx2rtkp -n`; RTKPOST: output format NMEA0183)"),
    (".ubx", ".obs", ".rnx", ".nav", ".sbf", ".t02", ".t04", ".gpb"): ("raw GNSS data", _RAW),
    (".out", ".sbet", ".smrmsg", ".traj", ".pof", ".trj"): ("perhaps a damaged trajectory (SBET, POF)", _PATH),
    (".insv", ".insp"): ("a recording of Insta360", "Stitch and export it as MP4 or JPEG, with its GPS as GPX"),
    (".zip", ".7z", ".rar", ".gz", ".tgz", ".tar", ".bz2", ".xz", ".zst"): ("an archive", "Unpack it first"),
}  # fmt: skip
"""Kind of a file and the remedy, by suffixes in lower case."""


def unread(path: Path, cause: str, remedy: str) -> InputError:
    """The error of a file whose format isn't read: what it is and what to export instead, if that is known.

    Args:
        path: the file.
        cause: what is wrong without that knowledge, such as "has an unknown cloud format".
        remedy: what is read instead.
    """
    suffix = path.suffix.lower()
    what, instead = next((about for suffixes, about in KNOWN.items() if suffix in suffixes), ("", ""))
    return InputError(path, f"{cause}: {suffix} is {what}" if what else cause, instead or remedy)

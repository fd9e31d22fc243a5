"""GPS tracks: all formats, rejected fixes, gaps."""

from __future__ import annotations

import math
import struct
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from pyproj import Geod, Transformer

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Frame, GpsTrack
from scan2sim.pipeline.io import gps
from scan2sim.pipeline.io.gps.gopro import GPS_YEAR_2000, gpmf_fixes
from scan2sim.pipeline.io.gps_fixes import reject_jumps
from tests.present import present

START = datetime(2023, 6, 1, 23, 59, 58, tzinfo=UTC).timestamp()  # midnight comes after two seconds
LAT, LON = 49.2, 16.6  # Brno, UTM 33
ALONG = [i * 1e-4 for i in range(8)]  # degrees of longitude, 7.29 m each


def points() -> list[tuple[float, float, float, float]]:
    """Time, latitude, longitude, height of eight fixes, 1 s apart."""
    return [(START + i, LAT, LON + step, 250.0 + i) for i, step in enumerate(ALONG)]


def iso(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def sentence(body: str) -> str:
    total = 0
    for character in body:
        total ^= ord(character)
    return f"${body}*{total:02X}"


def angle(value: float, width: int) -> str:
    return f"{int(value):0{width}d}{(value % 1) * 60:09.6f}"


def gga(time: float, lat: float, lon: float, height: float, quality: int = 1, hdop: float = 0.8) -> str:
    clock = datetime.fromtimestamp(time, UTC).strftime("%H%M%S.%f")[:9]
    return sentence(f"GPGGA,{clock},{angle(lat, 2)},N,{angle(lon, 3)},E,{quality},08,{hdop},{height},M,44,M,,")


def rmc(time: float) -> str:
    return sentence(datetime.fromtimestamp(time, UTC).strftime("GNRMC,%H%M%S.00,A,,,,,,,%d%m%y,,"))


def gpx(version: str) -> str:
    body = "".join(
        f'<trkpt lat="{lat}" lon="{lon}"><ele>{height}</ele><time>{iso(time)}</time><hdop>1.2</hdop></trkpt>'
        for time, lat, lon, height in points()
    )
    space = f"http://www.topografix.com/GPX/{version.replace('.', '/')}"
    return f'<?xml version="1.0"?><gpx version="{version}" xmlns="{space}"><trk><trkseg>{body}</trkseg></trk></gpx>'


def nmea() -> str:
    lines = []
    for time, lat, lon, height in points():
        lines += [gga(time, lat, lon, height), rmc(time)]  # the date follows its fix, over midnight too
    lines.insert(2, gga(START + 0.5, LAT + 0.1, LON, 250, quality=0))
    lines.insert(5, gga(START + 1.5, LAT, LON, 250).replace("250", "251"))  # wrong checksum
    lines.append(gga(START + 20, LAT, LON, 250, hdop=9.9))
    return "\r\n".join(["garbage", *lines])


def table(heading: str, delimiter: str = ",") -> str:
    return "\n".join([heading, *(delimiter.join(map(repr, row)) for row in points())])


def scaled(heading: str, per_second: float, per_metre: float, *, swap: bool = False) -> str:
    """A table with times and heights in other units: of drones' logs, or of a phone's sensors."""
    rows = [
        (f"{time * per_second:.0f}", *((lon, lat) if swap else (lat, lon)), f"{height * per_metre:.6f}")
        for time, lat, lon, height in points()
    ]
    return "\n".join([heading, *(",".join(map(str, row)) for row in rows)])


@pytest.mark.parametrize(
    ("name", "text", "sigma"),
    [
        ("a.gpx", gpx("1.1"), 1.8),
        ("b.gpx", gpx("1.0"), 1.8),
        ("a.nmea", nmea(), 1.2),
        ("a.csv", table("timestamp,lat,lng,ele"), None),
        ("b.csv", table("Time (s); Latitude; Longitude; Altitude (m)", ";").replace(",", "."), None),
        ("elevation.csv", table("time,latitude,longitude,elevation"), None),
        ("airdata.csv", scaled("time(millisecond),latitude,longitude,altitude(feet)", 1e3, 1 / 0.3048), None),
        ("phone.csv", scaled("time,longitude_deg,lat_deg,height_m", 1e9, 1, swap=True), None),
    ],
)
def test_all_formats_give_the_same_track(tmp_path: Path, name: str, text: str, sigma: float | None) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    track = gps.read(tmp_path / name)
    assert np.allclose(track.times, START + np.arange(8), atol=1e-3)
    assert track.frame.crs == "EPSG:32633"
    assert (np.abs(track.positions[0]) <= 1).all() and np.allclose(np.diff(track.positions[:, 2]), 1)
    east, north = Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True).transform(
        [LON + step for step in ALONG], [LAT] * 8
    )
    assert np.allclose(track.frame.to_crs(track.positions)[:, :2], np.column_stack([east, north]), atol=1e-3)
    true = Geod(ellps="WGS84").inv(LON, LAT, LON + ALONG[-1], LAT)[2]
    assert track.distance(track.times[:1], track.times[-1:])[0] == pytest.approx(np.hypot(true, 7), rel=5e-4)
    assert track.sigma is None if sigma is None else np.allclose(present(track.sigma), sigma)


def test_radians_are_read_by_their_unit(tmp_path: Path) -> None:
    rows = [f"{time},{math.radians(lat)!r},{math.radians(lon)!r},{height}" for time, lat, lon, height in points()]
    (tmp_path / "a.csv").write_text("\n".join(["time [s],lat [rad],lon [rad],alt [m]", *rows]), encoding="utf-8")
    (tmp_path / "b.csv").write_text(table("time,lat,lon,alt"), encoding="utf-8")
    a, b = gps.read(tmp_path / "a.csv"), gps.read(tmp_path / "b.csv")
    assert a.frame == b.frame and np.allclose(a.positions, b.positions, atol=1e-6)


def test_local_metres_are_kept_unchanged(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,x,y\n1,10,20\n0,5,20\n1,99,99\n2,15,20\n", encoding="utf-8")
    track = gps.read(tmp_path / "a.csv")
    assert track.frame == Frame() and track.times.tolist() == [0, 1, 2]
    assert track.positions.tolist() == [[5, 20, 0], [10, 20, 0], [15, 20, 0]]


def test_fixes_before_the_only_rmc_get_its_date(tmp_path: Path) -> None:
    (tmp_path / "a.nmea").write_text("\n".join([*(gga(*row) for row in points()), rmc(START + 8)]), encoding="utf-8")
    assert np.allclose(gps.read(tmp_path / "a.nmea").times, START + np.arange(8))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.gpx", "", r"a\.gpx: is not readable XML.*Export it again"),
        ("a.gpx", "<!DOCTYPE gpx [<!ENTITY a 'b'>]><gpx/>", r"declares a document type"),
        ("a.gpx", "<gpx/>", r"has no usable GPS fix \(0 points\)"),
        ("a.gpx", '<gpx><trkpt lat="1" lon="2"/></gpx>', r"no times"),
        ("a.gpx", '<gpx><trkpt lat="0" lon="0"><time>2023-01-01T00:00:00Z</time></trkpt></gpx>', r"no usable GPS fix"),
        ("a.csv", "", r"missing columns"),
        ("a.csv", "time,height\n1,2\n", r"missing columns \(its header line: time,height\).*time,x,y,z"),
        ("a.csv", "time,lat,lon\n1,,\n", r"no usable GPS fix \(1 points\)"),
        ("a.nmea", "$GPGGA,1,2,3*00\n", r"no NMEA sentence with a valid checksum"),
        ("a.nmea", gga(START, LAT, LON, 1), r"no date.*Log RMC"),
        ("a.mp4", "no video", r"a\.mp4: is not a readable video"),
        ("a.kml", "", r"unknown GPS format.*\.gpx"),
    ],
)
def test_invalid_files_are_rejected(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        gps.read(tmp_path / name)


def test_missing_file_is_reported() -> None:
    with pytest.raises(InputError, match=r"none\.gpx: file not found"):
        gps.read(Path("none.gpx"))


# --- jumps, gaps


def straight(seconds: float, rate: float = 10.0, speed: float = 15.0) -> tuple[np.ndarray, np.ndarray]:
    times = np.arange(0, seconds, 1 / rate)
    return times, np.column_stack([speed * times, 0 * times, 0 * times])


@pytest.mark.parametrize("bad", [[0], [0, 1, 2], [50], [40, 41, 42, 43], [99], [10, 30, 31, 98]])
def test_jumps_are_rejected_at_any_position(bad: list[int]) -> None:
    times, positions = straight(10)
    positions[bad, 1] += 400
    assert reject_jumps(times, positions[:, :2]).tolist() == [i for i in range(100) if i not in bad]
    assert reject_jumps(times, positions[:, :2], lookback=2).tolist() == [i for i in range(100) if i not in bad]


def test_gaps_are_not_interpolated() -> None:
    times, positions = straight(20, rate=1)
    keep = (times < 5) | (times > 9)
    track = GpsTrack(times[keep], positions[keep])
    x = track.at([-0.1, 0, 2.5, 4, 4.5, 7, 10, 10.5, 19, 19.1])[:, 0]
    assert np.isnan(x[[0, 4, 5, 9]]).all()
    assert np.allclose(x[[1, 2, 3, 6, 7, 8]], 15 * np.array([0, 2.5, 4, 10, 10.5, 19]))
    assert np.isfinite(track.at([7.0], max_gap=10)).all()
    assert track.distance([0, 0], [4, 7])[0] == 60 and np.isnan(track.distance([0, 0], [4, 7])[1])
    assert track.shifted(-100).at([-98.0])[0, 0] == 30


# --- GoPro


def entry(key: str, kind: str, size: int, body: bytes) -> bytes:
    return struct.pack(">4scBH", key.encode(), kind.encode(), size, len(body) // size) + body + bytes(-len(body) % 4)


def nested(key: str, body: bytes) -> bytes:
    return struct.pack(">4sBBH", key.encode(), 0, 1, len(body)) + body


def gps5(second: int, *, stamp: float | None = None, fix: int = 3, dop: int = 150) -> bytes:
    """A packet with an accelerometer and ten fixes, 5 m apart."""
    body = b"".join(
        struct.pack(">5l", int(LAT * 1e7), round((LON + (10 * second + i) * 7e-5) * 1e7), 250_000, 5000, 500)
        for i in range(10)
    )
    accelerometer = entry("SCAL", "s", 2, struct.pack(">h", 418)) + entry("ACCL", "s", 6, bytes(12))
    head = b""
    if stamp is not None:
        head = entry("STMP", "J", 8, struct.pack(">Q", round(stamp * 1e6)))
        accelerometer = entry("STMP", "J", 8, struct.pack(">Q", round((stamp - 0.2) * 1e6))) + accelerometer
    utc = datetime.fromtimestamp(START + second, UTC).strftime("%y%m%d%H%M%S.000").encode()
    head += entry("STNM", "c", 1, b"GPS (Lat., Long., Alt., 2D speed, 3D speed)")
    head += entry("GPSF", "L", 4, struct.pack(">L", fix)) + entry("GPSU", "U", 16, utc)
    head += entry("GPSP", "S", 2, struct.pack(">H", dop))
    head += entry("SCAL", "l", 4, struct.pack(">5l", 10_000_000, 10_000_000, 1000, 1000, 100))
    streams = nested("STRM", accelerometer) + nested("STRM", head + entry("GPS5", "l", 20, body))
    return nested("DEVC", entry("DVNM", "c", 1, b"Camera") + streams)


def gps9(second: int, bad: int | None = None) -> bytes:
    day = 86400
    since = START - GPS_YEAR_2000
    body = b""
    for i in range(10):
        clock = since + second + i / 10
        place = int(LAT * 1e7), round((LON + (10 * second + i) * 7e-5) * 1e7), 250_000, 5000, 500
        body += struct.pack(">7l2H", *place, int(clock // day), round(clock % day * 1000), 120, 0 if i == bad else 3)
    head = entry("TYPE", "c", 1, b"lllllllSS")
    head += entry("SCAL", "l", 4, struct.pack(">9l", 10_000_000, 10_000_000, 1000, 1000, 100, 1, 1000, 100, 1))
    return nested("DEVC", nested("STRM", head + entry("GPS9", "?", 32, body)))


def film(path: Path, packets: list[bytes], starts: list[float]) -> Path:
    """An MP4 with a second of black and a telemetry track, as FFmpeg writes one."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as out:
        video = out.add_stream("mpeg4", rate=5)
        video.width, video.height, video.pix_fmt = 32, 32, "yuv420p"
        track = out.add_data_stream("bin_data")
        for _ in range(5):
            out.mux(video.encode(av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), format="rgb24")))
        out.mux(video.encode(None))
        for data, start in zip(packets, starts, strict=True):
            packet = av.Packet(data)
            packet.stream, packet.time_base = track, Fraction(1, 1000)
            packet.pts = packet.dts = round(start * 1000)
            packet.duration = 1000
            out.mux(packet)
    return path


def test_gopro_telemetry_is_read(tmp_path: Path) -> None:
    track = gps.read(film(tmp_path / "a.mp4", [gps5(i) for i in range(4)], [0.0, 1.0, 2.0, 3.0]))
    assert np.allclose(track.times, np.arange(40) / 10, atol=2e-3)
    assert np.allclose(np.diff(track.positions[:, 0]), 5.1, atol=0.02)
    assert track.sigma is not None and np.allclose(track.sigma, 2.25)
    assert track.epoch == pytest.approx(START, abs=0.01)
    assert track.shifted(10).epoch == pytest.approx(START - 10, abs=0.01)


def test_gopro_telemetry_without_a_fix_is_dropped(tmp_path: Path) -> None:
    packets = [gps5(0, fix=0), gps5(1), gps5(2, dop=9999), gps5(3)]
    track = gps.read(film(tmp_path / "a.mp4", packets, [0.0, 1.0, 2.0, 3.0]))
    assert np.allclose(track.times, [*np.arange(1, 2, 0.1), *np.arange(3, 4, 0.1)], atol=2e-3)
    with pytest.raises(InputError, match=r"no usable GPS fix"):
        gps.read(film(tmp_path / "b.mp4", [gps5(0, fix=0)], [0.0]))


def test_camera_timestamps_give_the_start_of_gps(tmp_path: Path) -> None:
    """The first sample of the accelerometer is at the start of the video, the first GPS fix 0.2 s later."""
    packets = [gps5(i, stamp=7.2 + i) for i in range(3)]
    track = gps.read(film(tmp_path / "a.mp4", packets, [0.0, 1.0, 2.1]))
    assert np.allclose(track.times, 0.2 + np.arange(30) / 10, atol=2e-3)


def test_gps9_dates_every_fix(tmp_path: Path) -> None:
    packets = [gps9(0), gps9(1, bad=4), gps9(2)]
    track = gps.read(film(tmp_path / "a.mp4", packets, [0.0, 1.07, 2.0]))
    steady = track.times - np.delete(np.arange(30) / 10, 14)
    assert np.ptp(steady) < 1e-6 and abs(steady[0]) < 0.02
    assert track.epoch == pytest.approx(START, abs=0.02)


def test_damaged_or_missing_telemetry_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"truncated"):
        gpmf_fixes(gps5(0)[:-40])
    with pytest.raises(InputError, match=r"a\.mp4: has damaged GoPro telemetry.*Copy it"):
        gps.read(film(tmp_path / "a.mp4", [gps5(0)[:-40]], [0.0]))
    with pytest.raises(InputError, match=r"no GoPro telemetry"):
        gps.read(film(tmp_path / "b.mp4", [b"TMCD    "], [0.0]))
    with pytest.raises(InputError, match=r"telemetry, but no GPS"):
        gps.read(film(tmp_path / "c.mp4", [nested("DEVC", entry("DVNM", "c", 1, b"Camera"))], [0.0]))

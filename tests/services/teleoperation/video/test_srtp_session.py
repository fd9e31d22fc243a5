import os

import pytest
from pylibsrtp import Policy, Session

from scan2sim.services.teleoperation.control.messages import Key
from scan2sim.services.teleoperation.video import rtp_packets, srtp_session
from scan2sim.services.teleoperation.video.srtp_session import (
    AHEAD,
    EVERY,
    KEPT,
    LASTING,
    Keys,
    Opener,
    Sealer,
    lasting,
)

FRAME = b"\x01" + bytes(3000)


def sealer(keys: Keys, camera: int = 1, now: float = 0.0) -> Sealer:
    made = Sealer(keys, camera)
    assert made.renew(now)
    return made


def opener(keys: Keys) -> Opener:
    made = Opener()
    for key in keys.told(0.0):
        made.learn(key)
    return made


def test_packets_are_read_by_who_has_the_key() -> None:
    keys = Keys(0.0)
    sealed = sealer(keys).seal(FRAME, 77)
    assert all(FRAME[:500] not in packet for packet in sealed)
    station = opener(keys)
    plain = [station.open(packet, 0.0) for packet in sealed]
    assert b"".join(rtp_packets.parse(packet).data for packet in plain if packet) == FRAME
    assert not station.counts
    assert [opener(Keys(0.0)).open(packet, 0.0) for packet in sealed] == [None] * 3


def test_forged_and_doubled_packets_are_dropped_and_counted() -> None:
    keys = Keys(0.0)
    sealed, station = sealer(keys).seal(FRAME, 77), opener(keys)
    for packet in sealed:
        for at in (2, 5, 11, 20, 40, len(packet) - 1):
            forged = bytearray(packet)
            forged[at] ^= 1
            assert station.open(bytes(forged), 0.0) is None
    assert station.counts == {"forged": 18}
    assert all(station.open(packet, 0.0) for packet in sealed)
    assert not any(station.open(packet, 0.0) for packet in sealed)
    assert station.counts == {"forged": 18, "doubled": 3}
    source = sealed[0][8:12]
    for nothing in (b"", bytes(40), sealed[0][:31], sealed[0][:40], os.urandom(8) + source + os.urandom(5000)):
        assert station.open(nothing, 0.0) is None
    for _ in range(200):
        station.open(sealed[0][:8] + source + os.urandom(300), 0.0)
    assert sum(station.counts.values()) == 18 + 3 + 5 + 200


def test_a_station_reads_on_from_anywhere() -> None:
    keys = Keys(0.0)
    camera = sealer(keys)
    for _ in range(14_000):  # of 3 packets each
        last = camera.seal(FRAME, 0)
    assert all(opener(keys).open(packet, 0.0) for packet in last)


def test_whoever_learns_a_key_late_reads_on_whatever_the_rate() -> None:
    assert lasting(1e6, 30) == EVERY
    every = lasting(20e6, 60)
    camera = sealer(keys := Keys(0.0, every))
    sent, now = 0, 0.0
    while now < every:
        assert not camera.renew(now)
        last = camera.seal(FRAME * 27, 0)  # 20 Mbit/s at 30 pictures a second
        sent, now = sent + len(last), now + 1 / 30
    assert sent > 2**14 and all(opener(keys).open(packet, 0.0) for packet in last)
    assert camera.renew(every)


def test_keys_change_and_are_told_ahead() -> None:
    keys = Keys(0.0, every=60.0)
    first = keys.told(0.0)
    assert len(first) == 1 and len(first[0].secret) == 44
    assert keys.told(59.9 - AHEAD) == first
    ahead = keys.told(60.1 - AHEAD)
    assert ahead[0] == first[0] and keys.used(59.9) == first[0] and keys.used(60.0) == ahead[1]
    assert ahead[1].generation == (first[0].generation + 1) % 2**24 and ahead[1].secret != first[0].secret
    assert keys.told(60.0) == ahead[1:]


def test_an_earlier_key_is_taken_for_some_seconds() -> None:
    keys = Keys(0.0, every=60.0)
    camera, station = sealer(keys), opener(keys)
    late = [camera.seal(FRAME, 0) for _ in range(2)]
    for key in keys.told(59.0):
        station.learn(key)
    assert not camera.renew(59.9) and camera.renew(60.0)
    new = camera.seal(FRAME, 0)
    assert rtp_packets.parse(station.open(new[0], 60.0) or b"").sequence == 0
    assert all(station.open(packet, 60.0 + LASTING) for packet in late[0])
    assert station.open(new[1], 60.1 + LASTING)
    assert not any(station.open(packet, 60.2 + LASTING) for packet in late[1])
    assert station.counts == {"keyless": 3}


def test_a_station_holds_few_keys() -> None:
    station = Opener()
    keys = [Key(number, bytes(44)) for number in range(10)]
    for key in keys:
        station.learn(key)
        station.learn(key)
    for key in keys:
        session = Session(srtp_session._policy(key, Policy.SSRC_ANY_OUTBOUND))
        packet = session.protect(rtp_packets.packets(b"\x01data", key.generation << 8, 0, 0, 0)[0])
        assert bool(station.open(packet, 0.0)) == (key.generation >= 10 - KEPT)


@pytest.mark.parametrize("cameras", [(0, 1), (3, 255)])
def test_cameras_are_sources_of_their_own(cameras: tuple[int, int]) -> None:
    keys = Keys(0.0)
    station = opener(keys)
    for camera in cameras:
        plain = [station.open(packet, 0.0) for packet in sealer(keys, camera).seal(FRAME, 0)]
        assert {rtp_packets.parse(packet or b"").source & 0xFF for packet in plain} == {camera}

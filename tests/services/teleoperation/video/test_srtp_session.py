import os

import pytest
from pylibsrtp import Policy, Session

from scan2sim.services.teleoperation.control.messages import VideoKey
from scan2sim.services.teleoperation.video import rtp_packets, srtp_session
from scan2sim.services.teleoperation.video.srtp_session import (
    KEY_ANNOUNCE_S,
    KEY_LIFETIME_MAX_S,
    KEYS_MAX,
    OLD_KEY_LIFETIME_S,
    KeySchedule,
    PacketDecryptor,
    PacketEncryptor,
    key_lifetime,
)

FRAME = b"\x01" + bytes(3000)


def encryptor(keys: KeySchedule, camera: int = 1, now: float = 0.0) -> PacketEncryptor:
    result = PacketEncryptor(keys, camera)
    assert result.update_key(now)
    return result


def decryptor(keys: KeySchedule) -> PacketDecryptor:
    result = PacketDecryptor()
    for key in keys.announced(0.0):
        result.add_key(key)
    return result


def test_packets_are_decrypted_with_the_key_only() -> None:
    keys = KeySchedule(0.0)
    encrypted = encryptor(keys).encrypt(FRAME, 77)
    assert all(FRAME[:500] not in packet for packet in encrypted)
    station = decryptor(keys)
    plain = [station.decrypt(packet, 0.0) for packet in encrypted]
    assert b"".join(rtp_packets.parse(packet).data for packet in plain if packet) == FRAME
    assert not station.counts
    assert [decryptor(KeySchedule(0.0)).decrypt(packet, 0.0) for packet in encrypted] == [None] * 3


def test_forged_and_duplicate_packets_are_dropped_and_counted() -> None:
    keys = KeySchedule(0.0)
    encrypted, station = encryptor(keys).encrypt(FRAME, 77), decryptor(keys)
    for packet in encrypted:
        for at in (2, 5, 11, 20, 40, len(packet) - 1):
            forged = bytearray(packet)
            forged[at] ^= 1
            assert station.decrypt(bytes(forged), 0.0) is None
    assert station.counts == {"forged": 18}
    assert all(station.decrypt(packet, 0.0) for packet in encrypted)
    assert not any(station.decrypt(packet, 0.0) for packet in encrypted)
    assert station.counts == {"forged": 18, "duplicates": 3}
    source = encrypted[0][8:12]
    for nothing in (b"", bytes(40), encrypted[0][:31], encrypted[0][:40], os.urandom(8) + source + os.urandom(5000)):
        assert station.decrypt(nothing, 0.0) is None
    for _ in range(200):
        station.decrypt(encrypted[0][:8] + source + os.urandom(300), 0.0)
    assert sum(station.counts.values()) == 18 + 3 + 5 + 200


def test_station_can_decrypt_from_any_packet_on() -> None:
    keys = KeySchedule(0.0)
    camera = encryptor(keys)
    for _ in range(14_000):  # of 3 packets each
        last = camera.encrypt(FRAME, 0)
    assert all(decryptor(keys).decrypt(packet, 0.0) for packet in last)


def test_late_station_can_decrypt_at_any_rate() -> None:
    assert key_lifetime(1e6, 30) == KEY_LIFETIME_MAX_S
    lifetime = key_lifetime(20e6, 60)
    camera = encryptor(keys := KeySchedule(0.0, lifetime))
    sent, now = 0, 0.0
    while now < lifetime:
        assert not camera.update_key(now)
        last = camera.encrypt(FRAME * 27, 0)  # 20 Mbit/s at 30 frames/s
        sent, now = sent + len(last), now + 1 / 30
    assert sent > 2**14 and all(decryptor(keys).decrypt(packet, 0.0) for packet in last)
    assert camera.update_key(lifetime)


def test_keys_are_replaced_and_announced_in_advance() -> None:
    keys = KeySchedule(0.0, lifetime_s=60.0)
    first = keys.announced(0.0)
    assert len(first) == 1 and len(first[0].secret) == 44
    assert keys.announced(59.9 - KEY_ANNOUNCE_S) == first
    announced = keys.announced(60.1 - KEY_ANNOUNCE_S)
    assert announced[0] == first[0] and keys.current(59.9) == first[0] and keys.current(60.0) == announced[1]
    assert announced[1].generation == (first[0].generation + 1) % 2**24 and announced[1].secret != first[0].secret
    assert keys.announced(60.0) == announced[1:]


def test_old_key_is_accepted_for_some_seconds() -> None:
    keys = KeySchedule(0.0, lifetime_s=60.0)
    camera, station = encryptor(keys), decryptor(keys)
    late = [camera.encrypt(FRAME, 0) for _ in range(2)]
    for key in keys.announced(59.0):
        station.add_key(key)
    assert not camera.update_key(59.9) and camera.update_key(60.0)
    new = camera.encrypt(FRAME, 0)
    assert rtp_packets.parse(station.decrypt(new[0], 60.0) or b"").sequence == 0
    assert all(station.decrypt(packet, 60.0 + OLD_KEY_LIFETIME_S) for packet in late[0])
    assert station.decrypt(new[1], 60.1 + OLD_KEY_LIFETIME_S)
    assert not any(station.decrypt(packet, 60.2 + OLD_KEY_LIFETIME_S) for packet in late[1])
    assert station.counts == {"keyless": 3}


def test_station_keeps_a_limited_number_of_keys() -> None:
    station = PacketDecryptor()
    keys = [VideoKey(number, bytes(44)) for number in range(10)]
    for key in keys:
        station.add_key(key)
        station.add_key(key)
    for key in keys:
        session = Session(srtp_session._policy(key, Policy.SSRC_ANY_OUTBOUND))
        packet = session.protect(rtp_packets.packetize(b"\x01data", key.generation << 8, 0, 0, 0, 0)[0])
        assert bool(station.decrypt(packet, 0.0)) == (key.generation >= 10 - KEYS_MAX)


@pytest.mark.parametrize("cameras", [(0, 1), (3, 255)])
def test_each_camera_is_a_separate_source(cameras: tuple[int, int]) -> None:
    keys = KeySchedule(0.0)
    station = decryptor(keys)
    for camera in cameras:
        plain = [station.decrypt(packet, 0.0) for packet in encryptor(keys, camera).encrypt(FRAME, 0)]
        assert {rtp_packets.parse(packet or b"").source & 0xFF for packet in plain} == {camera}

import pytest

from scan2sim.services.teleoperation.control.messages import Malformed
from scan2sim.services.teleoperation.video import rtp_packets

CAPTURED = 123_456_789_012_345


@pytest.mark.parametrize("length", [1, rtp_packets.PAYLOAD_MAX_BYTES, rtp_packets.PAYLOAD_MAX_BYTES + 1, 40_000])
def test_frame_survives_packetization(length: int) -> None:
    data = bytes(i * i % 251 for i in range(length))
    packets = rtp_packets.packetize(data, 0xABCDEF03, 65_530, 32_767, CAPTURED, CAPTURED + 7_350_000)
    parsed = [rtp_packets.parse(packet) for packet in packets]
    assert b"".join(packet.data for packet in parsed) == data
    assert [packet.sequence for packet in parsed] == [(65_530 + i) % 65_536 for i in range(len(packets))]
    assert [packet.first for packet in parsed] == [True] + [False] * (len(packets) - 1)
    assert [packet.last for packet in parsed] == [False] * (len(packets) - 1) + [True]
    assert {packet[1:4] for packet in parsed} == {(0xABCDEF03, CAPTURED, 32_767)}
    assert {packet.sent for packet in parsed} == {CAPTURED + 7_300_000}


def test_packets_fit_the_minimum_mtu_of_ipv6() -> None:
    with_srtp_udp_and_ip = 16 + 8 + 40
    assert max(map(len, rtp_packets.packetize(bytes(9999), 1, 0, 0, 0, 0))) + with_srtp_udp_and_ip <= 1280


def test_packet_layout_follows_the_standards() -> None:
    packet = rtp_packets.packetize(b"\x01data", 0x00000102, 7, 5, 2_000_000_000, 2_025_600_000)[0]
    assert packet[0] == 0x90 and packet[1] == 0x80 | 96  # version 2 with an extension; marker bit, payload type 96
    assert packet[2:4] == b"\x00\x07" and int.from_bytes(packet[4:8], "big") == 180_000 and packet[8:12] == b"\0\0\1\2"
    assert packet[12:16] == b"\xbe\xde\x00\x03" and packet[16] == 1 << 4 | 8 - 1
    assert int.from_bytes(packet[17:25], "big") == 2_000_000_000 and packet[25:28] == b"\x21\x01\x00"
    assert packet[28:32] == b"\x90\x80\x80\x05"  # X and S; I; a picture number of 15 bits


def test_invalid_packets_are_malformed() -> None:
    valid = rtp_packets.packetize(b"\x01data", 1, 0, 0, 0, 0)[0]
    wrong = [
        b"",
        valid[:31],
        valid[:32],
        b"\x80" + valid[1:],
        valid[:1] + b"\x61" + valid[2:],
        valid[:28] + b"\x91" + valid[29:],
    ]
    for packet in wrong:
        with pytest.raises(Malformed):
            rtp_packets.parse(packet)


def test_key_frame_size_is_read() -> None:
    key = bytes([0x10, 0, 0]) + b"\x9d\x01\x2a" + bytes([0x80, 0x42, 0xE0, 0x01])  # upper bits: scaling
    assert rtp_packets.key_frame_size(key) == (640, 480)
    for wrong in (b"\x11" + key[1:], key[:9], key[:3] + b"abc" + key[6:]):
        with pytest.raises(Malformed):
            rtp_packets.key_frame_size(wrong)

from __future__ import annotations

import itertools
import random
from collections.abc import Iterable

import numpy as np
import pytest

from scan2sim.services.teleoperation.cameras import CameraFrame
from scan2sim.services.teleoperation.video import rtp_packets
from scan2sim.services.teleoperation.video.jitter_buffer import (
    BUFFER_MAX_PACKETS,
    KEY_FRAME_REQUEST_INTERVAL_S,
    NACK_TIMEOUT_ROUND_TRIPS,
    NACKS_MAX,
    REORDER_TIMEOUT_INITIAL_S,
    REORDER_TIMEOUT_MAX_S,
    FrameAssembler,
    ReorderTimeout,
)
from scan2sim.services.teleoperation.video.rate_control import EncodingPlan
from scan2sim.services.teleoperation.video.srtp_session import RETRANSMIT_BUFFER_PACKETS, KeySchedule, PacketEncryptor
from tests.services.teleoperation.video.videos import FRAME_INTERVAL_NS, ROUND_TRIP_S, Drive, psnr, scenery

take = itertools.islice


def test_frames_arrive_as_sent() -> None:
    drive = Drive()
    drive.send(take(scenery(), 40))
    results = drive.decoded()
    assert [frame.captured for frame, _ in results] == list(drive.images) and drive.in_order()
    assert all((frame.camera, frame.width, frame.height) == (3, 320, 240) for frame, _ in results)
    assert [frame.key for frame, _ in results] == [True] + [False] * 39
    assert np.median([psnr(image, drive.images[frame.captured]) for frame, image in results]) > 30
    counts = drive.receiver.frames()[3]
    assert counts == {"frames": 40, "broken": 0, "received": sum_of_packets(drive), "lost": 0, "retransmitted": 0}
    assert not drive.key_frame_requests[1:] and not drive.receiver.counts


def sum_of_packets(drive: Drive) -> int:
    return drive.encoder.counts["packets"]


def test_reordered_and_duplicate_packets_have_no_effect() -> None:
    drive, rng = Drive(), random.Random(0)

    def link(packets: list[bytes]) -> Iterable[bytes]:
        doubled = packets * 2
        rng.shuffle(doubled)
        return doubled

    drive.send(take(scenery(), 40), link)
    assert len(drive.decoded()) == 40 and drive.in_order() and len(drive.key_frame_requests) <= 1
    assert drive.receiver.counts == {"duplicates": sum_of_packets(drive)}


def test_frame_waits_for_its_predecessor() -> None:
    drive, held = Drive(), list[bytes]()

    def swap(packets: list[bytes]) -> Iterable[bytes]:
        """Every other frame arrives just after its successor."""
        if held or drive.now == 0.0:
            both = [*packets, *held]
            held.clear()
            return both
        held.extend(packets)
        return ()

    drive.send(take(scenery(), 41), swap)
    assert len(drive.decoded()) == 41 and drive.in_order() and len(drive.key_frame_requests) == 0


def test_lost_packets_are_retransmitted_and_no_frame_is_dropped() -> None:
    drive = Drive(retransmits=True)
    drive.send(take(scenery(), 60), lambda packets: packets[1:] if round(drive.now * 30) in (20, 40) else packets)
    assert len(drive.frames) == 60 and drive.in_order() and not drive.key_frame_requests and len(drive.nacks) == 2
    assert all(psnr(image, drive.images[frame.captured]) > 28 for frame, image in drive.decoded())
    counts = drive.receiver.frames()[3]
    assert (counts["broken"], counts["lost"], counts["retransmitted"]) == (0, 0, 2)
    assert drive.encoder.counts["again"] == 2
    [report] = drive.receiver.reports()
    assert (report.received, report.lost) == (sum_of_packets(drive) - 2, 2), "retransmissions count as lost in reports"


@pytest.mark.parametrize("loss", [0.01, 0.05])
def test_retransmission_saves_most_frames_on_a_lossy_link(loss: float) -> None:
    broken = {}
    for retransmits in (False, True):
        drive, rng = Drive(retransmits=retransmits, keep_images=False), random.Random(2)
        drive.send(take(scenery(640, 480), 900), lambda packets: [one for one in packets if rng.random() > loss])  # noqa: B023
        broken[retransmits] = drive.receiver.frames()[3]["broken"]
        assert drive.in_order()
    assert broken[True] < broken[False] / 5


def test_many_missing_packets_are_not_nacked() -> None:
    drive = Drive(plan=EncodingPlan(bitrate=2_000_000), retransmits=True)
    drive.send(take(scenery(640, 480), 90), lambda packets: packets if not 30 < drive.now * 30 < 60 else ())
    assert not drive.nacks and len(drive.key_frame_requests) == 1 and len(drive.frames) > 50


def test_recent_packets_are_kept_for_retransmission_with_their_key() -> None:
    encryptor = PacketEncryptor(KeySchedule(0.0), 1)
    encryptor.update_key(0.0)
    sent = [encryptor.encrypt(b"\x11" * 100, 0)[0] for _ in range(RETRANSMIT_BUFFER_PACKETS + 1)]
    source = int.from_bytes(sent[0][8:12], "big")
    assert encryptor.retransmit(source, [0, 1, RETRANSMIT_BUFFER_PACKETS, RETRANSMIT_BUFFER_PACKETS + 1]) == [
        sent[1],
        sent[RETRANSMIT_BUFFER_PACKETS],
    ]
    assert encryptor.retransmit(source + 256, [1]) == []


def test_frames_continue_from_a_key_frame_after_an_unrecovered_loss() -> None:
    drive = Drive()

    def lose(packets: list[bytes]) -> Iterable[bytes]:
        return packets[1:] if round(drive.now * 30) == 20 else packets

    drive.send(take(scenery(), 60), lose)
    results = drive.decoded()
    assert (
        drive.in_order()
        and len(drive.key_frame_requests) == 1
        and drive.key_frame_requests[0] - 20 / 30
        < 0.12 + NACK_TIMEOUT_ROUND_TRIPS * ROUND_TRIP_S + REORDER_TIMEOUT_INITIAL_S
    )
    assert 1 <= len(drive.nacks) <= NACKS_MAX
    missing = sorted(drive.images.keys() - {frame.captured for frame in drive.frames})
    assert missing == list(range(20 * FRAME_INTERVAL_NS, missing[-1] + 1, FRAME_INTERVAL_NS)) and len(missing) <= 9
    assert next(frame for frame in drive.frames if frame.captured > missing[-1]).key
    assert all(psnr(image, drive.images[frame.captured]) > 30 for frame, image in results)
    counts = drive.receiver.frames()[3]
    assert counts["broken"] == len(missing) and counts["lost"] == 1 and counts["frames"] == 60 - len(missing)


def test_unanswered_key_frame_request_is_repeated_at_its_interval() -> None:
    drive = Drive()
    drive.encoder.request_key_frame = lambda: None  # type: ignore[method-assign]
    drive.send(take(scenery(), 90), lambda packets: packets if drive.now else packets[1:])
    assert not drive.frames and 8 <= len(drive.key_frame_requests) <= 3.0 / KEY_FRAME_REQUEST_INTERVAL_S + 1


@pytest.mark.parametrize("loss", [0.01, 0.1, 0.3])
def test_output_frames_are_correct_at_any_loss(loss: float) -> None:
    drive, rng = Drive(), random.Random(1)

    def link(packets: list[bytes]) -> Iterable[bytes]:
        kept = [packet for packet in packets for _ in range(2) if rng.random() > loss]
        rng.shuffle(kept)
        return kept

    drive.send(take(scenery(), 150), link)
    assert drive.in_order() and len(drive.frames) > 150 * (1 - 2.5 * loss)
    assert all(psnr(image, drive.images[frame.captured]) > 28 for frame, image in drive.decoded())


def test_key_is_renewed_in_mid_stream() -> None:
    drive = Drive(key_lifetime=1.99)
    drive.send(take(scenery(), 150))
    assert len(drive.frames) == 150 and drive.in_order() and not drive.key_frame_requests
    assert [i for i, frame in enumerate(drive.frames) if frame.key] == [0, 60, 120]
    counts = drive.receiver.frames()[3]
    assert (counts["frames"], counts["lost"], counts["received"]) == (150, 0, sum_of_packets(drive))


def test_camera_changes_its_frame_size() -> None:
    drive, images = Drive(), scenery()
    drive.send(take(images, 20))
    start = 20 * FRAME_INTERVAL_NS
    drive.send(CameraFrame(one.image, one.captured + start) for one in take(scenery(481, 361), 20))
    drive.plan = EncodingPlan(bitrate=800_000, scale=0.5)
    drive.send(CameraFrame(one.image, one.captured + 2 * start) for one in take(scenery(481, 361), 20))
    assert len(drive.frames) == 60
    assert [frame.key for frame in drive.frames] == [i % 20 == 0 for i in range(60)]
    assert [(frame.width, frame.height) for frame in drive.frames[::20]] == [(320, 240), (480, 360), (240, 180)]
    assert all(image.shape == (frame.height, frame.width, 3) for frame, image in drive.decoded())


def test_forged_packets_do_not_disturb_the_video() -> None:
    drive, rng = Drive(), np.random.default_rng(0)

    def link(packets: list[bytes]) -> Iterable[bytes]:
        for packet in packets:
            for _ in range(5):
                yield packet[:12] + rng.bytes(len(packet) - 12)
                yield rng.bytes(200)
                yield bytes([packet[0], packet[1]]) + rng.bytes(2) + packet[4:]  # another sequence number
            yield packet

    drive.send(take(scenery(), 30), link)
    assert len(drive.decoded()) == 30 and not drive.key_frame_requests
    counts = drive.receiver.counts
    assert counts["forged"] >= 5 * sum_of_packets(drive) and set(drive.receiver.frames()) == {3}
    assert sum(counts.values()) == 15 * sum_of_packets(drive)


def test_report_has_the_statistics_of_reception() -> None:
    drive, images = Drive(), scenery()

    def late(packets: list[bytes]) -> Iterable[bytes]:
        drive.now += 0.025
        return packets

    drive.send(take(images, 30), late)
    drive.receiver.reports()
    drive.send(take(images, 15), late)
    drive.send(take(images, 15), lambda packets: packets if round(30 * drive.now) % 3 else (), name="wifi")
    drive.now = 2.0
    [report] = drive.receiver.reports()
    assert report.camera == 3 and report.delay == pytest.approx(25, abs=0.1)
    assert set(report.links) == {"lte", "wifi"} and report.links["lte"] > 1000
    assert 4 <= report.lost <= 15 and 25 <= report.received <= 40
    [after] = drive.receiver.reports()
    assert (after.received, after.lost, after.delay, after.links) == (0, 0, None, {})


def packet_of(sequence: int, key: bool = False, first: bool = True, last: bool = True) -> rtp_packets.Packet:
    return rtp_packets.Packet(sequence & 0xFFFF, 1, 0, sequence & 0x7FFF, first, last, b"\x10" if key else b"\x11")


def test_reorder_timeout_adapts_to_reordering_delays() -> None:
    timeout = ReorderTimeout()
    assembler, sent = FrameAssembler(timeout, lambda: ROUND_TRIP_S), 300
    arrivals = sorted((i * 0.033 + 0.07 * (i % 2), i) for i in range(sent))  # every other packet over a slower link
    key_frame_requests, output = [], 0
    for now, i in arrivals:
        output += len(list(assembler.add(packet_of(i, key=i == 0), now)))
        key_frame_requests.append(assembler.needs_key_frame)
    assert output == sent and not any(key_frame_requests[10:])
    # the packet over the fast link arrives 33 ms after the one before it
    assert 0.07 - 0.033 < timeout.seconds <= REORDER_TIMEOUT_MAX_S


def test_sequence_numbers_wrap() -> None:
    assembler = FrameAssembler(ReorderTimeout(), lambda: ROUND_TRIP_S)
    output = [len(list(assembler.add(packet_of(65_000 + i, key=i == 0), i / 30))) for i in range(70_000)]
    assert set(output) == {1} and assembler.counts["lost"] == 0


def test_buffer_is_bounded() -> None:
    assembler = FrameAssembler(ReorderTimeout(), lambda: ROUND_TRIP_S)
    for i in range(5 * BUFFER_MAX_PACKETS):
        list(assembler.add(packet_of(i, first=False, last=False), i / 1000))
    assert len(assembler._buffer) == BUFFER_MAX_PACKETS and assembler.needs_key_frame

from __future__ import annotations

import itertools
import random
from collections.abc import Iterable

import numpy as np
import pytest

from scan2sim.services.teleoperation.cameras import Picture
from scan2sim.services.teleoperation.video import rtp_packets
from scan2sim.services.teleoperation.video.jitter_buffer import (
    AGAIN,
    ASKED,
    FIRST,
    HELD,
    LONGEST,
    TRIPS,
    Assembly,
    Patience,
)
from scan2sim.services.teleoperation.video.rate_control import Plan
from scan2sim.services.teleoperation.video.srtp_session import RECENT, Keys, Sealer
from tests.services.teleoperation.video.videos import STEP, TRIP, Drive, psnr, scenery

take = itertools.islice


def test_pictures_come_as_they_were_sent() -> None:
    drive = Drive()
    drive.send(take(scenery(), 40))
    seen = drive.decoded()
    assert [frame.captured for frame, _ in seen] == list(drive.pictures) and drive.in_order()
    assert all((frame.camera, frame.width, frame.height) == (3, 320, 240) for frame, _ in seen)
    assert [frame.key for frame, _ in seen] == [True] + [False] * 39
    assert np.median([psnr(image, drive.pictures[frame.captured]) for frame, image in seen]) > 30
    counts = drive.watcher.frames()[3]
    assert counts == {"frames": 40, "broken": 0, "received": sum_of_packets(drive), "lost": 0, "mended": 0}
    assert not drive.wanted[1:] and not drive.watcher.counts


def sum_of_packets(drive: Drive) -> int:
    return drive.coder.counts["packets"]


def test_order_and_doubles_change_nothing() -> None:
    drive, rng = Drive(), random.Random(0)

    def link(packets: list[bytes]) -> Iterable[bytes]:
        twice = packets * 2
        rng.shuffle(twice)
        return twice

    drive.send(take(scenery(), 40), link)
    assert len(drive.decoded()) == 40 and drive.in_order() and len(drive.wanted) <= 1
    assert drive.watcher.counts == {"doubled": sum_of_packets(drive)}


def test_pictures_that_overtake_each_other_wait() -> None:
    drive, held = Drive(), list[bytes]()

    def swap(packets: list[bytes]) -> Iterable[bytes]:
        """Every other picture comes just after its successor."""
        if held or drive.now == 0.0:
            both = [*packets, *held]
            held.clear()
            return both
        held.extend(packets)
        return ()

    drive.send(take(scenery(), 41), swap)
    assert len(drive.decoded()) == 41 and drive.in_order() and len(drive.wanted) == 0


def test_what_is_lost_is_sent_again_and_nothing_is_left_out() -> None:
    drive = Drive(mends=True)
    drive.send(take(scenery(), 60), lambda packets: packets[1:] if round(drive.now * 30) in (20, 40) else packets)
    assert len(drive.frames) == 60 and drive.in_order() and not drive.wanted and len(drive.asked) == 2
    assert all(psnr(image, drive.pictures[frame.captured]) > 28 for frame, image in drive.decoded())
    counts = drive.watcher.frames()[3]
    assert (counts["broken"], counts["lost"], counts["mended"]) == (0, 0, 2) and drive.coder.counts["again"] == 2
    [report] = drive.watcher.reports()
    assert (report.received, report.lost) == (sum_of_packets(drive) - 2, 2), "the rate is to follow what links lose"


@pytest.mark.parametrize("loss", [0.01, 0.05])
def test_one_link_that_loses_packets_breaks_few_pictures(loss: float) -> None:
    broken = {}
    for mends in (False, True):
        drive, rng = Drive(mends=mends), random.Random(2)
        drive.send(take(scenery(640, 480), 900), lambda packets: [one for one in packets if rng.random() > loss])  # noqa: B023
        broken[mends] = drive.watcher.frames()[3]["broken"]
        assert drive.in_order()
    assert broken[True] < broken[False] / 5


def test_of_many_that_lack_none_is_asked_for() -> None:
    drive = Drive(plan=Plan(bitrate=2_000_000), mends=True)
    drive.send(take(scenery(640, 480), 90), lambda packets: packets if not 30 < drive.now * 30 < 60 else ())
    assert not drive.asked and len(drive.wanted) == 1 and len(drive.frames) > 50


def test_packets_are_kept_for_a_while_and_of_the_key_they_were_sent_by() -> None:
    sealer = Sealer(Keys(0.0), 1)
    sealer.renew(0.0)
    sent = [sealer.seal(b"\x11" * 100, 0)[0] for _ in range(RECENT + 1)]
    source = int.from_bytes(sent[0][8:12], "big")
    assert sealer.again(source, [0, 1, RECENT, RECENT + 1]) == [sent[1], sent[RECENT]]
    assert sealer.again(source + 256, [1]) == []


def test_after_a_loss_that_is_not_mended_frames_go_on_from_a_key_frame() -> None:
    drive = Drive()

    def lose(packets: list[bytes]) -> Iterable[bytes]:
        return packets[1:] if round(drive.now * 30) == 20 else packets

    drive.send(take(scenery(), 60), lose)
    seen = drive.decoded()
    assert drive.in_order() and len(drive.wanted) == 1 and drive.wanted[0] - 20 / 30 < 0.12 + TRIPS * TRIP + FIRST
    assert 1 <= len(drive.asked) <= ASKED
    missing = sorted(drive.pictures.keys() - {frame.captured for frame in drive.frames})
    assert missing == list(range(20 * STEP, missing[-1] + 1, STEP)) and len(missing) <= 9
    assert next(frame for frame in drive.frames if frame.captured > missing[-1]).key
    assert all(psnr(image, drive.pictures[frame.captured]) > 30 for frame, image in seen)
    counts = drive.watcher.frames()[3]
    assert counts["broken"] == len(missing) and counts["lost"] == 1 and counts["frames"] == 60 - len(missing)


def test_without_an_answer_a_key_frame_is_wanted_again_and_not_more_often() -> None:
    drive = Drive()
    drive.coder.want_key = lambda: None  # type: ignore[method-assign]
    drive.send(take(scenery(), 90), lambda packets: packets if drive.now else packets[1:])
    assert not drive.frames and 8 <= len(drive.wanted) <= 3.0 / AGAIN + 1


@pytest.mark.parametrize("loss", [0.01, 0.1, 0.3])
def test_whatever_is_lost_what_is_shown_is_right(loss: float) -> None:
    drive, rng = Drive(), random.Random(1)

    def link(packets: list[bytes]) -> Iterable[bytes]:
        kept = [packet for packet in packets for _ in range(2) if rng.random() > loss]
        rng.shuffle(kept)
        return kept

    drive.send(take(scenery(), 150), link)
    assert drive.in_order() and len(drive.frames) > 150 * (1 - 2.5 * loss)
    assert all(psnr(image, drive.pictures[frame.captured]) > 28 for frame, image in drive.decoded())


def test_a_key_is_renewed_in_mid_stream() -> None:
    drive = Drive(every=1.99)
    drive.send(take(scenery(), 150))
    assert len(drive.frames) == 150 and drive.in_order() and not drive.wanted
    assert [i for i, frame in enumerate(drive.frames) if frame.key] == [0, 60, 120]
    counts = drive.watcher.frames()[3]
    assert (counts["frames"], counts["lost"], counts["received"]) == (150, 0, sum_of_packets(drive))


def test_a_camera_changes_its_size() -> None:
    drive, pictures = Drive(), scenery()
    drive.send(take(pictures, 20))
    start = 20 * STEP
    drive.send(Picture(one.image, one.captured + start) for one in take(scenery(481, 361), 20))
    drive.plan = Plan(bitrate=800_000, scale=0.5)
    drive.send(Picture(one.image, one.captured + 2 * start) for one in take(scenery(481, 361), 20))
    assert len(drive.frames) == 60
    assert [frame.key for frame in drive.frames] == [i % 20 == 0 for i in range(60)]
    assert [(frame.width, frame.height) for frame in drive.frames[::20]] == [(320, 240), (480, 360), (240, 180)]
    assert all(image.shape == (frame.height, frame.width, 3) for frame, image in drive.decoded())


def test_forged_packets_leave_the_picture_alone() -> None:
    drive, rng = Drive(), np.random.default_rng(0)

    def link(packets: list[bytes]) -> Iterable[bytes]:
        for packet in packets:
            for _ in range(5):
                yield packet[:12] + rng.bytes(len(packet) - 12)
                yield rng.bytes(200)
                yield bytes([packet[0], packet[1]]) + rng.bytes(2) + packet[4:]  # another number
            yield packet

    drive.send(take(scenery(), 30), link)
    assert len(drive.decoded()) == 30 and not drive.wanted
    counts = drive.watcher.counts
    assert counts["forged"] >= 5 * sum_of_packets(drive) and set(drive.watcher.frames()) == {3}
    assert sum(counts.values()) == 15 * sum_of_packets(drive)


def test_a_report_tells_how_it_came() -> None:
    drive, pictures = Drive(), scenery()

    def late(packets: list[bytes]) -> Iterable[bytes]:
        drive.now += 0.025
        return packets

    drive.send(take(pictures, 30), late)
    drive.watcher.reports()
    drive.send(take(pictures, 15), late)
    drive.send(take(pictures, 15), lambda packets: packets if round(30 * drive.now) % 3 else (), name="wifi")
    drive.now = 2.0
    [report] = drive.watcher.reports()
    assert report.camera == 3 and report.delay == pytest.approx(25, abs=0.1)
    assert set(report.links) == {"lte", "wifi"} and report.links["lte"] > 1000
    assert 4 <= report.lost <= 15 and 25 <= report.received <= 40
    [after] = drive.watcher.reports()
    assert (after.received, after.lost, after.delay, after.links) == (0, 0, None, {})


def some(sequence: int, key: bool = False, first: bool = True, last: bool = True) -> rtp_packets.Packet:
    return rtp_packets.Packet(sequence & 0xFFFF, 1, 0, sequence & 0x7FFF, first, last, b"\x10" if key else b"\x11")


def test_packets_are_waited_for_as_long_as_they_come_late() -> None:
    patience = Patience()
    assembly, sent = Assembly(patience, lambda: TRIP), 300
    arrivals = sorted((i * 0.033 + 0.07 * (i % 2), i) for i in range(sent))  # every other by a slower link
    wanted, given = [], 0
    for now, i in arrivals:
        given += len(list(assembly.add(some(i, key=i == 0), now)))
        wanted.append(assembly.wants)
    assert given == sent and not any(wanted[10:])
    assert 0.07 - 0.033 < patience.seconds <= LONGEST  # after the one by the quick link, which came 33 ms later


def test_numbers_begin_again() -> None:
    assembly = Assembly(Patience(), lambda: TRIP)
    given = [len(list(assembly.add(some(65_000 + i, key=i == 0), i / 30))) for i in range(70_000)]
    assert set(given) == {1} and assembly.counts["lost"] == 0


def test_what_waits_is_bounded() -> None:
    assembly = Assembly(Patience(), lambda: TRIP)
    for i in range(5 * HELD):
        list(assembly.add(some(i, first=False, last=False), i / 1000))
    assert len(assembly._held) == HELD and assembly.wants

"""Video's encryption: SRTP by AES-256 in GCM (RFC 3711, RFC 7714); keys are made fresh, and changed during a drive.

Keys go to the station as messages (`messages.Key`) over the encrypted links. Each is a generation, and each camera a
source in it: SSRC = generation << 8 | camera. With the generation, packets are counted from 0 again, so whoever has the
key can read from any of its packets on.
"""

from __future__ import annotations

import secrets
import threading
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

from pylibsrtp import Error, Policy, Session

from scan2sim.services.teleoperation.control.messages import Key
from scan2sim.services.teleoperation.video import rtp_packets

SECRET = 44
"""Bytes of a key and its salt."""
EVERY = 120.0
"""Seconds that a key is used, at most."""
READABLE = 0.9 * 2**15
"""Packets of a camera by one key: who learns it later can still tell their numbers, which have 16 bits."""
AHEAD = 5.0
"""Seconds that a key is told before it is used, as messages may be lost."""
LASTING = 5.0
"""Seconds that packets of an earlier key are taken after the first of a later one."""
RECENT = 512
"""Packets of a camera that are kept, to be sent again: a second of them, or more."""
WINDOW = 1024
"""Packets before the newest that are still taken by a station: more than are kept."""
KEPT = 3
"""Keys that a station holds at most."""


def lasting(bitrate: float, fps: float) -> float:
    """Seconds that a key may be used for, of cameras that send at most so many bits and pictures a second."""
    return min(EVERY, READABLE / (bitrate / 8 / rtp_packets.LARGEST + fps))


def _policy(key: Key, direction: int) -> Policy:
    made = Policy(key.secret, direction, 0, Policy.SRTP_PROFILE_AEAD_AES_256_GCM)
    made.window_size = WINDOW
    return made


class Keys:
    """A vehicle's keys for one station: no other ever has them. All cameras' threads may ask."""

    def __init__(self, now: float, every: float = EVERY) -> None:
        """From now on, seconds of any clock."""
        self._every = every
        self._lock = threading.Lock()
        self._used = _fresh(secrets.randbelow(1 << 24))
        self._next: Key | None = None
        self._until = now + every

    def used(self, now: float) -> Key:
        """What packets are encrypted by."""
        with self._lock:
            if now >= self._until:
                self._used, self._next = self._next or _fresh(self._used.generation + 1), None
                self._until = now + self._every
            return self._used

    def told(self, now: float) -> tuple[Key, ...]:
        """What the station is to be told, again and again, once a second or so: the key in use, and soon the next."""
        used = self.used(now)
        with self._lock:
            if self._next is None and now >= self._until - AHEAD:
                self._next = _fresh(used.generation + 1)
            return (used,) if self._next is None else (used, self._next)


def _fresh(generation: int) -> Key:
    return Key(generation & 0xFFFFFF, secrets.token_bytes(SECRET))


class Sealer:
    """A camera's pictures, as packets that only the station can read."""

    def __init__(self, keys: Keys, camera: int) -> None:
        self._keys, self._camera = keys, camera
        self._key: Key | None = None
        self._session: Session | None = None
        self._sequence = self._number = 0
        self._recent: dict[tuple[int, int], bytes] = {}

    def renew(self, now: float) -> bool:
        """Go over to the key that is to be used now; whether it is another: then a key frame is due."""
        key = self._keys.used(now)
        if key is self._key:
            return False
        self._key, self._session, self._sequence = key, Session(_policy(key, Policy.SSRC_ANY_OUTBOUND)), 0
        return True

    def seal(self, data: bytes, captured: int) -> list[bytes]:
        """A picture's packets; `captured`: nanoseconds of the vehicle's monotonic clock."""
        assert self._key and self._session, "renew() comes first"
        source = self._key.generation << 8 | self._camera
        plain = rtp_packets.packets(data, source, self._sequence, self._number, captured)
        sealed = [self._session.protect(packet) for packet in plain]
        for i, packet in enumerate(sealed, self._sequence):
            self._recent[source, i & 0xFFFF] = packet
        while len(self._recent) > RECENT:
            del self._recent[next(iter(self._recent))]
        self._sequence += len(plain)
        self._number += 1
        return sealed

    def again(self, source: int, sequences: Iterable[int]) -> list[bytes]:
        """Packets as they were sent, those that are still kept. May be called in any thread."""
        found = (self._recent.get((source, sequence)) for sequence in sequences)
        return [packet for packet in found if packet is not None]


class _Open(NamedTuple):
    key: Key
    session: Session


class Opener:
    """A station's side: the vehicle's packets, each once; others are counted. For one thread at a time.

    Attributes:
        counts: packets that were dropped, by why: `doubled`, `late` (too late to know whether doubled), `forged`,
            `keyless` (their key isn't there, or not any more), `malformed`.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._open: dict[int, _Open] = {}
        self._newest = -1
        self._newest_since = 0.0

    def learn(self, key: Key) -> None:
        """Take a key; one that is known already changes nothing."""
        known = self._open.get(key.generation)
        if known is None or known.key.secret != key.secret:
            self._open[key.generation] = _Open(key, Session(_policy(key, Policy.SSRC_ANY_INBOUND)))
        while len(self._open) > KEPT:
            del self._open[next(iter(self._open))]

    def open(self, packet: bytes, now: float) -> bytes | None:
        """The RTP packet in it; None: it is none of the vehicle's, or came before."""
        if len(packet) < rtp_packets.HEADER.size:
            self.counts["malformed"] += 1
            return None
        generation = int.from_bytes(packet[8:11], "big")
        found = self._open.get(generation)
        if found is None:
            self.counts["keyless"] += 1
            return None
        try:
            plain = found.session.unprotect(packet)
        except Error as error:
            self.counts[_WHY.get(str(error), "forged")] += 1
            return None
        except ValueError:
            self.counts["malformed"] += 1
            return None
        self._retire(generation, now)
        return plain

    def _retire(self, generation: int, now: float) -> None:
        """Forget keys before the one that was seen last, some time after it was seen first."""
        if self._newest not in self._open or _later(generation, self._newest):
            self._newest, self._newest_since = generation, now
        elif len(self._open) > 1 and now > self._newest_since + LASTING:
            for old in [one for one in self._open if _later(self._newest, one)]:
                del self._open[old]


def _later(generation: int, other: int) -> bool:
    return 0 < (generation - other) & 0xFFFFFF < 1 << 23


_WHY = {
    "replay check failed (bad index)": "doubled",
    "replay check failed (index too old)": "late",
    "can't process as much data as requested": "malformed",
    "error parsing data": "malformed",
    "unsupported parameter": "malformed",
}
"""What libsrtp says, to what it is counted as."""

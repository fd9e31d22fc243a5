"""Video encryption: SRTP with AES-256-GCM (RFC 3711, RFC 7714), with random keys that are replaced during a drive.

Keys are sent to the station as messages (`messages.VideoKey`) over the encrypted links. Each key is a generation, and
each camera a source in it: SSRC = generation << 8 | camera. Packet numbers restart from 0 with each generation, so a
station that has the key can decrypt from any of its packets on.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

from pylibsrtp import Error, Policy, Session

from scan2sim.services.teleoperation.control.messages import VideoKey
from scan2sim.services.teleoperation.video import rtp_packets

SECRET_BYTES = 44
"""Length of a key with its salt."""
KEY_LIFETIME_MAX_S = 120.0
"""Maximum time for which a key is used."""
PACKETS_PER_KEY_MAX = 0.9 * 2**15
"""Packets of a camera per key: limited so that a station that joins late can reconstruct the 16-bit packet numbers."""
KEY_ANNOUNCE_S = 5.0
"""Time before its use at which a key is announced, since messages may be lost."""
OLD_KEY_LIFETIME_S = 5.0
"""Time for which packets of an old key are accepted after the first one of a newer key."""
RETRANSMIT_BUFFER_PACKETS = 512
"""Packets of a camera kept for retransmission: at least a second of video."""
REPLAY_WINDOW_PACKETS = 1024
"""Replay window of the station: packets before the newest that are accepted; exceeds the retransmission buffer."""
KEYS_MAX = 3
"""Maximum number of keys that a station keeps."""


def key_lifetime(bitrate: float, fps: float) -> float:
    """Time for which a key may be used, seconds, for cameras limited to this bit rate (bit/s) and frame rate."""
    return min(KEY_LIFETIME_MAX_S, PACKETS_PER_KEY_MAX / (bitrate / 8 / rtp_packets.PAYLOAD_MAX_BYTES + fps))


def _policy(key: VideoKey, direction: int) -> Policy:
    policy = Policy(key.secret, direction, 0, Policy.SRTP_PROFILE_AEAD_AES_256_GCM)
    policy.window_size = REPLAY_WINDOW_PACKETS
    return policy


class KeySchedule:
    """Keys of a vehicle for one station, which no other station ever gets; thread-safe."""

    def __init__(self, now: float, lifetime_s: float = KEY_LIFETIME_MAX_S) -> None:
        """`now`: current time, seconds of any clock."""
        self._lifetime_s = lifetime_s
        self._lock = threading.Lock()
        self._current = _new_key(secrets.randbelow(1 << 24))
        self._next: VideoKey | None = None
        self._valid_until = now + lifetime_s

    def current(self, now: float) -> VideoKey:
        """The key to encrypt with."""
        with self._lock:
            if now >= self._valid_until:
                self._current, self._next = self._next or _new_key(self._current.generation + 1), None
                self._valid_until = now + self._lifetime_s
            return self._current

    def announced(self, now: float) -> tuple[VideoKey, ...]:
        """Keys to send to the station, about once a second: the current one, and soon before its use the next."""
        used = self.current(now)
        with self._lock:
            if self._next is None and now >= self._valid_until - KEY_ANNOUNCE_S:
                self._next = _new_key(used.generation + 1)
            return (used,) if self._next is None else (used, self._next)


def _new_key(generation: int) -> VideoKey:
    return VideoKey(generation & 0xFFFFFF, secrets.token_bytes(SECRET_BYTES))


class PacketEncryptor:
    """Encrypts a camera's frames into packets for the station."""

    def __init__(self, keys: KeySchedule, camera: int) -> None:
        self._keys, self._camera = keys, camera
        self._key: VideoKey | None = None
        self._session: Session | None = None
        self._sequence = self._number = 0
        self._buffer: dict[tuple[int, int], bytes] = {}

    def update_key(self, now: float) -> bool:
        """Switch to the current key; returns whether it changed, so that a key frame is needed."""
        key = self._keys.current(now)
        if key is self._key:
            return False
        self._key, self._session, self._sequence = key, Session(_policy(key, Policy.SSRC_ANY_OUTBOUND)), 0
        return True

    def encrypt(self, data: bytes, captured: int) -> list[bytes]:
        """Encrypted packets of a frame; `captured`: nanoseconds of the vehicle's monotonic clock."""
        assert self._key and self._session, "update_key() must be called first"
        source = self._key.generation << 8 | self._camera
        plain = rtp_packets.packetize(data, source, self._sequence, self._number, captured, time.monotonic_ns())
        encrypted = [self._session.protect(packet) for packet in plain]
        for i, packet in enumerate(encrypted, self._sequence):
            self._buffer[source, i & 0xFFFF] = packet
        while len(self._buffer) > RETRANSMIT_BUFFER_PACKETS:
            del self._buffer[next(iter(self._buffer))]
        self._sequence += len(plain)
        self._number += 1
        return encrypted

    def retransmit(self, source: int, sequences: Iterable[int]) -> list[bytes]:
        """Packets as they were sent, as far as still buffered; thread-safe."""
        key_session = (self._buffer.get((source, sequence)) for sequence in sequences)
        return [packet for packet in key_session if packet is not None]


class _KeySession(NamedTuple):
    key: VideoKey
    session: Session


class PacketDecryptor:
    """Decrypts a vehicle's packets at the station, each once; dropped packets are counted. Not thread-safe.

    Attributes:
        counts: number of dropped packets, by reason: `duplicates`, `late` (before the replay window), `forged`,
            `keyless` (key not yet received, or expired), `malformed`.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._sessions: dict[int, _KeySession] = {}
        self._newest = -1
        self._newest_since = 0.0

    def add_key(self, key: VideoKey) -> None:
        """Add a key; a known key changes nothing."""
        known = self._sessions.get(key.generation)
        if known is None or known.key.secret != key.secret:
            self._sessions[key.generation] = _KeySession(key, Session(_policy(key, Policy.SSRC_ANY_INBOUND)))
        while len(self._sessions) > KEYS_MAX:
            del self._sessions[next(iter(self._sessions))]

    def decrypt(self, packet: bytes, now: float) -> bytes | None:
        """The RTP packet inside; None: it is not from the vehicle, or was received before."""
        if len(packet) < rtp_packets.HEADER.size:
            self.counts["malformed"] += 1
            return None
        generation = int.from_bytes(packet[8:11], "big")
        key_session = self._sessions.get(generation)
        if key_session is None:
            self.counts["keyless"] += 1
            return None
        try:
            plain = key_session.session.unprotect(packet)
        except Error as error:
            self.counts[_DROP_REASONS.get(str(error), "forged")] += 1
            return None
        except ValueError:
            self.counts["malformed"] += 1
            return None
        self._discard_old_keys(generation, now)
        return plain

    def _discard_old_keys(self, generation: int, now: float) -> None:
        """Discard keys older than the newest one in use, some time after its first use."""
        if self._newest not in self._sessions or _is_newer(generation, self._newest):
            self._newest, self._newest_since = generation, now
        elif len(self._sessions) > 1 and now > self._newest_since + OLD_KEY_LIFETIME_S:
            for old in [one for one in self._sessions if _is_newer(self._newest, one)]:
                del self._sessions[old]


def _is_newer(generation: int, other: int) -> bool:
    return 0 < (generation - other) & 0xFFFFFF < 1 << 23


_DROP_REASONS = {
    "replay check failed (bad index)": "duplicates",
    "replay check failed (index too old)": "late",
    "can't process as much data as requested": "malformed",
    "error parsing data": "malformed",
    "unsupported parameter": "malformed",
}
"""Error messages of libsrtp, and the reasons that they are counted as."""

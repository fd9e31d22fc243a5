"""Damage to files, drawn from a seed: as caused by interrupted copies, bad disks, careless edits or malice."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from random import Random

Damage = Callable[[bytes, Random], bytes]
INTEGERS = (0, 1, 127, 128, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63, 2**64 - 1)
FLOATS = (0.0, -1.0, 1e-300, 1e300, float("nan"), float("inf"), float("-inf"))
TEXTS = (
    "0", "-1", "nan", "inf", "-inf", "1e308", "1e999", "-0.0", "1" * 40, "9" * 5000, "0x10", "1,5", "1_000", "true",
    "x", "", " ", '""', "\u0661", "\0", "2011-09-26", "../../etc/passwd", "[" * 1200, "{", "\ufeff", "\r",
)  # fmt: skip
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_]+")


def cut(data: bytes, rng: Random) -> bytes:
    """Truncate, as an interrupted copy does."""
    return data[: rng.randrange(len(data) + 1)]


def flip(data: bytes, rng: Random) -> bytes:
    """Flip some bits, mostly near the beginning, where headers are."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 3, 30))):
        out[_offset(data, rng)] ^= 1 << rng.randrange(8)
    return bytes(out)


def blank(data: bytes, rng: Random) -> bytes:
    """Overwrite a range with zeros, as a disk does that lost a block."""
    at, length = _offset(data, rng), rng.choice((1, 8, 512, 4096))
    return data[:at] + bytes(min(length, len(data) - at)) + data[at + length :]


def noise(data: bytes, rng: Random) -> bytes:
    """Overwrite a range with random bytes."""
    at, length = _offset(data, rng), rng.choice((1, 4, 64, 1000))
    return data[:at] + rng.randbytes(min(length, len(data) - at)) + data[at + length :]


def drop(data: bytes, rng: Random) -> bytes:
    """Remove a range."""
    at = _offset(data, rng)
    return data[:at] + data[at + rng.choice((1, 2, 100, 2000)) :]


def repeat(data: bytes, rng: Random) -> bytes:
    """Repeat a range."""
    at = _offset(data, rng)
    end = at + rng.choice((1, 50, 1000))
    return data[:end] + data[at:end] + data[end:]


def number(data: bytes, rng: Random) -> bytes:
    """Overwrite bytes with a binary number of extreme value."""
    form, values = rng.choice(
        (("<B", INTEGERS), ("<H", INTEGERS), ("<I", INTEGERS), ("<Q", INTEGERS), ("<d", FLOATS), ("<f", FLOATS))
    )
    value: float = rng.choice(values)
    if form[1] in "BHIQ":
        value = int(value) % 2 ** (8 * struct.calcsize(form))
    elif form == "<f" and abs(value) == 1e300:
        value = 3e38
    body, at = struct.pack(form, value), _offset(data, rng)
    return data[:at] + body + data[at + len(body) :]


def replace(data: bytes, rng: Random) -> bytes:
    """Replace the whole file: empty, zeros, noise, an error page, doubled, reversed."""
    return rng.choice(
        (b"", b"\0" * 5000, rng.randbytes(3000), b"<html><body>404</body></html>", data + data, data[::-1])
    )


def token(data: bytes, rng: Random) -> bytes:
    """Replace a number or word of text."""
    found = list((NUMBER if rng.random() < 0.8 else WORD).finditer(data[:100_000]))
    if not found:
        return noise(data, rng)
    match = rng.choice(found)
    return data[: match.start()] + rng.choice(TEXTS).encode() + data[match.end() :]


def line(data: bytes, rng: Random) -> bytes:
    """Remove, duplicate, move or greatly lengthen a line of text."""
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    popped = lines.pop(at)
    kind = rng.randrange(4)
    if kind == 1:
        lines[at:at] = [popped, popped]
    elif kind == 2:
        lines.insert(rng.randrange(len(lines) + 1), popped)
    elif kind == 3:
        lines.insert(at, popped + popped[-1:] * 400_000)
    return b"\n".join(lines)


def punctuation(data: bytes, rng: Random) -> bytes:
    """Replace a separator, quote or bracket of text with another character; or prepend a byte order mark."""
    if rng.random() < 0.2:
        return b"\xef\xbb\xbf" + data
    signs = [i for i, byte in enumerate(data[:100_000]) if byte in b",;:= \t\"'[]{}<>/.\n"]
    if not signs:
        return noise(data, rng)
    at = rng.choice(signs)
    return data[:at] + rng.choice((b"", b";", b",", b'"', b"\n", b"[", b"}", b"\xff", b"\t")) + data[at + 1 :]


BINARY_DAMAGES: tuple[Damage, ...] = (cut, flip, blank, noise, drop, repeat, number, number, number, replace)
TEXT_DAMAGES: tuple[Damage, ...] = (token, token, token, token, line, punctuation)


def damaged(data: bytes, rng: Random) -> bytes:
    """Apply one damage, or two, to `data`; mostly text damages if it is text."""
    text = b"\0" not in data[:1000] and not any(byte > 126 for byte in data[:200])
    for _ in range(rng.choice((1, 1, 1, 2))):
        if data:
            data = rng.choice(TEXT_DAMAGES if text and rng.random() < 0.7 else BINARY_DAMAGES)(data, rng)
    return data


def _offset(data: bytes, rng: Random) -> int:
    """Random byte offset, in half of all cases within the first 400 bytes."""
    return rng.randrange(min(len(data), 400) if rng.random() < 0.5 else len(data)) if data else 0

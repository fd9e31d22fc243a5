"""Envelope: the trailer after a message's bytes."""

from __future__ import annotations

import pytest

from scan2sim.services.transport import envelope


@pytest.mark.parametrize("length", [0, 1, 4, 7, 1000])
def test_wrapping_and_unwrapping_preserves_the_message(length: int) -> None:
    data = bytes(range(256)) * 4
    wrapped = envelope.wrap(data[:length], 7, b"g" * 16, 123)
    message, header = envelope.unwrap(wrapped)
    assert bytes(message) == data[:length]
    assert header == envelope.Header(number=7, publisher=b"g" * 16, sent=123)
    assert len(wrapped) % 4 == 0  # else DDS's padding would follow the magic number


@pytest.mark.parametrize("data", [b"", b"abc", envelope.MAGIC, b"x" * 100])
def test_message_without_envelope_is_unchanged(data: bytes) -> None:
    message, header = envelope.unwrap(data)
    assert bytes(message) == data
    assert header is None

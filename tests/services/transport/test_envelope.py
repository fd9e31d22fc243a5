"""What follows a message's own bytes."""

from __future__ import annotations

import pytest

from scan2sim.services.transport import envelope


@pytest.mark.parametrize("length", [0, 1, 4, 7, 1000])
def test_a_message_comes_out_as_it_went_in(length: int) -> None:
    data = bytes(range(256)) * 4
    wrapped = envelope.wrapped(data[:length], 7, b"g" * 16, 123)
    opened, header = envelope.opened(wrapped)
    assert bytes(opened) == data[:length]
    assert header == envelope.Header(number=7, publisher=b"g" * 16, sent=123)
    assert len(wrapped) % 4 == 0  # as DDS pads it, or the mark would not be at the end


@pytest.mark.parametrize("data", [b"", b"abc", envelope.MARK, b"x" * 100])
def test_a_message_without_one_is_left_as_it_is(data: bytes) -> None:
    opened, header = envelope.opened(data)
    assert bytes(opened) == data
    assert header is None

"""Messages as they arrive from the bus: parsed strictly; what other programs leave there is rejected with a reason."""

from __future__ import annotations

import json
import logging
import math
from collections import Counter
from collections.abc import Callable
from typing import Any, NoReturn

from pydantic import ValidationError

from scan2sim.pipeline.core.errors import printable
from scan2sim.services.monitoring.record import SCHEMA, Record
from scan2sim.services.outbox import is_record_id

log = logging.getLogger(__name__)

MAX_RECORD_BYTES = 4 * 2**20
MAX_DETAIL_CHARS = 400
"""Characters of a rejection's reason that are kept."""
MAX_TIME_S = 1e11
"""Times are seconds since the epoch below this."""
INTEGER_BOUND = 2**63
"""Integers are smaller by amount: they fit 64 bits."""


class RejectedError(ValueError):
    """A message that can't be used. Its text is "REASON: DETAIL"; rejections are counted by reason."""


class Rejections:
    """Counts skipped messages by reason, and warns of the 1st, 10th, 100th, ...

    Attributes:
        counts: by reason.
        last: the last reason with its detail, printable.
    """

    def __init__(self, where: str, warn: Callable[[str], None] = log.warning) -> None:
        """`where`: what received the messages; `warn` is called with a message for the user."""
        self._where, self._warn, self.counts, self.last = where, warn, Counter[str](), ""

    def add(self, why: str | Exception) -> None:
        """Count a message; `why` is "REASON" or "REASON: DETAIL"."""
        self.counts[str(why).partition(": ")[0]] += 1
        self.last = printable(str(why)[:MAX_DETAIL_CHARS])
        number = self.counts.total()
        if str(number).strip("0") == "1":
            so_far = ", ".join(f"{reason} ({count})" for reason, count in self.counts.most_common())
            self._warn(f"{self._where}: skipped message number {number}: {self.last}. So far: {so_far}")


def load_json(body: str | bytes) -> Any:
    """Parse JSON that can be written again in any language: numbers fit 64 bits, text is Unicode.

    Raises:
        RejectedError: it is too large, isn't JSON, or a number is out of range.
    """
    if len(body) > MAX_RECORD_BYTES:
        raise RejectedError(f"too large: {len(body)} bytes")
    try:
        fields = json.loads(body, parse_int=_integer, parse_float=_finite, parse_constant=_reject_constant)
        json.dumps(fields, ensure_ascii=False).encode()  # fails for half of a surrogate pair
    except RejectedError:
        raise
    except UnicodeError:
        raise RejectedError("invalid JSON: not Unicode text") from None
    except RecursionError:
        raise RejectedError("invalid JSON: nested too deeply") from None
    except ValueError as error:
        raise RejectedError(f"invalid JSON: {error}") from None
    return fields


def parse_record(body: str | bytes) -> Record:
    """Parse and validate a record.

    Raises:
        RejectedError: it isn't a record, or a value is out of range.
    """
    return validated_record(load_json(body))


def validated_record(fields: Any) -> Record:
    """Validate a record's fields, as JSON has them.

    Raises:
        RejectedError: it isn't a record, or a value is out of range.
    """
    schema = fields.get("schema") if isinstance(fields, dict) else None
    if schema != SCHEMA:
        raise RejectedError(f"unknown schema: {'none' if schema is None else str(schema)[:MAX_DETAIL_CHARS]}")
    try:
        record = Record.model_validate(fields)
    except ValidationError as error:
        raise RejectedError(f"malformed: {first_error(error)}") from None
    check_record_id(record.id)
    if not 0 < record.period <= 86_400:
        raise RejectedError(f"malformed: a period of {record.period} s")
    if not 0 <= record.time < MAX_TIME_S:
        raise RejectedError(f"malformed: a time of {record.time} s")
    return record


def check_record_id(text: str) -> None:
    """Check the id of a record or event.

    Raises:
        RejectedError: it isn't one.
    """
    if not is_record_id(text):
        raise RejectedError(f"malformed: record id {text!r:.100}")


def first_error(error: ValidationError) -> str:
    """Field and cause of the first error that pydantic found."""
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"


def _integer(text: str) -> int:
    if len(text) > len(str(INTEGER_BOUND)) + 1 or abs(number := int(text)) >= INTEGER_BOUND:
        raise RejectedError(f"malformed: an integer of {len(text)} digits")
    return number


def _finite(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise RejectedError(f"malformed: {text[:20]} is out of range")
    return number


def _reject_constant(text: str) -> NoReturn:
    raise RejectedError(f"malformed: {text} is no number of JSON")

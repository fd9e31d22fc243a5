"""Notifications of alarms by webhook and e-mail: at least once, in order, retried until they are accepted.

[notify]
webhook = "https://example.com/alarms"   # POST of the alarm as JSON, the message as `text`
email = ["operator@example.com"]
smtp = "smtp.example.com:587"            # TLS by STARTTLS if the server offers it; port 465: TLS from the start
smtp_from = "scan2sim@example.com"
smtp_user = "scan2sim"
smtp_password_file = "/etc/scan2sim/smtp-password"
"""

from __future__ import annotations

import json
import logging
import smtplib
import ssl
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from email.message import EmailMessage
from pathlib import Path
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Params
from scan2sim.services import default_outbox
from scan2sim.services.credentials import redacted
from scan2sim.services.monitoring.events.schema import Alarm
from scan2sim.services.outbox import OutboxRecord, Sender, new_ids

log = logging.getLogger(__name__)

TIMEOUT_S = 10.0
"""Time for a server to answer."""
Address = Annotated[str, Field(pattern=r"^[^@\s<>,]+@[^@\s<>,]+$")]


class NotifyParams(Params):
    """Where notifications go."""

    webhook: Annotated[str, Field(pattern=r"^https?://\S+$", max_length=2000)] | None = None
    email: tuple[Address, ...] = ()
    smtp: Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]+:[0-9]{1,5}$")] = "localhost:25"
    smtp_from: Address = "scan2sim@localhost.localdomain"
    smtp_user: str = ""
    smtp_password_file: Path | None = None


class Notifier:
    """Sends notifications; each destination has its own outbox on disk, so that one that is down delays no other."""

    def __init__(self, params: NotifyParams, name: str) -> None:
        """`name`: of the alarm node, for the outboxes.

        Raises:
            InputError: the file with the password can't be read.
        """
        self._next_id = new_ids()
        sends: dict[str, Callable[[Sequence[OutboxRecord]], None]] = {}
        if params.webhook:
            sends["webhook"] = _Webhook(params.webhook).send
        if params.email:
            sends["email"] = _Mail(params).send
        self._outboxes = [default_outbox.open_outbox(f"{name}/notify", kind) for kind in sends]
        self._senders = [Sender(box, send) for box, send in zip(self._outboxes, sends.values(), strict=True)]

    def add(self, alarm: Alarm) -> None:
        """Store the notifications of an alarm on disk; `send` sends them."""
        body = json.dumps({"text": message(alarm), **alarm.model_dump()}).encode()
        for outbox in self._outboxes:
            outbox.append(self._next_id(), body)

    def send(self) -> None:
        """Send what was added; returns at once."""
        for sender in self._senders:
            sender.wake()

    def close(self) -> None:
        """Send pending notifications within a few seconds; the rest stays on disk for the next process."""
        for outbox, sender in zip(self._outboxes, self._senders, strict=True):
            sender.close()
            outbox.close()


def message(alarm: Alarm) -> str:
    """One line for people."""
    by = f", acknowledged by {alarm.acknowledged_by}" if alarm.acknowledged_by else ""
    return f"{alarm.state} {alarm.rule}: {alarm.subject}, {alarm.value:.4g}{by}"


class _Webhook:
    def __init__(self, url: str) -> None:
        self._url = url

    def send(self, records: Sequence[OutboxRecord]) -> None:
        """Post each record; one that the server refuses for good (4xx) is dropped with a warning.

        Raises:
            ConnectionError: the server doesn't answer, or can't accept it now.
        """
        for record in records:
            headers = {"Content-Type": "application/json", "Idempotency-Key": record.id}
            request = urllib.request.Request(self._url, record.body, headers)
            try:
                urllib.request.urlopen(request, timeout=TIMEOUT_S).close()
            except urllib.error.HTTPError as error:
                if error.code >= 500 or error.code == 429:
                    raise ConnectionError(f"the webhook {redacted(self._url)} answers {error.code}") from None
                log.warning("a notification was dropped: the webhook %s answers %d", redacted(self._url), error.code)
            except OSError as error:
                raise ConnectionError(f"the webhook {redacted(self._url)} can't be reached ({error})") from None


class _Mail:
    def __init__(self, params: NotifyParams) -> None:
        self._params, self._password = params, ""
        if path := params.smtp_password_file:
            try:
                self._password = path.read_text(encoding="utf-8").strip()
            except (OSError, UnicodeDecodeError) as error:
                raise InputError(path, f"can't be read ({error})", "Set notify.smtp_password_file") from None

    def send(self, records: Sequence[OutboxRecord]) -> None:
        """Send each record as a mail; one that the server refuses for good is dropped with a warning.

        Raises:
            ConnectionError: the server doesn't answer, or refuses the connection or the user.
        """
        host, _, port = self._params.smtp.rpartition(":")
        try:
            with self._connected(host, int(port)) as server:
                for record in records:
                    self._send(server, record)
        except (OSError, smtplib.SMTPException) as error:
            raise ConnectionError(f"mail server {self._params.smtp}: {error}") from None

    def _connected(self, host: str, port: int) -> smtplib.SMTP:
        context = ssl.create_default_context()
        if port == smtplib.SMTP_SSL_PORT:
            server: smtplib.SMTP = smtplib.SMTP_SSL(host, port, timeout=TIMEOUT_S, context=context)
        else:
            server = smtplib.SMTP(host, port, timeout=TIMEOUT_S)
            server.ehlo()
            if server.has_extn("starttls"):
                server.starttls(context=context)
        if self._params.smtp_user:
            server.login(self._params.smtp_user, self._password)
        return server

    def _send(self, server: smtplib.SMTP, record: OutboxRecord) -> None:
        fields = json.loads(record.body)
        mail = EmailMessage()
        mail["From"], mail["To"] = self._params.smtp_from, ", ".join(self._params.email)
        mail["Subject"] = " ".join(f"[scan2sim] {fields['text']}".split())[:200]
        mail["Message-ID"] = f"<{record.id.replace(':', '.')}@scan2sim>"
        mail.set_content("".join(f"{key}: {value}\n" for key, value in fields.items()))
        try:
            server.send_message(mail)
        except (smtplib.SMTPRecipientsRefused, smtplib.SMTPDataError) as error:
            log.warning("a notification was dropped: the mail server refuses it (%s)", error)

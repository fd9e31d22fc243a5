"""Credentials are redacted from URLs of any form; text without credentials is unchanged."""

from __future__ import annotations

import pytest

from scan2sim.services.credentials import redacted

CAMERA = "rtsp://***@camera.example:554/live"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("rtsp://admin:hunter2@camera.example:554/live", CAMERA),
        ("RTSP://admin:hunter2@camera.example:554/live", "RTSP://***@camera.example:554/live"),
        ("rtsp://admin@camera.example:554/live", CAMERA),
        ("rtsp://:hunter2@camera.example:554/live", CAMERA),
        ("rtsp://admin:hun@ter2@camera.example:554/live", CAMERA),
        ("rtsp://admin:hun/ter2@camera.example:554/live", CAMERA),
        ("rtsp://admin:hun?ter#2@camera.example:554/live", CAMERA),
        ("rtsp://admin:hunter 2@camera.example:554/live", CAMERA),
        ("rtsp://admin:hunter2@[fe80::1]:554/live", "rtsp://***@[fe80::1]:554/live"),
        ("rtsp:/admin:hunter2@camera.example:554/live", "rtsp:/***@camera.example:554/live"),
        ("rtsp://admin:hunter2@camera", "rtsp://***@camera"),
        ("http://camera/live?user=admin&password=hunter2&size=4", "http://camera/live?user=admin&password=***&size=4"),
        ("http://camera/live?pwd=hunter2", "http://camera/live?pwd=***"),
        ("http://camera/live?loginuse=a&loginpas=hunter2", "http://camera/live?loginuse=a&loginpas=***"),
        ("http://camera/live?Access_Token=hunter2#top", "http://camera/live?Access_Token=***"),
        ("http://a:hunter2@camera/live?token=hunter2", "http://***@camera/live?token=***"),
        ("https://s3/film?X-Amz-Signature=hunter2&X-Amz-Date=1", "https://s3/film?X-Amz-Signature=***&X-Amz-Date=1"),
        ("front=device:rtsp://admin:hunter2@camera/live", "front=device:rtsp://***@camera/live"),
        (
            "[Errno 111] Connection refused: 'rtsp://admin:hunter2@camera/live' (of http://a:hunter2@b/c)",
            "[Errno 111] Connection refused: 'rtsp://***@camera/live' (of http://***@b/c)",
        ),
    ],
)
def test_credentials_are_redacted(text: str, expected: str) -> None:
    assert redacted(text) == expected and "hunter" not in expected
    assert redacted(expected) == expected


@pytest.mark.parametrize(
    "text",
    [
        "0", "/dev/video0", "front", "/camera/image@1700000000", "rtsp://camera:554/live?channel=1&monkeys=2",
        "http://camera:8080/@front", "http://camera/live?design=2", "somebody@example.org", "C:/Users/me/film.mp4",
        "rtsp://[fe80::1]:554/live", "",
    ],
)  # fmt: skip
def test_text_without_credentials_is_unchanged(text: str) -> None:
    assert redacted(text) == text

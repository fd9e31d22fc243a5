"""Credentials are redacted from URLs of any form, and from answers that quote them; other text is unchanged."""

from __future__ import annotations

import pytest

from scan2sim.services.credentials import is_secret, redacted, secrets_of, without

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


def test_credentials_of_a_request_are_found_by_their_names() -> None:
    body = {
        "name": "core-site",
        "vim_password": "hunter2",
        "config": {"keypair": "laptop", "insecure": True, "token": "abc", "security_groups": ["default"]},
        "credentials": {"users": [{"user": {"client-key-data": "LS0t", "token": "hush"}}], "kind": "Config"},
    }
    assert set(secrets_of(body)) == {"hunter2", "LS0t", "hush"}  # "abc" is too short to be found in a message
    assert list(secrets_of(None)) == list(secrets_of(b"hunter2")) == []


@pytest.mark.parametrize("name", ["password", "os_passwd", "client_secret", "api_key", "APIKEY", "auth-token"])
def test_names_of_credentials(name: str) -> None:
    assert is_secret(name)


@pytest.mark.parametrize("name", ["keypair", "key_name", "security_groups", "keystone_region", "bypass_proxy", "user"])
def test_names_of_other_settings(name: str) -> None:
    assert not is_secret(name)


def test_quoted_credentials_are_redacted() -> None:
    secrets = ["hunter2", "hunter2-and-more", "it's \\ odd"]
    for secret in secrets:
        assert without(f"{secret!r} is too long", secrets) in ("'***' is too long", '"***" is too long')
    assert without("the name is too long", secrets) == "the name is too long"

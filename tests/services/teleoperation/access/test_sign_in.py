"""Sign-in at an OpenID provider: who is let in, what a wrong or hostile provider or browser gets, and when it ends."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra bus isn't installed")
pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
pytest.importorskip("websockets", reason="the extra teleop isn't installed")
pytest.importorskip("httpx", reason="the extra orchestration isn't installed")
import httpx
from fastapi.testclient import TestClient
from typer.testing import CliRunner
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from scan2sim.flows.cli import app as cli
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.teleoperation.access import drivers, sign_in
from scan2sim.services.teleoperation.access.drivers import DriverRole, Drivers
from scan2sim.services.teleoperation.access.oidc import Provider
from scan2sim.services.teleoperation.access.sign_in import SignedIn
from scan2sim.services.teleoperation.gateway.fleet import Fleet
from scan2sim.services.teleoperation.gateway.web import application
from scan2sim.services.teleoperation.settings import GatewayParams, StationParams
from tests.fakes.browser import chromium
from tests.fakes.openid import CLIENT, SECRET, FakeProvider, certified_provider
from tests.fakes.ports import free_port
from tests.services.teleoperation.pages import served
from tests.waiting import until


class FakeGateway:
    def alive(self) -> bool:
        return True


def settings(folder: Path, issuer: str, more: str = "") -> Path:
    """The settings of a provider."""
    (folder / "secret").write_text(f"{SECRET}\n", encoding="utf-8")
    file = folder / "oidc.toml"
    text = f'issuer = "{issuer}"\nclient_id = "{CLIENT}"\nclient_secret_file = "secret"\n'
    file.write_text(text + more, encoding="utf-8")
    return file


class Page:
    """A fleet page, and a browser that hasn't signed in."""

    def __init__(self, folder: Path, issuer: str, params: ServerParams | None = None) -> None:
        self.file, self.now = folder / "drivers.json", 0.0
        drivers.add(self.file, "anna", DriverRole.OPERATOR, login="anna@example.org")
        self.access = SignedIn(Drivers(self.file), Provider(settings(folder, issuer)), now=lambda: self.now)
        fleet = Fleet(folder / "state")
        self.app = application(params or ServerParams(), fleet, FakeGateway(), self.access)  # type: ignore[arg-type]
        self.browser = self.new_browser()

    def new_browser(self) -> TestClient:
        return TestClient(self.app, base_url="http://localhost", follow_redirects=False)

    def you(self, token: str) -> Any:
        answer = self.browser.get("/api/fleet", headers={"Authorization": f"Bearer {token}"})
        return answer.json()["you"] if answer.status_code == 200 else answer.status_code


@pytest.fixture
def provider() -> Iterator[FakeProvider]:
    with FakeProvider() as made:
        yield made


@pytest.fixture
def page(tmp_path: Path, provider: FakeProvider) -> Page:
    return Page(tmp_path, provider.issuer)


def returned(page: Page, provider: FakeProvider) -> str:
    """Path with which the provider sends the browser back."""
    sent = page.browser.get("/login")
    assert sent.status_code == 302, sent.text
    return provider.approve(sent.headers["Location"]).removeprefix("http://localhost")


def attempt(page: Page, provider: FakeProvider) -> Any:
    """Sign in; the last answer of the page."""
    return page.browser.get(returned(page, provider))


def session(answer: Any) -> str:
    assert answer.status_code == 303, answer.text
    where, _, token = answer.headers["Location"].partition("#session=")
    assert where == "/" and len(token) >= 43
    return token


def test_driver_signs_in_until_the_time_is_over_or_the_driver_is_revoked(page: Page, provider: FakeProvider) -> None:
    refused = page.browser.get("/api/fleet")
    assert refused.status_code == 401 and refused.json()["sign_in"] == "/login"
    token = session(attempt(page, provider))
    assert page.you(token) == {"name": "anna", "role": "operator"}
    page.now = 8 * 3600 - 1
    assert page.you(token) == {"name": "anna", "role": "operator"}
    page.now = 8 * 3600
    assert page.you(token) == 401
    token = session(attempt(page, provider))
    drivers.add(page.file, "anna", DriverRole.OBSERVER, login="anna@example.org")
    assert page.you(token) == {"name": "anna", "role": "observer"}, "the role is that of the file, at any time"
    drivers.revoke(page.file, "anna")
    assert page.you(token) == 401
    assert "is not one of the drivers here" in attempt(page, provider).text


def test_tokens_of_other_drivers_work_beside_the_sign_in(page: Page) -> None:
    token = drivers.add(page.file, "ben", DriverRole.OBSERVER)
    assert page.you(token) == {"name": "ben", "role": "observer"}
    assert page.you("anna@example.org") == page.you("") == 401


def test_stranger_is_named_and_not_let_in(page: Page, provider: FakeProvider) -> None:
    provider.login = "mallory@example.org"
    answer = attempt(page, provider)
    assert answer.status_code == 403 and "mallory@example.org: is not one of the drivers here" in answer.text


@pytest.mark.parametrize(
    ("claims", "expected"),
    [
        ({"iss": "http://127.0.0.1:1"}, "is of another issuer"),
        ({"aud": "other"}, "is for another client"),
        ({"aud": ["other", CLIENT], "azp": "other"}, "is for another client"),
        ({"exp": 1000}, "has expired"),
        ({"exp": None}, "has expired"),
        ({"nonce": "of yesterday"}, "is of another sign-in"),
        ({"nonce": None}, "is of another sign-in"),
        ({"email": None}, "has no claim `email`"),
        ({"email": ["anna@example.org"]}, "has no claim `email`"),
        ({"email_verified": False}, "hasn't verified"),
    ],
)
def test_id_tokens_that_are_not_for_this_sign_in_are_rejected(
    page: Page, provider: FakeProvider, claims: dict[str, Any], expected: str
) -> None:
    provider.claims = claims
    answer = attempt(page, provider)
    assert answer.status_code == 502 and expected in answer.text
    provider.claims = {"aud": [CLIENT]}
    assert page.you(session(attempt(page, provider))), "another attempt succeeds"


ODD = [b"", b"rubbish", b"[]", b"null", b"{}", b'{"id_token": 7}', b'{"id_token": "a.b.c"}', b'{"id_token": "..e30"}']


@pytest.mark.parametrize("body", [*ODD, b"[" * 100_000, b'{"id_token": "x.bnVsbA.y"}', b"\xff\xfe"])
@pytest.mark.parametrize("path", ["/token", "/.well-known/openid-configuration"])
def test_odd_answers_of_the_provider_are_a_sentence(page: Page, provider: FakeProvider, path: str, body: bytes) -> None:
    provider.answer = lambda where: (200, body) if where == path else None
    answer = page.browser.get("/login") if path != "/token" else attempt(page, provider)
    assert answer.status_code == 502 and answer.text.count("\n") == 1 and len(answer.text) < 500
    assert "Traceback" not in answer.text and provider.issuer in answer.text


@pytest.mark.parametrize(
    ("status", "body", "expected"),
    [
        (400, b'{"error": "invalid_grant", "error_description": "code expired"}', "(invalid_grant, code expired)"),
        (401, b'{"error": "invalid_client"}', "check client id and secret"),
        (403, b"<html>", "status 403"),
        (500, b"", "answers status 500"),
        (302, b"", "answers status 302"),
    ],
)
def test_rejections_of_the_provider_are_passed_on(
    page: Page, provider: FakeProvider, status: int, body: bytes, expected: str
) -> None:
    provider.answer = lambda path: (status, body) if path == "/token" else None
    assert expected in attempt(page, provider).text


def test_code_of_another_browser_or_of_yesterday_is_rejected(page: Page, provider: FakeProvider) -> None:
    path = returned(page, provider)
    victim = page.new_browser()
    assert "another browser" in victim.get(path).text, "an attacker's sign-in isn't foisted on somebody"
    assert session(page.browser.get(path))
    assert page.browser.get(path).status_code == 403, "it is used once"
    path = returned(page, provider)
    page.now += 601
    assert "took too long" in page.browser.get(path).text
    state = returned(page, provider).partition("state=")[2]
    rejected = page.browser.get(f"/login/callback?error=access_denied&state={state}")
    assert rejected.status_code == 403 and "rejected by the provider (access_denied)" in rejected.text
    for query in ("", "?state=", "?code=x", f"?state={state}", "?state=%C3%A9&code=x"):
        assert page.browser.get(f"/login/callback{query}").status_code == 403
    assert provider.seen.count("/token") == 1


def test_attempts_and_sessions_are_bounded(page: Page, provider: FakeProvider, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sign_in, "ATTEMPTS_MAX", 3)
    monkeypatch.setattr(sign_in, "SESSIONS_MAX", 2)
    first = returned(page, provider)
    for _ in range(3):
        page.new_browser().get("/login")
    assert "isn't known here" in page.browser.get(first).text
    tokens = [session(attempt(page, provider)) for _ in range(3)]
    assert [page.you(one) == 401 for one in tokens] == [True, False, False]


def test_provider_that_is_away_or_another_one_is_reported_once_in_a_while(tmp_path: Path) -> None:
    page = Page(tmp_path, f"http://127.0.0.1:{free_port()}")
    answer = page.browser.get("/login")
    assert answer.status_code == 502 and "can't be reached (" in answer.text and "Connection refused" in answer.text
    with FakeProvider() as provider:
        other = tmp_path / "other"
        other.mkdir()
        page = Page(other, f"{provider.issuer}/")
        assert f"calls itself {provider.issuer}" in page.browser.get("/login").text
        page.browser.get("/login")
        assert len(provider.seen) == 1, "a flood of sign-ins doesn't reach the provider"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('issuer = "http://login.example.org"\nclient_id = "a"', "not an https address"),
        ('issuer = "login.example.org"\nclient_id = "a"', "issuer"),
        ('client_id = "a"', "issuer"),
        ('issuer = "https://a"\nclient_id = "a"\nhours = 0', "hours"),
        ('issuer = "https://a"\nclient_id = "a"\nsecret = "x"', "secret"),
        ('issuer = "https://a"\nclient_id = "a"\nclient_secret_file = "gone"', "can't be read"),
        ('issuer = "https://a"\nclient_id = "a"\nclient_secret_file = "empty"', "is empty"),
        ('issuer = "https://a"\nclient_id = "a"\nca = "empty"', "can't be used as `ca`"),
        ('issuer = "https://a"\nclient_id = "a"\nca = "gone.pem"', "can't be used as `ca`"),
        ("issuer", "not valid TOML"),
    ],
)
def test_wrong_settings_are_rejected_at_start(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "empty").touch()
    (tmp_path / "oidc.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=expected):
        Provider(tmp_path / "oidc.toml")


@pytest.mark.parametrize("kind", [GatewayParams, StationParams])
def test_sign_in_needs_drivers_and_both_protect_a_page(tmp_path: Path, kind: Callable[..., Any]) -> None:
    file = settings(tmp_path, "https://login.example.org")
    given = {"certificates": tmp_path, "oidc": file} | ({"gateway": "a"} if kind is StationParams else {})
    with pytest.raises(SettingError, match="needs the drivers"):
        sign_in.access(kind(**given))
    with pytest.raises(SettingError, match="nothing protects"):
        kind(**given, host="0.0.0.0")
    drivers.add(tmp_path / "drivers.json", "anna", DriverRole.DRIVER, login="anna@example.org")
    found = sign_in.access(kind(**given, host="0.0.0.0", drivers=tmp_path / "drivers.json"))
    assert isinstance(found, SignedIn)


def test_command_adds_logins_and_rejects_wrong_ones(tmp_path: Path) -> None:
    file = tmp_path / "drivers.json"

    def run(*words: str) -> Any:
        return CliRunner().invoke(cli, ["teleop", "drivers", str(file), *words])

    done = run("--add", "anna", "--login", "anna@example.org")
    assert "anna signs in as anna@example.org" in done.output and "token of" not in done.output
    for words, expected in (
        (("--add", "ben", "--login", "anna@example.org"), "is that of anna"),
        (("--add", "ben", "--login", ""), "is not a valid login"),
        (("--add", "ben", "--login", "a\nb"), "is not a valid login"),
        (("--login", "ben@example.org"), "is for a driver who is added"),
    ):
        done = run(*words)
        assert isinstance(done.exception, SettingError) and expected in str(done.exception)
    assert [one.name for one in drivers.read(file)] == ["anna"]


def test_driver_whose_session_ends_loses_control(tmp_path: Path, provider: FakeProvider) -> None:
    file, now = tmp_path / "drivers.json", 0.0
    drivers.add(file, "anna", DriverRole.DRIVER, login="anna@example.org")
    access = SignedIn(Drivers(file), Provider(settings(tmp_path, provider.issuer)), now=lambda: now)
    with served(tmp_path, ServerParams(port=0), access) as cockpit:
        with httpx.Client(base_url=cockpit.url, follow_redirects=False) as browser:
            sent = browser.get("/login")
            back = provider.approve(sent.headers["Location"])
            token = session(browser.get(back))
        cockpit.street.fleet.join("car", "desk", "operator")
        address, named = cockpit.url.replace("http", "ws") + "live", ["scan2sim", f"token.{token.encode().hex()}"]
        with connect(address, subprotocols=named) as socket:  # type: ignore[arg-type]
            socket.send('{"do": "take"}')
            holder = cockpit.desk.station.driver_session.holder
            until(lambda: (holder() or "").startswith("anna (page"))
            now = 8 * 3600.0
            until(lambda: holder() is None)
            with pytest.raises(ConnectionClosed):
                while True:
                    socket.recv(timeout=60)
        with pytest.raises(InvalidStatus):
            connect(address, subprotocols=named)  # type: ignore[arg-type]


def test_certified_provider_and_browser(tmp_path: Path) -> None:
    """npm's oidc-provider, which is certified by the OpenID Foundation, and its pages in Chromium."""
    port, urls = free_port(), list[str]()
    params = ServerParams(port=0)
    page = Page(tmp_path, f"http://127.0.0.1:{port}", params)
    threading.Thread(target=factory.run, args=(page.app, params, urls.append), daemon=True).start()
    until(lambda: urls)
    redirect = f"{urls[0]}login/callback"
    with certified_provider(tmp_path, port, redirect), chromium(tmp_path / "browser") as browser:

        def enter(login: str) -> None:
            browser.do("Page.navigate", url=urls[0])
            browser.until("document.querySelector('#sign-in')?.hidden === false")
            browser.click("#sign-in")
            browser.until("document.querySelector('input[name=login]') !== null")
            browser.value(f"document.querySelector('input[name=login]').value = '{login}'")
            browser.value("document.querySelector('input[name=password]').value = 'any'")
            browser.value("document.querySelector('form').submit()")
            browser.until("document.querySelector('input[value=consent]') !== null")
            browser.value("document.querySelector('form').submit()")

        enter("anna@example.org")
        browser.until("document.querySelector('#you')?.textContent === 'anna, operator'")
        assert browser.value("location.href") == urls[0], "the session isn't in the address or the history"
        drivers.revoke(page.file, "anna")
        browser.until("document.querySelector('#token').hidden === false")
        assert browser.value("document.querySelector('#status').textContent").startswith("the token is wrong")

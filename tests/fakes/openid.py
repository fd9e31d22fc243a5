"""OpenID providers: a fake one, whose answers can be wrong, and the certified `oidc-provider` of npm."""

from __future__ import annotations

import base64
import hashlib
import json
import secrets
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlencode, urlsplit

import pytest

from tests.fakes.cesium import node_module
from tests.waiting import until

CLIENT, SECRET = "desk 1", "s:cret & more"
NPM_PACKAGE = "oidc-provider"


class FakeProvider:
    """An OpenID provider on this machine that lets everybody in as `login`; use it in a `with` statement.

    Attributes:
        login: e-mail address of who signs in.
        claims: claims that replace those of the ID token; None removes one.
        answer: replaces the answer to a path: status and body; None: none is replaced.
        seen: paths that were requested.
    """

    def __init__(self) -> None:
        self.login, self.claims = "anna@example.org", dict[str, Any]()
        self.answer: Callable[[str], tuple[int, bytes] | None] = lambda path: None
        self.seen: list[str] = []
        self._codes: dict[str, dict[str, str]] = {}
        handler = type("Handler", (_Handler,), {"provider": self})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self.issuer = f"http://127.0.0.1:{self._server.server_address[1]}"

    def __enter__(self) -> FakeProvider:
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def approve(self, url: str) -> str:
        """Sign in: the address to which the provider sends the browser from an authorization address."""
        query = {name: values[0] for name, values in parse_qs(urlsplit(url).query).items()}
        assert query["response_type"] == "code" and query["code_challenge_method"] == "S256"
        assert query["client_id"] == CLIENT and "openid" in query["scope"].split()
        code = secrets.token_hex(8)
        self._codes[code] = query
        return f"{query['redirect_uri']}?{urlencode({'code': code, 'state': query['state']})}"

    def metadata(self) -> dict[str, Any]:
        """The provider's metadata."""
        return {
            "issuer": self.issuer,
            "authorization_endpoint": f"{self.issuer}/authorize?tenant=plant",
            "token_endpoint": f"{self.issuer}/token",
        }

    def token(self, authorization: str, fields: dict[str, str]) -> tuple[int, dict[str, Any]]:
        """Answer of the token endpoint."""
        user, _, password = base64.b64decode(authorization.removeprefix("Basic ")).decode().partition(":")
        if (unquote(user), unquote(password)) != (CLIENT, SECRET):
            return 401, {"error": "invalid_client", "error_description": "unknown client"}
        asked = self._codes.pop(fields.get("code", ""), None)
        digest = hashlib.sha256(fields.get("code_verifier", "").encode()).digest()
        challenge = base64.urlsafe_b64encode(digest).rstrip(b"=").decode()
        if asked is None or asked["code_challenge"] != challenge or asked["redirect_uri"] != fields["redirect_uri"]:
            return 400, {"error": "invalid_grant"}
        claims = {
            "iss": self.issuer, "aud": CLIENT, "sub": "7", "email": self.login, "nonce": asked["nonce"],
            "iat": time.time(), "exp": time.time() + 300,
        } | self.claims  # fmt: skip
        kept = {name: value for name, value in claims.items() if value is not None}
        parts = [base64.urlsafe_b64encode(json.dumps(one).encode()).rstrip(b"=").decode() for one in ({}, kept)]
        return 200, {"id_token": ".".join([*parts, "signature"]), "token_type": "Bearer", "access_token": "x"}


class _Handler(BaseHTTPRequestHandler):
    provider: FakeProvider

    def log_message(self, *_: object) -> None:
        """Nothing."""

    def do_GET(self) -> None:
        if self.path.startswith("/authorize"):
            self.send_response(302)
            self.send_header("Location", self.provider.approve(self.path))
            self.end_headers()
            return
        found = self.path == "/.well-known/openid-configuration"
        self._send(200 if found else 404, self.provider.metadata() if found else {})

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"])).decode()
        fields = {name: values[0] for name, values in parse_qs(body).items()}
        self._send(*self.provider.token(self.headers.get("Authorization", ""), fields))

    def _send(self, status: int, answer: dict[str, Any]) -> None:
        path = urlsplit(self.path).path
        self.provider.seen.append(path)
        status, body = self.provider.answer(path) or (status, json.dumps(answer).encode())
        self.send_response(status)
        if 300 <= status < 400:
            self.send_header("Location", "http://192.0.2.1/")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)


SCRIPT = """
const [folder, port, id, secret, redirect] = process.argv.slice(2);
const { default: Provider } = await import(`file://${folder}/lib/index.js`);
const provider = new Provider(`http://127.0.0.1:${port}`, {
  clients: [{ client_id: id, client_secret: secret, redirect_uris: [redirect] }],
  claims: { openid: ["sub"], email: ["email", "email_verified"] },
  conformIdTokenClaims: false,
  cookies: { keys: ["tests"] },
  findAccount: (_, id) => ({ accountId: id, claims: () => ({ sub: id, email: id, email_verified: true }) }),
});
provider.listen(Number(port), "127.0.0.1", () => console.log("ready"));
"""


@contextmanager
def certified_provider(folder: Path, port: int, redirect: str) -> Iterator[None]:
    """Run npm's `oidc-provider`, which lets everybody in under the name that they enter; skips the test without it."""
    package = node_module(NPM_PACKAGE)
    if package is None:
        pytest.skip(f"{NPM_PACKAGE} isn't installed (npm install -g {NPM_PACKAGE})")
    script = folder / "provider.mjs"
    script.write_text(SCRIPT, encoding="utf-8")
    command = ["node", str(script), str(package), str(port), CLIENT, SECRET, redirect]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            until(lambda: "ready" in next(process.stdout, "the provider has ended"))  # type: ignore[arg-type]
            yield
        finally:
            process.kill()

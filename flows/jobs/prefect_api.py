"""Requests to a Prefect server: login, protection against forged requests, bounded in time.

Plain HTTP on the routes that Prefect documents, without Prefect's own client: that takes 1.2 s to
import, starts threads that may be alive at the interpreter's exit, tries again for minutes, and
refuses a server of another version. The login is the user's: PREFECT_API_AUTH_STRING
(`name:password`), PREFECT_API_KEY, or a name and password in the URL. A proxy is never asked for
an address on loopback.
"""

from __future__ import annotations

import base64
import ipaddress
import os
import ssl
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Literal, Self
from urllib.parse import urlsplit
from uuid import uuid4

import httpx

from modetune.core.errors import ModetuneError

#: What stands at an address, as this client sees it.
Answer = Literal["ready", "asks for a login", "is not a Prefect server", "does not answer"]
#: Seconds that connecting and each piece of an answer may take.
PATIENCE_S = 10.0
#: ... and of the question whether there is a server at all.
PROBE_S = 2.0
#: What a server answers while others write to its database, and seconds between the next attempts.
BUSY = 503
PAUSES_S = (0.2, 0.5, 1.0, 2.0)


class ServerRefused(ModetuneError):
    """A request that the server refused, or that never reached it.

    status: of the answer by HTTP; 0 where there was none.
    """

    def __init__(self, said: str, status: int) -> None:
        super().__init__(f"Prefect's server did not take the request: {said}")
        self.status = status


class PrefectApi:
    """A server's interface at one address (`http://127.0.0.1:4200/api`), for one thread at a time.

    login: `name:password`; None for the user's own of environment and URL, "" for none, so that
    the server is seen as others see it.
    """

    def __init__(self, url: str, login: str | None = None, patience_s: float = PATIENCE_S) -> None:
        headers = dict(_login(url, os.environ) if login is None else _basic(login))
        self._token = False
        parts = urlsplit(url)
        host = parts.netloc.rpartition("@")[2]
        self._client = httpx.Client(
            base_url=parts._replace(netloc=host).geturl(),
            headers=headers,
            timeout=patience_s,
            trust_env=not is_loopback(parts.hostname or ""),
            verify=_certificates(os.environ),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._client.close()

    def get(self, path: str) -> Any:
        """What the server has at this path. Raises ServerRefused."""
        return self._ask("GET", path, None)

    def post(self, path: str, content: object) -> Any:
        """What the server answers to this content. Raises ServerRefused."""
        return self._ask("POST", path, content)

    def patch(self, path: str, content: object) -> None:
        """Change what the server has at this path. Raises ServerRefused."""
        self._ask("PATCH", path, content)

    def answer(self) -> Answer:
        """Whether this is a Prefect server that takes this client's requests."""
        try:
            version = self.get("/admin/version")
        except ServerRefused as error:
            if error.status in (401, 403):
                return "asks for a login"
            return "is not a Prefect server" if error.status else "does not answer"
        return "ready" if isinstance(version, str) else "is not a Prefect server"

    def _ask(self, method: str, path: str, content: object) -> Any:
        try:
            if method != "GET" and not self._token:
                self._take_token()
            reply = self._client.request(method, path, json=content)
            if reply.status_code == 403 and method != "GET":  # the token has run out
                self._take_token()
                reply = self._client.request(method, path, json=content)
            for pause in PAUSES_S:
                if reply.status_code != BUSY:
                    break
                time.sleep(pause)
                reply = self._client.request(method, path, json=content)
            if not reply.is_success:
                said = reply.text.strip()[:300] if len(reply.content) < 10_000 else ""
                raise ServerRefused(
                    f"{method} {path}: {reply.status_code} {said}", reply.status_code
                )
            return reply.json() if reply.content else None
        except (httpx.HTTPError, httpx.InvalidURL, OSError) as error:
            raise ServerRefused(f"{type(error).__name__}: {error}", 0) from error
        except ValueError as error:  # a page, where JSON was expected
            raise ServerRefused(f"{method} {path}: its answer is not JSON", 200) from error

    def _take_token(self) -> None:
        """A token that says a request is meant; servers without that protection answer 422."""
        client = str(uuid4())
        reply = self._client.get("/csrf-token", params={"client": client})
        self._token = True
        if reply.status_code == 200:
            self._client.headers["Prefect-Csrf-Token"] = str(reply.json()["token"])
            self._client.headers["Prefect-Csrf-Client"] = client


def is_loopback(host: str) -> bool:
    """Whether a host's name is this machine's own, which no proxy can reach."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _login(url: str, environment: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    parts = urlsplit(url)
    text = environment.get("PREFECT_API_AUTH_STRING", "")
    if not text and parts.username is not None:
        text = parts.netloc.rpartition("@")[0]
    if text:
        return _basic(text)
    key = environment.get("PREFECT_API_KEY")
    return (("Authorization", f"Bearer {key}"),) if key else ()


def _basic(login: str) -> tuple[tuple[str, str], ...]:
    if not login:
        return ()
    return (("Authorization", f"Basic {base64.b64encode(login.encode()).decode()}"),)


def _certificates(environment: Mapping[str, str]) -> ssl.SSLContext | bool:
    """Whom to believe who a server is, by the settings that Prefect has for it."""
    if environment.get("PREFECT_API_TLS_INSECURE_SKIP_VERIFY", "").lower() in ("1", "true"):
        return False
    file = environment.get("PREFECT_API_SSL_CERT_FILE") or environment.get("SSL_CERT_FILE")
    return ssl.create_default_context(cafile=file) if file else True

"""Requests to a Prefect server with a deadline for the whole exchange.

Prefect's own client takes 1.2 s to import, retries for minutes and rejects servers of other
versions; flows and deployments use it, while this client probes servers and watches runs. A timeout
of httpx applies to each read, so a peer that sends single bytes could block a caller for ever:
here the exchange is one coroutine that is cancelled at its deadline. Loopback addresses bypass
proxies.
"""

from __future__ import annotations

import asyncio
import base64
import ipaddress
import os
import ssl
import threading
import tomllib
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit
from uuid import uuid4

import httpx

from modetune.core.errors import ModetuneError

#: The state of the server at an address.
Answer = Literal["ready", "asks for a login", "is not a Prefect server", "does not answer"]
#: Seconds for a whole request, and for a probe.
PATIENCE_S = 10.0
PROBE_S = 2.5
#: Seconds after its deadline in which a request closes its connection.
CLOSING_S = 0.3
#: The answer of a server while others write to its database, and seconds until the next attempt.
BUSY = 503
PAUSE_S = 0.3


class ServerRefused(ModetuneError):
    """A request failed; status is the HTTP status of the answer, 0 without an answer."""

    def __init__(self, reason: str, status: int) -> None:
        super().__init__(f"the request to Prefect's server failed: {reason}")
        self.status = status


class ServerClient:
    """A client of the server at one address (`http://127.0.0.1:4200/api`); thread-safe.

    login is `name:password`; key is an API key, used without a login.
    """

    def __init__(self, url: str, login: str | None = None, key: str | None = None) -> None:
        self.url = url
        self._headers: dict[str, str] = {}
        if login:
            code = base64.b64encode(login.encode()).decode()
            self._headers["Authorization"] = f"Basic {code}"
        elif key:
            self._headers["Authorization"] = f"Bearer {key}"

    def get(self, path: str, seconds: float = PATIENCE_S) -> Any:
        """Return the content at this path. Raises ServerRefused."""
        return self._request("GET", path, None, seconds)

    def post(self, path: str, content: object, seconds: float = PATIENCE_S) -> Any:
        """Return the server's answer to this content. Raises ServerRefused."""
        return self._request("POST", path, content, seconds)

    def patch(self, path: str, content: object, seconds: float = PATIENCE_S) -> Any:
        """Change what is at this path. Raises ServerRefused."""
        return self._request("PATCH", path, content, seconds)

    def answer(self, seconds: float = PROBE_S) -> Answer:
        """Probe whether this is a Prefect server that accepts this client's requests."""
        try:
            version = self.get("/admin/version", seconds)
        except ServerRefused as error:
            if error.status in (401, 403):
                return "asks for a login"
            return "is not a Prefect server" if error.status else "does not answer"
        return "ready" if isinstance(version, str) else "is not a Prefect server"

    def _request(self, method: str, path: str, content: object, seconds: float) -> Any:
        """Return the answer's content before the deadline, however the peer behaves."""
        future: Future[httpx.Response] = Future()

        def exchange() -> None:
            try:
                future.set_result(
                    asyncio.run(asyncio.wait_for(self._exchange(method, path, content), seconds))
                )
            except BaseException as error:
                future.set_exception(error)

        # A thread, because name resolution has no timeout and the caller may have an event loop.
        thread = threading.Thread(target=exchange, name="prefect-request", daemon=True)
        thread.start()
        thread.join(seconds + CLOSING_S)
        try:
            reply = future.result(0.0)
            if not reply.is_success:
                text = reply.text.strip()[:300] if len(reply.content) < 10_000 else ""
                raise ServerRefused(
                    f"{method} {path}: {reply.status_code} {text}", reply.status_code
                )
            return reply.json() if reply.content else None
        except TimeoutError as error:
            raise ServerRefused(f"{method} {path}: no answer in {seconds:.0f} s", 0) from error
        except (httpx.HTTPError, httpx.InvalidURL, OSError) as error:
            raise ServerRefused(f"{type(error).__name__}: {error}", 0) from error
        except ValueError as error:  # a page, where JSON was expected
            raise ServerRefused(f"{method} {path}: its answer is not JSON", 200) from error

    async def _exchange(self, method: str, path: str, content: object) -> httpx.Response:
        parts = urlsplit(self.url)
        loopback = is_loopback(parts.hostname or "")
        verify = _certificates() if parts.scheme == "https" else False
        async with httpx.AsyncClient(
            base_url=self.url,
            headers=self._headers,
            timeout=None,
            trust_env=not loopback,
            verify=verify,
        ) as client:
            if method != "GET":
                client.headers.update(await _forgery_token(client))
            reply = await client.request(method, path, json=content)
            while reply.status_code == BUSY:
                await asyncio.sleep(PAUSE_S)
                reply = await client.request(method, path, json=content)
            return reply


async def _forgery_token(client: httpx.AsyncClient) -> dict[str, str]:
    """Return headers with Prefect's CSRF token; {} if the server uses none."""
    name = str(uuid4())
    reply = await client.get("/csrf-token", params={"client": name})
    if reply.status_code != httpx.codes.OK:
        return {}
    return {"Prefect-Csrf-Token": str(reply.json()["token"]), "Prefect-Csrf-Client": name}


def is_loopback(host: str) -> bool:
    """Return whether a host name means this machine, which proxies cannot reach."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def prefect_setting(name: str) -> str:
    """Return a user's setting from the environment or Prefect's active profile; "" if none.

    Reads the profile file directly, because importing Prefect takes a second.
    """
    if value := os.environ.get(name):
        return value
    home = Path(os.environ.get("PREFECT_HOME") or "~/.prefect").expanduser()
    path = os.environ.get("PREFECT_PROFILES_PATH")
    try:
        text = (Path(path).expanduser() if path else home / "profiles.toml").read_text()
        profiles = tomllib.loads(text)
        active = os.environ.get("PREFECT_PROFILE") or profiles["active"]
        return str(profiles["profiles"][active][name])
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def _certificates() -> ssl.SSLContext | bool:
    """Return the certificates to trust, according to Prefect's settings."""
    if prefect_setting("PREFECT_API_TLS_INSECURE_SKIP_VERIFY").lower() in ("1", "true"):
        return False
    file = prefect_setting("PREFECT_API_SSL_CERT_FILE") or os.environ.get("SSL_CERT_FILE")
    return ssl.create_default_context(cafile=file) if file else True

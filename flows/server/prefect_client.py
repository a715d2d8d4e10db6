"""Prefect's engine as a client of one server, with all its waits bounded.

Settings hold in this context and for the import of Prefect alone: solvers inherit the environment,
and a login is none of their business. Prefect's requests end after 4 s and are made twice at most,
none goes to a proxy where the server is on loopback, its own heartbeat thread is off
(`run_page.py`), and events that a server does not take are dropped.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from modetune.flows.jobs.server_client import is_loopback

#: Seconds of one request of Prefect's client.
REQUEST_S = 4.0


@contextmanager
def prefect_client(settings: Mapping[str, str]) -> Iterator[None]:
    """Make Prefect a client of a server, by its settings as environment variables."""
    _import_prefect(settings)
    from prefect.events.worker import EventsWorker
    from prefect.settings import temporary_settings

    from modetune.flows.jobs.prefect_runner import bounded_events

    chosen: dict[Any, Any] = {
        "api.url": settings["PREFECT_API_URL"],
        "api.auth_string": settings.get("PREFECT_API_AUTH_STRING"),
        "api.key": settings.get("PREFECT_API_KEY") or None,
        "api.request_timeout": REQUEST_S,
        "client.max_retries": 1,
        "flows.heartbeat_frequency": None,
        "logging.to_api.enabled": False,
        "server.ephemeral.enabled": False,
    }
    if settings.get("PREFECT_CLIENT_CSRF_SUPPORT_ENABLED"):
        chosen["client.csrf_support_enabled"] = True
    with temporary_settings(chosen), _no_proxy(settings["PREFECT_API_URL"]):
        bounded_events(settings["PREFECT_API_URL"])
        try:
            yield
        finally:
            EventsWorker.set_client_override(None)


@contextmanager
def _no_proxy(url: str) -> Iterator[None]:
    """Ask no proxy for a server on loopback, which no proxy can reach."""
    host = urlsplit(url).hostname or ""
    before = os.environ.get("no_proxy"), os.environ.get("NO_PROXY")
    if not is_loopback(host):
        yield
        return
    os.environ["no_proxy"] = ",".join(filter(None, (before[0] or before[1], host)))
    try:
        yield
    finally:
        if before[0] is None:
            del os.environ["no_proxy"]
        else:
            os.environ["no_proxy"] = before[0]


def _import_prefect(settings: Mapping[str, str]) -> None:
    """Import Prefect with these settings in its environment, and keep its log to itself."""
    if "prefect" in sys.modules:
        return
    before = dict(os.environ)
    root = logging.getLogger()
    handlers = list(root.handlers)
    try:
        os.environ.update(settings)
        import prefect.main
        import prefect.task_engine  # noqa: F401  # what flows need, at once
    finally:
        os.environ.clear()
        os.environ.update(before)
        for handler in root.handlers[:]:
            if handler not in handlers:
                root.removeHandler(handler)

"""The page of one campaign for one user on this machine.

The server listens only on the loopback device. Its address contains a random token that opens the
page once; after that the browser has a cookie that no script can read and no request of another
site carries. The server refuses requests under another host name (DNS rebinding) and changes
requested by another page. There is no CORS, and the content security policy allows only the page's
own scripts.

What a section of the page needs is imported when it is opened: all of it takes some seconds, in
which there would be no page.
"""

from __future__ import annotations

import secrets
import socket
import threading
from collections.abc import Awaitable, Callable, Collection
from importlib import resources
from pathlib import Path
from typing import Annotated

import uvicorn
from fastapi import FastAPI, Query, Request
from fastapi.responses import HTMLResponse, JSONResponse, PlainTextResponse, RedirectResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from modetune.adapters.yaml_file import Place, read_yaml
from modetune.core.errors import CampaignError, ModetuneError
from modetune.flows.campaign.campaign import load_campaign, store_of
from modetune.flows.studies.view.campaign_changes import (
    Band,
    Change,
    Mark,
    Part,
    configuration_names,
    part_of,
)
from modetune.flows.studies.view.live_record import LiveRecord, live_json

LOOPBACK = "127.0.0.1"
#: Lifetime of the cookie, in seconds; it is worthless once the server has ended.
DAY_S = 86400
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src data: blob:; "
    "connect-src 'self'; frame-src 'self'; frame-ancestors 'self'; base-uri 'none'; "
    "form-action 'none'"
)
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
}
#: Files of the page, and the package of each; the 3D view belongs to the report.
FILES = {
    **dict.fromkeys(("view.html", "view.js", "view.css"), "modetune.flows.studies.view"),
    **dict.fromkeys(("space.js", "charts.js", "page.css"), "modetune.flows.report"),
}
MEDIA = {"html": "text/html", "js": "text/javascript", "css": "text/css"}
Order = Annotated[int, Query(ge=2, le=200)]
Edge = Annotated[float | None, Query(ge=0.0, allow_inf_nan=False)]


class PageRequest(BaseModel):
    """One change that the page requests.

    base: hash of the file that the page showed; the server writes the change if it is given.
    place: keys that lead to a value that a doubt offers, text: its new value as YAML, None to
    remove it.
    pairs: test mode to elastic mode. landmarks: test point to node or point of the model. pick:
    frequencies in Hz, with the band and order of their diagram.
    """

    model_config = ConfigDict(extra="forbid")

    place: tuple[str | int, ...] | None = None
    text: Annotated[str, Field(max_length=2000)] | None = None
    pairs: dict[int, Annotated[int, Field(ge=1)]] | None = None
    landmarks: dict[int, Mark] | None = None
    configuration: str = ""
    pick: list[Annotated[float, Field(gt=0.0, allow_inf_nan=False)]] | None = None
    band: tuple[float, float] | None = None
    order: Annotated[int, Field(ge=2, le=200)] = 60
    base: str = ""

    def change(self, part: Part, offered: Collection[Place]) -> Change:
        """Return the change of a campaign file; offered: places. Raises CampaignError."""
        from modetune.flows.studies.view.doubts import doubt_change
        from modetune.flows.studies.view.landmarks import landmarks_change
        from modetune.flows.studies.view.pairs import pairs_change
        from modetune.flows.studies.view.poles import poles_change

        if self.place is not None:
            return doubt_change(part, self.place, self.text, offered)
        if self.pairs is not None:
            return pairs_change(part, self.pairs)
        if self.landmarks is not None:
            return landmarks_change(part, self.landmarks)
        return poles_change(part, self.band, self.order, self.pick or ())


class Guard:
    """Allow requests only from a browser that opened the address with its token."""

    def __init__(self, port: int) -> None:
        self.token: str = secrets.token_urlsafe(32)
        self.hosts = {f"{LOOPBACK}:{port}", f"localhost:{port}"}
        self._cookie, self._session = f"modetune-view-{port}", secrets.token_urlsafe(32)
        self._opened = threading.Lock()

    async def __call__(
        self, request: Request, proceed: Callable[[Request], Awaitable[Response]]
    ) -> Response:
        response = self._answer(request) or await proceed(request)
        response.headers.setdefault("Content-Security-Policy", POLICY)
        for name, value in HEADERS.items():
            response.headers[name] = value
        return response

    def _answer(self, request: Request) -> Response | None:
        """Return the response in place of the page; None where the request is allowed."""
        if request.headers.get("host") not in self.hosts:
            return PlainTextResponse("unknown host name", 400)
        known = _same(request.cookies.get(self._cookie, ""), self._session)
        token = request.query_params.get("token")
        if token is not None and request.url.path == "/" and (known or self._is_first(token)):
            opened = RedirectResponse("/", 303)  # the token leaves the address
            opened.set_cookie(
                self._cookie, self._session, max_age=DAY_S, httponly=True, samesite="strict"
            )
            return opened
        if not known:
            return PlainTextResponse(
                "Open the address that `modetune view` printed. It works once; to open the page "
                "again elsewhere, restart the command.",
                403,
            )
        if request.method not in ("GET", "HEAD") and request.headers.get("origin") not in {
            f"http://{host}" for host in self.hosts
        }:
            return PlainTextResponse("only this page can request changes", 403)
        return None

    def _is_first(self, token: str) -> bool:
        return _same(token, self.token) and self._opened.acquire(blocking=False)


def _same(given: str, wanted: str) -> bool:
    return secrets.compare_digest(given.encode(), wanted.encode())


def view_app(campaign: Path, runs: Path, guard: Guard, ending: threading.Event) -> FastAPI:
    """Return the page's server; `ending`, once set, cancels a solver run that the page started.

    Raises CampaignError.
    """
    first = read_yaml(campaign, "a campaign")
    record, store = LiveRecord(runs / str(first.at(("name",)))), store_of(first)
    offered: set[Place] = set()  # by the doubts that the page has shown
    app = FastAPI(openapi_url=None)
    app.middleware("http")(guard)

    def part(configuration: str) -> Part:
        return part_of(read_yaml(campaign, "a campaign"), configuration)

    @app.exception_handler(ModetuneError)
    def refused(request: Request, error: ModetuneError) -> Response:
        problems = error.problems if isinstance(error, CampaignError) else (str(error),)
        return JSONResponse({"problems": list(problems)}, 422)

    @app.get("/")
    def shown() -> Response:
        return _file("view.html")

    @app.get("/{name}.{kind}")
    def script(name: str, kind: str) -> Response:
        return _file(f"{name}.{kind}") if f"{name}.{kind}" in FILES else Response(status_code=404)

    @app.get("/live")
    def live() -> Response:
        page_json = {"name": campaign.name, "configurations": configuration_names(first)}
        return JSONResponse({**page_json, **live_json(record, store)})

    @app.get("/report")
    def report() -> Response:
        from modetune.flows.report.page import page

        _, known = record.newest()
        text = "<p>No iteration yet.</p>" if known is None else page(known)
        return HTMLResponse(text, headers={"Content-Security-Policy": "frame-ancestors 'self'"})

    @app.get("/doubts")
    def doubts(solve: bool = False, configuration: str = "") -> Response:
        from modetune.flows.studies.view.doubts import find_doubts

        own = part(configuration)
        found = find_doubts(load_campaign(campaign), own, record.newest()[1], solve, ending)
        offered.update(found.places)
        return JSONResponse(found.to_json())

    @app.get("/pairs")
    def pairs(solve: bool = False, configuration: str = "") -> Response:
        from modetune.flows.studies.view.pairs import pairs_json

        return JSONResponse(pairs_json(load_campaign(campaign), solve, ending, configuration))

    @app.get("/poles")
    def poles(
        low: Edge = None, high: Edge = None, order: Order = 60, configuration: str = ""
    ) -> Response:
        from modetune.flows.studies.view.poles import poles_json

        band: Band = None if low is None or high is None else (low, high)
        return JSONResponse(poles_json(part(configuration), band, order))

    @app.get("/sensors")
    def sensors(configuration: str = "") -> Response:
        from modetune.flows.studies.view.landmarks import sensors_json

        return JSONResponse(sensors_json(part(configuration)))

    @app.post("/change")
    def change(request: PageRequest) -> Response:
        made = request.change(part(request.configuration), offered)
        if request.base:
            made.write(request.base)
        return JSONResponse({**made.to_json(), "written": bool(request.base)})

    return app


def _file(name: str) -> Response:
    text = resources.files(FILES[name]).joinpath(name).read_text(encoding="utf-8")
    return Response(text, media_type=MEDIA[name.rpartition(".")[2]])


def serve_view(campaign: Path, runs: Path, port: int, opened: Callable[[str], None]) -> None:
    """Serve the page until Ctrl-C; port 0 takes a free one. opened: receives the address.

    Raises CampaignError.
    """
    with socket.socket() as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((LOOPBACK, port))
            listening.listen()  # a browser that connects now waits for the server
        except OSError as error:
            raise CampaignError(f"port {port} cannot be used: {error.strerror}") from error
        guard, ending = Guard(listening.getsockname()[1]), threading.Event()
        app = view_app(campaign, runs, guard, ending)
        settings = uvicorn.Config(
            app, log_level="warning", access_log=False, timeout_graceful_shutdown=1, lifespan="off"
        )
        opened(f"http://{min(guard.hosts)}/?token={guard.token}")
        try:
            uvicorn.Server(settings).run(sockets=[listening])
        finally:
            ending.set()

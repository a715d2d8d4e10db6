"""The page of one campaign for one user on this machine.

It listens on the loopback device alone. The address holds a random token that opens it once; the
browser has a cookie from then on, which no script reads and no other site's request carries. A
request under another name of the host (DNS rebinding), and a change that another page asks for, are
refused. No other origin is given anything (no CORS), and the page's policy lets run its own scripts
only.
"""

from __future__ import annotations

import secrets
import socket
import threading
from collections.abc import Awaitable, Callable
from importlib import resources
from pathlib import Path
from typing import Annotated

import numpy as np
import uvicorn
from fastapi import FastAPI, Query, Request
from fastapi.responses import HTMLResponse, JSONResponse, PlainTextResponse, RedirectResponse
from pydantic import BaseModel, ConfigDict, Field, field_validator
from scipy.spatial.transform import Rotation
from starlette.responses import Response

from modetune.adapters.yaml_file import read_yaml
from modetune.core.errors import CampaignError, ModetuneError
from modetune.core.modes import Floats
from modetune.flows.campaign.campaign import load_campaign, store_of
from modetune.flows.campaign.schema import Triple
from modetune.flows.report.page import page
from modetune.flows.studies.view.changes import Change, Part, configuration_names, part_of
from modetune.flows.studies.view.live_record import LiveRecord, live_json
from modetune.flows.studies.view.pairs import pairs_change, pairs_json
from modetune.flows.studies.view.poles import Band, poles_change, poles_json
from modetune.flows.studies.view.sensors import (
    Mark,
    fitted_pose,
    landmarks_change,
    pose_change,
    sensors_json,
)

LOOPBACK = "127.0.0.1"
#: Seconds for which a browser keeps its cookie; it is worth nothing when the server has ended.
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
#: What the page is made of, and the package that has it; the view in space is the report's.
FILES = {
    **dict.fromkeys(("view.html", "view.js", "view.css"), "modetune.flows.studies.view"),
    **dict.fromkeys(("space.js", "charts.js", "page.css"), "modetune.flows.report"),
}
MEDIA = {"html": "text/html", "js": "text/javascript", "css": "text/css"}
Order = Annotated[int, Query(ge=2, le=200)]
Edge = Annotated[float | None, Query(ge=0.0, allow_inf_nan=False)]


class Pose(BaseModel):
    """How a test was laid by hand: from its axes to the model's, in the model's length."""

    model_config = ConfigDict(extra="forbid")

    rotation: tuple[Triple, Triple, Triple]
    translation: Triple

    @field_validator("rotation")
    @classmethod
    def _proper(cls, rotation: tuple[Triple, Triple, Triple]) -> tuple[Triple, Triple, Triple]:
        if not np.allclose(np.array(rotation) @ np.transpose(rotation), np.eye(3), atol=1e-3):
            raise ValueError("rows of a rotation are unit vectors at right angles")
        if np.linalg.det(rotation) < 0.0:
            raise ValueError("a rotation does not mirror")
        return rotation

    def arrays(self) -> tuple[Floats, Floats]:
        """Rotation (3, 3), made exact, and translation (3,)."""
        nearest = Rotation.from_matrix(np.array(self.rotation)).as_matrix()
        return np.asarray(nearest), np.array(self.translation)


class PageRequest(BaseModel):
    """One change that the page asks for; base: of the one that was shown, when it is to be written.

    pairs: test mode to elastic mode; landmarks: test point to node or place; pose: the test moved
    by hand; pick: Hz, with band and order of the diagram they were picked in.
    """

    model_config = ConfigDict(extra="forbid")

    pairs: dict[int, Annotated[int, Field(ge=1)]] | None = None
    landmarks: dict[int, Mark] | None = None
    pose: Pose | None = None
    configuration: str = ""
    pick: list[Annotated[float, Field(gt=0.0, allow_inf_nan=False)]] | None = None
    band: tuple[float, float] | None = None
    order: Annotated[int, Field(ge=2, le=200)] = 60
    base: str = ""

    def change(self, part: Part) -> Change:
        """What it makes of a campaign file. Raises CampaignError."""
        if self.pairs is not None:
            return pairs_change(part, self.pairs)
        if self.pose is not None:
            return pose_change(part, *self.pose.arrays())
        if self.landmarks is not None:
            return landmarks_change(part, self.landmarks)
        return poles_change(part, self.band, self.order, self.pick or ())


class Guard:
    """Who may ask: whoever opened the address with its token, from the page itself."""

    def __init__(self, port: int) -> None:
        self.token: str = secrets.token_urlsafe(32)
        self.hosts = {f"{LOOPBACK}:{port}", f"localhost:{port}"}
        self._cookie, self._session = f"modetune-view-{port}", secrets.token_urlsafe(32)
        self._opened = threading.Lock()

    async def __call__(
        self, request: Request, go_on: Callable[[Request], Awaitable[Response]]
    ) -> Response:
        response = self._answer(request) or await go_on(request)
        response.headers.setdefault("Content-Security-Policy", POLICY)
        for name, value in HEADERS.items():
            response.headers[name] = value
        return response

    def _answer(self, request: Request) -> Response | None:
        """Return the response in place of the page; None where the request is allowed."""
        if request.headers.get("host") not in self.hosts:
            return PlainTextResponse("this host is not served here", 400)
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
                "Open this page by the address that `modetune view` printed. It opens once; where "
                "it was used, start the command again.",
                403,
            )
        if request.method not in ("GET", "HEAD") and request.headers.get("origin") not in {
            f"http://{host}" for host in self.hosts
        }:
            return PlainTextResponse("changes are taken from this page only", 403)
        return None

    def _is_first(self, token: str) -> bool:
        return _same(token, self.token) and self._opened.acquire(blocking=False)


def _same(given: str, wanted: str) -> bool:
    return secrets.compare_digest(given.encode(), wanted.encode())


def view_app(campaign: Path, runs: Path, guard: Guard, ending: threading.Event) -> FastAPI:
    """What answers the page; ending: set when it ends, which ends a solver run that it began.

    Raises CampaignError.
    """
    first = read_yaml(campaign, "a campaign")
    record, store = LiveRecord(runs / str(first.at(("name",)))), store_of(first)
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
        told = {"name": campaign.name, "configurations": configuration_names(first)}
        return JSONResponse({**told, **live_json(record, store)})

    @app.get("/report")
    def report() -> Response:
        _, known = record.newest()
        text = "<p>There is no iteration yet.</p>" if known is None else page(known)
        return HTMLResponse(text, headers={"Content-Security-Policy": "frame-ancestors 'self'"})

    @app.get("/pairs")
    def pairs(solve: bool = False, configuration: str = "") -> Response:
        return JSONResponse(pairs_json(load_campaign(campaign), solve, ending, configuration))

    @app.get("/poles")
    def poles(
        low: Edge = None, high: Edge = None, order: Order = 60, configuration: str = ""
    ) -> Response:
        band: Band = None if low is None or high is None else (low, high)
        return JSONResponse(poles_json(part(configuration), band, order))

    @app.get("/sensors")
    def sensors(configuration: str = "") -> Response:
        return JSONResponse(sensors_json(part(configuration)))

    @app.post("/fit")
    def fit(asked: Pose, configuration: str = "") -> Response:
        return JSONResponse(fitted_pose(part(configuration), *asked.arrays()))

    @app.post("/change")
    def change(asked: PageRequest) -> Response:
        made = asked.change(part(asked.configuration))
        if asked.base:
            made.write(asked.base)
        return JSONResponse({**made.to_json(), "written": bool(asked.base)})

    return app


def _file(name: str) -> Response:
    text = resources.files(FILES[name]).joinpath(name).read_text(encoding="utf-8")
    return Response(text, media_type=MEDIA[name.rpartition(".")[2]])


def serve_view(campaign: Path, runs: Path, port: int, opened: Callable[[str], None]) -> None:
    """Serve the page until Ctrl-C; port: 0 for one that is free. opened: receives the address.

    Raises CampaignError.
    """
    with socket.socket() as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((LOOPBACK, port))
            listening.listen()  # whoever comes at once waits
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

"""`modetune worker`: deployed campaigns run on this machine."""

from __future__ import annotations

from typing import Annotated

import typer

from modetune.flows.cli.options import stoppable
from modetune.flows.cli.server import POOL, Pool, WithoutLogin, serving


def worker(
    pool: Pool = POOL,
    limit: Annotated[
        int | None, typer.Option(min=1, help="Campaigns at the same time; any number by default.")
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Only what is due now, then end.")] = False,
    without_login: WithoutLogin = False,
) -> None:
    """Run deployed campaigns of a work pool on this machine, until Ctrl-C."""
    said = "the worker has ended; runs that are due wait for the next one"
    with stoppable(said), serving() as server:
        from modetune.flows.server.worker import Worker, check_login

        if not without_login:
            check_login(server)
        if not once:
            typer.echo(f"working for pool {pool} of {server.pages}; Ctrl-C ends it")
        Worker(server, pool, limit).work(once)

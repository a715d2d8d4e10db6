"""`modetune server worker`: run deployed campaigns on this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from modetune.flows.cli.options import stoppable
from modetune.flows.cli.server import POLL, POOL, Pool, WithoutLogin, serving


def worker(
    pool: Pool = POOL,
    folder: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder that must contain campaigns and run folders; may be repeated; "
            "default: the current folder."
        ),
    ] = None,
    limit: Annotated[
        int | None,
        typer.Option(
            min=1, help="Maximum number of campaigns at the same time; default: no limit."
        ),
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Run what is due now, then stop.")] = False,
    without_login: WithoutLogin = False,
) -> None:
    """Run the deployed campaigns of a work pool on this machine, until Ctrl-C."""
    os.environ.update(POLL)
    with stoppable("the worker stopped; the next worker runs what is due"):
        with serving() as server:
            from modetune.flows.server.worker import check_login, work

            if not without_login:
                check_login(server.address.url)
            if not once:
                typer.echo(f"running the pool {pool} of {server.pages}; Ctrl-C stops it")
            work(
                server,
                pool,
                folder or [Path()],
                limit=limit,
                once=once,
                without_login=without_login,
            )

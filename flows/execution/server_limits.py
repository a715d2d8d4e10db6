"""Licences counted by a Prefect server, so that they hold over all machines that share it.

Each licence is a global concurrency limit of the server (`nastran`), with the number of slots that
the campaign names. A slot is a lease that is renewed while the solver runs; one that a killed
campaign held comes back about a minute later. Cores stay the machine's own.

Import this only after `server.use_server()`: Prefect reads its settings when it is imported.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import httpx
from prefect.client.orchestration import get_client
from prefect.concurrency._asyncio import ConcurrencySlotAcquisitionError
from prefect.concurrency.sync import concurrency

from modetune.flows.execution.limits import CORES, Limit, Limits

logger = logging.getLogger(__name__)

#: How long one request for a slot waits before cancellation is looked at, seconds.
PATIENCE_S = 5.0
#: What a server that is gone, or refuses, raises.
SERVER_ERRORS = (httpx.HTTPError, ConcurrencySlotAcquisitionError)


@dataclass(frozen=True, slots=True)
class ServerLimits:
    """Limits of this machine, with the licences among them counted by the server as well."""

    machine: Limits

    @contextmanager
    def held(self, limits: tuple[Limit, ...], waiting: Callable[[str], None]) -> Iterator[None]:
        """As `Limits.held`; licences first, so that no core waits for one.

        Where the server does not answer the machine's own limits hold, with a warning.
        """
        licences = sorted((item for item in limits if item.name != CORES), key=lambda i: i.name)
        with ExitStack() as held:
            for limit in licences:
                try:
                    _take(limit, held, waiting)
                except SERVER_ERRORS as error:
                    logger.warning(
                        "Prefect's server does not count licence %s (%s); this machine's limit "
                        "alone holds", limit.name, type(error).__name__,
                    )  # fmt: skip
            with self.machine.held(limits, waiting):
                yield


def on_server(machine: Limits, limits: tuple[Limit, ...]) -> Limits:
    """Limits that the server counts too; the machine's alone where it has no licences to count."""
    licences = [limit for limit in limits if limit.name != CORES]
    try:
        with get_client(sync_client=True) as client:
            for limit in licences:
                client.upsert_global_concurrency_limit_by_name(limit.name, limit.slots)
    except httpx.HTTPError as error:
        logger.warning(
            "Prefect's server takes no limits (%s); licences are counted on this machine alone",
            type(error).__name__,
        )
        return machine
    return ServerLimits(machine) if licences else machine


def _take(limit: Limit, held: ExitStack, waiting: Callable[[str], None]) -> None:
    while True:
        try:
            held.enter_context(
                concurrency(
                    limit.name, occupy=limit.taken, timeout_seconds=PATIENCE_S, strict=True,
                    raise_on_lease_renewal_failure=False,
                )
            )  # fmt: skip
            return
        except TimeoutError:
            waiting(limit.name)

"""Licences counted for all machines by the global concurrency limits of a Prefect server.

Each licence is a limit with the solver's name. A slot is a lease of 60 s that Prefect renews while
the solver runs, so the slots of a killed campaign are free after a minute. The limits of this
machine apply as well. A separate file, because importing Prefect is slow.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import httpx
from prefect.client.orchestration import get_client
from prefect.concurrency._asyncio import ConcurrencySlotAcquisitionError
from prefect.concurrency.sync import concurrency
from prefect.exceptions import PrefectException

from modetune.flows.jobs.limits import OWN, Limit, Limits

logger = logging.getLogger(__name__)

#: Errors of a server that is gone or does not support limits.
REFUSED = (
    PrefectException, ConcurrencySlotAcquisitionError, httpx.HTTPError, OSError, RuntimeError
)  # fmt: skip
#: Seconds until a slot that is not renewed becomes free, the minimum that servers allow.
LEASE_S = 60.0
#: Seconds that one request waits for a slot; cancellation is checked between requests.
WAIT_S = 2.0


class PrefectLimits:
    """The limits of this machine, with licences counted by Prefect's server as well.

    After the first failure of the server only this machine's limits apply.
    """

    def __init__(self, machine: Limits) -> None:
        self.machine = machine
        self._counts = True
        self._made: set[Limit] = set()

    @contextmanager
    def held(self, limits: tuple[Limit, ...], waiting: Callable[[str], None]) -> Iterator[None]:
        """Hold slots as `Limits.held` does, licences first, so that no core waits for one."""
        licences = sorted((item for item in limits if item.name not in OWN), key=lambda i: i.name)
        with ExitStack() as held:
            for limit in licences:
                if self._counts:
                    self._take(limit, held, waiting)
            with self.machine.held(limits, waiting):
                yield

    def _take(self, limit: Limit, held: ExitStack, waiting: Callable[[str], None]) -> None:
        try:
            if limit not in self._made:
                with get_client(sync_client=True) as client:
                    client.upsert_global_concurrency_limit_by_name(limit.name, limit.slots)
                self._made.add(limit)
            while not self._taken(limit, held):
                waiting(limit.name)
        except REFUSED as error:
            self._counts = False
            logger.warning(
                "Prefect's server does not count licences (%s); only this machine's limits apply",
                error,
            )

    def _taken(self, limit: Limit, held: ExitStack) -> bool:
        try:
            held.enter_context(
                concurrency(
                    limit.name,
                    occupy=limit.taken,
                    timeout_seconds=WAIT_S,
                    lease_duration=LEASE_S,
                    strict=True,
                    raise_on_lease_renewal_failure=False,
                )
            )
        except TimeoutError:
            return False
        return True

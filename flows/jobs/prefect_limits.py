"""Licences that a Prefect server counts for all machines, by its global concurrency limits.

A licence is a limit of the server by the solver's name. A slot is a lease of 60 s that Prefect
renews while the solver runs: what a killed campaign held is free a minute later. This machine's own
limits hold in addition.
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

#: What a server that is gone, or does not count, raises.
REFUSED = (
    PrefectException, ConcurrencySlotAcquisitionError, httpx.HTTPError, OSError, RuntimeError
)  # fmt: skip
#: Seconds that a slot stays taken without a renewal, the least that servers grant.
LEASE_S = 60.0
#: Seconds of one request for a slot that others hold; cancellation is looked at in between.
WAIT_S = 2.0


class PrefectLimits:
    """Limits of this machine, with the licences among them counted by Prefect's server as well.

    A server that refuses, or does not answer, is not asked again by this campaign.
    """

    def __init__(self, machine: Limits) -> None:
        self.machine = machine
        self._counts = True
        self._made: set[Limit] = set()

    @contextmanager
    def held(self, limits: tuple[Limit, ...], waiting: Callable[[str], None]) -> Iterator[None]:
        """As `Limits.held`; licences first, so that no core waits for one."""
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
                "Prefect's server counts no licences (%s): this machine alone does", error
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

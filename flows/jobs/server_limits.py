"""Licences counted by a Prefect server, so that they hold over all machines that share it.

Each licence is a global concurrency limit of the server (`nastran`), with the number of slots that
the campaign names. A slot is a lease that is renewed while the solver runs; one that a killed
campaign held is free again when its run is known to have crashed (`heartbeats`), or a minute later
where nobody looks after runs. Cores stay the machine's own.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from modetune.flows.jobs.limits import OWN, Limit, Limits
from modetune.flows.jobs.prefect_api import PrefectApi, ServerRefused

logger = logging.getLogger(__name__)

#: Seconds between two requests for a slot that others hold; cancellation is looked at in between.
PAUSE_S = 1.0
#: Seconds that a slot stays taken without a renewal, the least that servers grant.
LEASE_S = 60
RENEWAL_S = 20.0
#: A server slower than this does not hold a solver up.
PATIENCE_S = 5.0
#: What a server answers where all slots are taken.
TAKEN = 423
#: ... where it has no limit of a name, and where somebody else has made it meanwhile.
ABSENT, THERE_BY_NOW = 404, 409


class ServerLimits:
    """Limits of this machine, with the licences among them counted by the server as well.

    A server that refuses, or does not answer, is not asked again by this campaign.
    """

    def __init__(
        self, machine: Limits, url: str, tell: Callable[[str, bool], None] = lambda *told: None
    ) -> None:
        """tell: hears of each lease that is taken (true) and that is given back (false)."""
        self.machine = machine
        self.url = url
        self.tell = tell
        self._counts = True
        self._made: set[Limit] = set()

    @contextmanager
    def held(self, limits: tuple[Limit, ...], waiting: Callable[[str], None]) -> Iterator[None]:
        """As `Limits.held`; licences first, so that no core waits for one.

        Where the server does not count the machine's own limits hold, with a warning.
        """
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
                with PrefectApi(self.url, patience_s=PATIENCE_S) as api:
                    _set(api, limit)
                self._made.add(limit)
            lease = _lease(self.url, limit, waiting)
            self.tell(lease, True)
            held.callback(self.tell, lease, False)
            held.enter_context(_renewed(self.url, lease))
        except ServerRefused as error:
            self._counts = False
            logger.warning("%s; licences are counted on this machine alone", error)


def _set(api: PrefectApi, limit: Limit) -> None:
    """Let the server have a limit with so many slots. Raises ServerRefused."""
    try:
        api.patch(f"/v2/concurrency_limits/{limit.name}", {"limit": limit.slots})
    except ServerRefused as error:
        if error.status != ABSENT:
            raise
        try:
            api.post("/v2/concurrency_limits/", {"name": limit.name, "limit": limit.slots})
        except ServerRefused as other:
            if other.status != THERE_BY_NOW:
                raise


def _lease(url: str, limit: Limit, waiting: Callable[[str], None]) -> str:
    """The lease of a licence's slots, as soon as they are free. Raises ServerRefused."""
    asked = {"slots": limit.taken, "names": [limit.name], "lease_duration": LEASE_S}
    with PrefectApi(url, patience_s=PATIENCE_S) as api:
        while True:
            try:
                path = "/v2/concurrency_limits/increment-with-lease"
                return str(api.post(path, asked)["lease_id"])
            except ServerRefused as error:
                if error.status != TAKEN:
                    raise
            threading.Event().wait(PAUSE_S)
            waiting(limit.name)


@contextmanager
def _renewed(url: str, lease: str) -> Iterator[None]:
    """Keep a lease alive for as long as this lasts, and give it back then."""
    over = threading.Event()

    def keep() -> None:
        while not over.wait(RENEWAL_S):
            _quietly(
                url, f"/v2/concurrency_limits/leases/{lease}/renew", {"lease_duration": LEASE_S}
            )

    renewing = threading.Thread(target=keep, name="modetune-lease")
    renewing.start()
    try:
        yield
    finally:
        over.set()
        renewing.join()
        _quietly(url, "/v2/concurrency_limits/decrement-with-lease", {"lease_id": lease})


def _quietly(url: str, path: str, content: object) -> None:
    """A request whose failure the lease's own end makes good."""
    try:
        with PrefectApi(url, patience_s=PATIENCE_S) as api:
            api.post(path, content)
    except ServerRefused as error:
        logger.info("%s", error)

"""The errors of modetune, split by what the user can do about them.

::

    ModetuneError
    ├── CampaignError            edit the campaign or the test data
    │   └── CampaignRunning      wait: another run of it is under way
    ├── ModelError               fix the model
    │   └── TooManyModes         request fewer: the model has no more
    ├── ModesError               look at the modes
    ├── SolverError              look at the solver's log, try again
    │   ├── SolverMissing        install it
    │   ├── SolverRejected       it refused the input: fix the deck
    │   ├── SolverCrashed        it was stopped or broke off: may be tried again
    │   │   └── NoResult         it ended well and left what is not a result: look at its folder
    │   ├── SolverExhausted      give it more memory or disk
    │   ├── LicenceDenied        wait: no licence was free
    │   ├── SolverTimeout        raise the limit or make the model smaller
    │   └── SolverCancelled      the campaign itself was stopped
    ├── NotStored                run the campaign: the store alone was asked, and lacks a result
    ├── CampaignStopped          start it again: finished jobs are in the store
    └── StoreError               repair the store
        ├── StoreDamaged         an entry's checksum does not hold
        └── StorageUnavailable   no permission or no space

Each carries one paragraph that says what was found, what was expected and where; the command
line prints it and ends with the class's exit code.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar


class ModetuneError(Exception):
    """Root of all errors a user can cause or meet."""

    exit_code: ClassVar[int] = 2


class CampaignError(ModetuneError):
    """The campaign file or the test data must be edited; lists every problem at once."""

    def __init__(self, problems: str | Sequence[str]) -> None:
        self.problems = (problems,) if isinstance(problems, str) else tuple(problems)
        super().__init__("\n".join(self.problems))


class CampaignRunning(CampaignError):
    """Another run of the campaign holds its run folder."""


class ModelError(ModetuneError):
    """The deck cannot be read, or lacks what was asked of it."""


class TooManyModes(ModelError):
    """A model has fewer modes than requested; available: how many its mass matrix allows."""

    def __init__(self, requested: int, available: int, of: str = "") -> None:
        super().__init__(f"{requested} modes were asked of a model with {available} unknowns{of}")
        self.available = available


class ModesError(ModetuneError):
    """The modes do not allow what was asked: lost, unpaired, or not enough of them."""

    exit_code = 4


class NotStored(ModetuneError):
    """The store lacks a result, and no solver may run: in a dry run."""


class NotComputed(NotStored):
    """The store lacks what would be computed from its results: in a dry run."""


class CampaignStopped(ModetuneError):
    """The user stopped the campaign."""

    exit_code = 130


class SolverError(ModetuneError):
    """A solver run gave no result. The message carries command, folder and log tail.

    again: whether the job may be tried again.
    """

    exit_code = 4
    again = False


class SolverMissing(SolverError):
    """The solver's program is not there."""


class SolverRejected(SolverError):
    """The solver refused its input; running it again gives the same."""


class SolverCrashed(SolverError):
    """The solver was killed or broke off."""


class NoResult(SolverCrashed):
    """The solver ended with good grace, but what it left is not a result: cut short, empty, NaN."""


class SolverExhausted(SolverError):
    """The solver ran out of memory or disk; running it again would end the same."""


class LicenceDenied(SolverError):
    """The licence server gave the solver no licence; nothing is wrong with the job."""


class SolverTimeout(SolverError):
    """The solver ran longer than the campaign's timeout and was killed."""


class SolverCancelled(SolverError):
    """The solver was killed because its campaign is ending."""


class StoreError(ModetuneError):
    """The store or the record cannot be used."""

    exit_code = 5


class StoreDamaged(StoreError):
    """An entry of the store is not what its checksum says."""


class StorageUnavailable(StoreError):
    """A folder cannot be written: no permission, no space, or not there."""

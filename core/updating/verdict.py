"""The verdict on an update: whether to use the updated parameters.

Nothing heavy is imported here, because the command line reads the options that name a verdict.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Literal

#: What makes an update fail: no verdict, any but `trusted`, `not to be trusted` alone, or a change
#: of the structure over its runs.
FailOn = Literal["never", "doubt", "not-trusted", "change"]


class TrustVerdict(StrEnum):
    """How far updated parameters can be trusted (`core/updating/trust` states the rules).

    NOT_JUDGED: no sensitivity was computed, as where the model agrees at the start.
    """

    TRUSTED = "trusted"
    RESERVATIONS = "trusted with reservations"
    NOT_TRUSTED = "not to be trusted"
    NOT_JUDGED = "not judged"

    @property
    def brief(self) -> str:
        """The verdict in one or two words, for the state of a run."""
        short = {
            TrustVerdict.RESERVATIONS: "with reservations",
            TrustVerdict.NOT_TRUSTED: "not trusted",
        }
        return short.get(self, self.value)

    @property
    def advice(self) -> str:
        """What to do with the updated values."""
        return {
            TrustVerdict.TRUSTED: "use these values",
            TrustVerdict.RESERVATIONS: "check the reservations before you use these values",
            TrustVerdict.NOT_TRUSTED: "do not use these values",
            TrustVerdict.NOT_JUDGED: "nothing shows how well the test determines the parameters",
        }[self]

    def excluded_by(self, fail_on: FailOn) -> bool:
        """Return whether an update with this verdict fails; an update not judged is in doubt."""
        if fail_on == "doubt":
            return self is not TrustVerdict.TRUSTED
        return fail_on == "not-trusted" and self is TrustVerdict.NOT_TRUSTED

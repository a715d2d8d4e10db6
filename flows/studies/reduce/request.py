"""The request of a reduction; imports nothing heavy, because the command line reads it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from typer import Option

from modetune.flows.studies.study import FILE_OR_WORDS

ReductionMethod = Literal["guyan", "irs", "iterated_irs", "serep", "craig_bampton"]


@dataclass(frozen=True, slots=True)
class ReductionRequest:
    """The method and the masters of a reduction; modes: as many as fit where None."""

    method: Annotated[
        ReductionMethod, Option(help="guyan, irs, iterated_irs, serep or craig_bampton.")
    ] = "guyan"
    masters: Annotated[
        str,
        Option(
            help="Masters: 12.z,13,20-25.xyz, or a file with them; default: the test's sensors."
        ),
        FILE_OR_WORDS,
    ] = ""
    modes: Annotated[
        int | None,
        Option(
            min=1,
            help="Number of modes to compare; SEREP keeps them, and Craig-Bampton adds as many.",
        ),
    ] = None

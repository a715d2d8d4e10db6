"""The table of flows: one for each study, by its name."""

from __future__ import annotations

import inspect
from functools import cache
from typing import Any

from prefect import Flow
from prefect.states import Completed, Failed

from modetune.core.errors import ModetuneError
from modetune.flows.server.run import carried_out
from modetune.flows.studies.catalogue import STUDIES as FLOWS
from modetune.flows.studies.catalogue import find_study
from modetune.flows.updating.updating import Unwatched


@cache
def find_flow(name: str) -> Flow[..., Any]:
    """The flow of a study."""
    study = find_study(name)
    signature = inspect.Signature(study.parameters)

    def body(*arguments: Any, **named: Any) -> Any:
        parameters = signature.bind(*arguments, **named).arguments
        try:
            carried_out(study, parameters, Unwatched(), prefect="off")
        except ModetuneError as error:
            return Failed(message=str(error))
        return Completed()

    body.__name__ = body.__qualname__ = name
    body.__doc__ = study.help
    body.__module__ = __name__
    body.__signature__ = signature  # type: ignore[attr-defined]
    return Flow(body, name=name, persist_result=False)


def __getattr__(name: str) -> Any:
    if name in FLOWS:
        return find_flow(name)
    raise AttributeError(name)

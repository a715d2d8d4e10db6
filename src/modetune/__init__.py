"""modetune: finite element models that agree with vibration tests.

    import modetune

    campaign = modetune.load("campaign.yaml")
    run = modetune.update(campaign)         # or modetune.update("campaign.yaml")
    run.parameters, run.modes, run.mac      # pandas frames
    run.plot_mac()                          # a matplotlib figure

The verbs are those of the command line. Only the names in `__all__` are promised. Nothing heavy is
imported before it is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from modetune.core.errors import ModetuneError
    from modetune.flows.api import (
        check,
        compare,
        confirm,
        correlate,
        direct,
        expand,
        fleet,
        go,
        history,
        identify,
        init,
        load,
        localise,
        modes,
        pretest,
        read_record,
        read_test,
        receive,
        reduce,
        sample,
        scatter,
        screen,
        twin,
        update,
        validate,
    )
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.updating.record import CampaignRun

__version__ = "0.1.0"

__all__ = [
    "Campaign",
    "CampaignRun",
    "ModetuneError",
    "check",
    "compare",
    "confirm",
    "correlate",
    "direct",
    "expand",
    "fleet",
    "go",
    "history",
    "identify",
    "init",
    "load",
    "localise",
    "modes",
    "pretest",
    "read_record",
    "read_test",
    "receive",
    "reduce",
    "sample",
    "scatter",
    "screen",
    "twin",
    "update",
    "validate",
]

#: Where the names that are not verbs come from.
_CLASSES = {
    "Campaign": "modetune.flows.campaign.campaign",
    "CampaignRun": "modetune.flows.updating.record",
    "ModetuneError": "modetune.core.errors",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'modetune' has no attribute {name!r}")
    return getattr(importlib.import_module(_CLASSES.get(name, "modetune.flows.api")), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])

"""The studies, each in the module of its name; a module is imported when its study is needed."""

from __future__ import annotations

from importlib import import_module

from modetune.core.errors import CampaignError
from modetune.flows.studies.study import Study

STUDIES = (
    "update", "screen", "sample", "scatter", "validate", "localise", "check", "pretest",
    "correlate", "expand", "reduce", "direct", "modes", "twin",
)  # fmt: skip


def find_study(name: str) -> Study:
    """The study of a name. Raises CampaignError where there is none."""
    if name not in STUDIES:
        raise CampaignError(f"{name!r} is not a study: expected one of {', '.join(STUDIES)}")
    found: Study = getattr(import_module(f"{__name__}.{name}"), name)
    return found

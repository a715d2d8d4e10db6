"""The studies: where each is defined; a definition is imported when its study is needed."""

from __future__ import annotations

from importlib import import_module

from modetune.core.errors import CampaignError
from modetune.flows.studies.study import Study

#: The module below `flows/studies` that defines each study.
STUDIES = {
    "update": "update",
    "screen": "screen.study",
    "sample": "sample.study",
    "scatter": "scatter.study",
    "validate": "validate.study",
    "localise": "localise.study",
    "check": "check.study",
    "pretest": "pretest.study",
    "correlate": "correlate.study",
    "expand": "expand.study",
    "reduce": "reduce.study",
    "direct": "direct.study",
    "modes": "modes",
    "twin": "twin.study",
}


def find_study(name: str) -> Study:
    """Return the study of a name. Raises CampaignError where there is none."""
    if name not in STUDIES:
        raise CampaignError(f"{name!r} is not a study: expected one of {', '.join(STUDIES)}")
    found: Study = getattr(import_module(f"modetune.flows.studies.{STUDIES[name]}"), name)
    return found

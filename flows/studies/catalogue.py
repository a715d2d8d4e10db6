"""The studies: where each is defined; a definition is imported when its study is needed."""

from __future__ import annotations

from importlib import import_module

from modetune.core.errors import CampaignError
from modetune.flows.studies.study import Study

#: Headings of `modetune --help` that have studies.
TEST, BEFORE, UPDATING = "The test", "Model and test, before updating", "Updating"
MATRICES, TRUST, HERE = "Whole matrices", "Trust in the result", "This installation"
#: Each study in the order of a campaign's life: the module below `flows/studies` that defines it,
#: and its heading. To remove a study, delete its folder or file and its line here.
STUDIES = {
    "pretest": ("pretest.study", TEST),
    "check": ("check.study", BEFORE),
    "modes": ("modes", BEFORE),
    "correlate": ("correlate.study", BEFORE),
    "screen": ("screen.study", BEFORE),
    "localise": ("localise.study", BEFORE),
    "update": ("update", UPDATING),
    "expand": ("expand.study", MATRICES),
    "reduce": ("reduce.study", MATRICES),
    "direct": ("direct.study", MATRICES),
    "validate": ("validate.study", TRUST),
    "sample": ("sample.study", TRUST),
    "scatter": ("scatter.study", TRUST),
    "twin": ("twin.study", HERE),
}


def find_study(name: str) -> Study:
    """Return the study of a name. Raises CampaignError where there is none."""
    if name not in STUDIES:
        raise CampaignError(f"{name!r} is not a study: expected one of {', '.join(STUDIES)}")
    found: Study = getattr(import_module(f"modetune.flows.studies.{STUDIES[name][0]}"), name)
    return found

"""The studies: where each is defined; a definition is imported when its study is needed."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from modetune.core.errors import CampaignError
from modetune.flows.studies.study import Study

#: Headings of `modetune --help` that have studies, and a group of commands.
DAY, STUDY, MODEL = "A normal day", "Studies", "model"
#: Each study: the module below `flows/studies` that defines it, and its heading or group. To remove
#: a study, delete its folder or file and its line here.
STUDIES = {
    "go": ("go", DAY),
    "pretest": ("pretest.study", STUDY),
    "check": ("check.study", DAY),
    "modes": ("modes", STUDY),
    "correlate": ("correlate.study", STUDY),
    "screen": ("screen.study", STUDY),
    "localise": ("localise.study", STUDY),
    "update": ("update", DAY),
    "confirm": ("confirm", STUDY),
    "compare": ("compare.study", STUDY),
    "receive": ("receive.study", DAY),
    "history": ("history.study", DAY),
    "fleet": ("fleet.study", DAY),
    "expand": ("expand.study", MODEL),
    "reduce": ("reduce.study", MODEL),
    "direct": ("direct.study", MODEL),
    "validate": ("validate.study", DAY),
    "sample": ("sample.study", STUDY),
    "scatter": ("scatter.study", STUDY),
    "twin": ("twin.study", MODEL),
}


def find_study(name: str) -> Study:
    """Return the study of a name. Raises CampaignError where there is none."""
    if name not in STUDIES:
        raise CampaignError(f"{name!r} is not a study: expected one of {', '.join(STUDIES)}")
    found: Study = getattr(import_module(f"modetune.flows.studies.{STUDIES[name][0]}"), name)
    return found


def shell_command(study: Study, parameters: Mapping[str, Any]) -> str:
    """Return the command that runs a study with these parameters, from any folder.

    Raises CampaignError.
    """
    group = [MODEL] * (STUDIES[study.name][1] == MODEL)
    return shlex.join(["modetune", *group, study.name, *study.words(parameters)])

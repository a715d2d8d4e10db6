"""What a run that a server starts may do: its parameters reach no program and no other file.

Whoever may use the server chooses the parameters of a run. Files must be below folders that the
worker's owner named, after links are resolved; settings may change only keys that name neither a
file nor a program nor a line of a batch script. The campaign files below those folders are trusted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from modetune.core.errors import CampaignError
from modetune.flows.studies.study import Study

#: Keys of a campaign that a setting may change, with all that is below them.
OPEN_KEYS = (
    "name", "update", "sensitivity", "report", "parameters", "residuals",
    "model.solver", "model.dialect", "model.eigensolver", "model.units", "model.rigid_modes",
    "model.checks", "test.length", "test.axes", "test.sensors", "test.use", "test.hold_out",
    "test.pairs", "test.unmatched", "run.parallel", "run.threads", "run.retries",
    "run.failed_column", "run.timeout_s", "run.licence_pause_s", "run.licence_wait_s",
    "run.keep_jobs",
)  # fmt: skip
#: Solvers whose program is that of the worker's machine.
PROGRAMS = ("calculix", "nastran", "mystran", "matrices")


def check_request(
    study: Study, parameters: Mapping[str, Any], folders: Sequence[Path]
) -> dict[str, Any]:
    """Return all parameters of a study's run that the server asked for, checked, paths resolved.

    folders: below which files and run folders must be. Raises CampaignError.
    """
    checked = study.checked(parameters)
    check_settings(checked.get("settings") or [])
    _check_program(checked.get("solver"))
    allowed = [folder.resolve() for folder in folders]
    for path in study.paths(checked):
        if not any(path.resolve().is_relative_to(folder) for folder in allowed):
            raise CampaignError(
                f"{path} is outside the folders of this worker ({', '.join(map(str, allowed))}); "
                "start the worker with --folder to allow another one"
            )
    return checked


def check_settings(settings: Sequence[str]) -> None:
    """Refuse settings that name a program or a file. Raises CampaignError."""
    for setting in settings:
        key, _, text = setting.partition("=")
        key = key.strip()
        if not any(key == name or key.startswith(f"{name}.") for name in OPEN_KEYS):
            raise CampaignError(
                f"the setting {key!r} is not open to runs that a server starts; write it into the "
                "campaign file"
            )
        if key == "model.solver":
            _check_program(_value(text))


def _value(text: str) -> object:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return text


def _check_program(solver: object) -> None:
    if solver is not None and solver not in PROGRAMS:
        raise CampaignError(
            f"the solver {solver!r} is not open to runs that a server starts; expected one of "
            f"{', '.join(PROGRAMS)}, or write it into the campaign file"
        )

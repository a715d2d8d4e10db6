"""`modetune spacing`: how close the modes of a model come to each other."""

from __future__ import annotations

import numpy as np

from modetune.flows.report.tables import json_object
from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.study import DeckOptions, StudyContext, study


@study(DeckOptions)
def spacing(on: StudyContext) -> StudyResult:
    """Find the two elastic modes of a model whose frequencies are closest."""
    from modetune.flows.updating.mode_source import model_modes

    hz = model_modes(on.campaign, on.values, None).elastic.frequencies_hz
    gaps = np.diff(hz) / hz[1:]
    closest = int(np.argmin(gaps))
    sentence = (
        f"elastic modes {closest + 1} and {closest + 2} are {100.0 * gaps[closest]:.2f} % apart"
    )
    summary = json_object(modes=[closest + 1, closest + 2], gap=gaps[closest])
    return StudyResult(gaps, sentence, summary, written=None)

"""Section 5.1 of the reference thesis: the aircraft's six frequencies by five Young's moduli."""

from __future__ import annotations

import numpy as np

from modetune.configs.claims import Claim
from modetune.core.storage.campaign_record import CampaignRecord

#: Thesis Table 21: frequency errors after updating, in per cent, after 3 iterations.
THESIS_ERRORS = (1.6, 0.4, 3.6, 5.9, 1.0, 0.2)


def claims(record: CampaignRecord) -> list[Claim]:
    """Compare the errors with the thesis's."""
    reached = 100.0 * np.abs(record.best.frequency_errors)
    theirs = ", ".join(f"{error:.1f}" for error in THESIS_ERRORS)
    ours = ", ".join(f"{error:.1f}" for error in reached)
    return [
        Claim(
            f"frequency errors are {theirs} %, mean {np.mean(THESIS_ERRORS):.2f} %, after 3 "
            "iterations (Table 21); ours are no larger in the mean",
            bool(reached.mean() <= np.mean(THESIS_ERRORS)),
            f"{ours} %, mean {reached.mean():.2f} %, {record.iterations[-1].number} iterations",
        )
    ]

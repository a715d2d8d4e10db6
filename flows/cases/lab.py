"""From a lab's response functions to an updated model: the aircraft, measured by its twin."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modetune.adapters.measurements import read_measurement
from modetune.configs.garteur.lab import TRUTH, true_modes, write_lab
from modetune.core.errors import ModesError
from modetune.core.keys import Json
from modetune.core.modes import Floats
from modetune.core.record import CampaignRecord
from modetune.flows.cases.claims import Claim, claim_table, told_claims
from modetune.flows.identification.files import write_modes
from modetune.flows.identification.identify import IdentificationSettings, identify
from modetune.flows.terminal import terminal

BAND_HZ = (3.0, 57.0)
#: Identified frequencies, and moduli that the test sees, are to be right within these shares.
IDENTIFIED, UPDATED = 1e-3, 0.02


@dataclass(frozen=True, slots=True)
class LabComparison:
    """What was found beside what the responses were made from."""

    claims: tuple[Claim, ...]

    @property
    def holds(self) -> bool:
        return all(claim.holds for claim in self.claims)

    def told(self) -> dict[str, Json]:
        return {"claims": told_claims(self.claims)}

    def show(self) -> None:
        terminal().print(claim_table(self.claims, "from response functions"))


def prepare_lab(folder: Path) -> None:
    """Make lab.unv as the lab sends it, and identify modes.csv from it."""
    write_lab(folder)
    source = folder / "lab.unv"
    measured = read_measurement([source])
    if measured.frfs is None:
        raise ModesError(f"{source} holds no response functions")
    found = identify(measured.frfs, IdentificationSettings(band_hz=BAND_HZ))
    write_modes(folder / "modes.csv", found, measured.geometry, source.name)


def compare_lab(record: CampaignRecord) -> LabComparison:
    """Judge a finished campaign by the truth."""
    measured = record.test.modes.frequencies_hz
    truth = true_modes().frequencies_hz[: measured.size]
    off = measured / truth - 1.0
    moduli = np.array([TRUTH[name.removeprefix("E_").upper()] for name in record.parameters.names])
    errors = record.updated / moduli - 1.0
    seen = record.standard_errors < UPDATED
    return LabComparison(
        (
            Claim(
                f"all {measured.size} modes below 57 Hz are identified within {IDENTIFIED:.1%}",
                measured.size == 8 and bool(np.abs(off).max() < IDENTIFIED),
                f"worst {100.0 * np.abs(off).max():.3f} %, two of them 0.1 % apart",
            ),
            Claim(
                f"moduli that the test sees are found within {UPDATED:.0%}",
                bool(seen.sum() >= 3 and np.abs(errors[seen]).max() < UPDATED),
                _listed(record, errors, seen),
            ),
            Claim(
                "what the test does not see is told by its standard error",
                bool(np.all(np.abs(errors[~seen]) < 3.0 * record.standard_errors[~seen])),
                _listed(record, errors, ~seen),
            ),
        )
    )


def _listed(record: CampaignRecord, errors: Floats, which: NDArray[np.bool_]) -> str:
    return "; ".join(
        f"{name} {100.0 * errors[place]:+.1f} % (standard error "
        f"{100.0 * record.standard_errors[place]:.1f} %)"
        for place, name in enumerate(record.parameters.names)
        if which[place]
    )

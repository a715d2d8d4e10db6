"""Chapter 3 of the reference thesis: three ways to update the six-mass system, and what they keep.

The Direct Matrix Method with all masses measured, with mass 6 and with masses 5 and 6 unmeasured
and filled by Kidder's expansion (thesis Table 2); the Error Matrix Method with all measured; and
inverse eigensensitivity, a campaign like any other. Each is judged at all six masses, mode by mode
in the order of frequency as the thesis does, and by point receptances with a loss factor of 1 %
(the thesis's are undamped; where a peak ends would depend on the lines then).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse

from modetune.adapters.matrices.deck import read_deck
from modetune.adapters.test_files.modes_csv import read_modes_csv
from modetune.configs.claims import Beside, Claim
from modetune.configs.six_mass import system
from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.factorisation import Matrix, symmetric_matrix
from modetune.core.correlation.correlation import mac
from modetune.core.measurement.response_functions import Complexes, NormalModes, modal_frf
from modetune.core.modes import Floats, ModeSet
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.updating.direct_update import (
    DirectUpdate,
    ReferenceModes,
    direct_matrix_update,
    error_matrix_update,
)

HERE = Path(__file__).parent
LOSS_FACTOR = 0.01
EXCITATION_HZ = np.linspace(0.5, 16.0, 1241)
N = 6
#: Frequencies of the test are reproduced to this (thesis: "the same").
EXACT = 1e-9
#: From here on the thesis calls modes correlated.
CORRELATED = 0.8
#: Thesis, MAC diagonals after updating; a row of Table 6 is lost in the text.
THESIS_BEFORE = (0.76, 0.97, 0.96, 0.59, 0.10, 0.36)
THESIS_IEM_BEFORE = (0.99, 0.96, 0.99, 0.90, 0.87, 0.98)
THESIS_AFTER = {
    "case 1": (0.97, 0.95, 0.95, 0.97, 0.95, 0.97),
    "case 2": (1.0, 0.99, 0.97, 1.0, float("nan"), 0.98),
    "case 3": (0.86, 0.96, 0.58, 0.05, 0.73, 0.24),
    "error matrix": (0.99, 0.99, 1.0, 0.95, 0.93, 0.99),
    "inverse eigensensitivity": (0.97, 0.99, 0.99, 0.99, 0.99, 0.97),
}


@dataclass(frozen=True, slots=True)
class Vibration:
    """A state of the six-mass system: K, M (6, 6) and its modes, mass-normalised."""

    stiffness: sparse.csr_array
    mass: sparse.csr_array
    frequencies_hz: Floats
    mode_shapes: Floats

    def point_receptances(self) -> Complexes:
        """x / f of every mass at itself, (n_lines, 6), m/N; exact, for all modes take part."""
        damping = np.full(N, LOSS_FACTOR)
        eigenvalues = (2.0 * np.pi * self.frequencies_hz) ** 2
        modes = NormalModes(eigenvalues, self.mode_shapes, damping, "structural")
        receptances = modal_frf(EXCITATION_HZ, modes, range(N), range(N))
        return np.diagonal(receptances, axis1=1, axis2=2)


@dataclass(frozen=True, slots=True)
class Outcome:
    """A method's result compared with the test.

    unmeasured: masses (from 1) that the method did not see; mac_before, mac_after: (6, 6),
    computed by test; thesis_before, thesis_after: (6,), its diagonals; shown: masses whose
    receptances the thesis shows; receptance_errors: (6,), mean over the lines of the difference
    from the test in dB, a point receptance each.
    """

    name: str
    title: str
    unmeasured: tuple[int, ...]
    before: Vibration
    after: Vibration
    test: Vibration
    mac_before: Floats
    mac_after: Floats
    thesis_before: tuple[float, ...]
    thesis_after: tuple[float, ...]
    shown: tuple[int, ...]
    receptance_errors: Floats

    @property
    def frequency_errors(self) -> Floats:
        """Relative, (6,)."""
        return self.after.frequencies_hz / self.test.frequencies_hz - 1.0


def system_of(stiffness: Matrix, mass: Matrix) -> Vibration:
    """The system of two matrices, with all its modes."""
    k, m = symmetric_matrix(stiffness, "stiffness"), symmetric_matrix(mass, "mass matrix")
    eigenvalues, shapes = solve_modes(k, m, N)
    # A method may leave a stiffness that is none; its frequency then shows with a minus.
    frequencies = np.sign(eigenvalues) * np.sqrt(np.abs(eigenvalues)) / (2.0 * np.pi)
    return Vibration(k, m, frequencies, shapes)


def read_system(path: Path) -> Vibration:
    """The system of a model file. Raises ModelError."""
    model = read_deck(path).model
    return system_of(model.stiffness, model.mass)


def direct_outcomes() -> list[Outcome]:
    """The direct methods on the case's files: cases 1 to 3, and the Error Matrix Method."""
    before, test = (read_system(HERE / f"{name}.yaml") for name in ("analytical", "experimental"))
    measured = read_modes_csv(HERE / "all_measured.csv").modes
    found = []
    for number, (unmeasured, shown) in enumerate((((), (6,)), ((6,), (5, 6)), ((5, 6), (4, 5, 6)))):
        name = f"case {number + 1}"
        left = " and ".join(map(str, unmeasured))
        masses = f"mass{'es' if len(unmeasured) > 1 else ''} {left} not measured"
        title = f"Direct Matrix Method, {masses if left else 'all measured'}"
        change = direct_matrix_update(
            before.stiffness, before.mass, _given(measured, unmeasured), None
        )
        after = changed(before, change)
        found.append(outcome(name, title, unmeasured, before, after, test, THESIS_BEFORE, shown))
    change = error_matrix_update(
        before.stiffness,
        before.mass,
        _given(measured, ()),
        before.frequencies_hz,
        before.mode_shapes,
    )
    found.append(
        outcome(
            "error matrix",
            "Error Matrix Method, all measured",
            (),
            before,
            changed(before, change),
            test,
            THESIS_BEFORE,
            (6,),
        )
    )
    return found


def eigensensitivity_outcome(updated: Path) -> Outcome:
    """Inverse eigensensitivity from the case's files and the model that its campaign left."""
    before, test = (read_system(HERE / f"{name}.yaml") for name in ("six_mass", "experimental"))
    return outcome(
        "inverse eigensensitivity",
        "Inverse eigensensitivity, k1 to k4",
        (),
        before,
        read_system(updated),
        test,
        THESIS_IEM_BEFORE,
        (6,),
    )


def changed(system: Vibration, change: DirectUpdate) -> Vibration:
    """A system with a direct method's corrections."""
    return system_of(
        change.stiffness_change.added_to(system.stiffness), change.mass_change.added_to(system.mass)
    )


def outcome(
    name: str,
    title: str,
    unmeasured: tuple[int, ...],
    before: Vibration,
    after: Vibration,
    test: Vibration,
    thesis_before: tuple[float, ...],
    shown: tuple[int, ...],
) -> Outcome:
    """A method's result with all that it is judged by."""
    ratios = np.abs(after.point_receptances() / test.point_receptances())
    return Outcome(
        name,
        title,
        unmeasured,
        before,
        after,
        test,
        mac(before.mode_shapes, test.mode_shapes),
        mac(after.mode_shapes, test.mode_shapes),
        thesis_before,
        THESIS_AFTER[name],
        shown,
        np.abs(20.0 * np.log10(ratios)).mean(axis=0),
    )


def claims(direct: Sequence[Outcome], iem: Outcome, record: CampaignRecord) -> list[Claim]:
    """What the thesis says of the methods, held against the outcomes."""
    case_1, case_2, case_3, error_matrix = direct
    exact = max(float(np.abs(case_1.frequency_errors).max()), _shape_error(case_1))
    least = [float(np.diag(case.mac_after).min()) for case in (case_1, case_2, case_3)]
    mean = [float(np.diag(case.mac_after).mean()) for case in (case_1, case_2, case_3)]
    theirs = [float(np.nanmean(case.thesis_after)) for case in (case_1, case_2, case_3)]
    rise = float(np.nanmean(np.subtract(case_2.thesis_after, case_1.thesis_after)))
    found = [
        Claim(
            "Direct Matrix Method, all measured: test frequencies and shapes come out exactly",
            exact <= EXACT,
            f"largest relative difference {exact:.1e}",
        ),
        Claim(
            "its MAC falls with masses 5 and 6 unmeasured, as in the thesis's Table 8",
            least[2] < CORRELATED and mean[2] < mean[0] and theirs[2] < theirs[0],
            f"least {least[0]:.2f} to {least[2]:.2f}, mean {mean[0]:.2f} to {mean[2]:.2f}; the "
            f"thesis's mean {theirs[0]:.2f} to {theirs[2]:.2f}",
        ),
        Claim(
            "with mass 6 alone unmeasured it falls here (the thesis's rises from Table 4 to 6)",
            least[2] < least[1] < least[0] and mean[2] < mean[1] < mean[0] and rise > 0.0,
            f"least {least[1]:.2f}, mean {mean[1]:.2f}; the thesis's mean rises by {rise:.2f} in "
            "the five modes that Table 6 has",
        ),
    ]
    for case in (case_2, case_3):
        left = [mass - 1 for mass in case.unmeasured]
        wrong = float(case.receptance_errors[left].min())
        right = float(np.delete(case.receptance_errors, left).max())
        number = " and ".join(map(str, case.unmeasured))
        masses = f"mass{'es' if len(left) > 1 else ''} {number}"
        found.append(
            Claim(
                f"{case.name}: receptances of {masses}, not measured, go wrong",
                wrong > 1.0 and wrong > 10.0 * right,
                f"{wrong:.1f} dB or more there, {right:.1e} dB or less at the measured ones",
            )
        )
    off, shape = _worst(error_matrix)
    found.append(
        Claim(
            "Error Matrix Method: deviates even with all measured",
            off > 0.005 and shape < 0.999,
            f"frequencies up to {100 * off:.1f} %, MAC {shape:.3f}",
        )
    )
    off, shape = _worst(iem)
    iterations = record.iterations[-1].number
    found.append(
        Claim(
            "inverse eigensensitivity: all frequencies to 0.1 %, all MAC at least 0.97, in at most "
            "6 iterations",
            off <= 1e-3 and shape >= 0.97 and iterations <= 6 and record.status == "converged",
            f"{100 * off:.4f} %, MAC {shape:.4f}, {iterations} iterations",
        )
    )
    return found


def _given(measured: ModeSet, unmeasured: tuple[int, ...]) -> ReferenceModes:
    rows = [row for row in range(N) if row + 1 not in unmeasured]
    shapes = np.real(measured.mode_shapes[rows])
    return ReferenceModes(measured.frequencies_hz, shapes, rows, "mass", "kidder")


def _worst(result: Outcome) -> tuple[float, float]:
    """Largest relative frequency error and lowest MAC after updating."""
    errors = np.abs(result.frequency_errors)
    return float(errors.max()), float(np.diag(result.mac_after).min())


def _shape_error(case: Outcome) -> float:
    """Largest difference of shapes from the test's, of the test's largest entry; signs as found."""
    test, after = case.test.mode_shapes, case.after.mode_shapes
    signs = np.sign(np.sum(test * after, axis=0))
    return float(np.abs(signs * after - test).max() / np.abs(test).max())


def beside(outcomes: Sequence[Outcome], record: CampaignRecord) -> list[Beside]:
    """Compare MAC, frequencies and springs of all methods with the thesis's.

    outcomes: the direct methods' and inverse eigensensitivity's; record: of its campaign.
    """
    modes = tuple(str(mode) for mode in range(1, N + 1))
    macs: list[tuple[str, ...]] = []
    for item in outcomes:
        macs += [
            (item.name, "before", *_shares(np.diag(item.mac_before))),
            ("", "thesis", *_shares(np.array(item.thesis_before))),
            ("", "after", *_shares(np.diag(item.mac_after))),
            ("", "thesis", *_shares(np.array(item.thesis_after))),
        ]
    states = [("experimental", outcomes[0].test), ("analytical", outcomes[0].before)]
    states += [(item.name, item.after) for item in outcomes[:-1]]
    states += [("k1 to k4 erroneous", outcomes[-1].before), (outcomes[-1].name, outcomes[-1].after)]
    hz = [(name, *(f"{value:.3f}" for value in state.frequencies_hz)) for name, state in states]
    springs = []
    for place, name in enumerate(record.parameters.names):
        truth, start = system.SPRINGS[name][system.EXPERIMENTAL], float(record.deck_values[place])
        now = start * float(record.updated[place])
        errors = f"{100 * (start / truth - 1):+.1f}", f"{100 * (now / truth - 1):+.4f}"
        springs.append((name, f"{start:.0f}", f"{now:.2f}", f"{truth:.0f}", *errors))
    return [
        Beside("MAC, mode by mode", ("method", "state", *modes), tuple(macs)),
        Beside("Frequencies, Hz (the thesis has figures only)", ("model", *modes), tuple(hz)),
        Beside(
            "Springs, N/m (Table 11)",
            ("spring", "erroneous", "updated", "experimental", "error before %", "error after %"),
            tuple(springs),
        ),
    ]


def _shares(values: Floats) -> list[str]:
    return [f"{value:.2f}" if np.isfinite(value) else "-" for value in values]

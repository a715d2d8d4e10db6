"""Response functions as responses: the campaign's `residuals.frf`."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from pydantic import BeforeValidator, Field

from modetune.adapters.yaml_file import Place
from modetune.core.measurement.measurement import MeasuredFrfs
from modetune.core.measurement.response_functions import Complexes, chosen_lines, log_variances
from modetune.core.modes import dof_name
from modetune.core.parameters import DAMPING
from modetune.core.updating.damping_model import Linear
from modetune.core.updating.responses.frf import Frf, FrfCurve, fracs
from modetune.core.updating.responses.response import Residual
from modetune.flows.responses.response import (
    ResponseSection,
    SensorObserver,
    TestedModel,
    Variables,
    nothing_seen,
)
from modetune.flows.responses.section import OTHERS, Name, NotNegative, Positive, Share, by_mode

#: Default ends of the band, as parts of the lowest and the highest frequency of the used modes.
BELOW, ABOVE = 0.7, 1.1
#: Readers' notes on functions without a reference or units contain this.
OF_FUNCTIONS = "response function"
#: A damping ratio, or the name of a `variable` parameter that is one.
Ratio = Annotated[float, Field(gt=0.0, lt=1.0)] | Name


class FrfSection(ResponseSection):
    """Response functions in the test's files, compared as logarithms at chosen frequencies."""

    functions: ClassVar[bool] = True
    mode_keys: ClassVar[tuple[str, ...]] = ("damping",)

    band: tuple[NotNegative, Positive] | None = None
    """Lowest and highest frequency [Hz]; without it 0.7 times the lowest to 1.1 times the highest
    frequency of the used modes"""
    points: Annotated[int, Field(ge=1)] = 16
    """Maximum number of frequencies per function."""
    deviation: Positive = 0.1
    """Standard deviation of log H from causes other than noise, such as damping: that of the
    logarithm of the amplitude, and of the phase [rad]"""
    averages: Annotated[int, Field(ge=1)] = 1
    """Number of averages of the coherence, for estimating the noise from it."""
    coherence: Share = 0.8
    """Minimum coherence at a frequency that is used."""
    damping: Annotated[
        dict[str, Ratio], BeforeValidator(by_mode, json_schema_input_type=Ratio | dict[str, Ratio])
    ] = Field(default={})
    """Damping ratio, one for all modes or by mode, or the name of a `variable` parameter for it;
    without it the ratios of the test's modes, and their median for modes without a pair. If the
    model has dampers or loss factors, the ratio is added to their damping and is zero by default
    [of critical damping]"""
    frac: Share = 0.9
    """Smallest FRAC of each function, at its frequencies, that e1 accepts."""
    weight: NotNegative = 1.0
    """Weight; 0 leaves response functions out."""

    @property
    def counts(self) -> bool:
        return self.weight > 0.0

    @property
    def variables(self) -> set[str]:
        return {ratio for ratio in self.damping.values() if isinstance(ratio, str)}

    def check_variables(self, variables: Variables) -> None:
        for name in sorted(self.variables):
            if name not in variables:
                raise ValueError(f"residuals.frf.damping: no parameter {name} is a `variable`")
            values, (lower, upper) = variables[name]
            if not 0.0 < lower < upper < 1.0:
                raise ValueError(f"bounds of {name}, a damping ratio, must be between 0 and 1")
            if values == "additive":
                raise ValueError(f"{name}, a damping ratio, must have `values: absolute`")

    @staticmethod
    def scores(part: Residual) -> list[tuple[str, float, float]]:
        (block,) = part.blocks  # one number per function is easier to read than all its lines
        found = zip(block.names, fracs(part).tolist(), strict=True)
        return [(f"FRAC of {name.removeprefix('response function ')}", 1.0, f) for name, f in found]

    def response(self, given: TestedModel) -> Frf:
        curves = self._curves(given)
        observe = (
            SensorObserver("response functions", given.seen, given.deck)
            if given.seen
            else nothing_seen
        )
        variables = {
            item.name: Linear(item.origin, item.scale, column)
            for column, item in enumerate(given.parameters.parameters)
        }
        ratios = {
            key: variables[ratio] if isinstance(ratio, str) else Linear(ratio)
            for key, ratio in self.damping.items()
        }
        others = ratios.pop(OTHERS, None)
        damping = {int(key): ratio for key, ratio in ratios.items()}
        dampers = None if given.deck.undamped() else given.deck.damping
        own = damping, others, self.deviation, self.weight, self.frac, dampers
        return Frf(curves, observe, *own)

    def problems(self, given: TestedModel) -> list[tuple[Place, str]]:
        frfs = given.frfs
        if frfs is None or given.seen is None:
            texts = [note for note in given.notes if OF_FUNCTIONS in note]
            why = f" ({'; '.join(texts)})" if texts else "; name their files in test.modes as well"
            return [((), f"the test has no response functions that can be used{why}")]
        found: list[tuple[Place, str]] = []
        told = frfs.coherences
        if told.size and not ((told >= 0.0) & (told <= 1.0 + 1e-6)).all():
            line, column = np.argwhere((told < 0.0) | (told > 1.0 + 1e-6) | np.isnan(told))[0]
            found.append(
                ((), f"the coherence of {curve_name(frfs, column)} is {told[line, column]:.3g} at "
                 f"{frfs.frequencies_hz[line]:g} Hz; it must be from 0 to 1")
            )  # fmt: skip
        for key in ("averages", "coherence"):
            if not told.size and key in self.model_fields_set:
                found.append(((key,), "the test has no coherences; leave this out"))
        ratios = given.test.modes.damping_ratios
        told_all = ratios.size and (ratios > 0.0).all()
        if OTHERS not in self.damping and not told_all and given.deck.undamped():
            found.append(((), "not all modes of the test have damping ratios: give `damping`"))
        low, high = self._band(given)
        if low >= high:
            found.append((("band",), f"{low:g} to {high:g} Hz is not a band"))
        elif not found and not self._curves(given):
            found.append(
                ((), f"no response function at a sensor of the model exceeds its noise between "
                 f"{low:g} and {high:g} Hz")
            )  # fmt: skip
        return found

    def warnings(self, given: TestedModel) -> list[str]:
        found = [note for note in given.notes if OF_FUNCTIONS in note]
        moved = [item.name for item in given.parameters.parameters if item.quantity in DAMPING]
        why = given.deck.undamped()
        if moved and why:
            found.append(
                f"{', '.join(moved)} has no effect on response functions: {why}; they use the "
                "damping ratios of the test, or `damping`"
            )
        elif not why and given.test.modes.damping_ratios.size:
            found.append(
                "response functions use the deck's dampers and loss factors instead of the test's "
                "damping ratios; `damping` adds to them"
            )
        frfs, seen = given.frfs, given.seen
        if frfs is None or seen is None:
            return found
        places = set(zip(seen.nodes.tolist(), seen.components.tolist(), strict=True))
        compared = {curve.name for curve in self._curves(given)}
        low, high = self._band(given)
        reasons: dict[str, list[str]] = {}
        for column in range(frfs.nodes.size):
            name, ends = curve_name(frfs, column), _ends(frfs, column)
            lacking = [dof_name(end) for end in ends if end not in places]
            if lacking:
                text = f"the model has no sensor at {lacking[0]}"
                reasons.setdefault(text, []).append(name)
            elif name not in compared:
                text = f"none exceeds the noise between {low:g} and {high:g} Hz"
                reasons.setdefault(text, []).append(name)
        for reason, names in reasons.items():
            listed = ", ".join(name.removeprefix("response function ") for name in names)
            found.append(
                f"{len(names)} of {frfs.nodes.size} response functions are not compared, because "
                f"{reason}: {listed}"
            )
        return found

    def _band(self, given: TestedModel) -> tuple[float, float]:
        if self.band is not None:
            return self.band
        hz = given.test.modes.frequencies_hz
        return BELOW * float(hz.min()), ABOVE * float(hz.max())

    def _curves(self, given: TestedModel) -> tuple[FrfCurve, ...]:
        """Return the functions between two sensors of the model, at their chosen lines."""
        frfs, seen = given.frfs, given.seen
        if frfs is None or seen is None:
            return ()
        places = zip(seen.nodes.tolist(), seen.components.tolist(), strict=True)
        rows = {dof: row for row, dof in enumerate(places)}
        curves = []
        low, high = self._band(given)
        hz = frfs.frequencies_hz
        for column in range(frfs.nodes.size):
            output, force = _ends(frfs, column)
            if output not in rows or force not in rows:
                continue
            values = receptance(frfs, column, given.kilograms, given.metres)
            coherence = frfs.coherences[:, column] if frfs.coherences.size else np.zeros(0)
            usable = (hz > 0.0) & (hz >= low) & (hz <= high) & (np.abs(values) > 0.0)
            if coherence.size:
                usable &= coherence >= self.coherence
            variances = log_variances(frfs.values[:, column], coherence, self.averages)
            lines = chosen_lines(hz, values, variances, np.flatnonzero(usable), self.points)
            if lines.size:
                name, ends = curve_name(frfs, column), (rows[output], rows[force])
                curves.append(FrfCurve(name, *ends, hz[lines], values[lines], variances[lines]))
        return tuple(curves)


def _ends(frfs: MeasuredFrfs, column: int) -> tuple[tuple[int, int], tuple[int, int]]:
    output = int(frfs.nodes[column]), int(frfs.components[column])
    return output, (int(frfs.reference_nodes[column]), int(frfs.reference_components[column]))


def curve_name(frfs: MeasuredFrfs, column: int) -> str:
    """Return the name of a response function for people."""
    output, force = _ends(frfs, column)
    return f"response function {dof_name(output)} by {dof_name(force)}"


def receptance(frfs: MeasuredFrfs, column: int, kilograms: float, metres: float) -> Complexes:
    """Return a function (n_lines,) as receptance along the positive directions.

    kilograms, metres: of the units of the result. Mobilities and accelerances give 0 at 0 Hz.
    """
    output, force = _ends(frfs, column)
    unit = kilograms * metres ** ((output[1] > 3) + (force[1] > 3))
    order = ("receptance", "mobility", "accelerance").index(frfs.kind)
    values = unit * frfs.signs[column] * frfs.reference_signs[column] * frfs.values[:, column]
    rate = (2j * np.pi * frfs.frequencies_hz) ** order
    whole = np.zeros(rate.size, dtype=np.complex128)
    return np.asarray(np.divide(values, rate, out=whole, where=rate != 0.0))

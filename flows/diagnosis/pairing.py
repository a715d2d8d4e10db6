"""The pairing of test and model before updating: pairs, their quality and their margin.

Close modes of test and model can rotate within their common space. So a measured shape is compared
with the space of the computed modes paired with it and its neighbours, and these neighbours make no
pair ambiguous.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from modetune.core.correlation.correlation import subspace_mac
from modetune.core.correlation.pairing import (
    FEW,
    LOST_MAC,
    RESOLUTION,
    Pairing,
    PairRules,
    beyond,
    close_modes,
    first_pairing,
    mac_or_zero,
    reach_text,
    uncertain_pairs,
)
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, MeasuredModes, ModeSet, common_dofs
from modetune.flows.diagnosis.findings import (
    MODES,
    PAIRING,
    Finding,
    modes_left_out,
    paired_by_hand,
    setting,
)
from modetune.flows.report.tables import Column

#: Below it a pair is doubtful.
WEAK_MAC = 0.6
#: A second mode whose MAC comes this near makes a pair ambiguous.
AMBIGUOUS = 0.2
#: A relative frequency error of a first model above this is rarely a matter of parameters.
LARGE_ERROR = 0.4
#: Computed modes should reach this share above the highest measured frequency.
MARGIN = 0.1
#: Frequencies that are all off by one factor, within this share, are off by a unit.
COMMON_FACTOR = 0.1
#: Any other factor is common where all ratios are within this share of it.
COMMON = 0.05
#: Acceleration of gravity, m/s2 and inch/s2: weight over mass.
GRAVITY, GRAVITY_INCH = 9.80665, 386.0886
#: Measured over computed frequency, by the mistake behind it.
FACTORS = {
    "frequencies in rad/s": 2.0 * np.pi,
    "frequencies divided by 2 pi twice": 0.5 / np.pi,
    "frequencies in revolutions per minute": 60.0,
    "frequencies in kHz, or lengths a thousandfold too small": 1e-3,
    "lengths a thousandfold too large (mm in place of m)": 1e3,
    "lengths in mm in place of inches": 25.4,
    "lengths in inches in place of mm": 1.0 / 25.4,
    "a density a thousandfold too large": 1000.0**0.5,
    "a density a thousandfold too small": 1000.0**-0.5,
    "weight in place of mass (inches; Nastran: PARAM,WTMASS)": GRAVITY_INCH**0.5,
    "mass divided by gravity twice (inches; Nastran: PARAM,WTMASS)": GRAVITY_INCH**-0.5,
    "weight in place of mass (Nastran: PARAM,WTMASS)": GRAVITY**0.5,
    "mass divided by gravity twice (Nastran: PARAM,WTMASS)": GRAVITY**-0.5,
}


@dataclass(frozen=True, slots=True)
class ModePreview:
    """A test mode and its pair before updating.

    elastic_mode: number of the model's, from 1; error: of its frequency, relative to the test's;
    mac, subspace_mac: with that mode, and with the close ones together; second_mode, second_mac:
    the best of any mode that is not close, from 1, and its MAC; None and NaN where there is none;
    answering: elastic modes of the space paired with it, from 1: its pair and the close ones.
    """

    mode: Annotated[int, Column("test mode")]
    test_hz: Annotated[float, Column("test", "Hz")]
    elastic_mode: Annotated[int, Column("elastic mode")]
    computed_hz: Annotated[float, Column("model", "Hz")]
    error: Annotated[float, Column("error", "%", "+.2f")]
    mac: Annotated[float, Column("MAC", form=".3f")]
    subspace_mac: Annotated[float, Column("MAC with close modes", form=".3f")]
    second_mode: Annotated[int | None, Column("next best mode")]
    second_mac: Annotated[float, Column("its MAC", form=".3f")]
    answering: tuple[int, ...] = ()

    @property
    def judged_mac(self) -> float:
        return float(np.fmax(self.mac, self.subspace_mac))


def first_pairs(test: MeasuredModes, elastic: ModeSet, rules: PairRules) -> Pairing:
    """The pairs that updating begins with; low MACs are not refused, as they are to be shown.

    elastic: computed modes as the test's sensors see them. Raises ModesError where there are fewer
    computed modes than measured, or no common sensor.
    """
    return first_pairing(test, elastic, rules, RESOLUTION, np.zeros(0), lost_mac=-1.0)


def preview(
    test: MeasuredModes, elastic: ModeSet, rules: PairRules | None = None
) -> tuple[ModePreview, ...]:
    """Each test mode with its pair, as `first_pairs` has them."""
    pairing = first_pairs(test, elastic, rules or PairRules())
    if not test.has_shapes:
        return tuple(_by_order(test, elastic, pairing))
    table = mac_table(test.modes, elastic)
    return tuple(
        _by_shape(test, elastic, pairing, place, table) for place in range(pairing.measured.size)
    )


def uncertain_findings(
    test: MeasuredModes, elastic: ModeSet, rules: PairRules
) -> Iterator[Finding]:
    """Pairs without shapes that updating would not begin with unless they are confirmed."""
    pairs = first_pairs(test, elastic, rules)
    found = uncertain_pairs(test, elastic, pairs, rules)
    rows = zip(pairs.measured.tolist(), pairs.computed.tolist(), strict=True)
    paired = {test.numbers[row]: column + 1 for row, column in rows}
    yield from (
        PAIRING.doubtful(
            f"paired by the order of frequencies alone: {reason}",
            f"test mode {number}",
            "updating stops at it: name the pairs with `test.pairs`, or leave a mode out with "
            "`test.use`",
            paired_by_hand({number: paired[number]}),
            modes_left_out(number),
        )
        for number, reason in found.items()
    )


def mac_table(measured: ModeSet, computed: ModeSet) -> Floats:
    """MAC at common degrees of freedom, (n_measured, n_computed); 0 where a shape is zero there."""
    rows_m, rows_c = common_dofs(measured, computed)
    if rows_m.size == 0:
        raise ModesError("no sensor of the test is a node of the model's results")
    return mac_or_zero(measured.mode_shapes[rows_m], computed.mode_shapes[rows_c])


def _by_order(test: MeasuredModes, elastic: ModeSet, pairing: Pairing) -> Iterator[ModePreview]:
    unknown = float("nan")
    for row, column in zip(pairing.measured.tolist(), pairing.computed.tolist(), strict=True):
        test_hz = float(test.modes.frequencies_hz[row])
        computed_hz = float(elastic.frequencies_hz[column])
        yield ModePreview(
            test.numbers[row],
            test_hz,
            column + 1,
            computed_hz,
            computed_hz / test_hz - 1.0,
            unknown,
            unknown,
            None,
            unknown,
        )


def _by_shape(
    test: MeasuredModes, elastic: ModeSet, pairing: Pairing, place: int, table: Floats
) -> ModePreview:
    row, column = int(pairing.measured[place]), int(pairing.computed[place])
    neighbours = np.isin(pairing.measured, close_modes(test.modes.frequencies_hz, row))
    close = np.union1d(pairing.computed[neighbours], close_modes(elastic.frequencies_hz, column))
    rows_m, rows_c = common_dofs(test.modes, elastic)
    shape, basis = test.modes.mode_shapes[rows_m, row], elastic.mode_shapes[rows_c][:, close]
    moving = basis[:, basis.any(axis=0)]
    space = subspace_mac(shape, moving) if moving.shape[1] and shape.any() else 0.0
    others = table[row].copy()
    others[close] = -1.0
    test_hz = float(test.modes.frequencies_hz[row])
    computed_hz = float(elastic.frequencies_hz[column])
    return ModePreview(
        test.numbers[row],
        test_hz,
        column + 1,
        computed_hz,
        computed_hz / test_hz - 1.0,
        float(table[row, column]),
        space,
        int(others.argmax()) + 1,
        max(float(others.max()), 0.0),
        tuple((close + 1).tolist()),
    )


def pairing_findings(
    modes: tuple[ModePreview, ...], highest_hz: float, rules: PairRules | None = None
) -> Iterator[Finding]:
    """Report doubtful pairs. highest_hz: of the computed elastic modes."""
    rules = rules or PairRules()
    for mode in modes:
        where = f"test mode {mode.mode}"
        if mode.mode not in rules.by_hand and mode.judged_mac < LOST_MAC:
            yield _lost(mode, where, highest_hz, rules)
            continue
        if np.isfinite(mode.mac) and mode.judged_mac < WEAK_MAC:
            yield PAIRING.doubtful(
                f"best MAC is {mode.judged_mac:.2f} (elastic mode {mode.elastic_mode})",
                where,
                "check the sensor directions, and see `modetune correlate`",
                setting("test.pairs"),
                modes_left_out(mode.mode),
            )
        if mode.second_mac >= max(mode.judged_mac - AMBIGUOUS, LOST_MAC):
            yield PAIRING.doubtful(
                f"ambiguous: elastic mode {mode.elastic_mode} has MAC {mode.mac:.2f}, mode "
                f"{mode.second_mode} has {mode.second_mac:.2f}",
                where,
                "add sensors that distinguish the two, or leave the mode out",
                paired_by_hand({mode.mode: mode.elastic_mode}),
                modes_left_out(mode.mode),
            )
        far = beyond(mode.test_hz, mode.computed_hz, rules.reach)
        certain = np.isfinite(mode.mac) or mode.mode in rules.by_hand
        if (far and certain) or abs(mode.error) > LARGE_ERROR:
            what = f"{mode.computed_hz:.4g} Hz computed, {mode.test_hz:.4g} Hz measured: "
            what += f"{100 * mode.error:+.0f} %"
            if far:
                what += f", {reach_text(mode.computed_hz, rules.reach)}"
            remedy = "the parameters may be unable to correct this much: check the model"
            yield PAIRING.doubtful(
                what, where, remedy, setting("test.pairs"), modes_left_out(mode.mode)
            )


def _lost(mode: ModePreview, where: str, highest_hz: float, rules: PairRules) -> Finding:
    """A mode near the end of the computed range may be beyond it, where updating looks itself."""
    if rules.drop:
        return PAIRING.doubtful(
            f"no computed mode matches it: the best remaining MAC is {mode.judged_mac:.2f}",
            where,
            "updating leaves it out (`test.unmatched: drop`)",
        )
    beyond = mode.test_hz > highest_hz / (1.0 + MARGIN)
    return Finding(
        "doubtful" if beyond else "wrong",
        "pairing",
        f"no computed mode matches it: the best remaining MAC is {mode.judged_mac:.2f}, at least "
        f"{LOST_MAC:.1f} is needed",
        where,
        "it may be above the computed range, which updating extends once"
        if beyond
        else "check sensor nodes, directions and signs (`modetune correlate` lists the worst), "
        "or leave it out: `test.unmatched: drop`",
        (setting("test.unmatched", "drop"), modes_left_out(mode.mode)),
    )


def factor_findings(
    test: MeasuredModes, elastic: ModeSet, rules: PairRules | None = None
) -> Iterator[Finding]:
    """Report whether all frequencies are off by one factor: wrong for the factor of a wrong unit.

    elastic: computed modes as the test's sensors see them. The parameters' bounds rule out no pair
    here. rules: with their reach, to report another factor beyond it as doubtful. Raises ModesError
    as `first_pairs`.
    """
    ratios = np.array([mode.test_hz / mode.computed_hz for mode in preview(test, elastic)])
    if ratios.size < 2 or not (ratios > 0.0).all():
        return
    middle = float(np.median(ratios))
    what = f"all measured frequencies are about {middle:.3g} times the computed ones"
    for reason, factor in FACTORS.items():
        if (np.abs(ratios / factor - 1.0) < 2 * COMMON_FACTOR).all() and (
            abs(middle / factor - 1.0) < COMMON_FACTOR
        ):
            remedy = "check the units of the test and the deck (`model.units`)"
            yield MODES.wrong(f"{what}, as with {reason}", "", remedy, setting("model.units"))
            return
    low, high = (0.0, np.inf) if rules is None else rules.reach
    outside = (ratios < low) | (ratios > high)
    if ratios.size >= FEW and outside.all() and (np.abs(ratios / middle - 1.0) < COMMON).all():
        yield MODES.doubtful(
            f"{what}: stiffness over mass is off by a factor of {middle**2:.3g}, more than the "
            "parameters' bounds allow",
            "",
            "check moduli, densities and thicknesses of the whole model and its units "
            "(`model.units`), or widen the `bounds`",
            setting("model.units"),
        )


def margin_findings(test: MeasuredModes, elastic: ModeSet, all_there: bool) -> Iterator[Finding]:
    """Whether enough modes are computed above the test's band.

    all_there: the model has no further modes.
    """
    highest, last = float(test.modes.frequencies_hz.max()), float(elastic.frequencies_hz.max())
    text = f"{elastic.n_modes} elastic modes up to {last:.4g} Hz; the test's up to {highest:.4g} Hz"
    if all_there or last >= (1.0 + MARGIN) * highest:
        yield MODES.good(text)
        return
    yield MODES.doubtful(
        f"{text}: the margin is less than {100 * MARGIN:.0f} %",
        "",
        "updating extends the range if it does not find a mode; a model that is much too soft, or "
        "test modes that were left out, can be the cause",
    )

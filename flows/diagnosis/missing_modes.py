"""Modes that only the test or only the model has, and modes that the sensors do not measure.

With measured shapes, a mode without a counterpart is one that nothing resembles. A computed mode
that hardly moves the sensors resembles nothing either, and a test mode near its frequency without
another partner may be this mode. Without shapes the order of frequencies is all: where one mode of
the model or the test is left out, all ratios above it change, so the ratios scatter far less once
the right one is skipped.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from modetune.core.correlation.correlation import mac
from modetune.core.correlation.pairing import LOST_MAC, PairRules, beyond
from modetune.core.modes import Floats, MeasuredModes, ModeSet, common_dofs
from modetune.core.near_names import listed
from modetune.flows.diagnosis.findings import (
    MODES,
    SENSORS,
    Finding,
    modes_left_out,
    paired_by_hand,
    setting,
)
from modetune.flows.diagnosis.measured_modes import ALIKE
from modetune.flows.diagnosis.pairing import WEAK_MAC, ModePreview

#: The sensors hardly see a computed shape that is this short compared with the paired ones.
HARDLY_SEEN = 0.1
#: A test mode may be an unseen computed one if their frequencies differ by less than this share.
NEAR = 0.25
#: Scatter of ln(test / model) that one skipped mode must at least remove, and the factor by which.
SCATTER, REMOVED = 0.05, 5.0
#: With fewer pairs ratios agree by chance.
FEW_PAIRS = 5


def unmeasured(
    test: MeasuredModes, elastic: ModeSet, modes: tuple[ModePreview, ...], left_out: bool
) -> Iterator[Finding]:
    """Report computed modes in the test's band that are paired with no test mode.

    Such a mode is doubtful unless the campaign leaves out test modes (left_out), or the sensors
    hardly see it or cannot distinguish it from another.
    """
    if not test.has_shapes:
        return
    paired = {mode.elastic_mode for mode in modes}
    low, high = test.modes.frequencies_hz.min(), test.modes.frequencies_hz.max()
    free = [
        place
        for place, frequency in enumerate(elastic.frequencies_hz.tolist())
        if place + 1 not in paired and low <= frequency <= high
    ]
    distinct = [] if left_out else _separable(test, elastic, free, len(modes), paired)
    if distinct:
        yield MODES.doubtful(
            f"the test has no mode for the model's {_at(elastic, distinct)} within its band",
            "",
            "check whether it was excited and identified",
        )
    others = [place for place in free if place not in distinct]
    if others:
        text = f"elastic mode {_at(elastic, others)} is paired with no test mode"
        yield MODES.good(text)


def lost_findings(
    test: MeasuredModes, elastic: ModeSet, modes: tuple[ModePreview, ...], rules: PairRules
) -> Iterator[Finding]:
    """Report test modes without a partner that may be modes which the sensors do not see.

    elastic: computed modes, mass-normalised, as the sensors see them: sizes of different modes
    compare as the shares of kinetic energy that the sensors see do.
    """
    lost = [mode for mode in modes if mode.judged_mac < LOST_MAC and mode.mode not in rules.by_hand]
    paired = {mode.elastic_mode for mode in modes if mode not in lost}
    if not lost or not paired:
        return
    _, rows = common_dofs(test.modes, elastic)
    sizes = np.linalg.norm(elastic.mode_shapes[rows], axis=0)
    shares = sizes / np.median([sizes[number - 1] for number in paired])
    unseen = [
        place
        for place in range(elastic.n_modes)
        if place + 1 not in paired and shares[place] < HARDLY_SEEN
    ]
    for mode in lost:
        near = [
            place
            for place in unseen
            if abs(elastic.frequencies_hz[place] / mode.test_hz - 1.0) < NEAR
            and not beyond(mode.test_hz, float(elastic.frequencies_hz[place]), rules.widest)
        ]
        if near:
            seen = max(float(shares[place]) for place in near)
            yield SENSORS.doubtful(
                f"it may be the model's {_at(elastic, near)}, which the sensors hardly see "
                f"({100 * seen:.2g} % of the motion of other modes)",
                f"test mode {mode.mode} ({mode.test_hz:.4g} Hz)",
                "add sensors that see it, or leave the test mode out: `test.unmatched: drop`",
                setting("test.unmatched", "drop"),
                modes_left_out(mode.mode),
            )


def absent_findings(
    elastic: ModeSet, modes: tuple[ModePreview, ...], rules: PairRules
) -> Iterator[Finding]:
    """Report test modes that the model lacks, though it has most of the others.

    elastic: computed modes; modes: the test modes with their pairs.
    """
    lost = [mode for mode in modes if mode.judged_mac < LOST_MAC and mode.mode not in rules.by_hand]
    believed = [mode for mode in modes if mode.judged_mac >= WEAK_MAC]
    if 2 * len(believed) < len(modes):
        return
    yield from (
        MODES.doubtful(
            f"the model has no such mode, though it has {len(believed)} of the test's {len(modes)}",
            f"test mode {mode.mode} ({mode.test_hz:.4g} Hz)",
            "check for a part that the model lacks or a mode identified wrongly; "
            "`test.unmatched: drop` leaves it out",
            setting("test.unmatched", "drop"),
            modes_left_out(mode.mode),
        )
        for mode in lost
        if mode.test_hz < elastic.frequencies_hz.max()
    )


def order_findings(test: MeasuredModes, elastic: ModeSet, rules: PairRules) -> Iterator[Finding]:
    """Report a mode that the test or the model lacks by frequencies alone.

    elastic: the model's elastic modes. The test has no shapes.
    """
    order = np.argsort(test.modes.frequencies_hz)
    measured, computed = test.modes.frequencies_hz[order], np.sort(elastic.frequencies_hz)
    n = measured.size
    if test.has_shapes or rules.by_hand or n < FEW_PAIRS or computed.size < n + 1:
        return
    if not (measured > 0.0).all():
        return
    before = _scatter(measured, computed[:n])
    if before < SCATTER:
        return
    by_model = [_scatter(measured, np.delete(computed, place)[:n]) for place in range(n)]
    by_test = [_scatter(np.delete(measured, place), computed[: n - 1]) for place in range(n)]
    # Of the end modes one can be left out always, which removes the scatter of that pair alone.
    by_test[-1] = np.inf
    best = min(*by_model, *by_test)
    if best * REMOVED > before:
        return
    text = (
        f"the ratios of frequencies in order scatter by {100 * before:.2g} %, and by "
        f"{100 * best:.2g} % "
    )
    place = int(np.argmin(by_model if best in by_model else by_test))
    if best in by_model:
        numbers = np.delete(np.arange(1, computed.size + 1), place)[:n]
        by_hand = {
            test.numbers[row]: number
            for row, number in zip(order[place:].tolist(), numbers[place:].tolist(), strict=True)
        }
        yield MODES.doubtful(
            f"{text}if the test lacks the model's elastic mode {place + 1} "
            f"({computed[place]:.4g} Hz)",
            "",
            f"`test.pairs: {by_hand}` pairs them so",
            paired_by_hand(by_hand),
        )
        return
    number = test.numbers[int(order[place])]
    yield MODES.doubtful(
        f"{text}if the model lacks test mode {number} ({measured[place]:.4g} Hz)",
        "",
        "check for a part that the model lacks, or a mode of the suspension; leave the mode out "
        "with `test.use`",
        modes_left_out(number),
    )


def _scatter(measured: Floats, computed: Floats) -> float:
    """Root mean square of ln(measured / computed) about its median."""
    ratios = np.log(measured / computed)
    return float(np.sqrt(np.mean((ratios - np.median(ratios)) ** 2)))


def _at(elastic: ModeSet, places: list[int]) -> str:
    """Numbers of elastic modes with their frequencies."""
    return listed(f"{place + 1} ({elastic.frequencies_hz[place]:.4g} Hz)" for place in places)


def _separable(
    test: MeasuredModes, elastic: ModeSet, free: list[int], n_paired: int, paired: set[int]
) -> list[int]:
    """Return those of the modes that the sensors see and distinguish from others in the band."""
    _, rows = common_dofs(test.modes, elastic)
    shapes = elastic.mode_shapes[rows]
    if rows.size < n_paired + len(free):  # fewer sensors than modes
        return []
    sizes = np.linalg.norm(shapes, axis=0)
    usual = float(np.median(sizes[[number - 1 for number in paired]]))
    seen = [place for place in free if sizes[place] > HARDLY_SEEN * usual]
    apart = []
    for place in seen:
        others = [n for n in {*free, *(number - 1 for number in paired)} if n != place and sizes[n]]
        if not others or mac(shapes[:, [place]], shapes[:, others]).max() <= ALIKE:
            apart.append(place)
    return apart

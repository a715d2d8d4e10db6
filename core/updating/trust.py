"""How far updated parameters can be trusted: flags, sentences and a verdict.

A matched frequency proves little. Each parameter answers these questions, and each yes is a flag:

    missing     could its sensitivity not be computed?
    on_bound    is it on a bound?
    unseen      does less than a tenth of its value come from the test?
    prior       ... less than half?
    collinear   is it part of a combination that the test does not determine (and less than 90 %
                determined itself)?
    alike       is its effect so close to that of one or two others that a small error moves them
                in opposite directions (collinearity index of at least 20, the upper limit of Brun
                and others 2001), although the stated deviations separate them?
    far         is it more than three of its deviations away from the deck?
    starts      did searches from other starts end at other values that fit as well?
    undetermined  is its standard error infinite, although no other flag doubts it?
    uncertain   is its change smaller than its standard error? Then the deck's value fits as well,
                which is no doubt.

All but alike and uncertain put a parameter in doubt.

The verdict. Not to be trusted: more than half of the parameters are in doubt, other starts fit as
well with other values of parameters that nothing else puts in doubt, no degree of freedom is left
(as many parameters as measured values can match any test) and no other start was tried, standard
errors are withheld, or the remaining misfit is more than three times what noise explains. With
reservations: any parameter in doubt or alike, a combination of parameters that the test does not
determine, no degree of freedom left where other starts end at the same values, e1 not met, a
minimum misfit more than two standard errors away, or a concern: held-out modes got worse, an error
that no parameter can remove. Else trusted.

Where updating ended. e1 ends it where the model is good enough, which may be well before the
minimum misfit. The standard errors belong to the printed values: with C the covariance at the
minimum and d the distance to it, they are those of C + d d^T.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy

from modetune.core.modes import Floats, Integers
from modetune.core.parameters import Parameter, ParameterSet
from modetune.core.updating.identifiability import Identifiability, UnseenCombination
from modetune.core.updating.parameter_steps import LCurve
from modetune.core.updating.verdict import TrustVerdict

#: Where updating ended: at the minimum misfit, before it with e1 met, or before it without.
Ended = Literal["least misfit", "good enough", "under way"]

#: Flags that put no parameter in doubt.
NO_DOUBT = {"uncertain", "alike"}
#: Remaining misfit, over what noise explains, beyond which no answer is trusted.
MEANINGLESS = 3.0
#: Share of left-out modes that may miss their 95 % intervals; beyond it errors are withheld.
MISSES = 0.2
#: ... and probability below which such a number is no chance.
CHANCE = 0.025
#: Standard errors from the minimum misfit within which updating ended there.
THERE = 0.3
#: ... and beyond which values are not called trusted, if they move by more than NEGLIGIBLE.
SHORT = 2.0
#: A change below this share of the deck's value is not reported.
NEGLIGIBLE = 0.01
#: Shares of the test below which a parameter is unseen, mainly the prior's, or collinear.
UNSEEN_SHARE, HALF, SURE = 0.1, 0.5, 0.9
#: Deviations from the deck beyond which a parameter may compensate for another error.
FAR = 3.0
#: Collinearity index at which subsets count as alike.
ALIKE = 20.0
#: Number of names that are listed.
LISTED = 6
#: The concern about an answer whose modes come from stored matrices alone.
UNCONFIRMED = "The solver has not confirmed these values yet."
#: All parameters count as determined if less than this is missing: the resolution of one decimal.
ALL = 0.05
#: Standard deviations of the test below which a change of measured values is rounding.
NOTHING = 1e-6
#: Changes below it are shown as none: two decimals of a per cent.
SHOWN = 5e-5
#: Misfits below it are not shown in digits.
ROUNDED = 1e-3
#: Two changes whose amounts differ by less are called equal.
EQUAL = 0.05


@dataclass(frozen=True, slots=True)
class ParameterTrust:
    """How far one parameter can be trusted.

    test_share: 1 is the test alone, 0 the prior alone; flags: see the module; clauses: one for each
    flag. scale: the printed number of a change by 1; None for a relative value.
    """

    name: str
    updated: float
    standard_error: float
    repeatability: float
    test_share: float
    on_bound: bool
    collinear_with: tuple[str, ...]
    flags: tuple[str, ...]
    clauses: tuple[str, ...]
    scale: float | None = None

    @property
    def doubtful(self) -> bool:
        """Whether a flag puts it in doubt."""
        return bool(set(self.flags) - NO_DOUBT)

    @property
    def sentence(self) -> str:
        if self.clauses:
            return f"{self.name} {'; it '.join(self.clauses)}."
        determined = f"{self.name} is determined by the test ({100 * self.test_share:.0f} %)"
        if np.isnan(self.standard_error):
            return f"{determined}; its standard error is withheld."
        return f"{determined}, to ±{100 * self.standard_error:.2g} %."

    @property
    def error(self) -> float | None:
        """The standard error; None on a bound, where the value does not scatter."""
        return self.standard_error or None


@dataclass(frozen=True, slots=True)
class StartSpread:
    """The ends of searches from several starts, and their local minima.

    starts, updated: (n_ends, n_parameters). The first `n_starts` ends are of the starts; others
    left a saddle or are exchanges, and their starts are NaN. updated is NaN where a search failed.
    misfits: (n_ends,). outcomes: the status of each, or why it failed. minima: (n_ends,), numbers
    of the local minima, 0 the answer's, -1 where the end is none. rivals: numbers of minima whose
    misfit is as low as the answer's. exchanged: those of them that have the answer's values in
    another order. differ: names of parameters that have other values at rivals. chosen: the end of
    the answer. extent: (2, n_parameters), least and largest values within the answer's minimum;
    valley: names of parameters that these leave in doubt.
    """

    starts: Floats
    updated: Floats
    misfits: Floats
    outcomes: tuple[str, ...]
    minima: Integers
    rivals: tuple[int, ...]
    differ: tuple[str, ...]
    chosen: int
    seed: int
    n_starts: int
    exchanged: tuple[int, ...]
    extent: Floats
    valley: tuple[str, ...]

    @property
    def n_ended(self) -> int:
        """The number of starts whose search did not fail."""
        return int(np.isfinite(self.misfits[: self.n_starts]).sum())

    def lowest(self, minimum: int) -> int:
        """Return the end with the lowest misfit of a minimum."""
        members = np.flatnonzero(self.minima == minimum)
        return int(members[np.argmin(self.misfits[members])])


@dataclass(frozen=True, slots=True)
class Trust:
    """How far the parameters of an updating can be trusted.

    agrees: whether e1 is met; remaining: (n_parameters,), linear distance to the minimum misfit;
    freedom: degrees of freedom left; unseen: a sentence for each combination that the test does
    not determine;
    curve: the L-curve of the last step, None where there was none; regularisation: the factor that
    this step used; age: iterations since the sensitivity behind all this was computed; spread: of
    several starts; concerns: sentences on model and test; notes: sentences that raise no doubt;
    times_noise: the remaining misfit over what noise explains, if a model-form error is suspected,
    else 0; missed: names of the modes whose prediction from all other modes misses its
    95 % interval, of n_predicted.
    """

    parameters: tuple[ParameterTrust, ...]
    identifiability: Identifiability
    agrees: bool
    remaining: Floats
    freedom: int
    unseen: tuple[str, ...]
    curve: LCurve | None = None
    regularisation: float = float("nan")
    age: int = 0
    spread: StartSpread | None = None
    concerns: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    times_noise: float = 0.0
    missed: tuple[str, ...] = ()
    n_predicted: int = 0

    @property
    def meaningless(self) -> bool:
        """Whether the remaining misfit excludes any trust."""
        return self.times_noise > MEANINGLESS

    @property
    def withheld(self) -> bool:
        """Whether no standard error describes the parameters."""
        return any(np.isnan(item.standard_error) for item in self.parameters)

    @property
    def short(self) -> Floats:
        """The distance to the minimum misfit in its standard errors, (n_parameters,)."""
        errors = np.array([item.standard_error for item in self.parameters])
        noise = np.array([item.repeatability for item in self.parameters])
        errors = np.where(np.isnan(errors), np.hypot(noise, self.remaining), errors)
        known = np.isfinite(errors) & (self.remaining != 0.0)
        scatter = np.sqrt(np.maximum(np.where(known, errors, 1.0) ** 2 - self.remaining**2, 0.0))
        tiny = np.finfo(np.float64).tiny
        return np.where(known, np.abs(self.remaining) / np.maximum(scatter, tiny), 0.0)

    @property
    def ended(self) -> Ended:
        """Where updating ended."""
        if (self.short <= THERE).all():
            return "least misfit"
        return "good enough" if self.agrees else "under way"

    @property
    def too_short(self) -> bool:
        """Whether the distance to the minimum misfit matters."""
        return bool(((self.short > SHORT) & (np.abs(self.remaining) > NEGLIGIBLE)).any())

    @property
    def untested(self) -> bool:
        """Whether no other start was tried, so that there may be other minima."""
        return self.spread is None or self.spread.n_ended < 2

    @property
    def unchecked(self) -> bool:
        """Whether only the fit supports the answer, and any test can be fitted."""
        return self.freedom <= 0 and self.untested

    @property
    def fit_as_well(self) -> tuple[int, ...]:
        """Numbers of other minima that fit the test as well; none where not even the answer fits,
        because of a model-form error."""
        return () if self.spread is None or self.times_noise > 0.0 else self.spread.rivals

    @property
    def flagged(self) -> tuple[ParameterTrust, ...]:
        return tuple(item for item in self.parameters if item.flags)

    @property
    def verdict(self) -> TrustVerdict:
        doubtful = [item for item in self.parameters if item.doubtful]
        lost = self.meaningless or self.withheld or self.unchecked
        if lost or 2 * len(doubtful) > len(self.parameters):
            return TrustVerdict.NOT_TRUSTED
        if any(set(item.flags) - NO_DOUBT == {"starts"} for item in doubtful):
            return TrustVerdict.NOT_TRUSTED
        rivals = self.spread is not None and bool(self.spread.rivals)
        unsure = self.unseen or self.concerns or self.too_short or self.freedom <= 0
        unsure = unsure or self.untested
        if doubtful or rivals or unsure or not self.agrees:
            return TrustVerdict.RESERVATIONS
        return TrustVerdict.TRUSTED


def too_many_missed(n_missed: int, n_predicted: int) -> bool:
    """Return whether too many left-out modes miss their 95 % intervals for standard errors to be
    valid: more than a fifth, and more than chance makes likely."""
    chance = float(scipy.special.bdtrc(n_missed - 1.0, n_predicted, 0.05)) if n_missed else 1.0
    return n_missed > MISSES * n_predicted and chance < CHANCE


def with_spread(trust: Trust, spread: StartSpread) -> Trust:
    """Return trust with the minima that searches from several starts found."""
    text = "has another value at another minimum with as low a misfit"
    judged = []
    for place, item in enumerate(trust.parameters):
        clauses = [text] if item.name in spread.differ else []
        if item.name in spread.valley and not item.doubtful:
            low, high = spread.extent[:, place]
            clauses.append(f"may be anywhere from {low:.4g} to {high:.4g}, along a valley")
        if clauses:
            flags, clauses = (*item.flags, "starts"), [*item.clauses, "; it ".join(clauses)]
            item = replace(item, flags=flags, clauses=tuple(clauses))
        judged.append(item)
    return replace(trust, parameters=tuple(judged), spread=spread)


def with_concerns(trust: Trust, *concerns: str) -> Trust:
    """Return trust with concerns, which exclude trust without reservations."""
    return replace(trust, concerns=(*trust.concerns, *concerns))


def judge_parameters(
    parameters: ParameterSet,
    updated: Floats,
    start: Floats,
    standard_errors: Floats,
    repeatability: Floats,
    found: Identifiability,
    missing: tuple[int, ...] = (),
    zones: Collection[int] = (),
) -> tuple[ParameterTrust, ...]:
    """Return the flags and clauses of each parameter.

    updated, start, standard_errors, repeatability: (n_parameters,), relative to the deck, NaN where
    an error is withheld; missing: positions
    whose sensitivity could not be computed; zones: of fields, which are judged as one
    (`core/updating/parameter_fields`).
    """
    hidden = _companions([item.members for item in found.unseen])
    alike = _companions([subset for subset, _ in found.collinearity.above(ALIKE)])
    judged = []
    for place, item in enumerate(parameters.parameters):
        value, error = float(updated[place]), float(standard_errors[place])
        share, change = float(found.test_shares[place]), value - float(start[place])
        text = _bound_clause(item, value)
        scale = None if item.values == "relative" else item.scale
        if place in missing:
            text["missing"] = "kept its value, because its sensitivity could not be computed"
        elif place not in zones:
            mixed, like = (
                [parameters.names[other] for other in group.get(place, ())]
                for group in (hidden, alike)
            )
            moves = float(found.moves[place]) * (item.upper - item.lower) / item.standard_deviation
            moved = "" if abs(change) < SHOWN else _change(scale, change)
            text |= _share_clause(share, mixed, like, moves, moved)
        far = abs(value - 1.0) / item.standard_deviation
        where = "the deck" if scale is None else "its start"
        if far > FAR and place not in zones:
            text["far"] = (
                f"is {_change(scale, value - 1.0)} from {where}, {far:.1f} times the deviation it "
                "was given: it may compensate for another error"
            )
        if (
            not text
            and place not in zones
            and np.isfinite(error)
            and error > max(abs(change), NEGLIGIBLE)
        ):
            text["uncertain"] = (
                f"changed by {_change(scale, change)}, less than its standard error "
                f"({_change(scale, error).replace('+', '±')}): the value it had fits as well"
            )
        if np.isinf(error) and not set(text) - NO_DOUBT:
            text["undetermined"] = "has no finite standard error: the test alone does not fix it"
        others = sorted({*hidden.get(place, ()), *alike.get(place, ())})
        judged.append(
            ParameterTrust(
                item.name,
                value,
                error,
                float(repeatability[place]),
                share,
                "on_bound" in text,
                tuple(parameters.names[other] for other in others),
                tuple(text),
                tuple(text.values()),
                scale,
            )
        )
    return tuple(judged)


def _bound_clause(item: Parameter, value: float) -> dict[str, str]:
    bounds = {"lower": item.lower, "upper": item.upper}
    for side, bound in bounds.items():
        if np.isclose(value, bound, atol=1e-9):
            return {
                "on_bound": f"is on its {side} bound ({item.shown(bound):g}), which determines its "
                "value in place of the test"
            }
    return {}


def _share_clause(
    share: float, mixed: list[str], like: list[str], moves: float, moved: str
) -> dict[str, str]:
    """Return the clause on the test's share. moves: of the measured values over its bounds, in
    standard deviations of the test; moved: from its start, in words, "" if it stays."""
    percent = f"(the test determines {100 * share:.0f} % of its value)"
    if mixed and share < SURE:
        return {"collinear": f"cannot be separated from {_listed(mixed)} {percent}"}
    if share < UNSEEN_SHARE:
        did = f"was moved by {moved} without information from the test" * bool(moved)
        what = "no measured value changes" if moves < NOTHING else "measured values hardly change"
        return {
            "unseen": f"{did or 'stays at its start value'}: {what} with it (over its bounds by "
            f"{moves:.1g} standard deviations of the test)"
        }
    if share < HALF:
        return {"prior": f"follows from the prior more than from the test {percent}"}
    if like:
        return {
            "alike": f"has almost the same effect as {_listed(like)}: a small error of the test or "
            "the model moves them in opposite directions"
        }
    return {}


def _companions(groups: list[tuple[int, ...]]) -> dict[int, list[int]]:
    """Return the other members of its groups for each member."""
    others: dict[int, set[int]] = {}
    for group in groups:
        if len(group) > 1:
            for place in group:
                others.setdefault(place, set()).update(set(group) - {place})
    return {place: sorted(found) for place, found in others.items()}


def trust_sentences(trust: Trust) -> tuple[str, ...]:
    """Return the verdict in words, then its reasons."""
    return (
        _verdict_sentence(trust),
        ending_sentence(trust),
        *trust.unseen,
        *_spread_sentences(trust),
        *trust.concerns,
        *trust.notes,
    )


def combination_sentences(names: tuple[str, ...], found: Identifiability) -> tuple[str, ...]:
    """Return a sentence for each combination that the test does not determine."""
    texts = [_unseen_sentence(names, item) for item in found.unseen if len(item.members) > 1]
    told = {place for item in found.unseen for place in item.members}
    for subset, index in found.collinearity.above(ALIKE):
        if not told & set(subset):
            texts.append(
                f"{_listed([names[place] for place in subset])} have almost the same effect on "
                f"these modes (collinearity index {index:.0f}): a small error of the test or the "
                "model moves them in opposite directions."
            )
    return tuple(texts)


def ending_sentence(trust: Trust) -> str:
    """Return where updating ended, and the distance to the minimum misfit."""
    if trust.ended == "least misfit":
        return "Updating ended at the minimum misfit."
    short = trust.short
    order = [place for place in np.argsort(-short).tolist() if short[place] > THERE]
    moves = ", ".join(
        f"{trust.parameters[place].name} by "
        f"{_change(trust.parameters[place].scale, float(trust.remaining[place]))}, "
        f"{min(short[place], 1e3):.1f} standard errors"
        for place in order[:LISTED]
    )
    more = f", and {len(order) - LISTED} more" if len(order) > LISTED else ""
    why = "with e1 met, before" if trust.ended == "good enough" else "before"
    smaller = "; a smaller e1 leads to the minimum" if trust.agrees else ""
    return (
        f"Updating ended {why} the minimum misfit, which is further away ({moves}{more}). The "
        f"standard errors include this distance{smaller}."
    )


def _unseen_sentence(names: tuple[str, ...], item: UnseenCombination) -> str:
    first, *others = (names[place] for place in item.members)
    changes = item.changes[1:]
    if len(others) >= LISTED:
        return (
            f"The test determines {_listed([first, *others])} only relative to each other: "
            "changing all of them together hardly changes the measured values."
        )
    if len(others) > 1:
        moves = ", ".join(
            f"{name} by {_percent(0.01 * change)}"
            for name, change in zip(others, changes, strict=True)
        )
        return (
            f"The test cannot separate {_listed([first, *others])}: changing {first} by +1 % "
            f"together with {moves} hardly changes the measured values."
        )
    other, change = others[0], float(changes[0])
    equal = abs(abs(change) - 1.0) < EQUAL
    if change > 0.0:
        means = (
            "raising both by the same share"
            if equal
            else (f"raising {first} by 1 % and {other} by {change:.2g} %")
        )
        return (
            f"The test determines only the ratio of {first} and {other}: {means} hardly changes "
            "the measured values."
        )
    means = (
        "raising one and lowering the other by the same share"
        if equal
        else (f"raising {first} by 1 % and lowering {other} by {-change:.2g} %")
    )
    return (
        f"The test determines {first} and {other} only together: {means} hardly changes the "
        "measured values."
    )


def verdict_reasons(trust: Trust) -> tuple[str, ...]:
    """Return why the parameters are not trusted without reservations, the gravest reason first."""
    doubtful = [item.name for item in trust.parameters if item.doubtful]
    n, reasons = len(trust.parameters), []
    if too_many_missed(len(trust.missed), trust.n_predicted):
        reasons.append(
            f"{len(trust.missed)} of {trust.n_predicted} left-out modes miss the interval that the "
            f"other modes predict ({_listed(trust.missed)}), so standard errors are withheld"
        )
    elif trust.withheld:
        reasons.append(
            "the model's own error is too large for standard errors, so they are withheld"
        )
    if trust.meaningless:
        reasons.append(f"the remaining misfit is {trust.times_noise:.2g} times what noise explains")
    if doubtful:
        reasons.append(f"{len(doubtful)} of {n} parameters in doubt ({_listed(doubtful)})")
    if unseen := [item.name for item in trust.parameters if "unseen" in item.flags]:
        reasons.append(f"measured values hardly change with {_listed(unseen)}")
    if trust.freedom <= 0:
        reasons.append(
            "no degree of freedom is left, as many parameters as independent measured values can "
            "match any test"
        )
    if trust.unseen and not doubtful:
        reasons.append("the test can hardly separate some parameters")
    if not trust.agrees:
        reasons.append("e1 is not met")
    if trust.fit_as_well:
        reasons.append("other values fit as well")
    elif trust.spread is not None and trust.spread.rivals:
        reasons.append("other values have as low a misfit")
    if trust.untested:
        reasons.append("uniqueness not tested")
    if trust.too_short:
        reasons.append(f"the minimum misfit is more than {SHORT:.0f} standard errors away")
    if trust.concerns:
        reasons.append("concerns about the model or the test are listed with the verdict")
    return tuple(reasons)


def _verdict_sentence(trust: Trust) -> str:
    n, told = len(trust.parameters), trust.identifiability.n_told
    why = "; ".join(verdict_reasons(trust)) or "none in doubt"
    count = f"{told:.1f} of {n} parameters" if n > 1 else f"{100 * told:.0f} % of the parameter"
    if n - told >= ALL:
        count = f"{count}, the prior the rest"
    elif n > 1:
        count = f"all {n} parameters"
    return f"The parameters are {trust.verdict}: {why}. The test determines {count}."


def _spread_sentences(trust: Trust) -> list[str]:
    spread = trust.spread
    if spread is None:
        return ["Uniqueness not tested: no other starting point was tried."]
    names, n = [item.name for item in trust.parameters], spread.n_starts
    texts = [_starts_sentence(spread, n)]
    if spread.valley:
        ranges = ", ".join(
            f"{name} {low:.4g} to {high:.4g}"
            for name, low, high in zip(names, *spread.extent, strict=True)
            if name in spread.valley
        )
        texts.append(f"Along a valley the misfit rises by no more than noise: {ranges}.")
    return [*texts, *_rival_sentences(trust, spread, names), *_worse_sentence(spread)]


def _starts_sentence(spread: StartSpread, n: int) -> str:
    """How many starts led where."""
    numbers = spread.minima[:n]
    same, saddles = int(np.sum(numbers == 0)), spread.n_ended - int(np.sum(numbers >= 0))
    others = int(np.sum(numbers > 0))
    if same == n:
        return f"All {n} starting points converged to the reported solution."
    counts = [(same, "converged to the reported solution"), (others, "to other minima")]
    counts += [
        (saddles, "to saddles" if saddles > 1 else "to a saddle"),
        (n - spread.n_ended, "failed"),
    ]
    return f"Of {n} starting points " + ", ".join(f"{k} {what}" for k, what in counts if k) + "."


def _rival_sentences(trust: Trust, spread: StartSpread, names: list[str]) -> list[str]:
    """A sentence a minimum with as low a misfit, and one for all exchanges."""
    answer = _values(names, [item.updated for item in trust.parameters])
    good = "fit as well" if trust.fit_as_well else "have as low a misfit"
    one = "fit as well" if trust.fit_as_well else "have a misfit as low"
    texts = []
    if spread.exchanged:
        ends = [spread.lowest(number) for number in spread.exchanged]
        own = np.array([item.updated for item in trust.parameters])
        moved = np.abs(spread.updated[ends] - own).max(axis=0) > NEGLIGIBLE
        which = _listed([name for name, on in zip(names, moved.tolist(), strict=True) if on])
        example = _values(names, spread.updated[ends[0]].tolist())
        if len(ends) == 1:
            verb = good.replace("fit", "fits").replace("have", "has")
            what = f"Another minimum, an exchange of the values of {which}, {verb}:"
        else:
            what = f"{len(ends)} more minima, exchanges of the values of {which}, {good}, such as"
        texts.append(f"{what} {example}; the answer is {answer}.")
    for number in spread.rivals:
        if number not in spread.exchanged:
            values = _values(names, spread.updated[spread.lowest(number)].tolist())
            texts.append(f"Other values {one}: {values}; the answer is {answer}.")
    return texts


def _worse_sentence(spread: StartSpread) -> list[str]:
    """A sentence with the misfits of worse minima."""
    numbers = [n for n in range(1, int(spread.minima.max(initial=0)) + 1) if n not in spread.rivals]
    if not numbers:
        return []
    misfits = sorted(float(spread.misfits[spread.lowest(number)]) for number in numbers)
    shown = ", ".join(f"{misfit:.3g}" for misfit in misfits[:LISTED])
    more = ", ..." if len(misfits) > LISTED else ""
    what = "worse local minimum has" if len(numbers) == 1 else "worse local minima have"
    own = float(spread.misfits[spread.chosen])
    # Below it only rounding is left, which differs between machines.
    lowest = f"{own:.3g}" if own >= ROUNDED else f"below {ROUNDED:g}"
    return [f"{len(numbers)} {what} a misfit of {shown}{more} (the answer {lowest})."]


def _values(names: list[str], values: list[float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in zip(names, values, strict=True))


def _change(scale: float | None, change: float) -> str:
    """A change of a parameter's value: in per cent, or in the units of its values."""
    return _percent(change) if scale is None else f"{scale * change:+.3g}"


def _percent(share: float) -> str:
    return f"{100 * share:+.3g} %"


def _listed(names: list[str] | tuple[str, ...]) -> str:
    """Return names in a list, and the number of those beyond the first few."""
    shown = list(names)
    if len(shown) > LISTED:
        shown = [*shown[: LISTED - 1], f"{len(names) - LISTED + 1} others"]
    return " and ".join(filter(None, [", ".join(shown[:-1]), *shown[-1:]]))

"""What is said of parameters and of the whole: each flag of `core/updating/trust` in words."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from modetune.core.modes import Floats
from modetune.core.parameters import Parameter, ParameterSet
from modetune.core.updating.identifiability import Identifiability, UnseenCombination
from modetune.core.updating.trust import NEGLIGIBLE, THERE, ParameterTrust, Trust

#: Shares of the test below which a parameter is unseen, known by the prior mainly, mixed up.
UNSEEN_SHARE, HALF, SURE = 0.1, 0.5, 0.9
#: Deviations from the deck beyond which a parameter stands for something else.
FAR = 3.0
#: Collinearity index at which subsets count as alike.
ALIKE = 20.0
#: So many names are told one by one.
LISTED = 6
#: All are told where less of them is missing: what one decimal shows.
ALL = 0.05
#: Standard deviations of the test below which measured values do not change but for rounding.
NOTHING = 1e-6
#: Changes below it are shown as none: two decimals of a per cent.
SHOWN = 5e-5
#: Two changes whose amounts differ by less are called equal.
EQUAL = 0.05


def judge_parameters(
    parameters: ParameterSet,
    updated: Floats,
    start: Floats,
    standard_errors: Floats,
    found: Identifiability,
    missing: tuple[int, ...] = (),
    zones: Collection[int] = (),
) -> tuple[ParameterTrust, ...]:
    """Flags and half sentences of each parameter.

    updated, start, standard_errors: (n_parameters,), relative to the deck; missing: positions
    whose sensitivity could not be computed; zones: of fields, which are judged as one
    (`core/updating/fields`).
    """
    hidden = _companions([item.members for item in found.unseen])
    alike = _companions([subset for subset, _ in found.collinearity.above(ALIKE)])
    judged = []
    for place, item in enumerate(parameters.parameters):
        value, error = float(updated[place]), float(standard_errors[place])
        share, change = float(found.test_shares[place]), value - float(start[place])
        said = _bound_clause(item, value)
        scale = None if item.values == "relative" else item.scale
        if place in missing:
            said["missing"] = "kept its value, because its sensitivity could not be computed"
        elif place not in zones:
            mixed, like = (
                [parameters.names[other] for other in group.get(place, ())]
                for group in (hidden, alike)
            )
            moves = float(found.moves[place]) * (item.upper - item.lower) / item.standard_deviation
            moved = "" if abs(change) < SHOWN else _change(scale, change)
            said |= _share_clause(share, mixed, like, moves, moved)
        far = abs(value - 1.0) / item.standard_deviation
        where = "the deck" if scale is None else "its start"
        if far > FAR and place not in zones:
            said["far"] = (
                f"is {_change(scale, value - 1.0)} from {where}, {far:.1f} times the deviation it "
                "was given: it may stand in for something else that is wrong"
            )
        if (
            not said
            and place not in zones
            and np.isfinite(error)
            and error > max(abs(change), NEGLIGIBLE)
        ):
            said["uncertain"] = (
                f"changed by {_change(scale, change)}, less than its standard error "
                f"({_change(scale, error).replace('+', '±')}): the value it had fits as well"
            )
        others = sorted({*hidden.get(place, ()), *alike.get(place, ())})
        judged.append(
            ParameterTrust(
                item.name,
                value,
                error,
                share,
                "on_bound" in said,
                tuple(parameters.names[other] for other in others),
                tuple(said),
                tuple(said.values()),
                scale,
            )
        )
    return tuple(judged)


def _bound_clause(item: Parameter, value: float) -> dict[str, str]:
    bounds = {"lower": item.lower, "upper": item.upper}
    for side, bound in bounds.items():
        if np.isclose(value, bound, atol=1e-9):
            return {
                "on_bound": f"stands on its {side} bound ({item.shown(bound):g}): the number is "
                "the bound's, not the test's"
            }
    return {}


def _share_clause(
    share: float, mixed: list[str], like: list[str], moves: float, moved: str
) -> dict[str, str]:
    """moves: of the measured values over its bounds, in standard deviations of the test; moved:
    from its start, in words, "" where it stays."""
    percent = f"({100 * share:.0f} % of its value is the test's)"
    if mixed and share < SURE:
        return {"collinear": f"cannot be told apart from {_listed(mixed)} {percent}"}
    if share < UNSEEN_SHARE:
        did = f"was moved by {moved}, which the test does not tell" * bool(moved)
        what = "no measured value changes" if moves < NOTHING else "measured values hardly change"
        return {
            "unseen": f"{did or 'stays at its start value'}: {what} with it (over its bounds by "
            f"{moves:.1g} standard deviations of the test)"
        }
    if share < HALF:
        return {"prior": f"is known by the prior more than by the test {percent}"}
    if like:
        return {
            "alike": f"acts almost like {_listed(like)}: a small error of the test or the "
            "model moves them against each other"
        }
    return {}


def _companions(groups: list[tuple[int, ...]]) -> dict[int, list[int]]:
    """Of each member of a group of several, the others."""
    others: dict[int, set[int]] = {}
    for group in groups:
        if len(group) > 1:
            for place in group:
                others.setdefault(place, set()).update(set(group) - {place})
    return {place: sorted(found) for place, found in others.items()}


def trust_sentences(trust: Trust) -> tuple[str, ...]:
    """The verdict in words, then what stands behind it."""
    return (
        _verdict_sentence(trust),
        ending_sentence(trust),
        *trust.unseen,
        *_spread_sentences(trust),
        *trust.concerns,
        *trust.notes,
    )


def combination_sentences(names: tuple[str, ...], found: Identifiability) -> tuple[str, ...]:
    """What several parameters hide from the test together, a sentence each."""
    said = [_unseen_sentence(names, item) for item in found.unseen if len(item.members) > 1]
    told = {place for item in found.unseen for place in item.members}
    for subset, index in found.collinearity.above(ALIKE):
        if not told & set(subset):
            said.append(
                f"{_listed([names[place] for place in subset])} act almost alike on these modes "
                f"(collinearity index {index:.0f}): a small error of the test or the model moves "
                "them against each other."
            )
    return tuple(said)


def ending_sentence(trust: Trust) -> str:
    """Whether updating ended at the least misfit, or where e1 is met, and how far these are apart.

    Standard errors tell how the least misfit scatters; e1 may end updating well before it.
    """
    if trust.ended == "least misfit":
        return "Updating ended at the least misfit."
    short = trust.short
    order = [place for place in np.argsort(-short).tolist() if short[place] > THERE]
    moves = ", ".join(
        f"{trust.parameters[place].name} by "
        f"{_change(trust.parameters[place].scale, float(trust.remaining[place]))}, "
        f"{min(short[place], 1e3):.1f} standard errors"
        for place in order[:LISTED]
    )
    more = f", and {len(order) - LISTED} more" if len(order) > LISTED else ""
    why = (
        "Updating ended as soon as e1 was met, which is good enough, not the least misfit: that"
        if trust.ended == "good enough"
        else "Updating ended before the least misfit: that"
    )
    ask = "; for the least misfit itself ask for a smaller e1" if trust.agrees else ""
    return (
        f"{why} lies further on ({moves}{more}). The standard errors beside the values include "
        f"this way{ask}."
    )


def _unseen_sentence(names: tuple[str, ...], item: UnseenCombination) -> str:
    first, *others = (names[place] for place in item.members)
    changes = item.changes[1:]
    if len(others) >= LISTED:
        return (
            f"{_listed([first, *others])} are told relative to each other only: a change of all of "
            "them together is hardly noticed by the test."
        )
    if len(others) > 1:
        moves = ", ".join(
            f"{name} by {_percent(0.01 * change)}"
            for name, change in zip(others, changes, strict=True)
        )
        return (
            f"{_listed([first, *others])} cannot be told apart: changing {first} by +1 % together "
            f"with {moves} is hardly noticed by the test."
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
            f"{first} and {other} can only be told as a ratio: {means} is hardly noticed by the "
            "test."
        )
    means = (
        "raising one and lowering the other by the same share"
        if equal
        else (f"raising {first} by 1 % and lowering {other} by {-change:.2g} %")
    )
    return f"{first} and {other} can only be told together: {means} is hardly noticed by the test."


def _verdict_sentence(trust: Trust) -> str:
    doubtful = [item.name for item in trust.parameters if item.doubtful]
    n, told = len(trust.parameters), trust.identifiability.n_told
    reasons = []
    if trust.meaningless:
        reasons.append(
            f"what is left is {trust.times_noise:.2g} times what noise explains, so standard "
            "errors mean nothing"
        )
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
        reasons.append("some of them can hardly be told apart")
    if not trust.agrees:
        reasons.append("e1 is not met")
    if trust.spread is not None and trust.spread.rivals:
        reasons.append("other starts fit as well with other values")
    if trust.concerns or trust.too_short:
        reasons.append("see below")
    why = "; ".join(reasons) or "none in doubt"
    count = f"{told:.1f} of {n} parameters" if n > 1 else f"{100 * told:.0f} % of the parameter"
    if n - told >= ALL:
        count = f"{count}, the prior the rest"
    elif n > 1:
        count = f"all {n} parameters"
    return f"The parameters are {trust.verdict}: {why}. The test tells {count}."


def _spread_sentences(trust: Trust) -> list[str]:
    spread = trust.spread
    if spread is None:
        return []
    n, places = spread.starts.shape[0], int(spread.minima.max(initial=0)) + 1
    failed = n - spread.n_ended
    ended = f"{spread.n_ended} of {n} starts ended" if failed else f"All {n} starts ended"
    if places == 1:
        return [f"{ended} at the same values."]
    same = int(np.sum(spread.minima == 0))
    as_well = (
        f", {len(spread.rivals)} of which fit as well" if spread.rivals else ", which fit worse"
    )
    told = f"{ended}, in {places} places: {same} at the answer, the others elsewhere{as_well}."
    names = [item.name for item in trust.parameters]
    answer = _values(names, [item.updated for item in trust.parameters])
    others = [
        _values(names, spread.updated[int(np.flatnonzero(spread.minima == place)[0])].tolist())
        for place in spread.rivals
    ]
    return [
        told,
        *(f"Another set fits as well: {values}; the answer is {answer}." for values in others),
    ]


def _values(names: list[str], values: list[float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in zip(names, values, strict=True))


def _change(scale: float | None, change: float) -> str:
    """A change of a parameter's value: in per cent, or in the units of its values."""
    return _percent(change) if scale is None else f"{scale * change:+.3g}"


def _percent(share: float) -> str:
    return f"{100 * share:+.3g} %"


def _listed(names: list[str] | tuple[str, ...]) -> str:
    """Names as people list them; of many the first few."""
    shown = list(names)
    if len(shown) > LISTED:
        shown = [*shown[: LISTED - 1], f"{len(names) - LISTED + 1} others"]
    return " and ".join(filter(None, [", ".join(shown[:-1]), *shown[-1:]]))

"""Plausibility of parameters: sensible bounds, and an effect on the used modes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from modetune.core.modes import Floats, Integers
from modetune.core.parameters import DAMPING, QUANTITIES, Parameter
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.trust import NOTHING, UNSEEN_SHARE
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.solvers import untested_capabilities
from modetune.flows.diagnosis.findings import (
    PARAMETERS,
    Finding,
    of_parameter,
    setting,
    without_parameter,
)
from modetune.flows.updating.sensitivities import BALANCE_TOLERANCE, not_linear

#: A parameter with less of the strain energy in every used mode cannot be found from them.
DEAD = 1e-3
#: Bounds wider than this factor either way hold nothing back, narrower than this share nothing.
WIDEST, NARROWEST = 10.0, 0.02
#: An isotropic material does not bear more.
POISSON_LIMIT = 0.5
#: Steps that need more data than parameters.
DETERMINED = ("pseudo_inverse", "weighted_least_squares")
#: Responses that follow from the modes that are used.
MODAL = {"frequencies", "shapes", "mac", "complex_shapes"}


@dataclass(frozen=True, slots=True)
class EnergyShare:
    """A parameter's share of an energy (strain, kinetic) in each used mode, (n_pairs,); NaN if not
    known."""

    parameter: str
    energy: str
    shares: Floats

    @property
    def largest(self) -> float:
        return float(self.shares.max(initial=0.0))


def bound_findings(campaign: Campaign) -> Iterator[Finding]:
    """Report implausible bounds, start values and numbers of parameters."""
    yield from (PARAMETERS.good(text) for text in campaign.splits)
    for parameter in campaign.parameters.parameters:
        yield from _bounds(campaign, parameter)
    data = sum(
        int(case.weighting.frequencies_used.sum())
        + int(case.weighting.shapes_used.sum()) * case.test.modes.n_dof
        for case in campaign.used
    )
    count = len(campaign.parameters)
    if count >= data and campaign.update.step in DETERMINED:
        yield PARAMETERS.doubtful(
            f"{count} parameters from {data} measured numbers by {campaign.update.step}, which "
            "can match any test",
            "update.step",
            "compare more modes or shapes, use pulled_to_initial, or fewer parameters",
            setting("update.step", "pulled_to_initial"),
        )


def _bounds(campaign: Campaign, item: Parameter) -> Iterator[Finding]:
    bounds = f"bounds {item.shown(item.lower):g} to {item.shown(item.upper):g}"
    where = f"parameter {item.name}"
    if item.quantity == "poissons_ratio":
        reach = item.number(campaign.case.solver.deck.deck_value(item), item.upper)
        if reach >= POISSON_LIMIT:
            text = f"{bounds} let Poisson's ratio reach {reach:.3g}"
            lower = item.shown(item.lower)
            upper = item.shown(item.upper) * (POISSON_LIMIT - 0.01) / reach
            fits = (_short(lower), _short(upper)) if item.proportional and lower < upper else None
            remedy = "keep it below 0.5"
            yield PARAMETERS.wrong(text, where, remedy, of_parameter(item.name, "bounds", fits))
    if item.quantity in DAMPING and not campaign.case.needs("losses"):
        text = item.quantity.replace("_", " ")
        text += " does not change frequencies and shapes of undamped modes"
        remedy = "leave it out; no response of this campaign depends on it"
        yield PARAMETERS.doubtful(text, where, remedy, without_parameter(item.name))
    relative = item.values == "relative"
    if relative and not item.lower <= 1.0 <= item.upper:
        text = f"{bounds} exclude the deck's own value"
        around = (min(item.shown(item.lower), 1.0), max(item.shown(item.upper), 1.0))
        remedy = "bounds are relative to the deck's value, 1"
        yield PARAMETERS.doubtful(text, where, remedy, of_parameter(item.name, "bounds", around))
    if relative and (item.lower < 1.0 / WIDEST or item.upper > WIDEST):
        remedy = "give what is physically possible, such as 0.5 to 2"
        usual = of_parameter(item.name, "bounds", (0.5, 2.0))
        yield PARAMETERS.doubtful(f"{bounds} are too wide to limit anything", where, remedy, usual)
    if item.upper - item.lower < NARROWEST:
        remedy = "widen them, or fix the parameter"
        wider = of_parameter(item.name, "bounds", _widened(item))
        drop = without_parameter(item.name)
        yield PARAMETERS.doubtful(f"{bounds} are too narrow", where, remedy, wider, drop)
    if min(item.initial - item.lower, item.upper - item.initial) < 1e-6:
        text = f"it starts on a bound ({item.shown(item.initial):g})"
        middle = _short(item.shown(0.5 * (item.lower + item.upper)))
        wider = of_parameter(item.name, "bounds", _widened(item))
        inside = of_parameter(item.name, "initial", middle)
        yield PARAMETERS.doubtful(text, where, "start inside the bounds", wider, inside)


def _widened(item: Parameter) -> tuple[float, float]:
    """Bounds with the start value inside, at least a fifth of it away, in the campaign's terms."""
    away = 0.2 * max(abs(item.initial), 0.5 * (item.upper - item.lower))
    lower, upper = min(item.lower, item.initial - away), max(item.upper, item.initial + away)
    return _short(item.shown(lower)), _short(item.shown(upper))


def _short(value: float) -> float:
    """Return a value with four digits, which is enough for a bound."""
    return float(f"{value:.4g}")


def from_nothing(campaign: Campaign) -> tuple[Parameter, ...]:
    """Parameters that start from no stiffness or mass at all: without it parts may be loose.

    None where the number of rigid modes is given by hand.
    """
    solver = campaign.case.solver
    if solver.rigid_modes is not None:
        return ()
    starts = zip(campaign.parameters.parameters, campaign.start.tolist(), strict=True)
    return tuple(
        item
        for item, start in starts
        if QUANTITIES[item.quantity].sign == "not negative"
        and any(QUANTITIES[item.quantity].powers)
        and item.number(solver.deck.deck_value(item), start) == 0.0
    )


def joined_values(campaign: Campaign, nothing: tuple[Parameter, ...]) -> Floats:
    """The start, with parameters that start from nothing halfway to their upper bounds."""
    halfway = 0.5 * (campaign.start + campaign.parameters.upper)
    return np.where(
        [item in nothing for item in campaign.parameters.parameters], halfway, campaign.start
    )


def loose_findings(
    campaign: Campaign, nothing: tuple[Parameter, ...], start: ModalResult, joined: ModalResult
) -> Iterator[Finding]:
    """Whether parameters that start from nothing change the number of rigid modes."""
    if start.n_rigid == joined.n_rigid:
        return
    names = ", ".join(item.name for item in nothing)
    values = campaign.parameters.values(joined_values(campaign, nothing))
    shown = ", ".join(f"{item.shown(values[item.name]):g}" for item in nothing)
    yield PARAMETERS.doubtful(
        f"it starts from nothing, where {start.n_rigid} modes are rigid; at {shown} "
        f"{joined.n_rigid} are, so the order of elastic modes shifts as it moves",
        f"parameter {names}",
        "start it inside its bounds, about where it is expected",
        *(of_parameter(p.name, "initial", _short(p.shown(values[p.name]))) for p in nothing),
    )


def energy_shares(result: ModalResult, computed: Integers) -> tuple[EnergyShare, ...]:
    """Return the energy shares of parameters in these elastic modes, where the run has them."""
    total = result.total_strain_energy[result.n_rigid :][computed]
    if not (np.isfinite(total).all() and (total > 0.0).all()):
        return ()
    return tuple(
        EnergyShare(name, "strain", result.elastic_energies(name)[computed] / total)
        for name in result.groups
        if np.isfinite(result.elastic_energies(name)[computed]).all()
    )


def energy_findings(
    campaign: Campaign, result: ModalResult, modes: list[int], shares: tuple[EnergyShare, ...]
) -> Iterator[Finding]:
    """Report parameters that hardly affect a used mode, and those that the run cannot judge.

    modes: numbers of the test modes that the shares belong to.
    """
    for item in shares:
        yield from _dead(campaign, item, modes)
    judged = {item.parameter for item in shares}
    silent = [name for name in campaign.parameters.names if name not in judged]
    if silent:
        yield PARAMETERS.good(
            "strain energies cannot show its effect; the first sensitivity will",
            f"parameter {', '.join(silent)}",
        )
    if campaign.sensitivity.method == "auto":
        reasons = [reason(campaign.case.solver) for reason in (not_linear, untested_capabilities)]
        yield from (PARAMETERS.good(text) for text in reasons if text)
    yield from _balance(campaign, result, bool(shares))


def _dead(campaign: Campaign, item: EnergyShare, modes: list[int]) -> Iterator[Finding]:
    """Whether a parameter has next to no energy in used modes, or moves their frequencies by so
    little that its value would be the prior's, and nothing else is compared."""
    case, place = campaign.case, campaign.parameters.names.index(item.parameter)
    own, start = campaign.parameters.parameters[place], campaign.start[place]
    rows = [case.test.numbers.index(mode) for mode in modes if start]
    if not rows:
        return
    # A share is theta / lambda times the eigenvalue's slope, and twice the frequency's.
    moved = 0.5 * item.shares / start / case.weighting.frequency_deviations[rows]
    slope = float(np.linalg.norm(moved[case.weighting.frequencies_used[rows]]))
    known, moves = (own.standard_deviation * slope) ** 2, slope * (own.upper - own.lower)
    dead, kinds = item.largest < DEAD, {each.kind for each in case.responses}
    if not dead and (known >= UNSEEN_SHARE * (1.0 + known) or kinds != {"frequencies"}):
        return
    text = (
        f"{'dead' if dead else 'hardly alive'}: at most {100 * item.largest:.2g} % of the "
        f"{item.energy} energy of any used mode; over its bounds it moves their frequencies by "
        f"{moves:.1g} standard deviations of the test"
    )
    where, others = f"parameter {own.name}", ", ".join(sorted(kinds - MODAL)).replace("_", " ")
    if others:
        yield PARAMETERS.good(f"{text}, so only {others} may determine it", where)
        return
    text += ", so updating leaves it at its start value" * (moves < NOTHING)
    remedy = "leave it out, or use modes that it moves"
    yield PARAMETERS.doubtful(text, where, remedy, without_parameter(own.name))


def _balance(campaign: Campaign, result: ModalResult, has_shares: bool) -> Iterator[Finding]:
    if campaign.sensitivity.method != "strain_energy" or not has_shares:
        return
    balance = result.energy_balance
    if (np.abs(balance - 1.0) <= BALANCE_TOLERANCE).all():
        return
    yield PARAMETERS.wrong(
        f"strain energies are {balance.min():.4g} to {balance.max():.4g} of what the "
        "eigenvalues say",
        "sensitivity.method",
        "use `auto`: the solver leaves some energy out (reduced elements)",
        setting("sensitivity.method", "auto"),
    )

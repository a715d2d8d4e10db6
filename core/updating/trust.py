"""How far the answer of an updating can be trusted: flags, sentences, a verdict.

A matched frequency proves little, so each parameter is asked questions, and each yes is a flag:

    missing     could its sensitivity not be computed?
    on_bound    does it stand on a bound?
    unseen      does less than a tenth of its value come from the test?
    prior       ... less than half?
    collinear   is it part of a combination that the test cannot see (and less than 90 % its own)?
    alike       does it act so much like one or two others that a small fault moves them against
                each other (collinearity index 20 and more, the upper end of what Brun and others
                2001 advise), although the test, taken at its word, tells them apart?
    far         is it more than three of its deviations away from the deck?
    starts      did updates from other starts end elsewhere, and fit as well?
    uncertain   is its change smaller than its standard error? That doubts nothing: it says that
                the deck's value fits as well.

All but alike and uncertain put a parameter in doubt.

The verdict. Not to be trusted: more than half of the parameters are in doubt, other starts fit as
well with other values of parameters that nothing else puts in doubt, no degree of freedom is left
(as many parameters as measured values can match any test) and no other start was tried, or what is
left is more than three times what measurement noise explains, since standard errors mean nothing
then. With reservations: any parameter in doubt or alike, a combination of parameters that the test
cannot see, no degree of freedom left where other starts end at the same values, e1 not met, the
least misfit more than two standard errors further on, or a concern: what was held out got worse, an
error that no parameter can remove. Else trusted.

Where updating ended. e1 ends it where the model is good enough, which may be well before the least
misfit. The standard errors that are told hold at the values that are told: with C the covariance of
the least misfit and d the way that is left to it, they are those of C + d d^T.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from modetune.core.modes import Floats, Integers
from modetune.core.updating.estimation import LCurve
from modetune.core.updating.identifiability import Identifiability

Verdict = Literal["trusted", "trusted with reservations", "not to be trusted"]
#: Where updating ended: at the least misfit, before it where e1 is met, or where it is not.
Ended = Literal["least misfit", "good enough", "under way"]

#: Flags that put no parameter in doubt.
NO_DOUBT = {"uncertain", "alike"}
#: What is left, over what noise explains, beyond which standard errors mean nothing.
MEANINGLESS = 3.0
#: Standard errors of the least misfit within which updating ended there.
THERE = 0.3
#: ... and beyond which values are not called trusted, if they move by more than NEGLIGIBLE.
SHORT = 2.0
#: A change below this share of the deck's value is not worth a word.
NEGLIGIBLE = 0.01


@dataclass(frozen=True, slots=True)
class ParameterTrust:
    """What is to be said of one parameter.

    test_share: 1 is the test alone, 0 the prior alone; flags: see the module; clauses: a half
    sentence a flag. scale: what people read of a change by 1, None of a relative value.
    """

    name: str
    updated: float
    standard_error: float
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
        error = f"to ±{100 * self.standard_error:.2g} %"
        if not np.isfinite(self.standard_error):
            error = "the rest depends on what was known beforehand"
        return f"{self.name} is told by the test ({100 * self.test_share:.0f} %), {error}."


@dataclass(frozen=True, slots=True)
class StartSpread:
    """Where updates from several starts ended.

    starts, updated: (n_starts, n_parameters), NaN where one failed; misfits: (n_starts,);
    outcomes: status of each, or why it failed; minima: (n_starts,), numbers of the places where
    they ended, 0 being that of the answer, -1 failed; rivals: numbers of other places that fit as
    well; differ: names of parameters that have other values there; chosen: the start of the answer.
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

    @property
    def n_ended(self) -> int:
        return int(np.sum(self.minima >= 0))


@dataclass(frozen=True, slots=True)
class Trust:
    """How far the parameters of an updating can be trusted.

    agrees: whether e1 is met; remaining: (n_parameters,), how far the least misfit lies further
    on, linear; freedom: degrees of freedom, the measured values that are left to judge by;
    unseen: a sentence a combination that the test does not tell;
    curve: the L-curve of the last step, None where there was none; regularisation: the factor that
    this step used; age: iterations since the sensitivity behind all this was computed; spread: of
    several starts; concerns: sentences of others; notes: sentences that doubt nothing;
    times_noise: how many times more is left than noise explains where a model-form error is
    suspected, else 0.
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

    @property
    def meaningless(self) -> bool:
        """Whether so much is left that standard errors mean nothing."""
        return self.times_noise > MEANINGLESS

    @property
    def short(self) -> Floats:
        """The way to the least misfit in standard errors of that, (n_parameters,)."""
        errors = np.array([item.standard_error for item in self.parameters])
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
        """Whether the least misfit lies so far on that it matters."""
        return bool(((self.short > SHORT) & (np.abs(self.remaining) > NEGLIGIBLE)).any())

    @property
    def unchecked(self) -> bool:
        """Whether nothing but the fit itself speaks for it, and any test can be fitted."""
        return self.freedom <= 0 and (self.spread is None or self.spread.n_ended < 2)

    @property
    def flagged(self) -> tuple[ParameterTrust, ...]:
        return tuple(item for item in self.parameters if item.flags)

    @property
    def verdict(self) -> Verdict:
        doubtful = [item for item in self.parameters if item.doubtful]
        if self.meaningless or self.unchecked or 2 * len(doubtful) > len(self.parameters):
            return "not to be trusted"
        if any(set(item.flags) - NO_DOUBT == {"starts"} for item in doubtful):
            return "not to be trusted"
        rivals = self.spread is not None and bool(self.spread.rivals)
        unsure = self.unseen or self.concerns or self.too_short or self.freedom <= 0
        if doubtful or rivals or unsure or not self.agrees:
            return "trusted with reservations"
        return "trusted"


def with_spread(trust: Trust, spread: StartSpread) -> Trust:
    """With what updates from several starts showed."""
    said = "ends elsewhere from other starts, where the model fits as well"
    judged = tuple(
        replace(item, flags=(*item.flags, "starts"), clauses=(*item.clauses, said))
        if item.name in spread.differ
        else item
        for item in trust.parameters
    )
    return replace(trust, parameters=judged, spread=spread)


def with_concerns(trust: Trust, *concerns: str) -> Trust:
    """With sentences of others that keep the answer from being trusted without reservations."""
    return replace(trust, concerns=(*trust.concerns, *concerns))

"""Sampling of a density by emcee, and convergence of the chains.

Most moves are differences of other walkers (ter Braak 2006), which adapt to the scale of the
density; some are whole differences, which jump between peaks; others stretch (Goodman and Weare
2010). The walkers start around the peaks, in proportion to their shares.

Successive samples of a walker are correlated over the integrated autocorrelation time tau (Goodman
and Weare 2010), so n samples have an effective size of n / tau. The chains are long enough after 50
tau steps of each walker, if split R-hat, which compares the variance between half chains with that
within them (Gelman et al. 2013, 11.4), is below 1.05. Otherwise sampling continues: up to ten times
the requested steps, or a hundred times if they are cheap.

If a density p is expensive and g approximates it, most moves are STRIDE steps of a chain for g, and
p decides on the last one. As these steps are reversible for g, going from x to y
is accepted with min(1, p(y) g(x) / (p(x) g(y))) (Liu 2001, 9.4.3; Christen and Fox 2005): samples
are those of p for any g, and decorrelate in a few steps if g is accurate.
"""

from __future__ import annotations

from dataclasses import dataclass

import emcee
import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.flows.studies.sample.density import Peaks, Posterior

#: Steps of a walker that count as long enough, in autocorrelation times; R-hat likewise.
ENOUGH_TIMES, LARGEST_R_HAT = 50.0, 1.05
#: Autocorrelation times that are thrown away at the start.
BURN_TIMES = 5.0
#: Shares of the way from a peak that a walker beyond a limit begins at, one after the other.
TURNED = (-1.0, 0.5, -1.0, 0.3, -1.0, 0.1)
#: Steps by what foresees a density before it is asked itself; share of such moves.
STRIDE, FORESEEN_SHARE = 25, 0.7
#: Times the steps asked for that are made at most, and where they cost little.
LONGEST, LONGER = 10, 100


@dataclass(frozen=True, slots=True)
class Chains:
    """What the walkers left after they had forgotten where they began.

    samples: (n_steps, n_walkers, n_parameters); log_densities: (n_steps, n_walkers).
    autocorrelation_times, effective_sizes, r_hat: (n_parameters,). steps, burned: of each walker,
    made in all and thrown away; acceptance: share of moves that were accepted.
    """

    samples: Floats
    log_densities: Floats
    autocorrelation_times: Floats
    effective_sizes: Floats
    r_hat: Floats
    steps: int
    burned: int
    acceptance: float

    @property
    def are_enough(self) -> bool:
        """Whether the chains are long enough to be believed."""
        steps, times = self.samples.shape[0], self.autocorrelation_times
        return bool(steps >= ENOUGH_TIMES * times.max() and self.r_hat.max() <= LARGEST_R_HAT)

    @property
    def flat(self) -> Floats:
        """All samples, (n, n_parameters)."""
        return self.samples.reshape(-1, self.samples.shape[2])

    def thinned(self) -> tuple[Floats, Floats]:
        """Samples (n, n_parameters) that forgot half of the one before, and log densities (n,)."""
        every = max(1, int(self.autocorrelation_times.max() / 2.0))
        samples = self.samples[::every]
        return samples.reshape(-1, samples.shape[2]), self.log_densities[::every].ravel()


def sample(
    posterior: Posterior,
    peaks: Peaks,
    walkers: int,
    steps: int,
    rng: np.random.Generator,
    longest: int = LONGEST,
    foreseen: Posterior | None = None,
) -> Chains:
    """Sample a density. Reproducible for a generator's state.

    longest: how many times the steps asked for are made at most; foreseen: about the same density
    in the same range, at less cost.
    Raises CampaignError where there are too few walkers for the parameters.
    """
    check_walkers(walkers, posterior.lower.size)
    sampler = _sampler(posterior, walkers, rng, foreseen)
    state = _start(posterior, peaks, walkers, rng)
    made = 0
    while True:
        more = min(max(1, made // 2), longest - made)  # judging looks at all of them again
        state = sampler.run_mcmc(state, more * steps, skip_initial_state_check=made > 0)
        made += more
        chains = _judged(sampler, made * steps)
        if chains.are_enough or made >= longest:
            return chains


def check_walkers(walkers: int, n_parameters: int) -> None:
    """Raise CampaignError where the moves of the walkers need more of them."""
    least = max(6, 2 * n_parameters)
    if walkers < least or walkers % 2:
        raise CampaignError(
            f"--walkers {walkers}: expected an even number of at least {least} for {n_parameters} "
            "parameters"
        )


def walk(
    posterior: Posterior, peaks: Peaks, walkers: int, steps: int, rng: np.random.Generator
) -> Floats:
    """Return rough samples (n, n_parameters), the second half of a chain, without a check."""
    sampler = _sampler(posterior, walkers, rng)
    sampler.run_mcmc(_start(posterior, peaks, walkers, rng), steps)
    return np.asarray(sampler.get_chain(discard=steps // 2, flat=True))


class DensityForecast(emcee.moves.RedBlueMove):  # type: ignore[misc]  # emcee has no types
    """Steps of a chain for another density lead to what is proposed (see the module's head)."""

    def __init__(self, density: Posterior) -> None:
        super().__init__()
        self._density = density

    def get_proposal(
        self, sample: Floats, complement: list[Floats], random: np.random.RandomState
    ) -> tuple[Floats, Floats]:
        """Sets (n_walkers, n_parameters) and log g(x) / g(y), (n_walkers,)."""
        others, (n, n_parameters) = np.concatenate(complement), sample.shape
        at, begun = sample, self._density.log_density(sample)
        height = begun
        for _ in range(STRIDE):
            # Differences of two others, which stay where they are: as likely forth as back.
            first, second = random.randint(len(others), size=(2, n))
            scale = 2.38 / np.sqrt(2.0 * n_parameters) * np.exp(random.randn(n, 1))
            new = at + np.where(random.rand(n, 1) < 0.1, 1.0, scale) * (
                others[first] - others[second]
            )
            there = self._density.log_density(new)
            moves = np.log(random.rand(n)) < there - height
            at, height = np.where(moves[:, None], new, at), np.where(moves, there, height)
        return at, begun - height


def _sampler(
    posterior: Posterior, walkers: int, rng: np.random.Generator, foreseen: Posterior | None = None
) -> emcee.EnsembleSampler:
    # No snooker moves: in emcee 3.1 they accept with a wrong probability and narrow the samples.
    moves = [
        (emcee.moves.DEMove(), 0.6),
        (emcee.moves.DEMove(gamma0=1.0), 0.1),
        (emcee.moves.StretchMove(), 0.3),
    ]
    if foreseen is not None:
        moves = [(move, (1.0 - FORESEEN_SHARE) * share) for move, share in moves]
        moves.append((DensityForecast(foreseen), FORESEEN_SHARE))
    sampler = emcee.EnsembleSampler(
        walkers, posterior.lower.size, posterior.log_density, vectorize=True, moves=moves
    )
    sampler.random_state = np.random.MT19937(int(rng.integers(2**31))).state
    return sampler


def _start(posterior: Posterior, peaks: Peaks, walkers: int, rng: np.random.Generator) -> Floats:
    """Where walkers begin, (n_walkers, n_parameters): around the peaks, inside the range."""
    counts = np.floor(peaks.shares * walkers).astype(np.int64)
    counts[np.argsort(counts - peaks.shares * walkers)[: walkers - int(counts.sum())]] += 1
    drawn = np.vstack(
        [
            rng.multivariate_normal(point, covariance, size=count)
            for point, covariance, count in zip(
                peaks.points, peaks.covariances, counts.tolist(), strict=True
            )
        ]
    )
    # What fell outside is put back inside at random, so that no two walkers are at one point.
    outside = (drawn <= posterior.lower) | (drawn >= posterior.upper)
    again = posterior.lower + rng.random(drawn.shape) * (posterior.upper - posterior.lower)
    home = np.repeat(peaks.points, counts, axis=0)
    nearer = home + rng.random(drawn.shape) * 0.1 * (again - home)
    found = np.where(outside, nearer, drawn)
    for share in TURNED:  # what breaks a limit goes to the peak's other side, or nearer to it
        out = ~posterior.inside(found)
        found[out] = home[out] + share * (found[out] - home[out])
    return found


def _judged(sampler: emcee.EnsembleSampler, steps: int) -> Chains:
    """The chains so far, their beginning thrown away."""
    chain = np.asarray(sampler.get_chain())
    times = _autocorrelation_times(chain)
    # Half of a chain that is too short is kept all the same, so that it can be looked at.
    burned = min(int(np.ceil(BURN_TIMES * times.max())), steps // 2)
    kept = chain[burned:]
    times = _autocorrelation_times(kept)
    return Chains(
        samples=kept,
        log_densities=np.asarray(sampler.get_log_prob())[burned:],
        autocorrelation_times=times,
        effective_sizes=kept.shape[0] * kept.shape[1] / times,
        r_hat=split_r_hat(kept),
        steps=steps,
        burned=burned,
        acceptance=float(np.mean(sampler.acceptance_fraction)),
    )


def _autocorrelation_times(chain: Floats) -> Floats:
    """Of each parameter, (n_parameters,), at least 1; the chain's length where a walker does not
    move."""
    if chain.shape[0] < 2:
        return np.full(chain.shape[2], np.inf)
    moving = np.ptp(chain, axis=0).min(axis=0) > 0.0
    times = np.full(chain.shape[2], float(chain.shape[0]))
    if moving.any():
        # tol=0: whether the chain is long enough is judged here, not there
        times[moving] = emcee.autocorr.integrated_time(chain[:, :, moving], tol=0)
    return np.maximum(np.nan_to_num(times, nan=float(chain.shape[0])), 1.0)


def split_r_hat(chain: Floats) -> Floats:
    """Split R-hat of each parameter, (n_parameters,). chain: (n_steps, n_walkers, n_parameters).

    Root of the variance over all half chains by that within them: 1 where all agree.
    Source: Gelman et al. 2013, 11.4.
    """
    half = chain.shape[0] // 2
    if half < 2:
        return np.full(chain.shape[2], np.inf)
    halves = np.concatenate([chain[:half], chain[-half:]], axis=1)
    within = halves.var(axis=0, ddof=1).mean(axis=0)
    between = half * halves.mean(axis=0).var(axis=0, ddof=1)
    whole = (half - 1) / half * within + between / half
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.sqrt(whole / within)
    return np.asarray(np.where(within > 0.0, ratio, np.inf))

"""What modes cost by a model's matrices and by the solver's own runs, and which is less."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ModesForecast:
    """Seconds either way is expected to take, and the solver runs behind them.

    jobs: for the matrices; runs: of the solver's own modes and their differences; run_s: of one of
    them; measured: whether a run of the model was seen to take that, else its size tells.
    """

    jobs: int
    matrices_s: float
    runs: int
    solver_s: float
    run_s: float
    measured: bool

    @property
    def by_matrices(self) -> bool:
        """Whether the matrices are expected to take less; they do where they are there."""
        return self.jobs == 0 or self.matrices_s < self.solver_s

    @property
    def sentence(self) -> str:
        """Both ways and why, in words."""
        by = "matrices" if self.by_matrices else "the solver's own runs"
        source = "as measured" if self.measured else "judged by the number of elements"
        return (
            f"by {by}: {self.jobs} matrix job{'' if self.jobs == 1 else 's'}, about "
            f"{self.matrices_s:.2g} s in all, against {self.runs} runs, about "
            f"{self.solver_s:.2g} s (a run {self.run_s:.2g} s, {source})"
        )

"""Several solvers' modes side by side, on a terminal."""

from __future__ import annotations

from modetune.flows.report.tables import Column, Table, show
from modetune.flows.studies.cross_solver.cross_solver import Twin


def show_twin(twin: Twin) -> None:
    """Frequencies of all solvers side by side, differences and MAC from the first."""
    first, *others = twin.solvers
    columns = [Column("mode"), Column(first.solver, "Hz", ".4f")]
    values: list[list[float]] = [
        [pair + 1 for pair in range(first.frequencies_hz.size)],
        first.frequencies_hz.tolist(),
    ]
    for other in others:
        columns += [
            Column(other.solver, "Hz", ".4f"),
            Column("its mode"),
            Column("differs", "%", "+.3f"),
            Column("MAC", form=".4f"),
        ]
        values += [
            other.frequencies_hz.tolist(),
            (other.pairing.computed + 1).tolist(),
            twin.differences(other).tolist(),
            other.pairing.judged_mac.tolist(),
        ]
    rows = tuple(zip(*values, strict=True))
    lines = []
    for item in twin.solvers:
        lines.append(
            f"{item.solver} {item.version}: {item.result.n_rigid} rigid-body modes, mass "
            f"{item.result.mass:.6g}, {item.wall_s:.1f} s"
        )
        if item.masses:
            lines.append(f"  {item.masses}")
    lines += [f"{solver} did not run: {reason}" for solver, reason in twin.absent]
    show([Table(f"Elastic modes of {twin.name}", tuple(columns), rows), *lines])

"""Several solvers' modes side by side, on a terminal."""

from __future__ import annotations

from rich.console import Console
from rich.text import Text

from modetune.flows.report.tables import Column, Table, show_table
from modetune.flows.studies.cross_solver.cross_solver import Twin


def show_twin(console: Console, twin: Twin) -> None:
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
    show_table(console, Table(f"Elastic modes of {twin.name}", tuple(columns), rows))
    for item in twin.solvers:
        console.print(
            Text(
                f"{item.solver} {item.version}: {item.result.n_rigid} rigid-body modes, mass "
                f"{item.result.mass:.6g}, {item.wall_s:.1f} s"
            ),
            soft_wrap=True,
        )
        if item.masses:
            console.print(Text(f"  {item.masses}"), soft_wrap=True)
    for solver, reason in twin.absent:
        console.print(Text(f"{solver} did not run: {reason}"), soft_wrap=True)

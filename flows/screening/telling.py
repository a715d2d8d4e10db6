"""What a screening says to machines and to people."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from modetune.core.keys import Json, number_or_null
from modetune.core.modes import Floats
from modetune.flows.screening.choice import percent
from modetune.flows.screening.indices import UNITS
from modetune.flows.screening.notes import notes
from modetune.flows.screening.record import Screening

if TYPE_CHECKING:
    from rich.table import Table

#: Modes of which a terminal shows the columns.
SHOWN = 12


def told(screening: Screening) -> dict[str, Json]:
    """The `--json` object of `modetune screen`."""
    design, choice = screening.design, screening.choice
    return {
        "status": "done",
        "name": screening.name,
        "method": design.method,
        "seed": screening.seed,
        "points": len(design.points),
        "points_failed": screening.responses.n_failed,
        "points_used": screening.indices.used if screening.indices else 0,
        "levels": design.levels,
        "solver": screening.solver,
        "solver_version": screening.solver_version,
        "solver_runs": {
            "modal": screening.runs.modal,
            "sensitivity": screening.runs.sensitivity,
            "reused": screening.runs.reused,
        },
        "core_minutes": round(screening.runs.core_s / 60.0, 4),
        "wall_s": round(screening.wall_s, 3),
        "modes": [
            {
                "mode": number, "test_hz": float(screening.test_hz[place]),
                "nominal_hz": float(screening.nominal_hz[place]),
                "nominal_mac": number_or_null(screening.nominal_mac[place]),
            }
            for place, number in enumerate(screening.numbers)
        ],
        "parameters": [_parameter(screening, place) for place in range(len(screening.names))],
        "interactions": _interactions(screening),
        "collinear": [[screening.names[place] for place in group] for group in choice.groups],
        "chosen": list(choice.chosen),
        "residual_left": list(choice.misfits),
        "notes": list(notes(screening)),
    }  # fmt: skip


def _parameter(screening: Screening, place: int) -> dict[str, Json]:
    design, local, choice = screening.design, screening.local, screening.choice
    return {
        "name": screening.names[place],
        "bounds": [float(design.lower[place]), float(design.upper[place])],
        "importance": float(screening.importance[place]),
        "rank": choice.ranking.index(place) + 1,
        "chosen": choice.verdicts[place].rank,
        "reason": choice.verdicts[place].reason,
        "sensitivity": local.methods[place],
        "frequencies": _list(local.frequencies[:, place]),
        "mac": _list(local.mac[:, place]),
        "indices": _indices(screening, place),
    }


def _indices(screening: Screening, place: int) -> dict[str, Json]:
    """Measures of one parameter, a list over the responses each."""
    found = screening.indices
    if found is None:
        return {}
    measures: dict[str, Json] = {
        name: _list(found.values[row, :, place]) for row, name in enumerate(found.measures)
    }
    return {"responses": list(screening.response_names), **measures,
            "moves": _list(found.moves[:, place])}  # fmt: skip


def _interactions(screening: Screening) -> list[Json]:
    """Interactions of a factorial, those with the largest share first."""
    found = screening.indices
    if found is None or not found.interactions.size:
        return []
    names, responses = screening.names, screening.response_names
    rows = [
        (float(found.interaction_shares[r, i, j]), r, i, j)
        for r in range(len(responses))
        for i in range(len(names))
        for j in range(i + 1, len(names))
    ]
    return [
        {
            "response": responses[r], "parameters": [names[i], names[j]], "share": share,
            "effect": float(found.interactions[r, i, j]),
        }
        for share, r, i, j in sorted(rows, reverse=True)
    ]  # fmt: skip


def tables(screening: Screening) -> list[Table]:
    """Sensitivities, indices and verdicts."""
    local = screening.local
    made = [_local_table(screening, "frequencies, (df/f) / (dp/p)", local.frequencies)]
    if local.mac.size:
        made.append(_local_table(screening, "MAC, dMAC / (dp/p)", local.mac))
    if screening.indices is not None:
        made.append(_index_table(screening))
        if screening.indices.interactions.size and len(screening.names) > 1:
            made.append(_interaction_table(screening))
    return [*made, _verdict_table(screening)]


def _table(title: str, first: str, headings: list[str]) -> Table:
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    table.add_column(first, no_wrap=True)
    for heading in headings:
        table.add_column(heading, justify="right")
    return table


def _local_table(screening: Screening, what: str, rows: Floats) -> Table:
    """Sensitivities (n_modes, n_parameters) at the deck's values."""
    numbers, methods = screening.numbers[:SHOWN], screening.local.methods
    same = len(set(methods)) == 1
    title = f"At the deck's values: {what} of test modes{f', by {methods[0]}' if same else ''}"
    table = _table(title, "parameter", [*map(str, numbers), *([] if same else ["by"])])
    for place in screening.choice.ranking:
        cells = [f"{value:+.2f}" for value in rows[: len(numbers), place].tolist()]
        table.add_row(screening.names[place], *cells, *([] if same else [methods[place]]))
    return table


#: The measure that a terminal shows of each method, and what may stand behind it.
SHOWN_MEASURES = {
    "morris": ("mu_star", "sigma"), "sobol": ("total", "total_confidence"),
    "lhs": ("regression", ""), "factorial": ("main_effect", ""),
}  # fmt: skip
HEADINGS = {
    "morris": "Morris: mu* of frequencies over the bounds, and sigma",
    "sobol": "Sobol: total indices of frequencies, and half width of their 95 % intervals",
    "lhs": "Latin hypercube: standardised regression of frequencies",
    "factorial": "Full factorial: main effects on frequencies over the bounds",
}


def _index_table(screening: Screening) -> Table:
    found, method = screening.indices, screening.design.method
    assert found is not None
    main, beside = SHOWN_MEASURES[method]
    numbers = screening.numbers[:SHOWN]
    table = _table(HEADINGS[method], "parameter", [f"mode {number}" for number in numbers])
    for place in screening.choice.ranking:
        cells = [f"{value:.3f}" for value in found.measure(main)[: len(numbers), place]]
        if beside:
            more = found.measure(beside)[: len(numbers), place]
            cells = [f"{cell} ({value:.3f})" for cell, value in zip(cells, more, strict=True)]
        table.add_row(screening.names[place], *cells)
    explained = found.explained[: len(numbers)]
    if np.isfinite(explained).any():
        table.add_section()
        table.add_row("explained", *(f"{value:.3f}" for value in explained))
    return table


def _interaction_table(screening: Screening) -> Table:
    table = _table("Largest interactions of two parameters", "response",
                   ["parameters", "effect", "share"])  # fmt: skip
    for row in _interactions(screening)[:8]:
        assert isinstance(row, dict)
        first, second = row["parameters"]
        table.add_row(str(row["response"]), f"{first} x {second}", f"{row['effect']:.3g}",
                      f"{row['share']:.3g}")  # fmt: skip
    return table


def _verdict_table(screening: Screening) -> Table:
    table = _table("Candidates", "parameter", ["importance", "chosen"])
    table.add_column("reason")
    for place in screening.choice.ranking:
        verdict = screening.choice.verdicts[place]
        table.add_row(verdict.name, f"{screening.importance[place]:.3g}",
                      str(verdict.rank or "-"), verdict.reason)  # fmt: skip
    return table


def lines(screening: Screening) -> list[str]:
    """Sentences below the tables."""
    said, names, runs = [], screening.names, screening.runs
    for group in screening.choice.groups:
        said.append(f"collinear: {', '.join(names[place] for place in group)}")
    failed, design = screening.responses.n_failed, screening.design
    if failed and screening.indices is not None:
        first = next(text for text in screening.responses.failures if text).splitlines()[0]
        blocks = np.unique(design.blocks[[bool(text) for text in screening.responses.failures]])
        how = (
            ", fitted effects stand in for them" if design.method == "factorial"
            else " and are left out" if design.method == "lhs"
            else f", {blocks.size} of {np.unique(design.blocks).size} {UNITS[design.method]} are "
            "left out"
        )  # fmt: skip
        said.append(f"{failed} of {len(design.points)} points failed{how}; the first: {first}")
    chosen = screening.choice.chosen
    said.append(f"proposed: {', '.join(chosen) if chosen else 'none of them'}"
                + _explained(screening))  # fmt: skip
    said.extend(f"note: {note}" for note in notes(screening))
    said.append(
        f"solver runs: {runs.modal} modal, {runs.sensitivity} sensitivity, {runs.reused} answered "
        f"by the store; {screening.wall_s:.1f} s, {runs.core_s / 60.0:.1f} core-minutes"
    )
    return said


def _explained(screening: Screening) -> str:
    left = screening.choice.misfits
    if len(left) < 2:
        return ""
    return f"; linearly, {percent(left[-1])} % of the residual's square would be left"


def _list(values: Floats) -> list[Json]:
    return [number_or_null(value) for value in values.tolist()]

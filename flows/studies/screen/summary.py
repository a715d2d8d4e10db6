"""The tables, sentences and JSON of a screening, and notes on where its choice is doubtful.

The choice uses the linear model at the deck's values. A design over the whole bounds shows where
that model does not hold; and indices with wide intervals cannot rank parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from modetune.core.modes import Floats
from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Column, Table, json_object, table_of
from modetune.flows.studies.screen.choice import percent
from modetune.flows.studies.screen.design import MOST_POINTS
from modetune.flows.studies.screen.indices import UNITS, Indices
from modetune.flows.studies.screen.record import Screening

#: Maximum number of modes in a table on the terminal.
SHOWN = 12
#: Title of the table of all candidates.
CANDIDATES = "Candidates; importance in standard deviations of the test"


def summary(screening: Screening) -> dict[str, Json]:
    """Return the JSON object of a screening."""
    design, choice, runs = screening.design, screening.choice, screening.runs
    columns = ("mode", "test_hz", "nominal_hz", "nominal_mac")
    modes = zip(
        screening.numbers,
        screening.test_hz,
        screening.nominal_hz,
        screening.nominal_mac,
        strict=True,
    )
    return json_object(
        screening,
        "name seed solver solver_version",
        status="done",
        method=design.method,
        points=len(design.points),
        points_failed=screening.responses.n_failed,
        points_by=screening.points_by,
        reduced_model=screening.reduced_model,
        points_used=screening.indices.used if screening.indices else 0,
        levels=design.levels,
        solver_runs=runs,
        core_minutes=round(runs.core_s / 60.0, 4),
        wall_s=round(screening.wall_s, 3),
        modes=[dict(zip(columns, values, strict=True)) for values in modes],
        parameters=[_parameter(screening, place) for place in range(len(screening.names))],
        collinear=[[screening.names[place] for place in group] for group in choice.groups],
        chosen=choice.chosen,
        residual_left=choice.misfits,
        notes=notes(screening),
    )


@dataclass(frozen=True, slots=True)
class CandidateRow:
    """A candidate parameter.

    rank: by importance. chosen: place in the choice, 0 if rejected. frequencies, mac: normalised
    sensitivities of each mode. others: sensitivities of other responses by kind. indices: measures
    of the design, lists over the responses.
    """

    name: Annotated[str, Column("parameter")]
    bounds: tuple[float, float]
    importance: Annotated[float, Column("importance", form=".3g")]
    rank: int
    chosen: Annotated[int, Column("place in the choice (0: rejected)")]
    reason: Annotated[str, Column("reason")]
    sensitivity: str
    frequencies: Floats
    mac: Floats
    others: dict[str, list[float]]
    indices: dict[str, Any]


def _parameter(screening: Screening, place: int) -> CandidateRow:
    design, local, choice = screening.design, screening.local, screening.choice
    return CandidateRow(
        name=screening.names[place],
        bounds=(float(design.lower[place]), float(design.upper[place])),
        importance=float(screening.importance[place]),
        rank=choice.ranking.index(place) + 1,
        chosen=choice.verdicts[place].rank,
        reason=choice.verdicts[place].reason,
        sensitivity=local.methods[place],
        frequencies=local.frequencies[:, place],
        mac=local.mac[:, place],
        others=_others(screening, place),
        indices=_indices(screening, place),
    )


def _others(screening: Screening, place: int) -> dict[str, list[float]]:
    """Return sensitivities of one parameter by kind of response, in standard deviations."""
    found: dict[str, list[float]] = {}
    columns = screening.responses.other_kinds, screening.local.others[:, place].tolist()
    for kind, value in zip(*columns, strict=True):
        found.setdefault(kind, []).append(value)
    return found


def _indices(screening: Screening, place: int) -> dict[str, Any]:
    """Return the measures of one parameter, each a list over the responses."""
    found = screening.indices
    if found is None:
        return {}
    measures = {name: found.values[row, :, place] for row, name in enumerate(found.measures)}
    return {"responses": screening.response_names, **measures, "moves": found.moves[:, place]}


def tables(screening: Screening) -> list[Table]:
    """Return the tables of sensitivities, indices and candidates."""
    local = screening.local
    made = [_local_table(screening, "frequencies, (df/f) / (dp/p)", local.frequencies)]
    if local.mac.size:
        made.append(_local_table(screening, "MAC, dMAC / (dp/p)", local.mac))
    if local.others.size:
        made.append(_other_table(screening))
    if screening.indices is not None:
        made.append(_index_table(screening))
    candidates = [_parameter(screening, place) for place in screening.choice.ranking]
    return [*made, table_of(CANDIDATES, candidates, CandidateRow)]


def _local_table(screening: Screening, what: str, rows: Floats) -> Table:
    """Sensitivities (n_modes, n_parameters) at the deck's values."""
    modes, methods = screening.modes[:SHOWN], screening.local.methods
    columns = (
        Column("parameter", words=True),
        *(Column(name, form="+.2f") for name in modes),
        Column("method", words=True),
    )
    lines = tuple(
        (screening.names[place], *rows[: len(modes), place].tolist(), methods[place])
        for place in screening.choice.ranking
    )
    return Table(f"At the deck's values: {what} of {_of_modes(screening)}", columns, lines)


def _of_modes(screening: Screening) -> str:
    n = len(screening.modes)
    return "test modes" if n <= SHOWN else f"the first {SHOWN} of {n} test modes"


def _other_table(screening: Screening) -> Table:
    """Changes of other kinds of response over the bounds, as the root of the sum of squares."""
    found, local, design = screening.indices, screening.local, screening.design
    rows = local.others * (design.upper - design.lower) if found is None else found.moves
    squares = rows[len(rows) - len(local.others) :] ** 2
    kinds = np.array(screening.responses.other_kinds)
    names = tuple(dict.fromkeys(kinds.tolist()))
    lines = tuple(
        (
            screening.names[place],
            *(float(np.sqrt(squares[kinds == name, place].sum())) for name in names),
        )
        for place in screening.choice.ranking
    )
    columns = (
        Column("parameter", words=True),
        *(Column(name.replace("_", " "), form=".3g") for name in names),
    )
    return Table(
        "Changes of other responses over the bounds, in standard deviations of the test",
        columns,
        lines,
    )


#: The measure of each method in the table, and the one in parentheses.
SHOWN_MEASURES = {
    "morris": ("mu_star", "sigma"),
    "sobol": ("total", "total_confidence"),
    "lhs": ("regression", ""),
}
HEADINGS = {
    "morris": "Morris: mu* of frequencies over the bounds, and sigma",
    "sobol": "Sobol: total indices of frequencies, and half width of their 95 % intervals",
    "lhs": "Latin hypercube: standardised regression of frequencies",
}


def _index_table(screening: Screening) -> Table:
    found, method = screening.indices, screening.design.method
    assert found is not None
    main, second = SHOWN_MEASURES[method]
    modes = screening.modes[:SHOWN]
    rows = []
    for place in screening.choice.ranking:
        cells = [f"{value:.3f}" for value in found.measure(main)[: len(modes), place]]
        if second:
            more = found.measure(second)[: len(modes), place]
            cells = [f"{cell} ({value:.3f})" for cell, value in zip(cells, more, strict=True)]
        rows.append((screening.names[place], *cells))
    explained = found.explained[: len(modes)]
    foot = [("explained", *explained)] if np.isfinite(explained).any() else []
    columns = (Column("parameter", words=True), *(Column(name, form=".3f") for name in modes))
    heading = HEADINGS[method] + (f", {_of_modes(screening)}" if screening.modes[SHOWN:] else "")
    return Table(heading, columns, tuple(rows), tuple(foot))


def lines(screening: Screening) -> list[str]:
    """Return the sentences below the tables."""
    made, names, runs = [], screening.names, screening.runs
    for group in screening.choice.groups:
        made.append(f"collinear: {', '.join(names[place] for place in group)}")
    failed, design = screening.responses.n_failed, screening.design
    if failed and screening.indices is not None:
        first = (
            next(text for text in screening.responses.failures if text).splitlines()[0].rstrip(":")
        )
        blocks = np.unique(design.blocks[[bool(text) for text in screening.responses.failures]])
        how = (
            "they are left out"
            if design.method == "lhs"
            else f"{blocks.size} of {np.unique(design.blocks).size} {UNITS[design.method]} are "
            "left out"
        )
        made.append(
            f"{failed} of {len(design.points)} points failed; {how}. First failure: {first}"
        )
    made.append(proposed(screening))
    made.extend(f"note: {note}" for note in notes(screening))
    if screening.points_by:
        made.append(screening.points_by)
    made.append(f"{runs.sentence}; {screening.wall_s:.1f} s, {runs.core_s / 60.0:.1f} core-minutes")
    return made


def proposed(screening: Screening) -> str:
    """Return the sentence on the proposed parameters and the residual that they leave."""
    chosen = screening.choice.chosen
    return f"proposed: {', '.join(chosen) if chosen else 'none'}" + _explained(screening)


def _explained(screening: Screening) -> str:
    left = screening.choice.misfits
    if len(left) < 2:
        return ""
    return f"; by the linear model, {percent(left[-1])} % of the squared residual remains"


#: Minimum explained share of a frequency's variance for which the linear choice is reliable.
LEAST_EXPLAINED = 0.5
#: Parameters with a smaller share of a mode's largest mu* are ignored in the notes.
LEAST_EFFECT = 0.1
#: Largest half width of a Sobol index's 95 % interval that allows a ranking.
WIDEST = 0.1
HENCE = "so the choice, made by a linear model, may not hold over the whole bounds"


def notes(screening: Screening) -> list[str]:
    """Return the notes on doubtful points of the choice, most general first."""
    found = screening.indices
    made = _fewer_than_requested(screening)
    if found is None:
        return made
    method = screening.design.method
    if method == "lhs":
        made += _unexplained(screening, found.explained, "a linear model explains")
    elif method == "morris":
        made += _scattered(screening, found)
    elif method == "sobol":
        alone = np.where(found.moves.any(axis=1), found.measure("first").sum(axis=1), np.nan)
        made += _unexplained(screening, alone, "the parameters without interactions explain")
        made += _wide(screening, found)
    return made


def _fewer_than_requested(screening: Screening) -> list[str]:
    wanted, candidates, chosen = screening.wanted, len(screening.names), screening.choice.chosen
    if wanted <= len(chosen):
        return []
    why = (
        f"there are {candidates} candidates"
        if wanted > candidates
        else "the test cannot distinguish the others"
    )
    return [f"--choose {wanted}: only {len(chosen)} proposed, because {why}"]


def _unexplained(screening: Screening, shares: Floats, what: str) -> list[str]:
    return [
        f"{name}: {what} {100.0 * max(share, 0.0):.0f} % of its variance, {HENCE}"
        for name, share in zip(screening.modes, shares.tolist(), strict=False)
        if share < LEAST_EXPLAINED  # False for NaN
    ]


def _scattered(screening: Screening, found: Indices) -> list[str]:
    made = []
    sizes, spreads = found.measure("mu_star"), found.measure("sigma")
    for row, name in enumerate(screening.modes):
        active = sizes[row] >= LEAST_EFFECT * sizes[row].max()
        names = [
            screening.names[place]
            for place in np.flatnonzero(active & (spreads[row] > sizes[row])).tolist()
        ]
        if names:
            made.append(f"{name}: sigma exceeds mu* of {', '.join(names)}, {HENCE}")
    return made


def _wide(screening: Screening, found: Indices) -> list[str]:
    """Note wide intervals, which narrow with the root of the number of base samples."""
    n_modes, each = len(screening.numbers), len(screening.names) + 2
    half = float(found.measure("total_confidence")[:n_modes].max(initial=0.0))
    if not half > WIDEST:
        return []
    samples = found.used / each * (half / WIDEST) ** 2
    points = min(each * 2 ** int(np.ceil(np.log2(samples))), MOST_POINTS)
    return [
        f"total indices have intervals of up to +-{half:.2g}, too wide for a ranking: use --points "
        f"{points}"
    ]

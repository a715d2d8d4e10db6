"""Sensitivities by SOL 200: the cards that ask for them, and what its answer means.

Every parameter becomes one design variable x with the value 1, and each number p of the deck that
it scales a relation p = c x with c the number in the job's deck. So the design model agrees with
the analysis model, and for the parameter theta that the deck's own number p0 is
multiplied with,

    d lambda / d theta = (d lambda / d x) / theta,    for p = c x = (p0 theta) x.

A number that is not proportional to its parameter has an additional constant (p = c0 + c x), and
one that an expression of parameters gives has the expression as an equation (DVPREL2, DEQATN).

Responses are the eigenvalues (EIGN: unlike FREQ it has a derivative where the frequency is zero)
and, one a node, component and mode, the mass-normalised shapes (DISP with the mode's number).
Nastran leaves out responses that no constraint keeps; so all get one with Nastran's own bounds of
1e20, and the screening lets every constraint through. There is no objective: nothing is optimised,
and one above the subcases would have to be a response of none of them. The run ends
after the sensitivities (DSAPRT with END=SENS), which go to the OP2 file as DSCM2, their columns
named by DSCMCOL. (MSC and Simcenter Nastran, Quick Reference Guides: DSAPRT, DRESP1, DVMREL1.)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modetune.adapters.deck_numbers import moved_numbers
from modetune.adapters.nastran.deck import with_lines
from modetune.adapters.nastran.design_relations import (
    WIDTH,
    equation_card,
    in_fortran,
    large_card,
    real,
    relation_head,
    relation_kind,
    tied_numbers,
)
from modetune.adapters.nastran.fields import NastranCard, format_number
from modetune.adapters.nastran.model import NastranModel
from modetune.adapters.nastran.op2 import Op2Table, Record, read_tables
from modetune.adapters.nastran.results import COMPONENTS
from modetune.adapters.solver import SensitivityAnalysis
from modetune.core.errors import SolverCrashed
from modetune.core.expressions import names_of
from modetune.core.modes import Floats, Integers
from modetune.core.parameters import Parameter, Values
from modetune.core.updating.sensitivity import ModeDerivatives

#: The set of constraints that keep the responses.
CONSTRAINTS = 1
#: Bounds of the design variables, relative to their values; they only surround the 1.
LOWER, UPPER = ".5", "2."
#: A constraint is kept where it is above this, which all are.
THRESHOLD = "-1.+10"
#: Responses of one kind that are kept; more than any job asks for.
KEPT = 9_999_999


def design_commands(analysis: SensitivityAnalysis, method: str) -> list[str]:
    """Case control of a SOL 200 run that ends after its sensitivities.

    They are printed too where only eigenvalues are asked for, and so few.
    """
    printed = "NOPRINT" if analysis.nodes else "FORMATTED"
    return [
        f"DSAPRT({printed},EXPORT,END=SENS)",
        "SUBCASE 1",
        "ANALYSIS = MODES",
        f"DESSUB = {CONSTRAINTS}",
        method,
    ]


def response_id(analysis: SensitivityAnalysis, mode: int, row: int = -1) -> int:
    """Number of the DRESP1 card of a mode's eigenvalue, or of its shape at one row (from 0)."""
    if row < 0:
        return mode + 1
    return analysis.n_modes + 1 + row * analysis.n_modes + mode


def n_rows(analysis: SensitivityAnalysis) -> int:
    """Degrees of freedom of the shapes asked for: six a node."""
    return COMPONENTS * len(analysis.nodes)


def design_cards(
    model: NastranModel, changed: Mapping[int, str], values: Values, analysis: SensitivityAnalysis
) -> list[str]:
    """Bulk data of the design model. Raises ModelError for a parameter it cannot hold."""
    named = {parameter.name: parameter for parameter in model.parameters}
    chosen = [named[name] for name in analysis.parameters]
    lines = [
        f"DESVAR,{number},P{number},1.,{LOWER},{UPPER}" for number in range(1, len(chosen) + 1)
    ]
    edited = {card.lines[0]: card for card in with_lines(model.deck, changed).cards}
    lines += _relations(model, edited, values, chosen)
    lines += _equations(model, edited, values, chosen, n_before=len(lines))
    lines += _responses(analysis)
    kinds = ("EIGN", "DISP") if analysis.nodes else ("EIGN",)
    return [*lines, *(f"DSCREEN,{kind},{THRESHOLD},{KEPT}" for kind in kinds)]


def _relations(
    model: NastranModel,
    edited: Mapping[int, NastranCard],
    values: Values,
    parameters: Sequence[Parameter],
) -> list[str]:
    """What ties numbers to the design variables of their parameters, one to one."""
    lines: list[str] = []
    number = 0
    for variable, parameter in enumerate(parameters, start=1):
        numbers, here = model.numbers(parameter), values.get(parameter.name, 1.0)
        moved, twice = (moved_numbers(parameter, numbers, v) for v in (here, 2.0 * here))
        for count, place, coefficient in tied_numbers(
            model.deck, edited, parameter, model.places(parameter)
        ):
            now, then = moved[count][1], twice[count][1]
            number += 1
            constant = ""
            if not parameter.proportional:
                constant = format_number(2.0 * now - then, WIDTH)
                coefficient = format_number(then - now, WIDTH)
            fields = (*relation_head(number, place), "", constant, "", str(variable), coefficient)
            lines += large_card(relation_kind(place, 1), fields)
    return lines


def _equations(
    model: NastranModel,
    edited: Mapping[int, NastranCard],
    values: Values,
    parameters: Sequence[Parameter],
    n_before: int,
) -> list[str]:
    """Return the relations of numbers with the design variables in their expressions; other
    variables keep their values. n_before: relations and variables have lower numbers."""
    variables = {parameter.name: place for place, parameter in enumerate(parameters, start=1)}
    named = {item.name: item for item in model.parameters}
    lines: list[str] = []
    number = n_before
    for item in model.parameters:
        names = names_of(item.expression) if item.expression else ()
        own = [name for name in names if name in variables]
        if not own:
            continue
        texts = {name: real(named[name].shown(values.get(name, 1.0))) for name in names}
        for count, name in enumerate(own, start=1):
            free = named[name]
            slope = real(free.scale * values.get(name, 1.0))
            texts[name] = f"({real(free.origin)}+{slope}*X{count})"
        first = 1.0
        for _, place, _ in tied_numbers(model.deck, edited, item, model.places(item)):
            number += 1
            first = first if place.along else place.value
            ratio = place.value / first if place.along else 1.0
            text = in_fortran(item.expression, texts)
            if item.values == "relative":
                text = f"{real(first)}*{text}"
            elif item.values == "additive":
                text = f"({real(first)}+{text})"
            arguments = [f"X{n}" for n in range(1, len(own) + 1)]
            lines += equation_card(number, arguments, f"{real(ratio)}*{text}")
            rows = [*relation_head(number, place), "", str(number), "", "DESVAR"]
            lines += large_card(
                relation_kind(place, 2), [*rows, *(str(variables[name]) for name in own)]
            )
    return lines


def _responses(analysis: SensitivityAnalysis) -> Iterator[str]:
    modes = range(analysis.n_modes)
    for mode in modes:
        number = response_id(analysis, mode)
        yield f"DRESP1,{number},L{mode + 1},EIGN,,,{mode + 1}"
        yield f"DCONSTR,{CONSTRAINTS},{number}"
    for row in range(n_rows(analysis)):
        node, component = analysis.nodes[row // COMPONENTS], row % COMPONENTS + 1
        for mode in modes:
            number = response_id(analysis, mode, row)
            yield f"DRESP1,{number},S,DISP,,,{component},{mode + 1},{node}"
            yield f"DCONSTR,{CONSTRAINTS},{number}"


#: The first words of the record of DESVAR cards in EDOM, and words of a response in DSCMCOL.
DESVAR, WORDS = [3106, 31], 9
ASK = "PARAM,POST,-1 in the bulk data and DSAPRT(EXPORT,END=SENS)=ALL in the case control write it"


@dataclass(frozen=True, slots=True)
class DesignSensitivities:
    """Derivatives of responses with respect to design variables, in the units of the deck.

    design_variables: (n_desvar,), DESVAR numbers, ascending. responses: (n_response,), numbers of
    DRESP1 or DRESP2 cards. values: (n_desvar, n_response).
    """

    design_variables: Integers
    responses: Integers
    values: Floats


def read_dscm2(path: Path) -> DesignSensitivities:
    """Read the sensitivities of an OP2 file; of several design cycles the last ones.

    Raises SolverCrashed where the file is not whole or lacks DSCM2, DSCMCOL or EDOM, and says
    which request writes them.
    """
    names = ("DSCM2", "DSCMCOL", "EDOM")
    tables = {table.name: table for table in read_tables(path, lambda name: name in names)}
    for name in names:
        if name not in tables:
            raise SolverCrashed(
                f"{path} has no table {name}, without which sensitivities mean nothing; {ASK}"
            )
    try:
        values = _matrix(tables["DSCM2"])
        variables = _design_variables(tables["EDOM"], values.shape[0])
        responses = _read_responses(tables["DSCMCOL"])
    except (ValueError, IndexError, OverflowError) as error:
        raise SolverCrashed(f"{path} holds no sensitivities that can be used: {error}") from error
    if responses.size != values.shape[1]:
        raise SolverCrashed(
            f"{path}: DSCM2 has {values.shape[1]} columns, DSCMCOL names {responses.size}"
        )
    return DesignSensitivities(variables, responses, values)


def _matrix(table: Op2Table) -> Floats:
    """A real matrix, column by column; a column is strings of (row, values)."""
    if table.trailer.size < 5:
        raise ValueError(f"the trailer of {table.name} has {table.trailer.size} words")
    n_columns, n_rows, kind = (int(table.trailer[at]) for at in (1, 2, 4))
    if kind not in (1, 2):
        raise ValueError(f"{table.name} is not a real matrix (type {kind})")
    if len(table.records) != n_columns or not 0 < n_rows:
        raise ValueError(f"{table.name} has {len(table.records)} columns of {n_columns}")
    values = []
    for record in table.records:
        column: dict[int, float] = {}
        for piece in record.pieces:
            width = 8 if kind == 2 or record.word == 8 else 4
            row = int(Record((piece[: record.word],), record.word).integers()[0])
            body = np.frombuffer(piece[record.word :], dtype=f"<f{width}").astype(np.float64)
            column |= {row + at: float(value) for at, value in enumerate(body)}
        if any(not 1 <= row <= n_rows for row in column):
            raise ValueError(f"{table.name} has a row beyond its {n_rows} rows")
        values.append([column.get(row, 0.0) for row in range(1, n_rows + 1)])
    matrix = np.array(values).T
    if not np.isfinite(matrix).all():
        raise ValueError(f"{table.name} holds a number that is not finite")
    return matrix


def _design_variables(edom: Op2Table, n_rows: int) -> Integers:
    """DESVAR numbers; a card takes nine words in newer files and eight in older ones."""
    words = _desvar_words(edom)
    width = next((width for width in (9, 8) if words.size == n_rows * width), 0)
    if not width:
        raise ValueError(f"DSCM2 has {n_rows} rows, EDOM {words.size} words of DESVAR cards")
    numbers = words.reshape(-1, width)[:, 0]
    if (numbers < 1).any() or (np.diff(np.sort(numbers)) == 0).any():
        raise ValueError("the DESVAR numbers in EDOM are not distinct and positive")
    return np.sort(numbers)


def _desvar_words(edom: Op2Table) -> Integers:
    for record in edom.records:
        if len(record.content) % record.word == 0:
            words = record.integers()
            if words[:2].tolist() == DESVAR:
                return words[3:]
    return np.zeros(0, dtype=np.int64)


def _read_responses(table: Op2Table) -> Integers:
    """Return the card number of each response, (n_response,)."""
    words = table.records[0].integers()
    if words.size % WORDS or not words.size:
        raise ValueError(f"DSCMCOL has {words.size} words, {WORDS} belong to a response")
    rows = words.reshape(-1, WORDS)
    strange = np.flatnonzero(rows[:, 0] != np.arange(1, len(rows) + 1))[:1].tolist()
    if strange:
        raise ValueError(
            f"DSCMCOL has response {rows[strange[0], 0]} where {strange[0] + 1} belongs"
        )
    # Responses of DRESP2 cards, in a separate record, take six words each.
    more = [record.integers().reshape(-1, 6)[:, 1] for record in table.records[1:]]
    return np.concatenate([rows[:, 1], *more])


def mode_derivatives(
    found: DesignSensitivities, analysis: SensitivityAnalysis, values: Sequence[float]
) -> ModeDerivatives:
    """Derivatives with respect to the relative values of the analysis' parameters.

    values: of the parameters (design.py explains why they divide). Rows of rigid modes are
    rounding. Raises ValueError that names the first response or variable that is not there.
    """
    n_parameters = len(analysis.parameters)
    columns = {number: place for place, number in enumerate(found.responses.tolist())}
    # Where the file does not number its rows, they are all of the job's design variables.
    known = found.design_variables.tolist() or list(range(1, len(found.values) + 1))
    for place, name in enumerate(analysis.parameters):
        if place + 1 not in known:
            raise ValueError(f"no sensitivities to design variable {place + 1} ({name})")
    rows = [known.index(place + 1) for place in range(n_parameters)]
    table = found.values[rows] / np.asarray(values)[:, None]

    def derivatives(mode: int, row: int = -1) -> Floats:
        number = response_id(analysis, mode, row)
        if number not in columns:
            what = f"the eigenvalue of mode {mode + 1}"
            if row >= 0:
                node = analysis.nodes[row // COMPONENTS]
                what = f"component {row % COMPONENTS + 1} of node {node} in mode {mode + 1}"
            raise ValueError(f"no sensitivity of {what} (response {number})")
        slopes: Floats = table[:, columns[number]]
        return slopes

    modes = range(analysis.n_modes)
    slopes = np.array([derivatives(mode) for mode in modes])
    shapes = np.array(
        [[derivatives(mode, row) for mode in modes] for row in range(n_rows(analysis))]
    )
    return ModeDerivatives(slopes, shapes.reshape(-1, analysis.n_modes, n_parameters))

"""Sensitivities that SOL 200 computed: the matrix DSCM2 and what its columns mean.

DSAPRT(EXPORT, END=SENS) in the case control writes the derivatives of all retained responses with
respect to all design variables. In the OP2 file DSCM2 has a row a design variable, in ascending
order of the DESVAR numbers, and a column a response, in the units of both (not normalised). The
table DSCMCOL says what each column is, in nine words a response: internal and external number,
type, and six that depend on the type. It does not say which DESVAR a row is, nor whether a mode's
response is its frequency or its eigenvalue; the table EDOM, the design model as the run read it,
does.

Source: the data block descriptions of the MSC Nastran DMAP guide, checked against a run of MSC
Nastran 2018 whose sensitivities finite differences confirm.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modetune.adapters.nastran.op2_records import Op2Table, Record, read_tables
from modetune.core.errors import SolverCrashed
from modetune.core.modes import Floats, Integers

#: Response types of DSCMCOL that are told by that number alone.
WEIGHT, MODE, DISPLACEMENT = 1, 4, 5
#: Response types of DRESP1 cards in EDOM.
EDOM_EIGENVALUE, EDOM_FREQUENCY = 4, 12
#: The first words of the records of these cards in EDOM.
DESVAR, DRESP1 = (3106, 31), (3806, 38)
WORDS = 9
ASK = "PARAM,POST,-1 in the bulk data and DSAPRT(EXPORT,END=SENS)=ALL in the case control write it"


@dataclass(frozen=True, slots=True)
class DesignResponse:
    """One column.

    kind: weight, frequency (cycles), eigenvalue, displacement, or `other N` with the type N of
    DSCMCOL. number: of its DRESP1 card. mode: of a frequency or an eigenvalue. node, component:
    of a displacement. 0 where it has none.
    """

    kind: str
    number: int
    mode: int = 0
    node: int = 0
    component: int = 0


@dataclass(frozen=True, slots=True)
class DesignSensitivities:
    """Derivatives of responses with respect to design variables, in the units of the deck.

    design_variables: (n_desvar,), DESVAR numbers, ascending. responses: one a column.
    values: (n_desvar, n_response).
    """

    design_variables: Integers
    responses: tuple[DesignResponse, ...]
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
        responses = _responses(tables["DSCMCOL"], _dresp1_types(tables["EDOM"]))
    except (ValueError, IndexError, OverflowError) as error:
        raise SolverCrashed(f"{path} holds no sensitivities that can be used: {error}") from error
    if len(responses) != values.shape[1]:
        raise SolverCrashed(
            f"{path}: DSCM2 has {values.shape[1]} columns, DSCMCOL names {len(responses)}"
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
    words = _cards(edom, DESVAR)
    width = next((width for width in (9, 8) if words.size == n_rows * width), 0)
    if not width:
        raise ValueError(f"DSCM2 has {n_rows} rows, EDOM {words.size} words of DESVAR cards")
    numbers = words.reshape(-1, width)[:, 0]
    if (numbers < 1).any() or (np.diff(np.sort(numbers)) == 0).any():
        raise ValueError("the DESVAR numbers in EDOM are not distinct and positive")
    return np.sort(numbers)


def _dresp1_types(edom: Op2Table) -> dict[int, int]:
    """Type of each DRESP1 card; a card is number, label (2), type and more, and ends with -1."""
    words = _cards(edom, DRESP1).tolist()
    types: dict[int, int] = {}
    while words:
        end = words.index(-1) if -1 in words else len(words)
        if end > 3:
            types.setdefault(words[0], words[3])
        words = words[end + 1 :]
    return types


def _cards(edom: Op2Table, mark: tuple[int, int]) -> Integers:
    for record in edom.records:
        if len(record.content) % record.word == 0:
            words = record.integers()
            if tuple(words[:2].tolist()) == mark:
                return words[3:]
    return np.zeros(0, dtype=np.int64)


def _responses(table: Op2Table, types: dict[int, int]) -> tuple[DesignResponse, ...]:
    words = table.records[0].integers()
    if words.size % WORDS or not words.size:
        raise ValueError(f"DSCMCOL has {words.size} words, {WORDS} belong to a response")
    responses = []
    for at, row in enumerate(words.reshape(-1, WORDS).tolist()):
        if row[0] != at + 1:
            raise ValueError(f"DSCMCOL has response {row[0]} where {at + 1} belongs")
        responses.append(_response(row, types))
    # Responses of DRESP2 cards, in a record of their own, take six words each.
    for record in table.records[1:]:
        rows = record.integers().reshape(-1, 6).tolist()
        responses += [DesignResponse("other DRESP2", row[1]) for row in rows]
    return tuple(responses)


def _response(row: list[int], types: dict[int, int]) -> DesignResponse:
    _, number, kind, first, second, *_ = row
    if kind == WEIGHT:
        return DesignResponse("weight", number)
    if kind == DISPLACEMENT:
        return DesignResponse("displacement", number, node=first, component=second)
    if kind == MODE:
        names = {EDOM_EIGENVALUE: "eigenvalue", EDOM_FREQUENCY: "frequency"}
        name = names.get(types.get(number, 0))
        if name is None:
            raise ValueError(f"EDOM does not say whether DRESP1 {number} is EIGN or FREQ")
        return DesignResponse(name, number, mode=first)
    return DesignResponse(f"other {kind}", number)

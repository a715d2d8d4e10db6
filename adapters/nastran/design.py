"""Sensitivities by SOL 200: the cards that ask for them, and what its answer means.

Every parameter becomes one design variable x with the value 1, and each number p of the deck that
it scales a relation p = c x with c the number as it stands in the job's deck. So the design model
says what the analysis model says, and for the parameter theta that the deck's own number p0 is
multiplied with,

    d lambda / d theta = (d lambda / d x) / theta,    for p = c x = (p0 theta) x.

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
from dataclasses import replace

from modetune.adapters.nastran.deck import NastranCard, NastranDeck, with_lines
from modetune.adapters.nastran.model import NastranModel, ValuePlace
from modetune.adapters.nastran.number import format_number, read_number
from modetune.adapters.nastran.sections import station_rows
from modetune.adapters.solver import SensitivityAnalysis
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter

#: The set of constraints that keep the responses.
CONSTRAINTS = 1
#: Bounds of the design variables, relative to where they stand; they only surround the 1.
LOWER, UPPER = ".5", "2."
#: A constraint is kept where it is above this, which all are.
THRESHOLD = "-1.+10"
#: Responses of one kind that are kept; more than any job asks for.
KEPT = 9_999_999
COMPONENTS = 6
#: Offsets of a PBEAM's neutral axis.
OFFSETS = ("N1", "N2")
#: Characters of a field in large-field cards.
WIDTH = 16


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
    model: NastranModel, changed: Mapping[int, str], analysis: SensitivityAnalysis
) -> list[str]:
    """Bulk data of the design model. Raises ModelError for a parameter it cannot hold."""
    named = {parameter.name: parameter for parameter in model.parameters}
    chosen = [named[name] for name in analysis.parameters]
    lines = [
        f"DESVAR,{number},P{number},1.,{LOWER},{UPPER}" for number in range(1, len(chosen) + 1)
    ]
    lines += _relations(model, with_lines(model.deck, changed), chosen)
    lines += _responses(analysis)
    kinds = ("EIGN", "DISP") if analysis.nodes else ("EIGN",)
    return [*lines, *(f"DSCREEN,{kind},{THRESHOLD},{KEPT}" for kind in kinds)]


def _relations(
    model: NastranModel, edited: NastranDeck, parameters: Sequence[Parameter]
) -> list[str]:
    cards = {card.lines[0]: card for card in edited.cards}
    lines: list[str] = []
    number = 0
    for variable, parameter in enumerate(parameters, start=1):
        places = model.places(parameter)
        named = {(place.card.lines, place.symbol) for place in places}
        for place in places:
            if not place.scales:
                raise ModelError(
                    f"{model.deck.where(place.card)}: {parameter.name} does not scale this number, "
                    "and solver sensitivities are of scaled numbers only"
                )
            card = cards[place.card.lines[0]]
            text = card.text(place.field) or repr(place.value)  # blank: its default
            tied = {place.symbol: _coefficient(text), **_following(card, place, parameter)}
            for symbol, coefficient in tied.items():
                if symbol == place.symbol or (place.card.lines, symbol) not in named:
                    number += 1
                    said = replace(place, symbol=symbol)
                    lines += _relation(number, variable, said, coefficient)
    return lines


def _following(card: NastranCard, place: ValuePlace, parameter: Parameter) -> dict[str, str]:
    """Blank numbers of a beam's stations, which follow end A, by their names.

    Nastran fills them in as it reads the card; a design variable of end A alone would leave them.
    Raises ModelError for a blank one between ends of which the parameter scales one.
    """
    name = place.symbol.removesuffix("(A)")
    at_a = card.text(place.field)
    if name == place.symbol or not at_a:
        return {}
    if card.name == "PBEAM" and name in OFFSETS:  # N1(A), N2(A), N1(B), N2(B) stand in a row
        return {} if card.text(place.field + 2) else {f"{name}(B)": _coefficient(at_a)}
    if card.name != "PBEAM":
        return {f"{name}(B)": _coefficient(at_a)}
    offset, rows = place.field - 1, station_rows(card)
    where = {row: read_number(card.text(row + 1) or "1.") for row in rows}
    at_b = next((card.text(row + offset) for row in rows if where[row] == 1.0), "")
    found = {} if at_b else {f"{name}(B)": _coefficient(at_a)}
    a, b = read_number(at_a), read_number(at_b or at_a)
    for station, row in enumerate(rows, start=1):
        if where[row] != 1.0 and not card.text(row + offset):
            if parameter.item and at_b:
                raise ModelError(
                    f"PBEAM {place.ident}: station {station} has a blank {name}, which solver "
                    f"sensitivities to {parameter.name} need written out"
                )
            found[f"{name}({station})"] = format_number(a + (b - a) * where[row], WIDTH)
    return found


def _coefficient(text: str) -> str:
    """A number as it stands in the deck, or as much of it as a large field holds."""
    return text if len(text) <= WIDTH else format_number(read_number(text), WIDTH)


def _relation(number: int, variable: int, place: ValuePlace, coefficient: str) -> list[str]:
    """The card that ties one number of the model to a design variable."""
    owner = place.card.name
    kind = "DVPREL1"
    if owner.startswith("MAT"):
        kind = "DVMREL1"
    elif owner.startswith("C"):
        kind = "DVCREL1"
    fields = (str(number), owner, str(place.ident), place.symbol, "", "", "", "")
    return _large(kind, (*fields, str(variable), coefficient))


def _large(name: str, fields: Sequence[str]) -> list[str]:
    """A card in large field, four fields a line."""
    rows = [fields[start : start + 4] for start in range(0, len(fields), 4)]
    heads = [f"{name}*", *("*" for _ in rows[1:])]
    return [
        f"{head:<8}{''.join(f'{field:>{WIDTH}}' for field in row)}".rstrip()
        for head, row in zip(heads, rows, strict=True)
    ]


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

"""The deck of one Nastran job: the user's model in one file, and our requests.

Includes are merged and comments left out, so that the text is what can change the numbers and
nothing else. Of the user's case control the selections stay; of the bulk data everything but the
requests for modes, parameters of output, and cards of design optimisation. The requests are: the
lowest n_modes, mass-normalised, shapes at the analysis' nodes in the OP2 file, strain energies of
the groups' elements, the total mass, or the sensitivities of SOL 200.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache, partial

from modetune.adapters.nastran.bulk import with_points
from modetune.adapters.nastran.case_control import (
    OWN_PARAMETERS,
    CaseControl,
    absent_sets,
    alters,
    read_case_control,
    system_statements,
)
from modetune.adapters.nastran.deck import NastranDeck, with_lines
from modetune.adapters.nastran.design import design_cards, design_commands
from modetune.adapters.nastran.dialect import Dialect
from modetune.adapters.nastran.fields import NastranCard, large_field
from modetune.adapters.nastran.matrices import KEEP_AND_STOP, PRINT_TABLE, STOP
from modetune.adapters.nastran.model import NastranModel
from modetune.adapters.nastran.mystran.deck import mystran_cards
from modetune.adapters.nastran.mystran.shift import first_shift, usual_shift
from modetune.adapters.solver import Analysis, MatrixAnalysis, ModalAnalysis, SensitivityAnalysis
from modetune.core.errors import ModelError
from modetune.core.parameters import Values

#: Parameters at the values of the deck.
AS_IT_IS: Values = {}
#: SET numbers of the wanted nodes and elements; the user's SETs are removed.
NODES, ELEMENTS = 1, 2
#: MYSTRAN takes thirty times as long for one mode as for two, even before it looks for any.
LEAST_MODES = 2
#: The largest number of a grid point.
LARGEST_NUMBER = 99_999_999
#: Columns of case control that Nastran reads.
COLUMNS = 72
#: Cards that ask for modes in the user's way, and cards of design optimisation.
LEFT_OUT = frozenset({
    "EIGR", "EIGRL", "EIGB", "EIGC", "EIGP",
    "DESVAR", "DVPREL1", "DVPREL2", "DVMREL1", "DVMREL2", "DVCREL1", "DVCREL2", "DVGRID", "DVSHAP",
    "DVBSHAP", "DRESP1", "DRESP2", "DRESP3", "DCONSTR", "DCONADD", "DSCREEN", "DOPTPRM", "DLINK",
    "DDVAL", "DTABLE", "TOPVAR", "TOMVAR", "BEADVAR", "DSCONS", "DVSET", "DVAR",
})  # fmt: skip


def job_text(
    model: NastranModel,
    changed: Mapping[int, str],
    analysis: Analysis,
    dialect: Dialect,
    values: Values = AS_IT_IS,
) -> str:
    """The text of a job's deck.

    changed: position of a line of the deck to its edited text, at these values. Raises ModelError
    with file and line for what no job can carry.
    """
    matrices = isinstance(analysis, MatrixAnalysis)
    if matrices and dialect.name != "mystran":
        raise ModelError("matrices are not read from Nastran runs")
    if isinstance(analysis, SensitivityAnalysis) and dialect.name == "mystran":
        raise ModelError("MYSTRAN gives no sensitivities")
    case = read_case_control(model.deck)
    own = dialect.name == "mystran"
    if own and (case.added("K2GG") or case.added("M2GG")):
        raise ModelError(
            f"{model.deck.file}: MYSTRAN has no K2GG and M2GG (DMIG); use `solver: calculix`"
        )
    if own:  # which breaks off where Nastran warns
        case = case.without(absent_sets(model.deck, case))
    n_modes = 0 if isinstance(analysis, MatrixAnalysis) else analysis.n_modes
    lines = [
        *system_statements(model.deck, native=not own),
        *(KEEP_AND_STOP if matrices else []),
        "SOL 200" if isinstance(analysis, SensitivityAnalysis) else "SOL 103",
        *([] if own else [model.deck.lines[position].text for position in alters(model.deck)]),
        "CEND",
        "ECHO = NONE",
        *(text for text in case.selections if not (own and text.upper().startswith("TEMP"))),
        *_requests(model, case, analysis, dialect),
        "BEGIN BULK",
        *_parameters(analysis),
        *([f"PARVEC1,{STOP},1,{_missing_grid(model)}"] if matrices else []),
        *(
            ",".join(["PARAM", *(with_points("PARAM", [*one]) if own else one)])
            for one in case.parameters
        ),
        _eigrl(model, case.method or 1, n_modes, dialect),
    ]
    if isinstance(analysis, SensitivityAnalysis):
        lines += design_cards(model, changed, values, analysis)
    given = {name for name, _ in case.parameters}
    tied = bool(case.selected("MPC"))
    cards = _bulk(model, changed, dialect, given, n_modes, tied)
    return "\n".join([*lines, *cards, "ENDDATA"]) + "\n"


def requested_elements(model: NastranModel, analysis: ModalAnalysis) -> list[int]:
    """Elements whose strain energy is asked for, ascending."""
    names = {name for _, sets in analysis.groups for name in sets}
    return sorted({element for name in names for element in model.set_elements(name)})


def wrapped_set(number: int, members: Iterable[int]) -> list[str]:
    """A SET command within 72 columns a line."""
    lines, line = [], f"SET {number} ="
    for member in members:
        if len(line) + len(f" {member},") > COLUMNS:
            lines.append(line)
            line = "  "
        line += f" {member},"
    return [*lines, line.rstrip(",")]


def _requests(
    model: NastranModel, case: CaseControl, analysis: Analysis, dialect: Dialect
) -> list[str]:
    method = f"METHOD = {case.method or 1}"
    if isinstance(analysis, SensitivityAnalysis):
        return design_commands(analysis, method)
    if isinstance(analysis, MatrixAnalysis):
        return [method]
    sets, commands = list[str](), [method]
    if analysis.nodes:
        sets += wrapped_set(NODES, analysis.nodes)
        commands.append(f"DISPLACEMENT({dialect.displays}) = {NODES}")
    elements = requested_elements(model, analysis)
    if elements:
        sets += wrapped_set(ELEMENTS, elements)
        commands.append(f"ESE(PLOT) = {ELEMENTS}")
    return [*sets, *commands]


def _parameters(analysis: Analysis) -> list[str]:
    # MYSTRAN has the stiffness of a PCOMP wrong where it does not weigh the model (18.0).
    lines = ["PARAM,POST,-1", "PARAM,GRDPNT,0"]
    if isinstance(analysis, MatrixAnalysis):
        lines.append(PRINT_TABLE)
    if isinstance(analysis, ModalAnalysis) and analysis.groups:
        lines.append("PARAM,TINY,0.")  # else energies below 0.001 % of the total are not given
    if isinstance(analysis, SensitivityAnalysis):
        lines.append("PARAM,POSTEXT,YES")  # the tables of design optimisation too
    return lines


def _missing_grid(model: NastranModel) -> int:
    """A number that no grid point has."""
    grids = model.summary.node_ids
    return next(number for number in range(LARGEST_NUMBER, 0, -1) if number not in grids)


def _eigrl(model: NastranModel, method: int, n_modes: int, dialect: Dialect) -> str:
    shift = ""
    if dialect.name == "mystran":
        n_modes = max(n_modes, LEAST_MODES)
        speed = max(model.wave_speeds().values(), default=0.0)
        shift = first_shift(model.deck, method) or usual_shift(
            model.mesh(), model.bulk, speed, model.largest_eigenvalue()
        )
    return f"EIGRL,{method},,,{n_modes},,,{shift},MASS"


def _bulk(
    model: NastranModel,
    changed: Mapping[int, str],
    dialect: Dialect,
    given: set[str],
    n_modes: int,
    tied: bool,
) -> list[str]:
    """The user's cards in their order, edited, without comments and parameters given already.

    tied: whether the case control selects an MPC set.
    """
    own = OWN_PARAMETERS | given
    # MYSTRAN (18.0) breaks off at MPC cards that none selects.
    out = LEFT_OUT if tied or dialect.name != "mystran" else LEFT_OUT | {"MPC", "MPCADD"}

    def left_out(card: NastranCard) -> bool:
        return card.name in out or (card.name == "PARAM" and card.text(1) in own)

    if dialect.name == "mystran":
        out |= {"DMIG"}  # of loads and damping, or not selected
        deck = with_lines(model.deck, changed) if changed else model.deck
        bulk = cache(partial(model.bulk_at, dict(changed)))
        lumped = model.masses() == "lumped"
        return mystran_cards(deck, bulk, left_out, n_modes, lumped, model.mystran_texts)
    if model.deck.parts:  # in the numbers of the whole model
        deck = with_lines(model.deck, changed) if changed else model.deck
        return [large_card(deck, card) for card in deck.cards if not left_out(card)]
    kept = {line for card in model.deck.cards if not left_out(card) for line in card.lines}
    return [_text(model.deck, changed, position) for position in sorted(kept)]


def large_card(deck: NastranDeck, card: NastranCard) -> str:
    """Return a card in large field. Raises ModelError where a field does not fit into it."""
    try:
        return large_field(card.name, [card.text(place) for place in range(1, len(card.fields))])
    except ModelError as error:
        raise ModelError(f"{deck.lines[card.lines[0]].where}: {error}") from error


def _text(deck: NastranDeck, changed: Mapping[int, str], position: int) -> str:
    return changed.get(position, deck.lines[position].text).split("$", 1)[0].rstrip()

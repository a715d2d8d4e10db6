"""What a job keeps of the user's executive and case control.

Selections of the model's parts (constraints, temperatures, added matrices) can change the modes
and stay as they are written; requests for output, titles and plots go. What cannot be carried into
a job without another meaning is refused, each with file and line.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from modetune.adapters.nastran.deck import NastranDeck
from modetune.adapters.nastran.fields import NastranCard, read_number
from modetune.adapters.nastran.harmless import CHANGING, changing_parameter
from modetune.adapters.solver import ModalCase
from modetune.core.errors import ModelError

#: Case control commands that select parts of the model, and that a job on another solver follows
#: or that change no modes.
FOLLOWED = frozenset({
    "SPC", "MPC", "SUPORT", "SUPORT1", "TEMPERATURE", "TEMP", "AUTOSPC", "RIGID", "BC", "BOUTPUT",
    "K2GG", "M2GG", "K42GG",
})  # fmt: skip
#: All that select parts of the model.
SELECTIONS = FOLLOWED | {"NSM", "MFLUID", "A2GG", "BGSET", "ADAPT"}
#: A temperature that loads alone: no modes know it.
LOADING = re.compile(r"TEMP\w*\s*\(\s*LOAD\s*\)", re.IGNORECASE)
#: Commands whose meaning a plain modal job would lose, and why it is not a modal job then.
REFUSED = {
    "STATSUB": "modes of a preloaded structure",
    "SUPER": "superelements",
    "SEALL": "superelements",
    "SEMG": "superelements",
    "AUXCASE": "auxiliary models",
    "AUXMODEL": "auxiliary models",
}
#: Subcases that combine or repeat others.
COMBINED = ("SUBCOM", "SYMCOM", "REPCASE")
#: A SET command may go on over lines.
SET_FLAGS = re.IGNORECASE | re.DOTALL
#: The field of a GRID that puts it into a superelement, and cards that make superelements.
SEID = 8
PARTS = ("SEBULK", "SELOC", "CSUPER", "RELEASE")
#: Executive statements that change what is computed in ways a job does not carry.
DMAP = frozenset({"COMPILE", "ALTER", "ENDALTER", "LINK", "MALTER", "RESTART", "RFALTER"})
#: Where changes to the solution sequence begin, which Nastran's own jobs carry.
ALTERS = frozenset({"COMPILE", "MALTER"})
#: Cards of constraint sets, and of their sums, by the command that selects one.
CONSTRAINTS = {"SPC": (("SPC", "SPC1"), "SPCADD"), "MPC": (("MPC",), "MPCADD")}
#: Statements that may follow a COMPILE that compiles the solution sequence as it is.
PLAIN = frozenset({"SOL", "TIME", "DIAG", "GEOMCHECK", "ECHOON", "ECHOOFF", "COMPILE", "CEND"})
#: Field of the lower frequency of a METHOD's card.
LOWEST = {"EIGRL": 2, "EIGR": 3}
#: Files that an ASSIGN may bring in; the others are for output.
INPUT_FILES = ("INPUTT2", "INPUTT4", "USRSOU", "MATPOOL")
#: Executive statements that stay.
SYSTEM = frozenset({"NASTRAN", "GEOMCHECK"})
#: Plot requests reach from here to the bulk data.
PLOTS = re.compile(r"OUTPUT\s*\(", re.IGNORECASE)
#: Parameters of output that a job sets itself, or does without.
OWN_PARAMETERS = frozenset({
    "POST", "POSTEXT", "OGEOM", "GRDPNT", "TINY", "OPTEXIT", "OUGCORD", "PRTMAXIM", "NASPRT",
    "IUNIT", "PRTDOF",
})  # fmt: skip


@dataclass(frozen=True, slots=True)
class Statement:
    """One command with its continuation lines: name in upper case, text, and where it starts."""

    name: str
    text: str
    where: str

    @property
    def value(self) -> str:
        """The text after the equals sign or, without one, after the name."""
        _, equals, right = self.text.partition("=")
        return (right if equals else self.text.split(None, 1)[-1]).strip()

    @property
    def parameter(self) -> str:
        """The parameter that a PARAM command sets, empty for other commands."""
        words = re.split(r"[\s,=]+", self.text.strip())
        return words[1].upper() if self.name == "PARAM" and len(words) > 1 else ""

    @property
    def parameter_value(self) -> str:
        """The value that a PARAM command gives its parameter."""
        words = re.split(r"[\s,=]+", self.text.strip())
        return words[2] if len(words) > 2 else ""


@dataclass(frozen=True, slots=True)
class CaseControl:
    """What stays of a deck's case control: selections, parameters by name, the METHOD's number.

    A parameter of the case control goes before one of the bulk data.
    """

    selections: tuple[str, ...]
    parameters: tuple[tuple[str, str], ...]
    method: int

    @property
    def lost(self) -> list[str]:
        """A sentence for each selection and parameter that other solvers' jobs would lose."""
        names = [re.split(r"\W", text, maxsplit=1)[0].upper() for text in self.selections]
        reasons = [changing_parameter(name, value) for name, value in self.parameters]
        return [
            *(f"case control {name}: not translated" for name in names if name not in FOLLOWED),
            *(f"case control {reason}" for reason in reasons if reason),
        ]

    @property
    def temperature(self) -> str:
        """The selection of the temperature that materials have, empty where there is none."""
        found = (text for text in self.selections if text.upper().startswith("TEMP"))
        return next((text for text in found if not LOADING.match(text)), "")

    def added(self, name: str) -> tuple[tuple[float, str], ...]:
        """The DMIG that K2GG or M2GG adds to the model's matrix, each behind its factor.

        Raises ModelError.
        """
        texts = (re.fullmatch(rf"{name}\s*=\s*(.*)", s, SET_FLAGS) for s in self.selections)
        text = next((match.group(1).upper() for match in texts if match), "")
        found = list[tuple[float, str]]()
        for term in re.split(r"[\s,()]+(?![*])", text.strip("() \n")) if text else ():
            factor, _, matrix = term.rpartition("*")
            try:
                found.append((read_number(factor) if factor else 1.0, matrix))
            except ValueError:
                raise ModelError(f"{name} = {text}: {factor!r} is no factor of {matrix}") from None
        return tuple(found)

    def without(self, absent: Iterable[str]) -> CaseControl:
        """Return the case control without these selections."""
        kept = tuple(text for text in self.selections if text.upper() not in absent)
        return replace(self, selections=kept)

    def selected(self, name: str) -> int:
        """The set that a selection names (SPC, MPC), 0 where there is none."""
        for text in self.selections:
            found = re.match(rf"{name}\s*=\s*(\d+)", text, re.IGNORECASE)
            if found:
                return int(found.group(1))
        return 0


def read_statements(deck: NastranDeck, positions: Iterable[int]) -> Iterator[Statement]:
    """Commands of the executive or case control; a comma at a line's end continues it."""
    text, where = "", ""
    for position in positions:
        line = deck.lines[position]
        part = line.text.split("$", 1)[0].rstrip()
        if not part.strip():
            continue
        where = where if text else line.where
        text = f"{text}\n{part}" if text else part.strip()
        if not part.endswith(","):
            yield _statement(text, where)
            text = ""
    if text:
        yield _statement(text, where)


def _statement(text: str, where: str) -> Statement:
    name = re.match(r"[A-Za-z0-9]+", text)
    return Statement(name.group().upper() if name else "", text, where)


def system_statements(deck: NastranDeck, native: bool = True) -> list[str]:
    """NASTRAN statements and their like. Raises ModelError for what a job cannot carry.

    native: whether a Nastran's job it is, which carries the deck's `alters`.
    """
    kept, problems = [], list[str]()
    carried = alters(deck) if native else []
    rest = [position for position in deck.executive if position not in carried]
    statements = list(read_statements(deck, rest))
    for place, statement in enumerate(statements):
        after = statements[place + 1].name if place + 1 < len(statements) else "CEND"
        if statement.name == "COMPILE" and after in PLAIN:
            continue  # nothing is altered
        if statement.name in SYSTEM:
            kept.append(statement.text)
        elif statement.name in DMAP:
            problems.append(
                f"{statement.where}: {statement.name} changes the solution sequence, which jobs "
                "do not carry; take it out"
            )
        elif statement.name == "ASSIGN" and _brings_in(statement.text):
            problems.append(
                f"{statement.where}: the model takes data from another file "
                f"(`{statement.text.splitlines()[0]}`), which jobs do not carry"
            )
    if problems:
        raise ModelError("\n".join(problems))
    return kept


def alters(deck: NastranDeck) -> list[int]:
    """Return the positions of COMPILE and MALTER statements and what belongs to each."""
    found, inside = list[int](), False
    for position in deck.executive:
        word = _statement(deck.lines[position].text.strip(), "").name
        inside = (inside or word in ALTERS) and word not in ("SOL", "CEND")
        found += [position] if inside else []
        inside = inside and word != "ENDALTER"
    return found


def _brings_in(text: str) -> bool:
    words = text.upper().replace("=", " ").split()
    return len(words) > 1 and words[1].startswith(INPUT_FILES)


def read_case_control(deck: NastranDeck) -> CaseControl:
    """Selections of the one subcase that counts, below those above all subcases.

    Raises ModelError where several subcases select different things and the deck names none of
    them, or for preloads and superelements.
    """
    kept, problems = chosen_statements(deck), list[str]()
    for statement in kept:
        if statement.name in REFUSED and not _whole(deck, statement):
            problems.append(
                f"{statement.where}: {statement.name} asks for {REFUSED[statement.name]}, which "
                "is not supported"
            )
    if problems:
        raise ModelError("\n".join(problems))
    latest: dict[tuple[str, str], Statement] = {}  # a subcase's word counts, not the one above
    for statement in kept:
        if _selects(statement):
            latest[statement.name, statement.parameter or _describers(statement)] = statement
    parameters = tuple(
        (name, statement.parameter_value)
        for (_, name), statement in latest.items()
        if statement.parameter
    )
    selections = tuple(
        re.sub(r"^(\w+)\s*=?\s*(\d+)$", r"\1 = \2", statement.text)
        for statement in latest.values()
        if not statement.parameter
    )
    methods = [statement for statement in kept if statement.name == "METHOD"]
    bulk_only = not deck.case_control and not deck.executive
    return CaseControl(
        selections + (_only_sets(deck) if bulk_only else ()),
        parameters,
        _number(methods[-1]) if methods else 0,
    )


def absent_sets(deck: NastranDeck, case: CaseControl) -> list[str]:
    """Return the selections of SPC and MPC sets of which the deck has nothing."""
    return [
        f"{name} = {number}"
        for name, (_, sums) in CONSTRAINTS.items()
        if (number := case.selected(name))
        and str(number) not in _own_sets(deck, name)
        and not any(
            members_of(deck, card) for card in deck.named(sums) if card.text(1) == str(number)
        )
    ]


def absent_members(deck: NastranDeck, case: CaseControl) -> list[str]:
    """Return what a selected SPCADD or MPCADD adds and the deck does not have, by `SPCADD 3: 9`."""
    found = []
    for name, (_, sums) in CONSTRAINTS.items():
        for card in deck.named(sums):
            if card.text(1) == str(case.selected(name)):
                named = [text for place in range(2, len(card.fields)) if (text := card.text(place))]
                lost = [text for text in named if text not in members_of(deck, card)]
                found += [f"{sums} {card.text(1)}: {', '.join(lost)}"] if lost else []
    return found


def members_of(deck: NastranDeck, card: NastranCard) -> list[str]:
    """Return the sets of a SPCADD or MPCADD that the deck has."""
    own = _own_sets(deck, card.name.removesuffix("ADD"))
    return [text for place in range(2, len(card.fields)) if (text := card.text(place)) in own]


def _own_sets(deck: NastranDeck, name: str) -> set[str]:
    """Return the numbers of the SPC or MPC sets of which the deck has cards, without sums."""
    return {card.text(1) for card in deck.named(*CONSTRAINTS[name][0])}


def _whole(deck: NastranDeck, statement: Statement) -> bool:
    """Whether superelements are asked for where the whole model is, or becomes, one."""
    if deck.parts:
        return True
    whole = statement.name in ("SEALL", "SEMG") or statement.value in ("0", "ALL")
    of_parts = any(card.text(SEID) not in ("", "0") for card in deck.named("GRID"))
    known = statement.name in ("SUPER", "SEALL", "SEMG")
    return known and whole and not of_parts and not deck.named(*PARTS)


def _only_sets(deck: NastranDeck) -> tuple[str, ...]:
    """Selections for a file of bulk data alone: its one SPC and its one MPC set.

    Raises ModelError where there are several and nothing says which one holds.
    """
    chosen = []
    for name in ("SPC", "MPC"):
        sums = deck.named(f"{name}ADD")
        parts = {card.text(i) for card in sums for i in range(2, len(card.fields))}
        cards = [*deck.named(name, f"{name}1"), *sums]
        sets = sorted({card.text(1) for card in cards} - parts)
        if len(sets) > 1:
            raise ModelError(
                f"{deck.file}: the file has no case control, and {name} sets {', '.join(sets)} "
                f"are both there; say which one holds with case control (`{name} = "
                f"{sets[0]}` between CEND and BEGIN BULK)"
            )
        chosen += [f"{name} = {number}" for number in sets]
    return tuple(chosen)


def _split(deck: NastranDeck) -> tuple[list[Statement], list[list[Statement]]]:
    above: list[Statement] = []
    subcases: list[list[Statement]] = []
    sets: dict[str, str] = {}
    for statement in read_statements(deck, deck.case_control):
        if PLOTS.match(statement.text) or statement.name == "BEGIN":
            break
        if statement.name in ("SUBCASE", "SYM", *COMBINED):
            subcases.append([statement])
        elif subcases:
            subcases[-1].append(statement)
        else:
            above.append(statement)
        if found := re.fullmatch(r"SET\s+(\d+)\s*=\s*(.*)", statement.text, SET_FLAGS):
            sets[found.group(1)] = found.group(2)
    if not deck.parts:
        return above, subcases
    whole = [own for own in subcases if _of_whole(own, sets)]
    if not whole:
        return above, subcases
    for own in subcases:
        if own not in whole and not _same_constraints(above, own, whole[-1]):
            raise ModelError(
                f"{own[0].where}: this subcase of a part selects other SPC or MPC sets than that "
                "of the residual structure; give both the same sets"
            )
    return above, whole


def _of_whole(own: list[Statement], sets: Mapping[str, str]) -> bool:
    """Whether a subcase is of the residual structure, which has the whole model's modes."""
    for statement in own:
        if statement.name == "SUPER":
            first = statement.value.partition(",")[0].strip().upper()
            members = re.split(r"[\s,]+", sets.get(first, first).strip().upper())
            return "ALL" in members or "0" in members
    return True


def _same_constraints(above: list[Statement], one: list[Statement], other: list[Statement]) -> bool:
    """Whether two subcases select the same constraints, those above all in force."""
    selected = [
        {item.name: item.value for item in (*above, *own) if item.name in CONSTRAINTS}
        for own in (one, other)
    ]
    return selected[0] == selected[1]


def modal_subcases(deck: NastranDeck) -> tuple[ModalCase, ...]:
    """Return the subcases among which a campaign may choose, in the deck's order.

    They have a METHOD, their own or that above all; if none has, all are returned. Empty where they
    give the same modes.
    """
    above, subcases = _split(deck)
    plain = _plain(subcases)
    modal = [own for own in plain if _has_method(above) or _has_method(own)] or plain
    if len({_meaning(own) for own in modal}) < 2:
        return ()
    try:
        default = _one(subcases)
    except ModelError:
        default = []
    return tuple(replace(_modal_case(own), default=own is default) for own in modal)


def parts_note(deck: NastranDeck) -> str:
    """Return that superelements are one model here; empty for a deck without any."""
    if not deck.parts:
        return ""
    return (
        f"{deck.file}: its superelements are joined to one model without reduction, so the modes "
        "are those of the whole structure; docs/nastran.md says what numbers the parts have"
    )


def choice_note(deck: NastranDeck) -> str:
    """Return which of several subcases counts without a choice; empty where one is named."""
    cases = () if deck.subcase else modal_subcases(deck)
    others = "; ".join(str(item) for item in cases if not item.default)
    return "".join(
        f"{deck.file}: the modes are those of subcase {item}; `model.subcase` (`--subcase` with a "
        f"deck) chooses another: {others}"
        for item in cases
        if item.default
    )


def range_note(deck: NastranDeck) -> str:
    """Return what a lower frequency of the selected EIGRL or EIGR means here; empty without one.

    Raises ModelError where it is no number.
    """
    method = read_case_control(deck).method
    for card in deck.named("EIGRL", "EIGR"):
        if card.text(1) == str(method) and (deck.number(card, LOWEST[card.name]) or 0.0) > 0.0:
            lowest = card.text(LOWEST[card.name])
            return (
                f"{deck.where(card)}: the lower frequency {lowest} of {card.name} is left out: "
                "modes are counted from the lowest one, also where the deck's own run has others "
                "first"
            )
    return ""


def _has_method(statements: list[Statement]) -> bool:
    return any(item.name == "METHOD" for item in statements)


def chosen_statements(deck: NastranDeck) -> list[Statement]:
    """Return what is above all subcases and what the one that counts has. Raises ModelError."""
    above, subcases = _split(deck)
    if deck.subcase:
        return [*above, *_numbered(deck, subcases)]
    return [*above, *(_one(subcases) if subcases else ())]


def _numbered(deck: NastranDeck, subcases: list[list[Statement]]) -> list[Statement]:
    """Return the subcase that the campaign names."""
    plain = _plain(subcases)
    for own in plain:
        if _subcase_number(own) == deck.subcase:
            return own
    if not plain:
        raise ModelError(
            f"{deck.file}: the deck has no subcases, so `model.subcase: {deck.subcase}` names none"
        )
    others = "; ".join(str(_modal_case(own)) for own in plain)
    raise ModelError(f"{deck.file}: the deck has no subcase {deck.subcase}; it has {others}")


def _plain(subcases: list[list[Statement]]) -> list[list[Statement]]:
    """Return the subcases that do not combine or repeat others."""
    return [own for own in subcases if own[0].name not in COMBINED]


def _modal_case(own: list[Statement]) -> ModalCase:
    """Return a subcase by its number, with its label and its selections."""
    texts = [item.value for item in own if item.name in ("LABEL", "SUBTITLE")][:1]
    wanted = SELECTIONS | {"METHOD"}
    texts += [" ".join(item.text.split()) for item in own if item.name in wanted]
    return ModalCase("subcase", _subcase_number(own), ", ".join(texts))


def _subcase_number(own: list[Statement]) -> int:
    """Return the number of a subcase; one without a number is the first."""
    found = re.search(r"\d+", own[0].value)
    return int(found.group()) if found else 1


def _one(subcases: list[list[Statement]]) -> list[Statement]:
    """The subcase with the one METHOD, or the one SPC, or any where all say the same."""
    subcases = _plain(subcases) or subcases
    chosen = subcases
    for names in ((), ("METHOD",), ("METHOD", "SPC")):
        named = [subcase for subcase in subcases if any(s.name in names for s in subcase)]
        chosen = named if names else subcases
        if len({_meaning(subcase) for subcase in chosen}) == 1:
            return chosen[0]
    places = ", ".join(subcase[0].where.rsplit(", ", 1)[-1] for subcase in chosen or subcases)
    raise ModelError(
        f"{subcases[0][0].where}: {len(chosen)} of {len(subcases)} subcases have a METHOD or SPC "
        f"({places}), so the wanted modes are ambiguous; `model.subcase` (`--subcase` with a deck) "
        f"chooses one: {'; '.join(str(_modal_case(own)) for own in chosen or subcases)}"
    )


def _meaning(subcase: list[Statement]) -> tuple[str, ...]:
    """What of a subcase counts for modes."""
    return tuple(
        " ".join(statement.text.upper().split())
        for statement in subcase
        if _selects(statement, "METHOD")
        and not LOADING.match(statement.text)
        and (statement.parameter in CHANGING if statement.parameter else True)
    )


def _selects(statement: Statement, *more: str) -> bool:
    parameter = statement.parameter
    if parameter:
        return parameter not in OWN_PARAMETERS
    return statement.name in SELECTIONS or statement.name in more


def _describers(statement: Statement) -> str:
    """Return the describers, by which TEMPERATURE(INITIAL) and TEMPERATURE(LOAD) differ."""
    found = re.match(r"\w+\s*\(([^)]*)\)", statement.text)
    return found.group(1).upper().replace(" ", "") if found else ""


def _number(statement: Statement) -> int:
    try:
        return int(statement.value)
    except ValueError:
        raise ModelError(
            f"{statement.where}: METHOD requires the number of an EIGRL card: `{statement.text}`"
        ) from None

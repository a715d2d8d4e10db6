"""Superelements of a deck as one model.

Each part (BEGIN SUPER) numbers its points and cards for itself. Points are joined where Nastran
joins them: at one place (SEBULK's tolerance), or by SECONCT. Joined points take the number of the
first; a number that another part has for something else gets an offset, SEID times a power of ten,
so card 1 of part 2 becomes 2001. A coordinate system that reads alike keeps its number. Sets that
only reduce a part (SESET, ASET, QSET) are left out: modes are those of the whole model.

What this does not give exactly is refused by name: parts that are moved, mirrored, copied, released
or kept in other files.

Source: SEBULK and SECONCT in the MSC Nastran Quick Reference Guide.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pyNastran.bdf.bdf import BDF

from modetune.adapters.deck_files import Line
from modetune.adapters.nastran.fields import CardField, NastranCard, read_cards, read_number
from modetune.adapters.nastran.harmless import CHANGING, HARMLESS
from modetune.core.errors import ModelError
from modetune.core.modes import Floats

#: A part's number (0 is the residual structure) and the positions of its lines.
Part = tuple[int, range]
#: Cards that only say how superelements are reduced or shown.
REDUCING = frozenset(
    "SEBULK SECONCT SESET SEELT SELABEL SETREE SENQSET SEQSET SEQSET1 SEBSET SEBSET1 SECSET "
    "SECSET1 SESUP SEUSET SEUSET1 SELOAD CSUPEXT".split()
)
#: Cards by which a part is not where or what its own section says.
REFUSED = {
    "SELOC": "moves a part; give the part's points at their final place",
    "SEMPLN": "mirrors or moves a part; write the image out as a part",
    "CSUPER": "makes an image of a superelement; write the image out as a part",
    "RELEASE": "frees a boundary; use points of separate numbers with springs or MPC between them",
    "SEEXCLD": "keeps points apart; list the pairs to be joined with SEBULK ... MANUAL and SECONCT",
    "SEBNDRY": "limits the search for a boundary; list the pairs to be joined with SECONCT",
    "EXTRN": "belongs to a superelement of another file; use its matrices (K2GG, M2GG)",
}
#: What the numbers in a card's fields are: N points, C coordinate systems, E elements,
#: P properties, M materials. `*` repeats the letter before it to the card's end, `-` is no number.
NUMBERS = {
    "GRID": "NC---C", "SPOINT": "N*", "CORD2R": "CC", "CORD2C": "CC", "CORD2S": "CC",
    "CORD1R": "CNNNCNNN", "CORD1C": "CNNNCNNN", "CORD1S": "CNNNCNNN",
    "CBAR": "EPNNN", "CBEAM": "EPNNN-----------NN", "CROD": "EPNN", "CTUBE": "EPNN",
    "CONROD": "ENNM",
    "CQUAD4": "EPNNNNC", "CQUADR": "EPNNNNC", "CTRIA3": "EPNNNC", "CTRIAR": "EPNNNC",
    "CQUAD8": "EPNNNNNNNN----C", "CTRIA6": "EPNNNNNNC", "CSHEAR": "EPNNNN",
    "CHEXA": "EPN*", "CPENTA": "EPN*", "CTETRA": "EPN*", "CPYRAM": "EPN*",
    "CELAS1": "EPN-N", "CELAS2": "E-N-N", "CELAS3": "EPNN", "CELAS4": "E-NN",
    "CMASS1": "EPN-N", "CMASS2": "E-N-N", "CMASS3": "EPNN", "CMASS4": "E-NN",
    "CDAMP1": "EPN-N", "CDAMP2": "E-N-N", "CDAMP3": "EPNN", "CDAMP4": "E-NN", "CVISC": "EPNN",
    "PDAMP": "P-P-P-P", "PVISC": "P---P",
    "CBUSH": "EPNNN--C-C", "CONM1": "ENC", "CONM2": "ENC",
    "PSHELL": "PM-M-M----M", "PCOMP": "P-------" + "M---" * 200, "PSOLID": "PMC", "PBAR": "PM",
    "PBARL": "PM", "PBEAM": "PM", "PBEAML": "PM", "PROD": "PM", "PTUBE": "PM", "PSHEAR": "PM",
    "PELAS": "P---P", "PBUSH": "P", "PMASS": "P-P-P-P",
    "MAT1": "M", "MAT2": "M", "MAT8": "M", "MAT9": "M",
    "RBE2": "EN-N*", "RBAR": "ENN", "RBAR1": "ENN", "RROD": "ENN", "RBE3": "E-N",
    "SPC": "-N--N", "SPC1": "--N*", "SPCADD": "", "MPC": "-N--N---" * 200, "MPCADD": "",
}  # fmt: skip
#: Coordinate systems given by numbers alone.
SYSTEMS = ("CORD2R", "CORD2C", "CORD2S")
#: Cards that fill blank fields of others in the same section.
DEFAULTS = {"GRDSET": "GRID", "BAROR": "CBAR", "BEAMOR": "CBEAM"}
#: Sums of sets.
SUMS = ("SPCADD", "MPCADD")
#: Cards with ranges of points, and the number of fields before these.
RANGES = {"SPOINT": 1, "SPC1": 3, "RBE2": 4}
#: Parameters that change modes, and that one model has once.
ONE_VALUE = frozenset(("WTMASS", "COUPMASS", *CHANGING))
#: How cards of elements begin, and the fields of a RBE3 before its weights.
ELEMENTS = ("CQ", "CT", "CH", "CP", "CB", "CR", "CE", "CM", "CS", "CD", "CV", "CON", "R")
RBE3_HEAD = 4
#: Fields of the numbers of cards with several properties.
PROPERTIES_AT = {"PMASS": (1, 3, 5, 7), "PDAMP": (1, 3, 5, 7), "PELAS": (1, 5), "PVISC": (1, 5)}
#: What follows what in a RBE3: weight, components, points; behind UM points and components.
FOLLOWS = {"": "", "weight": "components", "components": "N", "N": "N", "um": "um components",
           "um components": "um"}  # fmt: skip
#: Fields of a GRID, and the distance of joined points by default.
CD, PS, SEID, NEAR = 6, 7, 8, 1e-5
LARGEST = 2**31 - 1


def is_partitioned(cards: Iterable[NastranCard]) -> bool:
    """Whether cards of one section make superelements."""
    own = ("SESET", "SEELT", "CSUPER", "RELEASE")
    return any(
        card.name in own or (card.name == "GRID" and card.text(SEID) not in ("", "0"))
        for card in cards
    )


def merged_cards(lines: Sequence[Line], parts: Sequence[Part]) -> tuple[NastranCard, ...]:
    """Return the cards of one model; parts: all sections, the residual structure first.

    Raises ModelError with file and line of every card that prevents it.
    """
    sections = [(number, read_cards(lines, positions)) for number, positions in parts]
    cards = (card for _, own in sections for card in own)
    largest = max((n for card in cards for _, n in _numbered(card)), default=1)
    merge = Merge(lines, max(1000, 10 ** len(str(largest))), len(sections) > 1)
    for number, own in sections:
        merge.add(number, own)
    if len(merge.numbers) > 1 and len([own for own in merge.numbers.values() if own]) > 1:
        merge.problems += [
            f"{lines[positions.start - 1].where}: superelements: part {number} is joined to no "
            "other part; check the places of its points, SEBULK's tolerance or SECONCT"
            for number, positions in parts
            if number in merge.alone - {0}
        ]
    if merge.problems:
        raise ModelError("\n".join(dict.fromkeys(merge.problems)))
    return tuple(sorted(merge.cards, key=lambda card: card.lines[0]))


@dataclass(slots=True)
class MergedPoint:
    """A point of the merged model.

    part: its first; at: of its card in the model's cards; place: None of a scalar point; used: by
    an element.
    """

    part: int
    card: NastranCard
    at: int
    place: Floats | None
    used: bool


@dataclass(slots=True)
class Merge:
    """The merged model as parts are added to it.

    step: SEID times this is the offset of numbers; several: whether there are parts. taken: cards
    by kind and number, points apart. numbers: of each part's points in the merged model. searches:
    whether a part is joined by SECONCT alone, and its tolerance. pairs: what SECONCT joins, as part
    and point. values: of parameters. systems: those of numbers alone, as they read.
    alone: sections with points of which none is joined.
    """

    lines: Sequence[Line]
    step: int
    several: bool
    cards: list[NastranCard] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    points: dict[int, MergedPoint] = field(default_factory=dict)
    taken: dict[tuple[str, int], NastranCard] = field(default_factory=dict)
    numbers: dict[int, dict[int, int]] = field(default_factory=dict)
    searches: dict[int, tuple[bool, float]] = field(default_factory=dict)
    pairs: dict[tuple[int, int], set[tuple[int, int]]] = field(default_factory=dict)
    values: dict[str, str] = field(default_factory=dict)
    systems: set[tuple[str, ...]] = field(default_factory=set)
    alone: set[int] = field(default_factory=set)

    def where(self, card: NastranCard) -> str:
        return self.lines[card.lines[0]].where

    def refuse(self, card: NastranCard, reason: str) -> None:
        self.problems.append(f"{self.where(card)}: superelements: {card.name} {reason}")

    def add(self, part: int, cards: Sequence[NastranCard]) -> None:
        """Add the cards of a part; of the residual structure, part 0, all others stay too."""
        defaults = {name: card for card in cards if (name := DEFAULTS.get(card.name))}
        own = [
            _with_text(filled, SEID, "") if card.name == "GRID" else filled
            for card in cards
            if self._is_of_model(part, card)
            for filled in (_filled(card, defaults.get(card.name)),)
        ]
        maps = self._maps(part, own)
        places = self._places(own) if self.several else {}
        if any(card.name == "GRID" for card in own):
            self.alone.add(part)
        maps["N"] = self.numbers[part] = self._joined(part, own, places, maps["C"])
        used = set[int]()
        for card in own if self.several else ():
            points = [n for kind, n in _numbered(card) if kind == "N"]
            if card.name.startswith(ELEMENTS):
                used.update(points)
                for number in points:
                    if number not in maps["N"]:
                        self.refuse(card, f"{card.text(1)} names point {number}, which part {part} "
                                          "does not have; give it a GRID or SPOINT")  # fmt: skip
        for card in own:
            if not self.several:
                self.cards.append(card)
                continue
            new = _renumbered(card, maps)
            if card.name == "GRID" and card.text(1).isdecimal():
                self._add_point(part, new, int(card.text(1)), places, used)
                continue
            if card.name == "SPOINT":
                fresh = [number for number in _points(new) if number not in self.points]
                point = MergedPoint(part, new, len(self.cards), None, used=True)
                self.points.update(dict.fromkeys(fresh, point))
                if not fresh:
                    continue
                new = _listed(new, fresh)
            if card.name in SYSTEMS:
                if _texts(new) in self.systems:
                    continue
                self.systems.add(_texts(new))
            self.cards.append(new)

    def _is_of_model(self, part: int, card: NastranCard) -> bool:
        """Whether a card is numbered and joined; what else the model has is added at once."""
        if card.name in REFUSED:
            self.refuse(card, REFUSED[card.name])
        elif card.name == "SEBULK":
            self._part_kind(card)
        elif card.name == "SECONCT":
            self._connection(card)
        elif card.name == "PARAM" and card.text(1) in ONE_VALUE and part:
            if self.values.get(card.text(1)) != card.text(2):
                self.refuse(card, f"{card.text(1)} of part {part} is not that of the main bulk "
                                  "data; one model has one value")  # fmt: skip
        elif card.name in REDUCING or card.name in DEFAULTS:
            return False
        elif card.name in SUMS and _texts(self.taken.setdefault(_sum(card), card)) != _texts(card):
            self.refuse(card, f"{card.text(1)} of part {part} is not that of another part; give "
                              "both the same sets")  # fmt: skip
        elif card.name in NUMBERS:
            return True
        elif not part:
            self.cards.append(card)
            if card.name == "PARAM":
                self.values[card.text(1)] = card.text(2)
        elif card.name not in HARMLESS and card.name not in ("PARAM", "MDLPRM"):
            self.refuse(card, f"in part {part} cannot be joined; write the model without parts")
        return False

    def _add_point(
        self, part: int, card: NastranCard, own: int, places: Mapping[int, Floats], used: set[int]
    ) -> None:
        """Add a grid point by its number in the merged model; own: that in its part."""
        number = int(card.text(1))
        there = self.points.get(number)
        if there is None:
            self.points[number] = MergedPoint(
                part, card, len(self.cards), places.get(own), own in used
            )
            self.cards.append(card)
        elif own in used:
            if there.used and there.card.text(PS) != card.text(PS):
                where = f"the point that it is joined to, at {self.where(there.card)}"
                self.refuse(card, f"{own} has other supports (PS) than {where}; give both the same")
            there.card = self.cards[there.at] = _with_text(there.card, PS, card.text(PS))
            there.used = True

    def _part_kind(self, card: NastranCard) -> None:
        if card.text(2) not in ("", "PRIMARY"):
            self.refuse(card, f"of type {card.text(2)} is no part of this deck's own; write it out "
                              "with BEGIN SUPER, or use its matrices (K2GG, M2GG)")  # fmt: skip
        elif card.text(1).isdecimal():
            try:
                near = read_number(card.text(5)) if card.text(5) else NEAR
            except ValueError as error:
                self.refuse(card, f"has a tolerance that cannot be read: {error}")
                return
            self.searches[int(card.text(1))] = (card.text(4) == "MANUAL", near)

    def _connection(self, card: NastranCard) -> None:
        """Read the pairs of points that a SECONCT joins."""
        texts = [card.text(place) for place in range(9, len(card.fields))]
        ends = [card.text(1), card.text(2) or "0"]
        words = [text for text in texts if text]
        if not all(word.isdecimal() for word in (*ends, *words)) or len(words) % 2:
            self.refuse(card, "is read as pairs of points (GIDA, GIDB); write out THRU")
            return
        first, second = map(int, ends)
        for one, other in zip(map(int, words[::2]), map(int, words[1::2]), strict=True):
            self.pairs.setdefault((first, one), set()).add((second, other))
            self.pairs.setdefault((second, other), set()).add((first, one))

    def _maps(self, part: int, cards: Sequence[NastranCard]) -> dict[str, dict[int, int]]:
        """Return the merged model's numbers for those of a part that it has otherwise."""
        maps: dict[str, dict[int, int]] = {kind: {} for kind in "NCEPM"}
        owners = [(kind, number, card) for card in cards for kind, number in _owned(card)]
        changed = True
        while changed:  # a system whose own system has another number has one too
            changed = False
            for kind, number, card in owners:
                there = self.taken.get((kind, number))
                if there is None or number in maps[kind]:
                    continue
                same = card.name in SYSTEMS and _texts(_renumbered(card, maps)) == _texts(there)
                if not same:
                    maps[kind][number] = self._free(card, part, number)
                    changed = True
        for kind, number, card in owners:
            self.taken.setdefault((kind, maps[kind].get(number, number)), _renumbered(card, maps))
        return maps

    def _free(self, card: NastranCard, part: int, number: int) -> int:
        """Return the number of something whose own is taken."""
        if part * self.step + number > LARGEST:
            self.refuse(card, f"{number} of part {part} is something else in another part; "
                              "renumber one of them")  # fmt: skip
        return part * self.step + number

    def _joined(
        self,
        part: int,
        cards: Sequence[NastranCard],
        places: Mapping[int, Floats],
        systems: Mapping[int, int],
    ) -> dict[int, int]:
        """Return the numbers of all points of a part in the merged model."""
        manual, near = self.searches.get(part, (False, NEAR))
        found = dict[int, int]()
        there = [number for number, point in self.points.items() if point.place is not None]
        known = np.array([self.points[number].place for number in there]).reshape(-1, 3)
        for card in cards:
            if card.name not in ("GRID", "SPOINT"):
                continue
            for number in _points(card):
                place, others = places.get(number), self._paired(part, number)
                if not others and not manual and place is not None:
                    close = np.abs(known - place).max(axis=1, initial=0.0) <= near
                    others = {there[row] for row in np.flatnonzero(close).tolist()}
                    others = others & {number} or others
                if len(others) > 1 or others & set(found.values()):
                    self.refuse(card, f"{number} of part {part} is at the place of several points; "
                                      "say by SECONCT which two are one")  # fmt: skip
                for other in others:
                    self.alone -= {part, self.points[other].part}
                    self._check_joined(card, number, self.points[other], place, near, systems)
                new = next(iter(others), number)
                clash = not others and part and number in self.points
                found[number] = self._free(card, part, number) if clash else new
        return found

    def _paired(self, part: int, number: int) -> set[int]:
        """Return the points of earlier parts that SECONCT joins to one, in the merged numbers."""
        return {
            self.numbers[other][own]
            for other, own in self.pairs.get((part, number), ())
            if own in self.numbers.get(other, {})
        }

    def _check_joined(
        self,
        card: NastranCard,
        number: int,
        point: MergedPoint,
        place: Floats | None,
        near: float,
        systems: Mapping[int, int],
    ) -> None:
        """Refuse points that are joined and not one: apart, or with other axes."""
        if place is None or point.place is None:
            return
        where = f"the point that it is joined to, at {self.where(point.card)}"
        if np.abs(point.place - place).max() > near:
            self.refuse(card, f"{number} is not at the place of {where}; put both at one place")
        own = card.text(CD) or "0"
        axes = str(systems.get(int(own), own)) if own.isdecimal() else own
        if axes != (point.card.text(CD) or "0"):
            self.refuse(card, f"{number} has other axes (CD) than {where}; give both the same")

    def _places(self, cards: Sequence[NastranCard]) -> dict[int, Floats]:
        """Return the places of a section's grid points in the basic system, (3,) each."""
        bulk: Any = BDF(debug=None)
        bulk.log.level = "critical"
        own = [card for card in cards if card.name == "GRID" or card.name.startswith("CORD")]
        try:
            for card in own:
                bulk.add_card_lax(list(_texts(card)), card.name, is_list=True, has_none=False)
            bulk.cross_reference()
            return {number: np.asarray(node.get_position()) for number, node in bulk.nodes.items()}
        except (
            ValueError,
            KeyError,
            TypeError,
            RuntimeError,
            AttributeError,
            SyntaxError,
        ) as error:
            first = (str(error).strip() or type(error).__name__).splitlines()[0]
            self.problems.append(f"{self.where(own[0])}: the points of this part: {first}")
            return {}


def _sum(card: NastranCard) -> tuple[str, int]:
    return card.name, int(card.text(1) or 0) if card.text(1).isdecimal() else 0


def _kinds(card: NastranCard) -> Iterator[tuple[int, str]]:
    """Yield the fields of a card that hold numbers, with their kinds."""
    pattern, weighed = NUMBERS.get(card.name, ""), ""
    for place in range(1, len(card.fields)):
        text = card.text(place)
        kind = pattern[place - 1 : place] or pattern[-1:]
        if place > len(pattern) and kind != "*":
            kind = ""
        if card.name == "RBE3" and place > RBE3_HEAD:
            # A weight, its components, then points; behind UM points and components in turn.
            weighed = FOLLOWS[weighed]
            if text in ("UM", "ALPHA") or "." in text:
                weighed = {"UM": "um components", "ALPHA": ""}.get(text, "weight")
            kind = "N" if weighed in ("N", "um") else ""
        kind = pattern[-2] if kind == "*" else kind
        if kind and kind != "-" and text.isdecimal() and text.strip("0"):
            yield place, kind


def _numbered(card: NastranCard) -> Iterator[tuple[str, int]]:
    """Yield all numbers in a card with their kinds; of ranges the ends."""
    for place, kind in _kinds(card):
        yield kind, int(card.text(place))


def _points(card: NastranCard) -> list[int]:
    """Return the points of a GRID, SPOINT or another card of ranges, written out."""
    if card.name == "GRID":
        return [int(card.text(1))] if card.text(1).isdecimal() else []
    first = RANGES[card.name]
    texts = [text for place in range(first, len(card.fields)) if (text := card.text(place))]
    found = [int(text) for text in texts if text.isdecimal()]
    for before, word, after in zip(texts, texts[1:], texts[2:], strict=False):
        if word == "THRU" and before.isdecimal() and after.isdecimal():
            found += range(int(before) + 1, int(after))
    return found


def _owned(card: NastranCard) -> Iterator[tuple[str, int]]:
    """Yield what a card numbers, other than points."""
    kind = NUMBERS[card.name][:1]
    places = PROPERTIES_AT.get(card.name, (1,))
    for place in (1, 5) if card.name.startswith("CORD1") else places:
        if kind in ("C", "E", "P", "M") and card.text(place).isdecimal():
            yield kind, int(card.text(place))


def _renumbered(card: NastranCard, maps: Mapping[str, Mapping[int, int]]) -> NastranCard:
    """Return a card in the merged model's numbers; points of ranges one by one."""
    fields = list(card.fields)
    for place, kind in _kinds(card):
        own, number = fields[place], int(card.text(place))
        if own is not None and number in maps[kind]:
            fields[place] = own._replace(text=str(maps[kind][number]))
    texts = {found.text.upper() for found in fields if found}
    if card.name in RANGES and "THRU" in texts and maps["N"]:
        points = sorted(maps["N"][n] for n in _points(card) if n in maps["N"])
        return _listed(replace(card, fields=tuple(fields)), points)
    return replace(card, fields=tuple(fields))


def _listed(card: NastranCard, points: Iterable[int]) -> NastranCard:
    """Return a card of ranges with these points instead."""
    here = CardField(card.lines[0], 0, 0, 0, "")
    head = card.fields[: RANGES[card.name]]
    return replace(card, fields=(*head, *(here._replace(text=str(n)) for n in points)))


def _texts(card: NastranCard) -> tuple[str, ...]:
    return card.name, *(card.text(place) for place in range(1, len(card.fields)))


def _filled(card: NastranCard, default: NastranCard | None) -> NastranCard:
    """Return a card whose blank fields are those of the section's GRDSET, BAROR or BEAMOR."""
    if default is None:
        return card
    for place in range(1, len(default.fields)):
        if default.text(place) and not card.text(place):
            card = _with_text(card, place, default.text(place))
    return card


def _with_text(card: NastranCard, place: int, text: str) -> NastranCard:
    """Return a card with another text in a field; the deck's line stays as it is."""
    if card.text(place) == text:
        return card
    fields = [*card.fields, *[None] * (place + 1 - len(card.fields))]
    fields[place] = CardField(card.lines[0], 0, 0, 0, text) if text else None
    return replace(card, fields=tuple(fields))

"""Where numbers of a CalculiX deck act in the matrices, and in which powers.

Stiffness is linear in *ELASTIC (Young's modulus, all moduli or a shear modulus of engineering
constants, each constant of TYPE=ORTHO and ANISO) and *SPRING, mass in *DENSITY and *MASS. Shells
are expanded to solids of thickness t, whose matrices are polynomials in t and 1/t; of a laminate
that holds where all its layers go together. So are straight beams in each
dimension of a rectangular section. Pipes and boxes are integrated in parts of it, which makes them
no polynomials; curved beams were up to 5e-7 of the diagonal off.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from modetune.adapters.calculix.cards import ACROSS, CARDS, constant_places
from modetune.adapters.calculix.constraints import read_constraints
from modetune.adapters.calculix.deck import KeywordCard, KeywordDeck, read_number
from modetune.adapters.calculix.mesh import EXPANDED, roles_of
from modetune.adapters.calculix.structure import DEPENDENT, CalculixStructure
from modetune.adapters.solver import AffectedElements
from modetune.core.errors import ModelError
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.core.updating.parameter_matrices import with_tied

#: Powers by which constants of an anisotropic material may follow a value: those of a translated
#: shell have membrane, coupling and bending in them.
CUBIC = (1, 2, 3)
#: ccx takes shells that meet as one where their normals are less than 20 degrees apart and their
#: thickness differs by less than this (gen3dnor.f); at another thickness they meet in a knot.
SAME_THICKNESS = 1e-10
#: Cosine of an angle well above these 20 degrees, for elements that are not flat.
NEAR_NORMALS = 0.7
#: Cards whose lines are numbers alone: neither mesh nor ties are other with others of them.
NUMBERS = {keyword for keyword, row in CARDS.items() if row.moves}
#: Moduli by direction, and the places of their Poisson's ratios.
ENGINEERING, RATIOS = "ENGINEERINGCONSTANTS", slice(3, 6)
#: A number of a deck: a line and the place in it.
Place = tuple[int, int]


def affected_elements_of(
    structure: CalculixStructure,
    geometry: Mesh,
    places: Collection[Place],
    powers: tuple[int, ...] = (1,),
) -> AffectedElements | None:
    """What these numbers of the deck move, as one relative value of theirs.

    powers: by which they follow it; none for thickness and dimensions.
    None where the matrices are not a polynomial of it, where a step before the frequency step may
    preload the structure, or where the number of equations depends on the value.
    """
    cards = _cards(structure, {line for line, _ in places})
    if structure.preload() or not cards:
        return None
    rows = [CARDS[keyword] for keyword in {card.keyword for card in cards} & NUMBERS]
    if len(rows) < len({card.keyword for card in cards}) or not all(row.powers for row in rows):
        return None
    across = any(row.powers == ACROSS for row in rows)
    if across and not (
        len(rows) == 1
        and all(_one_power(card, places) for card in cards)
        and _keeps_knots(structure, geometry, cards)
    ):
        return None
    sets = {name for card in cards for name in _sets(structure, card)}
    members = structure.mesh.element_sets
    elements = frozenset[int]().union(*(members.get(name, frozenset()) for name in sets))
    return AffectedElements(
        elements=elements,
        nodes=_with_tied(structure, structure.mesh.nodes_of(elements)),
        stiffness=any("K" in row.moves for row in rows),
        mass=any("M" in row.moves for row in rows),
        powers=ACROSS if across else powers,
        proportional=all(row.moves == "K" for row in rows)
        and not _layered(structure, sets)
        and all(_moduli(structure, card) <= set(places) for card in cards),
    )


def _one_power(card: KeywordCard, places: Collection[Place]) -> bool:
    """Whether these numbers of a section are one dimension, or the thickness of all layers."""
    own = {place for place in places if place[0] in card.data}
    if card.keyword == "*BEAMSECTION":
        return len(own) == 1 and card.option("SECTION") == "RECT"
    return "COMPOSITE" not in card.options or own == {(line, 0) for line in card.data}


def _moduli(structure: CalculixStructure, card: KeywordCard) -> set[Place]:
    """Constants of an *ELASTIC card that are not zero, Poisson's ratios apart."""
    if card.keyword != "*ELASTIC":
        return set()
    numbers = {(line, place) for _, line, place in constant_places(card, "youngs_modulus")}
    return {(line, place) for line, place in numbers if structure.deck.number(line, place)}


def _with_tied(structure: CalculixStructure, nodes: frozenset[int]) -> frozenset[int]:
    """These nodes, and all that ties lead to from them; all nodes where ties are not followed."""
    if not structure.deck.named(*DEPENDENT):
        return nodes
    constraints = read_constraints(structure)
    if not constraints.followed:
        return structure.mesh.nodes
    ties = [
        {node, *(term for term, _ in terms)} for (node, _), terms in constraints.dependent.items()
    ]
    ties += [{node, body.reference, body.rotation} for node, body in constraints.bodies.items()]
    return frozenset(with_tied(nodes, ((tied, tied) for tied in ties))) & structure.mesh.nodes


@dataclass(frozen=True, slots=True)
class Changed:
    """Numbers that follow a value: by which powers of it besides the constant.

    proportional: whether all are proportional to it.
    """

    places: frozenset[Place]
    powers: tuple[int, ...]
    proportional: bool


def changed_places(
    nominal: CalculixStructure, texts: Sequence[Sequence[str]], values: Sequence[float]
) -> Changed | None:
    """Numbers of a deck that are others at these relative values, two or more, than at 1.

    texts: the lines of the deck at 1 and at these values.
    None where more than numbers that matrices are linear in differ, or where such a number is not
    linear in the value (a thickness: not proportional to it; constants of an anisotropic material:
    no cubic polynomial of it, which four values would show).
    """
    if len({len(lines) for lines in texts}) > 1:
        return None
    at = np.array([1.0, *values])
    changed, powers = set[Place](), {1}
    proportional = True
    for line, row in enumerate(zip(*texts, strict=True)):
        if len(set(row)) == 1:
            continue
        cards, numbers = _cards(nominal, [line]), _numbers(row)
        if len(cards) != 1 or numbers is None:
            return None
        own = _powers(nominal, cards[0], numbers, at)
        if own is None:
            return None
        moved = np.flatnonzero(np.ptp(numbers, axis=0) > 0.0).tolist()
        changed |= {(line, place) for place in moved}
        powers |= set(own)
        proportional = proportional and _fits(numbers[:, moved], at, (1,))
    return Changed(frozenset(changed), tuple(sorted(powers)), proportional)


def changed_numbers(nominal: CalculixStructure, deck: KeywordDeck) -> dict[int, str] | None:
    """The lines in which a deck differs from another; None where more than numbers of cards do.

    Of ties the factors may differ, and not what is tied.
    """
    lines = nominal.deck.lines
    if len(deck.lines) != len(lines):
        return None
    pairs = enumerate(zip(lines, deck.lines, strict=True))
    changed = {place: new.text for place, (line, new) in pairs if line.text != new.text}
    cards = nominal.deck.cards
    starts = [card.lines.start for card in cards]
    for place, new in changed.items():
        old = lines[place].text
        keyword = cards[bisect_right(starts, place) - 1].keyword
        tied = keyword == "*EQUATION" and _tied(old) == _tied(new)
        if old.startswith("*") or new.startswith("*") or not (keyword in NUMBERS or tied):
            return None
    return changed


def _tied(line: str) -> list[str]:
    """Nodes and components of a line of an equation."""
    return [word for place, word in enumerate(line.split(",")) if place % 3 < 2]


def _numbers(texts: Sequence[str]) -> Floats | None:
    """(n_values, n_words), None where a word is no number."""
    words = [[word.strip() for word in text.split(",")] for text in texts]
    try:
        return np.array([[read_number(word) if word else 0.0 for word in row] for row in words])
    except ValueError:
        return None


def _powers(
    nominal: CalculixStructure, card: KeywordCard, numbers: Floats, at: Floats
) -> tuple[int, ...] | None:
    """The powers of the value by which a line's numbers move matrices, None where by no such."""
    kind, moved = card.option("TYPE"), np.ptp(numbers, axis=0) > 0.0
    isotropic = kind in ("", "ISO", "ISOTROPIC")
    if card.keyword == "*ELASTIC" and (
        (isotropic and moved[1:].any())  # Poisson's ratio
        or (not isotropic and kind not in ("ORTHO", "ANISO", ENGINEERING))
        or (kind == ENGINEERING and _couples(nominal, card))
    ):
        return None
    if _fits(numbers[:, moved], at, (1,) if card.keyword == "*SHELLSECTION" else (0, 1)):
        return (1,)
    cubic = kind == "ANISO" and at.size > 4 and _fits(numbers[:, moved], at, (0, *CUBIC))
    return CUBIC if cubic else None


def _couples(nominal: CalculixStructure, card: KeywordCard) -> bool:
    """Whether engineering constants have Poisson's ratios: without any, the stiffness is linear in
    each of the moduli."""
    line = nominal.deck.lines[card.data[0]].text
    numbers = _numbers([line])
    return numbers is None or bool(numbers[0, RATIOS].any())


def _fits(numbers: Floats, at: Floats, powers: tuple[int, ...]) -> bool:
    """Whether numbers (n_values, n_words) are such polynomials of the values (n_values,)."""
    terms = at[:, None] ** np.array(powers)
    left = numbers - terms @ np.linalg.lstsq(terms, numbers, rcond=None)[0]
    # Numbers are written with twelve digits or more.
    return bool((np.abs(left) <= 1e-9 * np.abs(numbers).max(axis=0)).all())


def _cards(structure: CalculixStructure, lines: Collection[int]) -> list[KeywordCard]:
    """The cards that have these lines, each once."""
    cards = structure.deck.cards
    starts = [card.lines.start for card in cards]
    places = sorted({bisect_right(starts, line) - 1 for line in lines})
    return [cards[place] for place in places if place >= 0]


def _sets(structure: CalculixStructure, card: KeywordCard) -> list[str]:
    """Element sets that a card's numbers belong to."""
    if CARDS[card.keyword].owner == "elset":
        return [card.option("ELSET")]
    materials = structure.deck.named("*MATERIAL")
    above = [other for other in materials if other.lines.start < card.lines.start]
    name = above[-1].option("NAME") if above else ""
    return [user.option("ELSET") for user in structure.users({name})]


def _layered(structure: CalculixStructure, sets: Collection[str]) -> bool:
    """Whether a section of these sets has layers, which may be of other materials too."""
    return any(
        "COMPOSITE" in card.options for card in structure.sections if card.option("ELSET") in sets
    )


def _keeps_knots(
    structure: CalculixStructure, geometry: Mesh, cards: Sequence[KeywordCard]
) -> bool:
    """Whether shells of these sections meet no others of the same thickness about in their plane.

    ccx joins those in common expanded nodes, and in knots as soon as the thickness differs: then
    the matrices have other equations. Beams may meet no other beam or shell.
    """
    members = structure.mesh.element_sets
    sets = [members.get(card.option("ELSET"), frozenset[int]()) for card in cards]
    own = frozenset[int]().union(*sets)
    touched, elements = structure.mesh.nodes_of(own), structure.mesh.elements
    places = dict(zip(geometry.nodes.tolist(), geometry.coordinates, strict=True))
    if cards[0].keyword == "*BEAMSECTION":
        others = [number for number in elements if number not in own]
        meeting = [n for n in others if touched.intersection(elements[n].nodes)]
        kinds = {structure.mesh.elements[number].kind for number in meeting}
        alone = all(EXPANDED.isdisjoint(roles_of(kind)) for kind in kinds)
        return alone and all(_straight(elements[number].nodes, places) for number in own)
    try:
        thickness = _thicknesses(structure)
    except ModelError:
        return False
    beside: dict[int, list[int]] = {}
    for number in thickness.keys() - own:
        for node in touched.intersection(elements[number].nodes):
            beside.setdefault(node, []).append(number)
    normals: dict[int, Floats] = {}
    for number in own:
        for node in elements[number].nodes:
            for other in beside.get(node, []):
                if abs(thickness[number] - thickness[other]) > SAME_THICKNESS:
                    continue
                for each in (number, other):
                    if each not in normals:
                        normals[each] = _normal(elements[each].nodes, places)
                if normals[number] @ normals[other] > NEAR_NORMALS:
                    return False
    return True


def _thicknesses(structure: CalculixStructure) -> dict[int, float]:
    """Of each shell element the sum of its layers. Raises ModelError where nodes have their own."""
    found = {}
    for card in structure.deck.named("*SHELL SECTION"):
        if "NODALTHICKNESS" in card.options:
            where = structure.deck.where(card)
            raise ModelError(f"{where}: nodes define thicknesses; give *SHELL SECTION one")
        layers = card.data if "COMPOSITE" in card.options else card.data[:1]
        total = sum(structure.deck.number(line, 0) for line in layers)
        for number in structure.mesh.element_sets.get(card.option("ELSET"), frozenset()):
            found[number] = total
    return found


def _straight(nodes: tuple[int, ...], places: Mapping[int, Floats]) -> bool:
    """Whether the middle node of a beam, if it has one, lies in the middle."""
    first, middle, last = (places[node] for node in (nodes[0], nodes[len(nodes) // 2], nodes[-1]))
    bow = np.linalg.norm(2.0 * middle - first - last)
    return len(nodes) == 2 or bool(bow <= 1e-6 * np.linalg.norm(last - first))


def _normal(nodes: tuple[int, ...], places: Mapping[int, Floats]) -> Floats:
    """The unit normal of a triangle or quadrilateral by its corners."""
    corners = [places[node] for node in nodes[: 4 if len(nodes) in (4, 8) else 3]]
    across = corners[2] - corners[0]
    other = corners[3] - corners[1] if len(corners) == 4 else corners[1] - corners[0]
    normal = np.cross(across, other)
    return np.asarray(normal / np.linalg.norm(normal))

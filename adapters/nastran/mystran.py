"""What MYSTRAN wants otherwise than Nastran, and what it cannot do at all."""

from __future__ import annotations

from modetune.adapters.nastran.deck import Deck
from modetune.core.errors import ModelError

#: Cards that change modes and that MYSTRAN does not have.
UNSUPPORTED = frozenset({
    "CBEAM", "PBEAM", "PBEAML", "PBCOMP", "CBEND", "PBEND", "CTUBE", "PTUBE", "CBUSH1D", "CGAP",
    "CWELD", "CFAST", "CSEAM", "CQUADR", "CTRIAR", "CTRIA6", "CQUADX", "CTRIAX", "CTRIAX6",
    "CPYRAM", "CONM1", "GENEL", "DMIG", "RROD", "RTRPLT", "RJOINT", "ACMODL", "NSM", "NSM1",
    "NSML", "NSML1", "PCOMPG", "SUPORT1", "RELEASE", "SESET",
})  # fmt: skip
#: Springs and the fields of their two nodes.
SPRINGS = {"CELAS1": (3, 5), "CELAS2": (3, 5)}
#: Field of a PSOLID that says how many points a solid is integrated with.
INTEGRATION = 4
#: Fields of an EIGRL card: its number, and the shift of the first factorisation.
EIGRL_ID, EIGRL_SHIFT = 1, 7
#: A negative shift keeps the stiffness of free structures from being singular, (rad/s)^2. It is
#: of the size of the lowest elastic eigenvalues (5 Hz) and far above the rounding of rigid ones.
SHIFT = "-1000."


def first_shift(deck: Deck, method: int) -> str:
    """The shift of the user's own EIGRL where it is negative, else a usual one."""
    for card in deck.named("EIGRL"):
        shift = card.text(EIGRL_SHIFT)
        if card.text(EIGRL_ID) == str(method) and shift.startswith("-"):
            return shift
    return SHIFT


def adapted_cards(deck: Deck) -> dict[int, str]:
    """Cards that MYSTRAN needs in another form: position of the first line to the card's text.

    Its solids have no default for the integration, so a blank IN of PSOLID becomes 2 (two points
    a direction). Raises ModelError for all cards it cannot take, with the lines they stand in.
    """
    problems, adapted = [], {}
    for card in deck.cards:
        where = deck.where(card)
        if card.name in UNSUPPORTED:
            problems.append(f"{where}: MYSTRAN has no {card.name}")
        elif any(card.text(node) in ("", "0") for node in SPRINGS.get(card.name, ())):
            problems.append(
                f"{where}: in MYSTRAN a {card.name} to ground needs a node there that is held "
                "(123456 in field 8 of its GRID)"
            )
        elif card.name == "PSOLID" and not card.text(INTEGRATION):
            texts = [card.text(field) for field in range(1, max(len(card.fields), INTEGRATION + 1))]
            texts[INTEGRATION - 1] = "2"
            adapted[card.lines[0]] = ",".join(["PSOLID", *texts])
    if problems:
        raise ModelError("\n".join(problems))
    return adapted

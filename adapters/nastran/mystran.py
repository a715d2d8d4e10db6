"""What MYSTRAN requires otherwise than Nastran, and what it cannot do at all."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from modetune.adapters.nastran.bulk import DEFAULTS, Bulk, filled
from modetune.adapters.nastran.cards import large_field
from modetune.adapters.nastran.deck import NastranCard, NastranDeck
from modetune.adapters.nastran.harmless import HARMLESS
from modetune.adapters.nastran.mystran_beams import CARDS as BEAM_CARDS
from modetune.adapters.nastran.mystran_beams import BeamCards
from modetune.adapters.nastran.mystran_scalars import ELEMENTS, PROPERTIES, Card, Scalars
from modetune.core.errors import ModelError

#: Cards whose modes by MYSTRAN were compared with another solver's or a closed form. What is
#: neither here nor harmless is refused: MYSTRAN passes over some cards without a word.
COMPARED = frozenset({
    "GRID", "CORD1R", "CORD1C", "CORD1S", "CORD2R", "CORD2C", "CORD2S", "PARAM", "CQUAD4", "CTRIA3",
    "CHEXA", "CPENTA", "CTETRA", "CBAR", "CBEAM", "CROD", "CONROD", "CTUBE", "CBUSH", "CONM2",
    "PSHELL", "PCOMP", "PSOLID", "PBAR", "PBARL", "PBEAM", "PBEAML", "PROD", "PTUBE", "PBUSH",
    "MAT1", "MAT8", "RBE2", "RBE3", "SPC", "SPC1", "SPCADD", "MPC", "MPCADD", "SPOINT", *ELEMENTS,
    *PROPERTIES,
})  # fmt: skip
#: Fields: TFLAG of shells; frame of a GRID's results; grid point, offset and
#: inertia of a CONM2; the first ply of a PCOMP and the distance of plies; densities of materials.
GRID_CD, CONM2_GRID, PLY, PLIES_APART = 6, 2, 9, 4
TFLAGS = {"CQUAD4": 10, "CTRIA3": 10}
CONM2_BODY = (5, 6, 7, 9, 10, 11, 12, 13, 14)
DENSITIES = {"MAT1": 5, "MAT8": 8}
#: Field of a PSOLID that says how many points a solid is integrated with.
INTEGRATION = 4
#: Fields of an EIGRL card: its number, and the shift of the first factorisation.
EIGRL_ID, EIGRL_SHIFT = 1, 7
#: A negative shift keeps the stiffness of free structures from being singular, (rad/s)^2. It is
#: of the size of the lowest elastic eigenvalues (5 Hz) and far above the rounding of rigid ones.
SHIFT = "-1000."


def first_shift(deck: NastranDeck, method: int) -> str:
    """The shift of the user's own EIGRL where it is negative, else a usual one."""
    for card in deck.named("EIGRL"):
        shift = card.text(EIGRL_SHIFT)
        if card.text(EIGRL_ID) == str(method) and shift.startswith("-"):
            return shift
    return SHIFT


def mystran_cards(
    deck: NastranDeck,
    bulk: Callable[[], Bulk],
    left_out: Callable[[NastranCard], bool],
    n_modes: int = 0,
) -> list[str]:
    """The deck's cards as MYSTRAN reads them, all in large field, without those it does without.

    bulk: pyNastran's model of the same deck, of which the cards of bars and beams are written.
    n_modes: how many it must be able to find. Blank fields that a GRDSET or BAROR fills are filled.
    MYSTRAN's solids have no default for the integration, so a blank IN of PSOLID becomes 2 (two
    points a direction). Raises ModelError for all cards it cannot take, with the lines they stand
    in.
    """
    scalars = Scalars(deck)
    cards: list[Card] = list(scalars.grids())
    problems: dict[str, list[str]] = {}
    defaults = {name: card for card in deck.cards if (name := DEFAULTS.get(card.name))}
    frames = {
        card.text(1): filled(card, defaults.get("GRID"))[GRID_CD - 1 : GRID_CD]
        for card in deck.named("GRID")
    }
    densities = {
        card.text(1): card.text(field)
        for name, field in DENSITIES.items()
        for card in deck.named(name)
    }
    beams = BeamCards(bulk(), scalars.new_number) if deck.named(*BEAM_CARDS) else None
    for card in deck.cards:
        if card.name in HARMLESS or left_out(card):
            continue
        reason = _obstacle(card, frames, densities)
        if not reason and card.name in (*ELEMENTS, "CBUSH"):
            reason = scalars.obstacle(card)
        if beams and card.name in BEAM_CARDS:
            try:
                written = beams.cards(card.name, int(card.text(1)))
            except ValueError as error:
                reason = f"{card.name} in MYSTRAN: {error}"
            else:
                if written is not None:
                    cards += written
                    continue
        if reason:
            problems.setdefault(reason, []).append(deck.where(card))
            continue
        fields = filled(card, defaults.get(card.name))
        if card.name == "PSOLID" and not card.text(INTEGRATION):
            fields += [""] * (INTEGRATION - len(fields))
            fields[INTEGRATION - 1] = "2"
        cards += _written(card, fields, scalars)
    cards += beams.rest() if beams else []
    if problems:
        raise ModelError(
            "\n".join(
                f"{places[0]}: {reason}"
                + (f" ({len(places)} such cards)" if len(places) > 1 else "")
                for reason, places in problems.items()
            )
        )
    if n_modes:
        cards += scalars.spare(n_modes)
    return [large_field(name, fields) for name, fields in cards]


def _written(card: NastranCard, fields: list[str], scalars: Scalars) -> list[Card]:
    """The cards that say to MYSTRAN what a card says; none for what others have in them."""
    if card.name in PROPERTIES or card.name == "SPOINT":
        return []
    if card.name in ELEMENTS:
        return scalars.spring(card) if card.name.startswith("CELAS") else scalars.mass(card)
    if card.name in ("CBUSH", "PBUSH"):
        return scalars.bush(card, fields)
    if card.name in ("SPC", "SPC1", "MPC"):
        return scalars.constraint(card, fields)
    return [(card.name, fields)]


def _obstacle(
    card: NastranCard, frames: Mapping[str, list[str]], densities: Mapping[str, str]
) -> str:
    """Why MYSTRAN cannot take a card, or takes it for another one; empty if it can.

    frames: CD of the grid points; densities of materials, both as the deck writes them.
    """
    if card.name not in COMPARED:
        return f"MYSTRAN has no {card.name}, or its modes with it were never compared"
    if card.name in TFLAGS and card.text(TFLAGS[card.name]) not in ("", "0"):
        return f"MYSTRAN takes relative thicknesses (TFLAG 1) of {card.name} for thicknesses"
    if card.name == "PCOMP":
        plies = {card.text(place) for place in range(PLY, len(card.fields), PLIES_APART)} - {""}
        if len({densities.get(ply, "") for ply in plies}) > 1:
            return "MYSTRAN has the mass of a PCOMP with plies of several densities wrong"
    turned = frames.get(card.text(CONM2_GRID), []) not in ([], [""], ["0"])
    if card.name == "CONM2" and turned and any(card.text(field) for field in CONM2_BODY):
        return "MYSTRAN turns offset and inertia of a CONM2 where its GRID has a CD frame"
    return ""

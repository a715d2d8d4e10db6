"""Constants of *ELASTIC cards, in the order in which ccx reads them: eight a line."""

from __future__ import annotations

from modetune.adapters.calculix.deck import KeywordCard
from modetune.core.parameters import Quantity

_D = ("1111", "1122", "2222", "1133", "2233", "3333")
#: Constants by what TYPE begins with. Those of D-matrices are named by their indices.
TYPES: dict[str, tuple[str, ...]] = {
    "ISO": ("E", "NU"),
    "ENGINEERINGCONSTANTS": ("E1", "E2", "E3", "NU12", "NU13", "NU23", "G12", "G13", "G23"),
    "ORTHO": tuple(f"D{indices}" for indices in (*_D, "1212", "1313", "2323")),
    "ANISO": tuple(
        f"D{indices}"
        for indices in (
            *_D, "1112", "2212", "3312", "1212", "1113", "2213", "3313", "1213", "1313", "1123",
            "2223", "3323", "1223", "1323", "2323",
        )
    ),
}  # fmt: skip
#: Letters of the constants that a quantity scales. All moduli go with Young's, so that the
#: stiffness is proportional.
LETTERS: dict[Quantity, str] = {
    "youngs_modulus": "EDG", "shear_modulus": "G", "poissons_ratio": "NU",
}  # fmt: skip
IN_A_LINE = 8


def constant_places(card: KeywordCard, quantity: Quantity) -> list[tuple[int, int, int]]:
    """Item, line and place in it of a quantity's constants, at each temperature of the card.

    An item is the number in a constant's name, 0 without one; -1 goes with all only. Empty where
    a material of this type has no such quantity.
    """
    kind = card.option("TYPE") or "ISO"
    names = next((names for start, names in TYPES.items() if kind.startswith(start)), ())
    lines = -(-len(names) // IN_A_LINE)
    found = []
    for first in range(0, len(card.data) - lines + 1, lines or 1):
        for place, name in enumerate(names):
            letters = name.rstrip("0123456789")
            if letters in LETTERS[quantity]:
                alone = quantity != "youngs_modulus" or letters != "G"
                item = int(name.removeprefix(letters) or 0) if alone else -1
                row, at = divmod(place, IN_A_LINE)
                found.append((item, card.data[first + row], at))
    return found

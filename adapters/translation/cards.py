"""Which Nastran cards a translation takes, and which it may leave out without a change of modes.

Whatever is on neither list is refused: a card that is dropped in silence is a wrong model. Real
normal modes know no loads, no damping, no design variables and no requests for output.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from modetune.adapters.nastran.harmless import HARMLESS

#: Translated, or looked at where they are used.
TRANSLATED = frozenset(
    "GRID SPOINT CORD1R CORD1C CORD1S CORD2R CORD2C CORD2S "
    "CHEXA CPENTA CTETRA CPYRAM CSHEAR PSHEAR CQUAD4 CQUAD8 CQUADR CTRIA3 CTRIA6 CTRIAR "
    "CBAR CBEAM CROD CONROD CTUBE CELAS1 CELAS2 CELAS3 CELAS4 CBUSH CBUSH1D GENEL CONM1 CONM2 "
    "CMASS1 CMASS2 CMASS3 CMASS4 PMASS "
    "PSHELL PCOMP PCOMPG PSOLID PLSOLID PBAR PBARL PBEAM PBEAML PBCOMP PROD PTUBE PELAS PBUSH "
    "PBUSH1D DMIG "
    "MAT1 MAT2 MAT3 MAT8 MAT9 MAT10 MAT11 RBE1 RBE2 RBE3 RBAR RROD RSPLINE RBAR1 "
    "SPC SPC1 SPCADD SPCOFF SPCOFF1 MPC MPCADD PARAM MDLPRM".split()
)
#: Families of cards of which those count alone that elements use.
BY_USE = ("P", "MAT")


def refused_cards(bulk: Any) -> list[str]:
    """A sentence for each kind of card that can be neither translated nor left out."""
    counts = {name.upper(): count for name, count in bulk.card_count.items()}
    used = _used_kinds(bulk)
    found = [
        f"{name}: {count} card{'s' if count > 1 else ''}{_numbers(bulk, name)} not translated"
        for name, count in sorted(counts.items())
        if name not in TRANSLATED
        and name not in HARMLESS
        and count
        and (name in used or not name.startswith(BY_USE))
    ]
    return found


def _used_kinds(bulk: Any) -> set[str]:
    """Names of the properties that elements have, and of their materials."""
    found = set[str]()
    for element in bulk.elements.values():
        card = getattr(element, "pid_ref", None) or element
        names = ("mid_ref", "mid1_ref", "mid2_ref", "mid3_ref", "mid4_ref")
        materials = [getattr(card, name, None) for name in names]
        materials += list(getattr(card, "mids_ref", None) or [])
        found.update(item.type for item in (card, *materials) if item is not None)
    return found


def _numbers(bulk: Any, name: str) -> str:
    try:
        numbers = sorted(bulk.get_card_ids_by_card_types([name])[name])
    except (KeyError, TypeError, RuntimeError):
        return ""
    return f" ({shortened(numbers)})" if numbers else ""


def shortened(numbers: Iterable[Any]) -> str:
    """The first few numbers of many."""
    words = [str(number) for number in numbers]
    return ", ".join(words[:5]) + (f", ... {words[-1]}" if len(words) > 5 else "")


def summarised(problems: Iterable[str]) -> list[str]:
    """One sentence for all cards of a kind that have the same problem."""
    groups: dict[tuple[str, str], list[str]] = {}
    for problem in dict.fromkeys(problems):
        found = re.fullmatch(r"([A-Z]+\d?) (\d+)(\D.*)", problem, re.DOTALL)
        kind, number, reason = found.groups() if found else ("", "", problem)
        groups.setdefault((kind, reason), []).append(number)
    sentences = []
    for (kind, reason), numbers in groups.items():
        many = f" ({len(numbers)} of them)" if len(numbers) > 1 else ""
        sentences.append(f"{kind} {shortened(numbers)}{many}{reason}" if kind else reason)
    return sentences

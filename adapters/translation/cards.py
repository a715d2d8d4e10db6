"""Which Nastran cards a translation takes, and which it may leave out without a change of modes.

Whatever is on neither list is refused: a card that is dropped in silence is a wrong model. Real
normal modes know no loads, no damping, no design variables and no requests for output.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from modetune.adapters.nastran.case_control import CaseControl
from modetune.adapters.nastran.harmless import HARMLESS

#: Translated, or looked at where they are used.
TRANSLATED = frozenset(
    "GRID SPOINT CORD1R CORD1C CORD1S CORD2R CORD2C CORD2S "
    "CHEXA CPENTA CTETRA CQUAD4 CQUAD8 CQUADR CTRIA3 CTRIA6 CTRIAR "
    "CBAR CBEAM CROD CONROD CTUBE CELAS1 CELAS2 CELAS3 CELAS4 CBUSH CONM1 CONM2 "
    "CMASS1 CMASS2 CMASS3 CMASS4 PMASS "
    "PSHELL PCOMP PCOMPG PSOLID PLSOLID PBAR PBARL PBEAM PBEAML PBCOMP PROD PTUBE PELAS PBUSH "
    "MAT1 MAT2 MAT3 MAT8 MAT9 MAT10 MAT11 RBE1 RBE2 RBE3 RBAR RROD RSPLINE RBAR1 "
    "SPC SPC1 SPCADD SPCOFF SPCOFF1 MPC MPCADD PARAM MDLPRM".split()
)
#: Parameters that change no frequency of a translated model, or are translated (WTMASS).
PARAMETERS = frozenset(
    "WTMASS AUTOSPC AUTOSPCR AUTOSPRT COUPMASS GRDPNT POST POSTEXT OGEOM OIBULK OMACHPR OUGCORD "
    "K6ROT SNORM SNORMPRT PRGPST USETPRT USETSEL EST ECHO PRTMAXIM MAXRATIO BAILOUT EPZERO EPPRT "
    "TINY G GFL W3 W4 W3FL W4FL LMODES LMODESFL LFREQ HFREQ LFREQFL HFREQFL RESVEC RESVINER DBALL "
    "DBDICT NEWSEQ SEQOUT PRTRESLT PATVER PGRPST NOCOMPS NOELOF NOELOP NOGPF OELMSET OGRDSET "
    "TABS CURV CURVPLOT BIGER NUMOUT S1 S1G MODACC DDRMM IRES INREL EXTOUT EXTRCV CHECKOUT XFLAG "
    "OUNIT1 OUNIT2 OMID SRCOMPS STRFIT PVALINIT ALPHA1 ALPHA2 ASING ERROR RSPECTRA SCRSPEC SIGMA "
    "MAXIT EIGFILT OPTEXIT DESPCH DESPCH1 NASPRT DSNOKD OPTION OP4FMT MODEL MECHFIX UNITSYS "
    "SOLLIN GEOMU PRTPCOMP PRPA PRPJ PRTCSTM PRTEQXIN PRTGPDT PRTGPL PRTGPTT PRTBGPDT PRTMGG "
    "LGDISP RMS AUTOMSET RGBEAMA RGBEAME RGLCRIT RGSPRGK SPARSEDR".split()
)
#: Names of an MDLPRM card that change no frequency.
MODEL_PARAMETERS = frozenset(("HDF5", "H5MDL", "H5NORDOF", "H5GM34", "MRALIAS"))
#: Selections of the case control that a translation follows, or that change no modes.
COMMANDS = frozenset(("SPC", "MPC", "SUPORT", "SUPORT1", "TEMPERATURE", "TEMP", "AUTOSPC", "RIGID"))


def refused_commands(case: CaseControl) -> list[str]:
    """A sentence for each selection and parameter of the case control that would be lost."""
    names = [re.split(r"\W", text, maxsplit=1)[0].upper() for text in case.selections]
    found = [f"case control {name}: not translated" for name in names if name not in COMMANDS]
    return found + [
        f"case control PARAM,{name}: not known to be without effect on normal modes"
        for name, _ in case.parameters
        if name not in PARAMETERS
    ]


def refused_cards(bulk: Any) -> list[str]:
    """A sentence for each kind of card that can be neither translated nor left out."""
    counts = {name.upper(): count for name, count in bulk.card_count.items()}
    found = [
        f"{name}: {count} card{'s' if count > 1 else ''}{_numbers(bulk, name)} not translated"
        for name, count in sorted(counts.items())
        if name not in TRANSLATED and name not in HARMLESS and count
    ]
    if bulk.mdlprm is not None:
        for name in sorted(set(bulk.mdlprm.mdlprm_dict) - MODEL_PARAMETERS):
            found.append(f"MDLPRM,{name}: not known to be without effect on normal modes")
    for name in sorted(bulk.params):
        if name not in PARAMETERS:
            found.append(f"PARAM,{name}: not known to be without effect on normal modes")
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

"""One small deck a card: what the card adds to a base that runs without it.

Bases: a cantilever of 16 bars along x (grid points 1 to 5 at its quarters), a plate of 12 x 4
quadrilaterals clamped at x = 0, a block of 10 x 1 x 1 hexahedra clamped at x = 0.
Units: m, kg, s.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

HEAD = "SOL 103\nCEND\nSPC = 1\nMETHOD = 1\nBEGIN BULK\nEIGRL,1,,,6\nMAT1,1,7.+10,,.3,2700.\n"
#: Ends and quarters are 1 to 5, the points between them 101 and so on.
POINTS = [(1 + i // 4 if i % 4 == 0 else 100 + i, 0.0625 * i) for i in range(17)]
BARS = (
    "".join(f"GRID,{node},,{x},0.,0.\n" for node, x in POINTS)
    + "".join(
        f"CBAR,{i},1,{POINTS[i - 1][0]},{POINTS[i][0]},0.,0.,1.\n" for i in range(1, len(POINTS))
    )
    + "SPC1,1,123456,1\nPBAR,1,1,4.-4,2.-8,1.-8,2.-8\n"
)
LINE = BARS.replace("CBAR,", "{kind},").replace("PBAR,1,1,4.-4,2.-8,1.-8,2.-8\n", "{section}")


def _plate(element: str, section: str) -> str:
    grids = [
        f"GRID,{13 * j + i + 1},,{i / 12:.6f},{0.1 * j},0.\n" for j in range(5) for i in range(13)
    ]
    cells = [(13 * j + i + 1) for j in range(4) for i in range(12)]
    shells = []
    for number, a in enumerate(cells, start=1):
        corners = (a, a + 1, a + 14, a + 13)
        if element.startswith("CTRIA"):
            shells += [f"{element},{number},1,{a},{a + 1},{a + 14}\n"]
            shells += [f"{element},{100 + number},1,{a},{a + 14},{a + 13}\n"]
        else:
            shells += [
                f"{element},{number},1,{corners[0]},{corners[1]},{corners[2]},{corners[3]}\n"
            ]
    return "".join([*grids, *shells, "SPC1,1,123456,1,14,27,40,53\n", section])


def _block(element: str) -> str:
    grids = [
        f"GRID,{4 * i + 2 * j + k + 1},,{0.1 * i:.3f},{0.1 * j},{0.1 * k},,456\n"
        for i in range(11) for j in range(2) for k in range(2)
    ]  # fmt: skip
    solids = []
    for i in range(10):
        a = 4 * i + 1
        corners = (a, a + 4, a + 6, a + 2, a + 1, a + 5, a + 7, a + 3)
        text = [str(corner) for corner in corners]
        if element == "CHEXA":
            solids.append(f"CHEXA,{i + 1},1,{','.join(text[:6])}\n,{','.join(text[6:])}\n")
        else:
            for half, places in enumerate(((0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7))):
                nodes = ",".join(text[place] for place in places)
                solids.append(f"CPENTA,{100 * half + i + 1},1,{nodes}\n")
    return "".join([*grids, *solids, "SPC1,1,123,1,2,3,4\nPSOLID,1,1\n"])


SHELL = "PSHELL,1,1,.01,1,,1\n"
TIP = "GRID,9,,1.2,0.,.1\n"
#: What is added to the base, by the card's name.
ON_BARS = {
    "CBAR": "", "GRDSET": "GRDSET,,,,,,,5\n", "BAROR": "BAROR,,,,,0.,0.,1.\n",
    "CONM2": "CONM2,50,5,,2.,.05,0.,.02\n,.01,,.02,,,.02\n",
    "CONM1": "CONM1,50,5,,2.,,2.,,\n,2.,,,,.01,,,\n,,.02,,,,,,.02\n",
    "CMASS1": "PMASS,7,1.5\nCMASS1,50,7,5,3\n", "CMASS2": "CMASS2,50,1.5,5,3\n",
    "CMASS3": "SPOINT,70\nCELAS1,51,8,5,3,70,0\nPELAS,8,3.E4\nPMASS,7,1.5\nCMASS3,50,7,70\n",
    "CMASS4": "CELAS2,51,3.E4,5,3,70,0\nSPOINT,70\nCMASS4,50,1.5,70\n",
    "CELAS1": "PELAS,8,3.E4\nCELAS1,50,8,5,3\n", "CELAS2": "CELAS2,50,3.E4,5,3\n",
    "CELAS3": "SPOINT,70\nCELAS2,51,3.E4,5,3,70,0\nPELAS,8,5.E4\nCELAS3,50,8,70\nCMASS4,52,.5,70\n",
    "CELAS4": "SPOINT,70\nCELAS2,51,3.E4,5,3,70,0\nCELAS4,50,5.E4,70\nCMASS4,52,.5,70\n",
    "CBUSH": "PBUSH,8,K,1.E5,2.E5,3.E4,50.,60.,70.\nCBUSH,50,8,5,,,,,0\n",
    "PBUSH M": TIP + "PBUSH,8,K,1.E5,2.E5,3.E4,50.,60.,70.\n,,M,.8\nCBUSH,50,8,5,9,,,,0\n",
    "CVISC": "PVISC,8,9.\nCVISC,50,8,4,5\n", "CDAMP2": "CDAMP2,50,9.,5,3\n",
    "RBE1": TIP + "RBE1,50,5,123456\n,UM,9,123456\nCONM2,51,9,,1.\n",
    "RBE2": TIP + "RBE2,50,5,123456,9\nCONM2,51,9,,1.\n",
    "RBE3": TIP + "RBE3,50,,9,123456,1.,123456,4,5\nCONM2,51,9,,1.\n",
    "RBAR": TIP + "RBAR,50,5,9,123456\nCONM2,51,9,,1.\n",
    "RBAR1": TIP + "RBAR1,50,5,9,123456\nCONM2,51,9,,1.\n",
    "RROD": "GRID,9,,1.,0.,.5,,12456\nRROD,50,5,9\nCONM2,51,9,,1.\n",
    "RSPLINE": "GRID,9,,1.2,0.,0.\nGRID,8,,1.1,0.,0.\nRSPLINE,50,.1,5,8,123456,9\nCONM2,51,8,,1.\n",
    "MPC": "GRID,9,,1.2,0.,0.,,12456\nMPC,4,9,3,1.,5,3,-2.\nCONM2,51,9,,1.\n",
    "SUPORT": "SUPORT,5,3\n", "ASET1": "ASET1,3,2,3,4,5\n", "OMIT1": "OMIT1,456,2,3,4\n",
    "EPOINT": "EPOINT,90\nTF,3,90,,1.\n", "MATT1": "MATT1,1,5\nTABLEM1,5\n,0.,1.,99.,.5,ENDT\n",
    "PARAM": "PARAM,NASPDV,1\nPARAM,GPECT,1\nPARAM,MPCX,3\n",
    "CORD2R": "CORD2R,5,,0.,0.,0.,0.,0.,1.\n,1.,1.,0.\nGRID,9,5,.9,-.9,0.,5\n"
    "RBE2,50,5,123456,9\nCONM2,51,9,,1.\n",
    "CROD": "GRID,9,,1.,0.,1.,,123456\nPROD,8,1,1.-5\nCROD,50,8,5,9\n",
    "CONROD": "GRID,9,,1.,0.,1.,,123456\nCONROD,50,5,9,1,1.-5\n",
    "CTUBE": "GRID,9,,1.,0.,1.,,123456\nPTUBE,8,1,.02,.002\nCTUBE,50,8,5,9\n",
    "CGAP": "GRID,9,,1.,0.,1.,,123456\nPGAP,8,0.,,1.E5\nCGAP,50,8,5,9,1.,0.,0.\n",
    "CBUSH1D": "GRID,9,,1.,0.,1.,,123456\nPBUSH1D,8,1.E5\nCBUSH1D,50,8,5,9\n",
    "PLOTEL": "PLOTEL,50,1,5\n", "AERO": "AERO,,1.,1.,1.2\n", "NSM1": "NSM1,3,PBAR,1.,1\n",
    "GENEL": "GENEL,50,,5,3,5,2\n,K,3.E4,1.E4,2.E4\n",
}  # fmt: skip
ON_LINES = {
    "CBEAM": "PBEAM,1,1,4.-4,2.-8,1.-8,,2.-8\n", "PBEAML": "PBEAML,1,1,,BAR\n,.03,.02\n",
    "PBARL": "PBARL,1,1,,BOX\n,.04,.03,.002,.002\n",
}  # fmt: skip
ON_SHELLS = {
    "CQUAD4": SHELL, "CQUADR": SHELL, "CTRIA3": SHELL, "CTRIAR": SHELL,
    "PCOMP": "PCOMP,1\n,2,.004,0.,,2,.004,90.\nMAT8,2,1.3+11,9.+9,.3,5.+9,5.+9,3.+9,1600.\n",
    "PCOMPG": "PCOMPG,1\n,1,2,.004,0.\n,2,2,.004,90.\nMAT8,2,1.3+11,9.+9,.3,5.+9,5.+9,3.+9,1600.\n",
    "MAT2": "PSHELL,1,2,.01,2,,2\nMAT2,2,8.+10,2.+10,0.,6.+10,0.,2.5+10,2700.\n",
    "MID3": "PSHELL,1,1,.01,1,4.,2,.8\nMAT1,2,,1.+8,.3\n",
    "NSM": "PSHELL,1,1,.01,1,,1,,5.\n",
    "CSHEAR": "PSHEAR,1,1,.01\n",
}  # fmt: skip


def decks() -> Iterator[tuple[str, str]]:
    """Names of cards, and whole decks."""
    for name, text in ON_BARS.items():
        head = HEAD.replace("METHOD", "MPC = 4\nMETHOD") if name == "MPC" else HEAD
        yield name, head + BARS + text
    for name, text in ON_LINES.items():
        kind = "CBAR" if name == "PBARL" else "CBEAM"
        yield name, HEAD + LINE.format(kind=kind, section=text)
    for name, text in ON_SHELLS.items():
        kind = name if name.startswith("C") else "CQUAD4"
        rods = "".join(f"CROD,{500 + i},7,{i},{i + 1}\n" for i in (*range(1, 13), *range(53, 65)))
        frame = f"{rods}PROD,7,1,1.-4\n" if name == "CSHEAR" else ""
        yield name, HEAD + _plate(kind, text) + frame
    for name in ("CHEXA", "CPENTA"):
        yield name, HEAD + _block(name)


def write_decks(folder: Path) -> list[Path]:
    """All decks as files of their card's name."""
    found = []
    for name, text in decks():
        path = folder / f"{name.replace(' ', '-')}.bdf"
        path.write_text(text + "ENDDATA\n")
        found.append(path)
    return found

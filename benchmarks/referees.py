"""Element cards on three solvers against closed forms: MYSTRAN, CalculiX and NASTRAN-95.

    python -m benchmarks.referees [--nastran95 FOLDER]

prints a Markdown row per card and mass rule: the error of one frequency on a mesh and on one twice
as fine. FOLDER has NASTRAN-95's `bin/nastrn` and `rf`, as the folder `nastran95/_data` of the
package of that name; without it the column is empty. Units: m, kg, s.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmarks.corpus import BINDERS, reason, solve
from scipy.optimize import brentq

from modetune.adapters.nastran.f06 import read_f06
from modetune.core.errors import ModetuneError, SolverCrashed

E, RHO, NU = 2.1e11, 7850.0, 0.3
STEEL = "MAT1,1,2.1+11,,.3,7850.\n"
PLY = "MAT8,1,1.4+11,1.+10,.3,5.+9,5.+9,5.+9,1600.\n"
HEAD = "SOL 103\nCEND\nMETHOD = 1\nBEGIN BULK\nEIGRL,1,,,2\n"
MESHES = (1, 2)
#: Length and side of bars and blocks, side and thickness of plates.
LENGTH, WIDTH, SIDE, THICK = 1.0, 0.1, 1.0, 0.01
#: How the cards of NASTRAN-95 are called, and their properties.
OLD_NAMES = (("CHEXA", "CIHEX1"), ("CPENTA", "CWEDGE"), ("PSOLID,1,1", "PIHEX,1,1"))
TIMEOUT_S = 300


@dataclass(frozen=True, slots=True)
class Card:
    """name: of the card; deck: bulk data on a mesh 1 or 2; hz: of its lowest mode by the closed
    form; old: whether NASTRAN-95 has the card."""

    name: str
    deck: Callable[[int], str]
    hz: float
    old: bool = True


def line(kind: str, section: str, free: str, count: int = 4) -> Callable[[int], str]:
    """A bar along x, clamped at its foot, whose other points move in the components `free`."""
    held = "".join(digit for digit in "123456" if digit not in free)

    def deck(mesh: int) -> str:
        n, way = count * mesh, "" if kind == "CROD" else ",0.,0.,1."
        lines = [f"GRID,1,,0.,0.,0.,,123456\n{section}{STEEL}"]
        for k in range(1, n + 1):
            lines.append(f"GRID,{k + 1},,{LENGTH * k / n:.6f},0.,0.,,{held}\n")
            lines.append(f"{kind},{k},1,{k},{k + 1}{way}\n")
        return "".join(lines)

    return deck


def plate(kind: str, section: str, count: int = 8) -> Callable[[int], str]:
    """A square plate that bends on simple supports."""

    def deck(mesh: int) -> str:
        n = count * mesh
        row, lines = n + 1, [section]
        for j in range(row):
            for i in range(row):
                held = "1236" if i in (0, n) or j in (0, n) else "126"
                held += "5" * (j in (0, n) and i not in (0, n))  # the edge stays straight
                held += "4" * (i in (0, n) and j not in (0, n))
                held += "45" * (i in (0, n) and j in (0, n))
                place = f"{SIDE * i / n:.6f},{SIDE * j / n:.6f},0."
                lines.append(f"GRID,{j * row + i + 1},,{place},,{''.join(sorted(held))}\n")
        for j in range(n):
            for i in range(n):
                a, number = j * row + i + 1, 2 * (j * n + i) + 1
                corners = (a, a + 1, a + row + 1, a + row)
                if kind == "CTRIA3":
                    lines.append(f"CTRIA3,{number},1,{a},{a + 1},{a + row + 1}\n")
                    lines.append(f"CTRIA3,{number + 1},1,{a},{a + row + 1},{a + row}\n")
                else:
                    lines.append(f"CQUAD4,{number},1,{','.join(map(str, corners))}\n")
        return "".join(lines)

    return deck


#: Corners of a brick by their steps along x, y, z, and the wedges and tetrahedra that fill it.
CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
WEDGES = ((0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7))
TETRAHEDRA = (
    (0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6),
)  # fmt: skip


def block(kind: str, midsides: bool = False) -> Callable[[int], str]:
    """A bar of solids that bends, clamped at its foot; one brick across, two on the fine mesh."""
    parts = {"CHEXA": (tuple(range(8)),), "CPENTA": WEDGES, "CTETRA": TETRAHEDRA}[kind]
    edges = {
        "CHEXA": ((0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 5), (2, 6), (3, 7),
                  (4, 5), (5, 6), (6, 7), (7, 4)),
        "CPENTA": ((0, 1), (1, 2), (2, 0), (0, 3), (1, 4), (2, 5), (3, 4), (4, 5), (5, 3)),
        "CTETRA": ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)),
    }[kind]  # fmt: skip

    def deck(mesh: int) -> str:
        number: dict[tuple[float, ...], int] = {}
        lines = ["PSOLID,1,1\n", STEEL]

        def node(place: tuple[float, ...]) -> int:
            if place not in number:
                number[place] = len(number) + 1
                held = "123456" if place[0] == 0 else "456"
                x, y, z = (WIDTH / mesh * step for step in place)
                lines.append(f"GRID,{number[place]},,{x:.6f},{y:.6f},{z:.6f},,{held}\n")
            return number[place]

        element = 0
        for base in np.ndindex(round(LENGTH / WIDTH) * mesh, mesh, mesh):
            for part in parts:
                places = [
                    tuple(float(a + b) for a, b in zip(base, CORNERS[corner], strict=True))
                    for corner in part
                ]
                nodes = [node(place) for place in places]
                if midsides:
                    nodes += [
                        node(
                            tuple(0.5 * (p + q) for p, q in zip(places[a], places[b], strict=True))
                        )
                        for a, b in edges
                    ]
                element += 1
                fields = [kind, str(element), "1", *map(str, nodes)]
                rows = [fields[:9], *(["", *fields[k : k + 8]] for k in range(9, len(fields), 8))]
                lines += [",".join(row) + "\n" for row in rows]
        return "".join(lines)

    return deck


def oscillator(cards: str) -> Callable[[int], str]:
    """Two masses of 2 kg in a row on springs of 50 kN/m along z."""
    points = "".join(f"GRID,{n},,0.,0.,0.,,12456\nCONM2,{n + 8},{n},,2.\n" for n in (1, 2))
    return lambda mesh: f"{points}{STEEL}{cards}"


def timoshenko(depth: float, shear_factor: float = 5.0 / 6.0) -> float:
    """First bending frequency of a square cantilever with shear strain and rotary inertia, Hz."""
    area, inertia = depth**2, depth**4 / 12.0
    shear = shear_factor * area * E / (2.0 * (1.0 + NU))

    def determinant(omega: float) -> float:
        # w, turn, moment and force along x: y' = A y, clamped at 0, free at the end.
        a = np.array([
            [0.0, 1.0, 0.0, 1.0 / shear],
            [0.0, 0.0, 1.0 / (E * inertia), 0.0],
            [0.0, -RHO * inertia * omega**2, 0.0, -1.0],
            [-RHO * area * omega**2, 0.0, 0.0, 0.0],
        ])  # fmt: skip
        values, vectors = np.linalg.eig(a * LENGTH)
        whole = (vectors * np.exp(values)) @ np.linalg.inv(vectors)
        return float(np.linalg.det(whole[2:, 2:].real))

    slender = 1.875104**2 * np.sqrt(E * inertia / (RHO * area)) / LENGTH**2
    return float(brentq(determinant, 0.8 * slender, 1.05 * slender)) / (2.0 * np.pi)


def _cards() -> list[Card]:
    area, inertia = 1e-4, 8.333e-10
    moment = "8.333-10"
    section = f"1,1,1.-4,{moment},{moment},1.4-9"
    stretch = np.sqrt(E / RHO) / (4.0 * LENGTH)
    bend = 1.875104**2 * np.sqrt(E * inertia / (RHO * area)) / LENGTH**2 / (2.0 * np.pi)
    stiff = E * THICK**3 / 12.0 / (1.0 - NU**2)
    sheet = np.pi * np.sqrt(stiff / (RHO * THICK)) / SIDE**2
    # Plies of 0, 90 and 0 degrees, alike: D_ij of the laminate by the cubes of their heights.
    q1, q2, q12 = (value / (1.0 - 0.3**2 / 14.0) for value in (1.4e11, 1e10, 3e9))
    outer, inner = THICK**3 / 12.0 * 26.0 / 27.0, THICK**3 / 12.0 / 27.0
    d11, d22 = q1 * outer + q2 * inner, q2 * outer + q1 * inner
    d12, d66 = (outer + inner) * q12, (outer + inner) * 5e9
    whole = d11 + 2.0 * (d12 + 2.0 * d66) + d22
    laminate = np.pi / 2.0 * np.sqrt(whole / (1600.0 * THICK)) / SIDE**2
    spring = np.sqrt((3.0 - np.sqrt(5.0)) / 2.0 * 5e4 / 2.0) / (2.0 * np.pi)
    shell = f"PSHELL,1,1,{THICK},1,,1\n{STEEL}"
    third = f"{THICK / 3.0:.6f}"
    plies = f"{PLY}PCOMP,1\n,1,{third},0.,,1,{third},90.\n,1,{third},0.\n"
    thick = timoshenko(WIDTH)
    return [
        Card("CROD", line("CROD", "PROD,1,1,1.-4\n", "1"), stretch),
        Card("CBAR", line("CBAR", f"PBAR,{section}\n", "35"), bend),
        Card("CBEAM", line("CBEAM", f"PBEAM,1,1,1.-4,{moment},{moment},,1.4-9\n", "35"),
             bend, old=False),
        Card("CQUAD4", plate("CQUAD4", shell), sheet),
        Card("CTRIA3", plate("CTRIA3", shell), sheet),
        Card("CQUAD4, PCOMP", plate("CQUAD4", plies), laminate),
        Card("CHEXA 8", block("CHEXA"), thick),
        Card("CHEXA 20", block("CHEXA", midsides=True), thick, old=False),
        Card("CPENTA 6", block("CPENTA"), thick),
        Card("CPENTA 15", block("CPENTA", midsides=True), thick, old=False),
        Card("CTETRA 4", block("CTETRA"), thick),
        Card("CTETRA 10", block("CTETRA", midsides=True), thick, old=False),
        Card("CELAS2", oscillator("CELAS2,1,5.+4,1,3\nCELAS2,2,5.+4,1,3,2,3\n"), spring),
        Card("CBUSH", oscillator("PBUSH,1,K,,,5.+4\nCBUSH,1,1,1,,,,,0\nCBUSH,2,1,1,2,,,,0\n"),
             spring, old=False),
    ]  # fmt: skip


CARDS = _cards()


def nastran95(bulk: str, lumped: bool, program: Path, folder: Path) -> float:
    """The lowest frequency of a deck by NASTRAN-95, Hz. Raises ModetuneError."""
    for name, old in OLD_NAMES:
        bulk = bulk.replace(name, old)
    # Tetrahedra and wedges name their material instead of a property.
    bulk = "".join(
        line for line in bulk.splitlines(True)
        if not (line.startswith("PIHEX") and "CIHEX1" not in bulk)
    )  # fmt: skip
    head = "ID REFEREE,ONE\nAPP DISP\nSOL 3,0\nTIME 30\nCEND\nMETHOD = 1\nBEGIN BULK\n"
    mass = "" if lumped else "PARAM,COUPMASS,1\n"
    method = "EIGR,1,FEER,0.1,,,3,,,\n,MAX\n"
    variables = {
        "RFDIR": str(program.parent.parent / "rf"), "DIRCTY": str(folder), "DBMEM": "12000000",
        "OCMEM": "2000000", "LOGNM": "run.log", "NPTPNM": "run.nptp", "DICTNM": "run.dic",
        "PLTNM": "plot.dat", "PUNCHNM": "punch.dat", "OPTPNM": "none",
        **{f"SOF{k}": "none" for k in range(1, 11)},
        **{f"FTN{k}": f"ftn{k}" for k in range(11, 24)},
    }  # fmt: skip
    ended = subprocess.run(
        [program], input=head + method + mass + bulk + "ENDDATA\n", cwd=folder, text=True,
        env=os.environ | variables, capture_output=True, timeout=TIMEOUT_S, check=False,
    )  # fmt: skip
    printed = folder / "out.f06"
    printed.write_text(ended.stdout)
    read = read_f06(printed)
    if not read.modes.eigenvalues.size:
        told = [message.text for message in read.fatal_messages]
        raise SolverCrashed(told[0] if told else "NASTRAN-95 printed no modes")
    return float(np.sqrt(np.min(read.modes.eigenvalues))) / (2.0 * np.pi)


def error(
    solver: str, card: Card, lumped: bool, mesh: int, program: Path | None = None
) -> float | str:
    """Of a solver's lowest frequency from the closed form, in per cent, or the reason for none.

    program: of NASTRAN-95.
    """
    bulk = card.deck(mesh)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            if solver == "nastran95":
                if program is None or not card.old:
                    return "-"
                hz = nastran95(bulk, lumped, program, folder)
            else:
                path = folder / "card.bdf"
                path.write_text(f"{HEAD}PARAM,COUPMASS,{-1 if lumped else 1}\n{bulk}ENDDATA\n")
                hz = float(solve(BINDERS[solver](path, ()), folder / "job").frequencies_hz[0])
        except (ModetuneError, subprocess.TimeoutExpired) as fault:
            return reason(fault)
    return 100.0 * (hz / card.hz - 1.0)


def main(arguments: Sequence[str]) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nastran95", type=Path, help="folder with bin/nastrn and rf")
    asked = parser.parse_args(arguments)
    program = asked.nastran95 and (asked.nastran95 / "bin" / "nastrn").resolve()
    write = sys.stdout.write
    write("| card | masses | closed form, Hz | MYSTRAN | CalculiX | NASTRAN-95 |\n")
    write("| --- | --- | --- | --- | --- | --- |\n")
    for card in CARDS:
        for lumped in (True, False):
            cells = []
            for solver in (*BINDERS, "nastran95"):
                errors = [error(solver, card, lumped, mesh, program) for mesh in MESHES]
                texts = (e if isinstance(e, str) else f"{e:+.2f}" for e in errors)
                cells.append(", ".join(dict.fromkeys(texts)))
            masses = "lumped" if lumped else "coupled"
            write(f"| {card.name} | {masses} | {card.hz:.4g} | {' | '.join(cells)} |\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])

"""A program that behaves as Nastran does towards its caller, with a small solver inside.

It is started as `nastran job.bdf scr=yes ...`, leaves F06, F04, log and OP2 files, and always ends
with code 0. `outcomes.json` beside it lists what its runs do, one word a run, the last word for
all others: good, fatal, memory, denied, killed, half, short, missing, few, other, hang, halved
(sensitivities half of what they are). Each run adds a line to `runs.log` beside it.

The solver knows GRID, SPC1, CELAS2, CONM2, CONROD, and CBAR and CBEAM along x that bend in the
plane x-y, with MAT1, in free field or in columns of 8 or 16; a beam without its property is fatal.
It gives what PARAM,POST,-1 puts into an OP2 file: LAMA, OUGV1, ONRGY1 and OGPWG, and for
SOL 200 DSCMCOL and DSCM2.
"""

from __future__ import annotations

import json
import os
import re
import signal
import struct
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
HERE = Path(sys.argv[0]).resolve().parent
FATAL = """
0*** USER FATAL MESSAGE 316 (IFPDRV)
     ILLEGAL DATA ON BULK DATA ENTRY MAT1
        {card}
"""
UNDEFINED = """
 *** USER FATAL MESSAGE 2070 (FAKE)
     {card} REFERENCES UNDEFINED PROPERTY {number}.
"""
MEMORY = """
0*** SYSTEM FATAL MESSAGE 3008 (DCMPA)
     INSUFFICIENT MEMORY AVAILABLE FOR THIS MODULE (TRY TO INCREASE BY    12345678 WORDS)
"""
DENIED = """MSC Nastran V2021.4 (Intel Linux 5.4.0) Control File:
MSC Licensing: Authentication failed for feature NASTRAN
FLEXlm error:  -4,132.  System Error: 11 "Resource temporarily unavailable"
Licensed number of users already reached.
*** USER FATAL MESSAGE: License checkout failed. MSC Nastran was not started.
"""
EIGENVALUES = """
1    FAKE                                                 NOVEMBER   1, 2021  MSC Nastran  8/ 9/21   PAGE     6

0                                                                                        SUBCASE 1

                                              R E A L   E I G E N V A L U E S
   MODE    EXTRACTION      EIGENVALUE            RADIANS             CYCLES            GENERALIZED         GENERALIZED
    NO.       ORDER                                                                       MASS              STIFFNESS
"""  # noqa: E501
WEIGHT = """
                           O U T P U T   F R O M   G R I D   P O I N T   W E I G H T   G E N E R A T O R
0                                                     REFERENCE POINT =        0
                                                                M O
{rows}
                                                                 S
                                           *  1.000000E+00  0.000000E+00  0.000000E+00 *
                                           *  0.000000E+00  1.000000E+00  0.000000E+00 *
                                           *  0.000000E+00  0.000000E+00  1.000000E+00 *
                               DIRECTION
                          MASS AXIS SYSTEM (S)     MASS              X-C.G.        Y-C.G.        Z-C.G.
                                  X            {mass:.6E}      0.000000E+00  0.000000E+00  0.000000E+00
                                  Y            {mass:.6E}      0.000000E+00  0.000000E+00  0.000000E+00
                                  Z            {mass:.6E}      0.000000E+00  0.000000E+00  0.000000E+00
"""  # noqa: E501
#: Where the end B of a PBEAM of one row of stress points has its I1.
END_B = 20
END = "1                                        * * * END OF JOB * * *\n"


@dataclass(frozen=True)
class Card:
    """A card's fields as texts, the name first."""

    fields: tuple[str, ...]

    def number(self, field: int, default: float = 0.0) -> float:
        text = self.text(field)
        return float(re.sub(r"(?<=[\d.])([+-]\d+)$", r"e\1", text)) if text else default

    def text(self, field: int) -> str:
        return self.fields[field] if field < len(self.fields) else ""


@dataclass(frozen=True)
class Modes:
    """Everything a run knows at its end: one mode a column of shapes (6 a grid)."""

    grids: list[int]
    eigenvalues: Floats
    shapes: Floats
    elements: dict[int, Floats]
    mass: float


def split(line: str) -> list[str]:
    """The fields of one line, its first one included."""
    if "," in line:
        return [text.strip() for text in line.split(",")]
    line = line.expandtabs()
    width = 16 if "*" in line[:8] else 8
    return [line[:8].strip(), *(line[i : i + width].strip() for i in range(8, 72, width))]


def read_cards(bulk: list[str]) -> list[Card]:
    rows: list[list[str]] = []
    for line in bulk:
        first, *rest = split(line)
        if first.strip("+*"):
            rows.append([first.rstrip("*").upper(), *rest])
        else:
            rows[-1] += rest
    return [Card(tuple(row)) for row in rows]


def read_set(case: list[str], request: str) -> list[int]:
    """Members of the SET that a request such as DISPLACEMENT(PLOT) = 1 names."""
    text = "\n".join(case)
    found = re.search(rf"^{request}\([A-Z,]*\) = (\d+)", text, re.MULTILINE)
    if found is None:
        return []
    members = re.search(rf"^SET {found.group(1)} =((?:[^,\n]*,\s*)*[^,\n]*)", text, re.MULTILINE)
    assert members is not None
    return [int(word) for word in members.group(1).replace(",", " ").split()]


def springs(cards: list[Card], row: dict[int, int], places: dict[int, Floats]) -> dict[int, Floats]:
    """Element numbers with the matrix factor (6 n, rank) b of stiffness b b^T."""
    size, found = 6 * len(row), dict[int, Floats]()
    moduli = {card.text(1): card.number(2) for card in cards if card.fields[0] == "MAT1"}
    for card in cards:
        b = np.zeros(size)
        if card.fields[0] == "CELAS2":
            for sign, field in ((1.0, 3), (-1.0, 5)):
                if card.text(field) not in ("", "0"):
                    b[6 * row[int(card.text(field))] + int(card.text(field + 1)) - 1] = sign
            found[int(card.text(1))] = b * np.sqrt(card.number(2))
        elif card.fields[0] == "CONROD":
            ends = int(card.text(2)), int(card.text(3))
            along = places[ends[1]] - places[ends[0]]
            length = float(np.linalg.norm(along))
            for sign, end in ((1.0, ends[1]), (-1.0, ends[0])):
                b[6 * row[end] : 6 * row[end] + 3] = sign * along / length
            found[int(card.text(1))] = b * np.sqrt(moduli[card.text(4)] * card.number(5) / length)
        elif card.fields[0] in ("CBAR", "CBEAM"):
            found[int(card.text(1))] = beam(card, cards, moduli, row, places)
    return {number: b.reshape(size, -1) for number, b in found.items()}


class UndefinedProperty(Exception):
    """A beam names a property that the deck has not."""


def beam(
    card: Card,
    cards: list[Card],
    moduli: dict[str, float],
    row: dict[int, int],
    places: dict[int, Floats],
) -> Floats:
    """Curvature with equal and opposite ends, and with equal ones: all that a beam's bending is."""
    section = f"P{card.fields[0].removeprefix('C')}"
    owned = [p for p in cards if p.fields[0] == section and p.text(1) == card.text(2)]
    if not owned:
        raise UndefinedProperty(UNDEFINED.format(card=card.fields[0], number=card.text(2)))
    inertia = owned[0].number(4)
    if section == "PBEAM":  # both ends
        inertia = (inertia + owned[0].number(END_B, inertia)) / 2.0
    ends = int(card.text(3)), int(card.text(4))
    length = places[ends[1]][0] - places[ends[0]][0]
    stiffness = moduli[owned[0].text(2)] * inertia
    b = np.zeros((6 * len(row), 2))
    for sign, end in ((-1.0, ends[0]), (1.0, ends[1])):
        b[6 * row[end] + 5, 0] = sign * np.sqrt(stiffness / length)
        b[6 * row[end] + 1, 1] = sign * np.sqrt(12.0 * stiffness / length**3)
        b[6 * row[end] + 5, 1] = -length / 2.0 * np.sqrt(12.0 * stiffness / length**3)
    return b


def selected(case: list[str], cards: list[Card]) -> list[Card]:
    """The cards without the constraints that the case control does not select."""
    chosen = [line.partition("=")[2].strip() for line in case if line.startswith("SPC")]
    return [card for card in cards if card.fields[0] != "SPC1" or card.text(1) in chosen]


def solve(cards: list[Card], n_modes: int) -> Modes:
    grids = sorted(int(card.text(1)) for card in cards if card.fields[0] == "GRID")
    row = {grid: place for place, grid in enumerate(grids)}
    places = {
        int(card.text(1)): np.array([card.number(field) for field in (3, 4, 5)])
        for card in cards
        if card.fields[0] == "GRID"
    }
    elements = springs(cards, row, places)
    factors = np.hstack(list(elements.values()))
    stiffness, masses = factors @ factors.T, np.zeros(6 * len(grids))
    scale = next(
        (c.number(2) for c in cards if c.fields[0] == "PARAM" and c.text(1) == "WTMASS"), 1.0
    )
    weight = 0.0
    for card in cards:
        if card.fields[0] == "CONM2":
            start = 6 * row[int(card.text(2))]
            masses[start : start + 3] += scale * card.number(4)
            weight += card.number(4)
    held = {
        6 * row[int(grid)] + int(component) - 1
        for card in cards
        if card.fields[0] == "SPC1"
        for grid in card.fields[3:]
        if grid
        for component in card.text(2)
    }
    free = [
        dof
        for dof in range(masses.size)
        if dof not in held and stiffness[dof, dof] > 0.0 and masses[dof] > 0.0
    ]
    # Unknowns without mass follow the others.
    turns = [
        dof
        for dof in range(masses.size)
        if dof not in held and stiffness[dof, dof] > 0.0 and masses[dof] == 0.0
    ]
    follow = -np.linalg.solve(stiffness[np.ix_(turns, turns)], stiffness[np.ix_(turns, free)])
    reduced = stiffness[np.ix_(free, free)] + stiffness[np.ix_(free, turns)] @ follow
    root = np.sqrt(masses[free])
    eigenvalues, vectors = np.linalg.eigh(reduced / np.outer(root, root))
    shapes = np.zeros((masses.size, min(n_modes, len(free))))
    shapes[free] = (vectors / root[:, None])[:, :n_modes]
    shapes[turns] = follow @ shapes[free]
    energies = {number: 0.5 * ((b.T @ shapes) ** 2).sum(0) for number, b in elements.items()}
    return Modes(grids, eigenvalues[:n_modes], shapes, energies, weight)


# OP2 files: records between their lengths, tables of numbered records.


def record(data: bytes) -> bytes:
    size = struct.pack("<i", len(data))
    return size + data + size


def integers(*numbers: int) -> bytes:
    return b"".join(record(struct.pack("<i", number)) for number in numbers)


def matrix(name: str, columns: Floats) -> bytes:
    """A matrix of doubles: a record a column, which starts with its first row."""
    n_rows, n_columns = columns.shape
    title = f"{name:<8}".encode()
    text = integers(2) + record(title) + integers(-1, 7)
    text += record(struct.pack("<7i", 102, n_columns, n_rows, 2, 2, 2 * n_rows, 10000))
    text += integers(-2, 1, 0, 2) + record(title)
    for place, column in enumerate(columns.T):
        data = struct.pack(f"<i{n_rows}d", 1, *column)
        text += integers(-3 - place, 1, 1, 2 * n_rows) + record(data)
    return text + integers(-3 - n_columns, 1, 0, 0)


def table(name: str, *records: bytes) -> bytes:
    title = f"{name:<8}".encode()
    text = integers(2) + record(title) + integers(-1, 7)
    text += record(struct.pack("<7i", 101, 1, 0, 0, 0, 0, 0)) + integers(-2, 1, 0, 7)
    text += record(title + struct.pack("<5i", 11, 1, 21, 0, 1))
    number = -3
    for data in records:
        text += integers(number, 1, 0, len(data) // 4) + record(data)
        number -= 1
    return text + integers(number, 1, 0, 0)


def identity(words: dict[int, int | float | bytes]) -> bytes:
    """The 146 words before a table's data; words are numbered from 1."""
    data = bytearray(struct.pack("<50i", *([0] * 50)) + b" " * 384)
    for number, value in words.items():
        kind = {int: "<i", float: "<f", bytes: "<8s"}[type(value)]
        struct.pack_into(kind, data, 4 * (number - 1), value)
    return bytes(data)


def op2_head() -> bytes:
    text = integers(3) + record(struct.pack("<3i", 11, 1, 21)) + integers(7)
    text += record(b"NASTRAN FORT TAPE ID CODE - ") + integers(2) + record(b"XXXXXXXX")
    return text + integers(-1, 0)


def op2_tables(modes: Modes, grids: list[int], elements: list[int]) -> bytes:
    text = op2_head()
    mass = np.diag([modes.mass] * 3 + [0.0] * 3).ravel().tolist()
    weight = struct.pack("<36f9f", *mass, *np.eye(3).ravel())
    weight += struct.pack("<12f", *([modes.mass, 0.0, 0.0, 0.0] * 3))
    weight += struct.pack("<9f3f9f", *([0.0] * 12), *np.eye(3).ravel())
    text += table("OGPWG", identity({1: 11, 2: 13, 3: 0, 10: 78}), weight)
    rows = b""
    for mode, eigenvalue in enumerate(modes.eigenvalues.tolist(), start=1):
        omega = abs(eigenvalue) ** 0.5
        rows += struct.pack(
            "<2i5f", mode, mode, eigenvalue, omega, omega / 2.0 / np.pi, 1.0, eigenvalue
        )
    text += table("LAMA", identity({1: 21, 2: 6, 10: 7}), rows)
    shapes, energies = [], []
    for mode, eigenvalue in enumerate(modes.eigenvalues.tolist()):
        cycles = abs(eigenvalue) ** 0.5 / 2.0 / np.pi
        shapes.append(
            identity({1: 22, 2: 7, 4: 1, 5: mode + 1, 6: eigenvalue, 7: cycles, 9: 1, 10: 8})
        )
        shapes.append(
            b"".join(
                struct.pack(
                    "<2i6f", 10 * grid + 2, 1, *modes.shapes[6 * place : 6 * place + 6, mode]
                )
                for place, grid in enumerate(modes.grids)
                if grid in grids
            )
        )
        total = sum(float(energy[mode]) for energy in modes.elements.values())
        energies.append(
            identity(
                {
                    1: 22,
                    2: 18,
                    3: total,
                    4: 1,
                    5: mode + 1,
                    6: b"ELAS2   ",
                    9: 1,
                    10: 4,
                    14: eigenvalue,
                    16: cycles,
                }
            )
        )
        shown = [(number, float(modes.elements[number][mode])) for number in elements]
        lines: list[tuple[float, ...]] = [
            (10 * n + 2, energy, 100.0 * energy / (total or 1.0), 0.0) for n, energy in shown
        ]
        sums = [sum(line[column] for line in lines) for column in (1, 2, 3)]
        lines.append((1_000_000_000, *sums))
        energies.append(b"".join(struct.pack("<i3f", int(line[0]), *line[1:]) for line in lines))
    if grids:
        text += table("OUGV1", *shapes)
    if elements:
        text += table("ONRGY1", *energies)
    return text


#: Response types of DRESP1 cards in EDOM.
TYPES = {"EIGN": 4, "DISP": 5}
#: Fields of the numbers that design variables may scale.
SCALED = {
    ("MAT1", "E"): 2, ("CELAS2", "K"): 2, ("CONM2", "M"): 4, ("CONROD", "A"): 5, ("PBAR", "I1"): 4,
    ("PBEAM", "I1(A)"): 4, ("PBEAM", "I1(B)"): END_B,
}  # fmt: skip


def scaled(cards: list[Card], variable: str, factor: float) -> list[Card]:
    """The cards with the numbers that a design variable governs, at another value of it."""
    numbers: dict[tuple[str, str, int], float] = {}
    for card in cards:
        if card.fields[0] in ("DVMREL1", "DVCREL1", "DVPREL1") and card.text(9) == variable:
            field = SCALED[card.text(2), card.text(4)]
            numbers[card.text(2), card.text(3), field] = card.number(10) * factor
    found = []
    for card in cards:
        fields = list(card.fields)
        if fields[0] == "PBEAM" and not card.text(END_B):  # filled in as the card is read
            fields += [""] * (END_B + 1 - len(fields))
            fields[END_B] = fields[4]
        for (name, number, field), value in numbers.items():
            if fields[0] == name and fields[1] == number:
                fields[field] = repr(value)
        found.append(Card(tuple(fields)))
    return found


def sensitivities(cards: list[Card], n_modes: int, lacking: int, size: float) -> bytes:
    """DSCMCOL and DSCM2 by central differences; the last `lacking` responses are left out.

    size: a factor on all of them.
    """
    base = solve(cards, n_modes)
    variables = [card.text(1) for card in cards if card.fields[0] == "DESVAR"]
    responses = [card for card in cards if card.fields[0] == "DRESP1"]
    responses = responses[: len(responses) - lacking]
    step, rows = 1e-5, []
    for variable in variables:
        ends = [solve(scaled(cards, variable, 1.0 + s), n_modes) for s in (step, -step)]
        signs = [np.sign((end.shapes * base.shapes).sum(axis=0)) for end in ends]
        slopes = (ends[0].eigenvalues - ends[1].eigenvalues) / (2.0 * step)
        shapes = (ends[0].shapes * signs[0] - ends[1].shapes * signs[1]) / (2.0 * step)
        row = []
        for card in responses:
            if card.text(3) == "EIGN":
                row.append(slopes[int(card.text(6)) - 1])
            else:
                place = 6 * base.grids.index(int(card.text(8))) + int(card.text(6)) - 1
                row.append(shapes[place, int(card.text(7)) - 1])
        rows.append(row)
    words = b""
    for place, card in enumerate(responses, start=1):
        number = int(card.text(1))
        if card.text(3) == "EIGN":
            words += struct.pack("<9i", place, number, 4, int(card.text(6)), 0, 1, 0, 0, 0)
        else:
            grid, component, mode = int(card.text(8)), int(card.text(6)), int(card.text(7))
            words += struct.pack("<9i", place, number, 5, grid, component, 1, mode, 0, 0)
    text = op2_head()
    design = struct.pack("<3i", 3106, 31, 352) + b"".join(
        struct.pack("<i8s4fif", int(variable), b"P       ", 1.0, 0.5, 2.0, 0.0, 0, 0.0)
        for variable in variables
    )
    blank = b" " * 8
    asked = struct.pack("<3i", 3806, 38, 359) + b"".join(
        struct.pack("<i8si8s", int(card.text(1)), blank, TYPES[card.text(3)], blank)
        + struct.pack("<5i", 0, int(card.text(6)), int(card.text(7) or 0), 0, -1)
        for card in responses
    )
    text += table("EDOM", design, asked)
    return text + table("DSCMCOL", words) + matrix("DSCM2", size * np.array(rows))


def print_file(modes: Modes) -> str:
    rows = []
    for mode, value in enumerate(modes.eigenvalues.tolist(), start=1):
        omega = abs(value) ** 0.5
        numbers = (value, omega, omega / 2.0 / np.pi, 1.0, value)
        rows.append(f"{mode:9d}{mode:10d}" + "".join(f"{number:20.6E}" for number in numbers))
    matrix = np.diag([modes.mass] * 3 + [0.0] * 3)
    lines = (" ".join(f"{value:13.6E}" for value in line) for line in matrix)
    weight = WEIGHT.format(
        mass=modes.mass, rows="\n".join(f"                      * {line} *" for line in lines)
    )
    return weight + EIGENVALUES + "\n".join(rows) + "\n" + END


def behaviour() -> str:
    log = HERE / "runs.log"
    with log.open("a") as lines:
        lines.write(" ".join(sys.argv[1:]) + "\n")
    script = HERE / "outcomes.json"
    outcomes = json.loads(script.read_text()) if script.exists() else ["good"]
    number = len(log.read_text().splitlines())
    return str(outcomes[min(number, len(outcomes)) - 1])


def run(deck: Path, outcome: str) -> None:
    stem = deck.stem
    lines = deck.read_text().splitlines()
    begin = lines.index("BEGIN BULK")
    case, bulk = lines[:begin], lines[begin + 1 : lines.index("ENDDATA")]
    cards = selected(case, read_cards(bulk))
    n_modes = next(int(card.text(4)) for card in cards if card.fields[0] == "EIGRL")
    try:
        modes = solve(cards, n_modes - 1 if outcome == "few" else n_modes)
    except UndefinedProperty as error:
        Path(f"{stem}.f06").write_text(f"{error}{END}")
        return
    grids = read_set(case, "DISPLACEMENT")
    data = op2_tables(modes, grids[1:] if outcome == "other" else grids, read_set(case, "ESE"))
    if "SOL 200" in case:
        size = 0.5 if outcome == "halved" else 1.0
        data = sensitivities(cards, n_modes, 1 if outcome == "few" else 0, size)
    data += integers(0)
    text = print_file(modes)
    if outcome == "half":
        data = data[: len(data) // 2]
    if outcome == "short":
        text = text.removesuffix(END)
    if outcome == "fatal":
        card = next(line for line in bulk if line.startswith("MAT1"))
        text, data = FATAL.format(card=card) + END, b""
    if outcome == "memory":
        text, data = MEMORY + END, b""
    Path(f"{stem}.f06").write_text(text)
    if outcome != "missing" and data:
        Path(f"{stem}.op2").write_bytes(data)


def main() -> None:
    outcome, deck = behaviour(), Path(sys.argv[1])
    Path(f"{deck.stem}.log").write_text(DENIED if outcome == "denied" else "job started\n")
    if outcome == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if outcome == "hang":
        time.sleep(600)
    if outcome != "denied":
        run(deck, outcome)


if __name__ == "__main__":
    main()

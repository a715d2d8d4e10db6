"""Datasets of universal files written out by the letter of the format, without pyuff."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray


def save(path: Path, *datasets: str | bytes) -> Path:
    parts = [part.encode() if isinstance(part, str) else part for part in datasets]
    path.write_bytes(b"".join(parts))
    return path


def dataset(kind: int | str, *rows: str) -> str:
    return "\n".join(["    -1", f"{kind:>6}", *rows, "    -1", ""])


def e13(values: Sequence[float], letter: str = "E") -> str:
    return "".join(f"{value:13.5E}" for value in values).replace("E", letter)


def nodes_15(*rows: tuple[int, int, int, Sequence[float]]) -> str:
    """Rows of node, definition system, displacement system, coordinates."""
    return dataset(
        15, *(f"{node:10d}{cs:10d}{disp:10d}{8:10d}{e13(place)}" for node, cs, disp, place in rows)
    )


def nodes_2411(*rows: tuple[int, int, Sequence[float]], letter: str = "D") -> str:
    """Rows of node, displacement system, coordinates."""
    lines = []
    for node, disp, place in rows:
        lines.append(f"{node:10d}{1:10d}{disp:10d}{11:10d}")
        lines.append("".join(f"{value:25.16E}" for value in place).replace("E", letter))
    return dataset(2411, *lines)


def system_18(
    number: int, kind: int, reference: int, points: Sequence[Sequence[float]]
) -> Sequence[str]:
    origin, x, xz = points
    head = f"{number:10d}{kind:10d}{reference:10d}{8:10d}{1:10d}"
    return head, f"SYS{number}", e13([*origin, *x]), e13(xz)


def units_164(factor: float, force: float = 1.0) -> str:
    return dataset(
        164,
        f"{9:10d}{'USER_DEFINED':20}{2:10d}",
        "".join(f"{value:25.17E}" for value in (factor, force, 1.0)).replace("E", "D"),
        f"{273.15:25.17E}".replace("E", "D"),
    )


def mode_55(
    number: int,
    pole: complex | float,
    values: Mapping[int, Sequence[complex]],
    *,
    damping: float = 0.0,
    modal_mass: float = 0.0,
    hysteretic: float = 0.0,
    letter: str = "E",
    analysis: int | None = None,
) -> str:
    """A mode; a complex pole (rad/s) makes a complex mode, a real one (Hz) a normal mode."""
    is_complex = isinstance(pole, complex)
    width = len(next(iter(values.values())))
    kind = analysis or (3 if is_complex else 2)
    reals = (
        [pole.real, pole.imag, 0.0, 0.0, 0.0, 0.0]
        if isinstance(pole, complex)
        else [pole, modal_mass, damping, hysteretic]
    )
    rows = [
        f"{1:10d}{kind:10d}{width // 3 + 1:10d}{8:10d}{5 if is_complex else 2:10d}{width:10d}",
        f"{2:10d}{len(reals):10d}{1:10d}{number:10d}",
        e13(reals, letter),
    ]
    for node, parts in values.items():
        flat = (
            [part for value in parts for part in (value.real, value.imag)]
            if is_complex
            else [value.real for value in parts]
        )
        rows.append(f"{node:10d}")
        rows += [e13(flat[start : start + 6], letter) for start in range(0, len(flat), 6)]
    return dataset(55, *["NONE"] * 5, *rows)


def head_58(
    kind: int,
    ends: tuple[int, int, int, int],
    form: tuple[int, int, int, float, float],
    quantities: tuple[int, int] = (12, 13),
    unit: str = "NONE",
    below: str = "NONE",
) -> list[str]:
    """Records 1 to 11; ends: node, direction, reference node, direction; form: record 7."""
    node, direction, reference, along = ends
    numerator, denominator = quantities
    return [
        *["NONE"] * 5,
        f"{kind:5d}{0:10d}{0:5d}{0:10d} {'NONE':10}{node:10d}{direction:4d} "
        f"{'NONE':10}{reference:10d}{along:4d}",
        f"{form[0]:10d}{form[1]:10d}{form[2]:10d}{e13([form[3], form[4], 0.0])}",
        f"{18:10d}{0:5d}{0:5d}{0:5d} {'NONE':20} {'Hz':20}",
        f"{numerator:10d}{0:5d}{0:5d}{0:5d} {'NONE':20} {unit:20}",
        f"{denominator:10d}{0:5d}{0:5d}{0:5d} {'NONE':20} {below:20}",
        f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':20} {'NONE':20}",
    ]


def even_58(
    values: Sequence[complex],
    ends: tuple[int, int, int, int],
    *,
    kind: int = 4,
    start: float = 0.0,
    step: float = 1.0,
    quantities: tuple[int, int] = (12, 13),
    unit: str = "NONE",
    below: str = "NONE",
) -> str:
    """A function at even abscissae, complex or real, in single precision."""
    is_complex = any(isinstance(value, complex) for value in values)
    flat = (
        [part for value in values for part in (value.real, value.imag)]
        if is_complex
        else [value.real for value in values]
    )
    head = head_58(
        kind, ends, (5 if is_complex else 2, len(values), 1, start, step), quantities, unit, below
    )
    rows = [e13(flat[first : first + 6]) for first in range(0, len(flat), 6)]
    return dataset(58, *head, *rows)


def binary_58(
    values: NDArray[Any],
    ends: tuple[int, int, int, int],
    form: tuple[int, int, int, float, float],
    *,
    order: int = 1,
    claimed: int | None = None,
    before_mark: bytes = b"",
) -> bytes:
    """A binary function with these bytes as values."""
    data = values.tobytes()
    size = len(data) if claimed is None else claimed
    first = f"{'58b':>7}{order:6d}{2:6d}{11:12d}{size:12d}{0:6d}{0:6d}{0:12d}{0:12d}"
    text = "\n".join(["    -1", first, *head_58(4, ends, form), ""])
    return text.encode() + data + before_mark + b"    -1\n"

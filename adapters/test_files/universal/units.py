"""Response functions in SI: m, m/s or m/s^2 of motion (rad for rotations) per N (Nm for moments).

The unit labels of a function's own axes (records 9 and 10 of dataset 58) say what its values are
in, `g` and `in/s^2` among them; where they say nothing that is known, dataset 164 of the same file
does, whose factors turn SI into the file's units; without either the values are taken as SI, with
a note that says so.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from modetune.adapters.test_files.universal.contents import Function, Units, UniversalFile
from modetune.core.measurement.frf import Complexes, Response

#: Standard gravity, m/s^2 (exact by definition).
GRAVITY = 9.80665
METRES = {
    "m": 1.0,
    "nm": 1e-9,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "in": 0.0254,
    "inch": 0.0254,
    "ft": 0.3048,
}
NEWTONS = {
    "n": 1.0, "kn": 1e3, "lbf": 4.4482216152605, "lb": 4.4482216152605, "lbs": 4.4482216152605,
    "kgf": GRAVITY,
}  # fmt: skip
#: How often a motion is divided by time.
DERIVATIVES: dict[Response, int] = {"receptance": 0, "mobility": 1, "accelerance": 2}
_MOTION = re.compile(r"(nm|um|mm|cm|m|inch|in|ft)(?:/s(?:ec)?((?:\^|\*\*)?2|/s)?)?")
_RATIO = re.compile(r"(.+?)\s*/\s*[(\[]?\s*(kgf|kn|lbf|lbs|lb|n)\s*[)\]]?")
#: How far the factors of dataset 164, some printed with four digits, may be from those of a label.
SAME = 1e-3
#: Where the number of functions goes in a note; in no path or label.
_COUNT = "\0"


def in_si(
    functions: Sequence[Function], kind: Response, files: Sequence[UniversalFile], notes: list[str]
) -> list[Complexes]:
    """The values of these functions in SI, (n_lines,) each; `notes` say what was converted."""
    given = [item for file in files for item in file.contents if isinstance(item, Units)]
    said: Counter[str] = Counter()
    values: list[Complexes] = []
    for function in functions:
        factor, note = _factor(function, kind, _units_at(function, given))
        said[note] += 1
        values.append(np.asarray(function.values * factor, dtype=np.complex128))
    notes += [note.replace(_COUNT, str(count)) for note, count in said.items() if note]
    return values


def motion_label(label: str) -> tuple[float, int] | None:
    """SI value of the unit of a motion and its derivatives by time; nothing if it is none."""
    text = _bare(label)
    if text in ("g", "gn", "gs", "g's"):
        return GRAVITY, 2
    found = _MOTION.fullmatch(text.replace(" ", ""))
    if found is None:
        return None
    return METRES[found[1]], 2 if found[2] else int("/" in text)


def _factor(function: Function, kind: Response, units: Units | None) -> tuple[float, str]:
    """What the values are multiplied by, and a note on it, empty where there is nothing to tell."""
    path = function.place.path
    by_file = None if units is None else _by_file(function, units)
    motion, force = _labels(function, kind)
    if motion is not None or force is not None:
        return _by_labels(function, kind, (motion, force), by_file)
    if by_file is not None:
        factor = by_file[0] / by_file[1]
        return factor, _converted(factor, f"{path}: dataset 164")
    return 1.0, (
        f"doubtful: {path}: {_COUNT} response functions are taken as SI (m, s, N): neither a "
        "dataset 164 nor their unit labels tell their units"
    )


def _by_labels(
    function: Function,
    kind: Response,
    labels: tuple[float | None, float | None],
    by_file: tuple[float, float] | None,
) -> tuple[float, str]:
    """As `_factor`, where a label names the unit of motion or force, or both."""
    motion, force = labels
    file_motion, file_force = by_file or (1.0, 1.0)
    factor = (motion or file_motion) / (force or file_force)
    said = f"{function.place.path}: units {_label_text(function)}"
    if by_file is None and (motion is None or force is None):
        missing = "motion" if motion is None else "force"
        times = "" if factor == 1.0 else f", the values are multiplied by {factor:.6g}"
        return factor, (
            f"doubtful: {said}: the {missing} of {_COUNT} functions is taken as SI{times}"
        )
    # accelerations in g go with any unit of length
    in_g = motion == GRAVITY and kind == "accelerance"
    if by_file is not None and (
        (motion is not None and not in_g and not _same(motion, file_motion))
        or (force is not None and not _same(force, file_force))
    ):
        return factor, (
            f"doubtful: {said} of {_COUNT} response functions contradict dataset 164; the labels "
            f"are taken (values times {factor:.6g})"
        )
    return factor, _converted(factor, said)


def _converted(factor: float, source: str) -> str:
    if math.isclose(factor, 1.0, rel_tol=1e-12):
        return ""
    return f"{source}: {_COUNT} response functions are converted to SI, times {factor:.6g}"


def _labels(function: Function, kind: Response) -> tuple[float | None, float | None]:
    """SI values of the units of motion and force that the labels name, nothing for unknown ones."""
    numerator, denominator = function.unit, function.denominator_unit
    ratio = _RATIO.fullmatch(_bare(numerator, ends=False))
    force = NEWTONS.get(_bare(denominator))
    if ratio is not None:
        numerator = ratio[1]
        force = force or NEWTONS[ratio[2]]
    found = motion_label(numerator)
    fits = found is not None and found[1] == DERIVATIVES[kind]
    # a label of a length at a rotation, or of a force at a moment, is none of its unit
    motion = found[0] if found is not None and fits and abs(function.direction) <= 3 else None
    return motion, force if abs(function.reference_direction) <= 3 else None


def _by_file(function: Function, units: Units) -> tuple[float, float] | None:
    """SI values of a file's units of this motion and force; nothing where it tells no force."""
    if math.isnan(units.newtons):
        return None
    return (
        units.metres if abs(function.direction) <= 3 else 1.0,
        units.newtons * (1.0 if abs(function.reference_direction) <= 3 else units.metres),
    )


def _units_at(function: Function, given: Sequence[Units]) -> Units | None:
    """The dataset 164 that goes for a function: of its file, the last before it, else the first."""
    own = [units for units in given if units.place.path == function.place.path]
    before = [units for units in own if units.place.line < function.place.line]
    return before[-1] if before else own[0] if own else None


def _same(one: float, other: float) -> bool:
    return math.isclose(one, other, rel_tol=SAME)


def _bare(label: str, ends: bool = True) -> str:
    text = label.strip().lower()
    return text.strip("()[] ") if ends else text


def _label_text(function: Function) -> str:
    labels = (function.unit, function.denominator_unit)
    return " over ".join(repr(label) for label in labels if label and label.upper() != "NONE")

"""Functions of universal files (dataset 58): response functions, coherences and time histories.

Response functions become SI: m, m/s or m/s^2 of motion (rad for rotations) per N (Nm for moments).
The unit labels of the axes of a function (records 9 and 10 of dataset 58) give the units of its
values, including `g` and `in/s^2`. Where no label is recognised, dataset 164 of the same file gives
them by factors from SI to the units of the file. Without either, the values are taken as SI, and a
note reports it.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from modetune.adapters.test_files.histories import (
    GRAVITY,
    NEWTONS,
    Channel,
    channel_unit,
    motion_label,
    recording,
)
from modetune.adapters.test_files.universal.datasets import Content, Function, Units, UniversalFile
from modetune.core.measurement.measurement import MeasuredFrfs
from modetune.core.measurement.response_functions import Complexes, Response
from modetune.core.measurement.time_histories import TimeHistories
from modetune.core.modes import Floats

RESPONSE_FUNCTION, COHERENCE, MULTIPLE_COHERENCE = 4, 6, 26
#: What the kinds of dataset 58 are called, for people.
KINDS = {
    0: "general function", 1: "time history", 2: "auto spectrum", 3: "cross spectrum",
    4: "response function", 5: "transmissibility", 6: "coherence", 9: "power spectral density",
    12: "spectrum", 18: "mode indicator function", 26: "multiple coherence",
}  # fmt: skip
#: What is measured by the kind of quantity of the ordinate's numerator.
QUANTITIES: dict[int, Response] = {8: "receptance", 11: "mobility", 12: "accelerance"}
_ACCELERATION = re.compile(r"m/s(\^|\*\*)?2|\bg\b|in/s(\^|\*\*)?2|ft/s(\^|\*\*)?2", re.IGNORECASE)

#: Kinds of quantity that a force may have: unknown, general, reaction force, excitation force.
FORCES = (0, 1, 9, 13)
#: What the others are called, for people.
MOTIONS = {8: "a displacement", 11: "a velocity", 12: "an acceleration"}

#: A time history among the kinds of dataset 58, forces among its quantities, and the order of the
#: time derivative of each motion.
TIME_RESPONSE, FORCE_KINDS, ORDERS = 1, (9, 13), {8: 0, 11: 1, 12: 2}
#: How a doubt begins about points of several components with one number.
UNNUMBERED = "whose point"

Dof = tuple[int, int, int, int]


def frfs(files: Sequence[UniversalFile], notes: list[str]) -> MeasuredFrfs | None:
    """Return all response functions over the same frequencies in SI, or None."""
    functions = [item for file in files for item in file.contents if isinstance(item, Function)]
    _note_others(functions, notes)
    usable: dict[tuple[Response, bytes], dict[Dof, Function]] = {}
    passed: dict[str, list[Function]] = {}
    for function in functions:
        if function.kind != RESPONSE_FUNCTION:
            continue
        reason, quantity = _unusable(function), _quantity(function)
        if reason is not None or quantity is None:
            passed.setdefault(reason or "of no known quantity", []).append(function)
            continue
        grid = np.round(function.abscissae, 6).tobytes()
        group = usable.setdefault((quantity, grid), {})
        if (first := group.get(_dof(function))) is not None:
            passed.setdefault(_again(first, function), []).append(function)
        group.setdefault(_dof(function), function)
    for reason, others in passed.items():
        more = f" (and {len(others) - 1} more{_records(others[1:])})" if len(others) > 1 else ""
        doubt = "doubtful: " if reason.startswith(UNNUMBERED) else ""
        notes.append(f"{doubt}{others[0].place}: a response function {reason}; passed over{more}")
    if not usable:
        return None
    chosen = max(usable, key=lambda key: len(usable[key]))
    left = sum(len(group) for key, group in usable.items() if key != chosen)
    if left:
        notes.append(
            f"{left} response functions have other frequencies or another quantity than the "
            f"{len(usable[chosen])} that are used; passed over"
        )
    group = usable[chosen]
    names = np.array(list(group), dtype=np.int64)
    values = in_si(list(group.values()), chosen[0], files, notes)
    return MeasuredFrfs(
        kind=chosen[0],
        frequencies_hz=next(iter(group.values())).abscissae,
        values=np.column_stack(values),
        nodes=names[:, 0],
        components=np.abs(names[:, 1]),
        signs=np.sign(names[:, 1]).astype(np.float64),
        reference_nodes=names[:, 2],
        reference_components=np.abs(names[:, 3]),
        reference_signs=np.sign(names[:, 3]).astype(np.float64),
        coherences=_coherences(group, functions, notes),
    )


def _records(functions: Sequence[Function]) -> str:
    """Return the lines of the first few."""
    lines = [str(function.place.line) for function in functions[:20]]
    return f": line{'s' * (len(lines) > 1)} {', '.join(lines)}{', ...' * (len(functions) > 20)}"


def _again(first: Function, second: Function) -> str:
    """Return why a function at the node and direction of one before is passed over."""
    parts, others = ((end.part, end.reference_part) for end in (first, second))
    if parts == others:
        return "that was given before"
    one, two = (" over ".join(name or "no name" for name in names) for names in (parts, others))
    return (
        f"{UNNUMBERED} in {two} has the number of one in {one}; export the test with numbers that "
        "are used once over all components"
    )


def _coherences(
    group: dict[Dof, Function], functions: Sequence[Function], notes: list[str]
) -> Floats:
    """Return coherences of these functions, (n_lines, n_functions), empty where one has none."""
    broken = [
        item
        for item in functions
        if item.kind in (COHERENCE, MULTIPLE_COHERENCE) and not np.isfinite(item.values).all()
    ]
    if broken:
        more = f" (and {len(broken) - 1} more)" if len(broken) > 1 else ""
        notes.append(
            f"doubtful: {broken[0].place}: a coherence with values that are not finite numbers; "
            f"passed over{more}"
        )
    places = {item.place for item in broken}
    functions = [item for item in functions if item.place not in places]
    first = next(iter(group.values()))
    coherent = {_dof(item): item for item in functions if item.kind == COHERENCE}
    of_all = {_dof(item)[:2]: item for item in functions if item.kind == MULTIPLE_COHERENCE}
    found = [coherent.get(dof) or of_all.get(dof[:2]) for dof in group]
    fitting = [item.values.real for item in found if item and item.values.size == first.values.size]
    if len(fitting) == len(found):
        return np.column_stack(fitting)
    if fitting:
        lacking = [of for of, item in zip(group.values(), found, strict=True) if item is None]
        notes.append(
            f"{len(found) - len(fitting)} of {len(found)} response functions have no coherence at "
            f"their frequencies{_records(lacking) if lacking else ''}; the coherences of the "
            "others are not used"
        )
    return np.zeros((0, 0))


def _note_others(functions: Sequence[Function], notes: list[str]) -> None:
    """Say how many functions of other kinds there are; coherences are used."""
    kinds = Counter(
        function.kind
        for function in functions
        if function.kind not in (RESPONSE_FUNCTION, COHERENCE, MULTIPLE_COHERENCE)
    )
    for kind, count in kinds.items():
        name = KINDS.get(kind, f"function of kind {kind}")
        notes.append(f"{count} x {name}: listed, not used")


def _unusable(function: Function) -> str | None:
    """Return why a response function cannot be used, or nothing."""
    if not 1 <= abs(function.direction) <= 6 or function.node < 1:
        return "without node or direction of its sensor"
    if not 1 <= abs(function.reference_direction) <= 6 or function.reference_node < 1:
        return "without node or direction of its force"
    below = function.denominator
    by_label = below in (0, 1) and motion_label(function.denominator_unit) is not None
    if below not in FORCES or by_label:
        what = MOTIONS.get(below) or (
            f"a quantity of kind {below}" if below not in FORCES else function.denominator_unit
        )
        return f"over {what}, not over a force (a transmissibility)"
    if not np.iscomplexobj(function.values):
        return "with real values only"
    if not (np.isfinite(function.values).all() and np.isfinite(function.abscissae).all()):
        return "with values that are not finite numbers"
    if function.abscissae.size < 2 or (np.diff(function.abscissae) <= 0.0).any():
        return "whose frequencies do not ascend"
    return None


def _quantity(function: Function) -> Response | None:
    """Return the measured quantity, by its unit where the file leaves it open."""
    if function.numerator in QUANTITIES:
        return QUANTITIES[function.numerator]
    return "accelerance" if _ACCELERATION.search(function.unit) else None


def _dof(function: Function) -> Dof:
    return (
        function.node,
        function.direction,
        function.reference_node,
        function.reference_direction,
    )


#: How often a motion is divided by time.
DERIVATIVES: dict[Response, int] = {"receptance": 0, "mobility": 1, "accelerance": 2}
_RATIO = re.compile(r"(.+?)\s*/\s*[(\[]?\s*(kgf|kn|lbf|lbs|lb|n)\s*[)\]]?")
#: How far the factors of dataset 164, some printed with four digits, may be from those of a label.
SAME = 1e-3
#: Where the number of functions goes in a note; in no path or label.
_COUNT = "\0"


def in_si(
    functions: Sequence[Function], kind: Response, files: Sequence[UniversalFile], notes: list[str]
) -> list[Complexes]:
    """Return the values of these functions in SI, (n_lines,) each.

    `notes` say what was converted.
    """
    given = [item for file in files for item in file.contents if isinstance(item, Units)]
    text: Counter[str] = Counter()
    values: list[Complexes] = []
    for function in functions:
        factor, note = _factor(function, kind, _units_at(function, given))
        text[note] += 1
        values.append(np.asarray(function.values * factor, dtype=np.complex128))
    notes += [note.replace(_COUNT, str(count)) for note, count in text.items() if note]
    return values


def _factor(function: Function, kind: Response, units: Units | None) -> tuple[float, str]:
    """Return the factor of the values, and a note on it, empty where none is needed."""
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
        "dataset 164 nor their unit labels state their units"
    )


def _by_labels(
    function: Function,
    kind: Response,
    labels: tuple[float | None, float | None],
    by_file: tuple[float, float] | None,
) -> tuple[float, str]:
    """Return as `_factor`, where a label names the unit of motion or force, or both."""
    motion, force = labels
    file_motion, file_force = by_file or (1.0, 1.0)
    factor = (motion or file_motion) / (force or file_force)
    text = f"{function.place.path}: units {_label_text(function)}"
    if by_file is None and (motion is None or force is None):
        missing = "motion" if motion is None else "force"
        times = "" if factor == 1.0 else f", the values are multiplied by {factor:.6g}"
        return factor, (
            f"doubtful: {text}: the {missing} of {_COUNT} functions is taken as SI{times}"
        )
    # accelerations in g go with any unit of length
    in_g = motion == GRAVITY and kind == "accelerance"
    if by_file is not None and (
        (motion is not None and not in_g and not math.isclose(motion, file_motion, rel_tol=SAME))
        or (force is not None and not math.isclose(force, file_force, rel_tol=SAME))
    ):
        return factor, (
            f"doubtful: {text} of {_COUNT} response functions contradict dataset 164; the labels "
            f"are taken (values times {factor:.6g})"
        )
    return factor, _converted(factor, text)


def _converted(factor: float, source: str) -> str:
    if math.isclose(factor, 1.0, rel_tol=1e-12):
        return ""
    return f"{source}: {_COUNT} response functions are converted to SI, times {factor:.6g}"


def _labels(function: Function, kind: Response) -> tuple[float | None, float | None]:
    """Return the SI values of the labels' units of motion and force, None for unknown ones."""
    numerator, denominator = function.unit, function.denominator_unit
    ratio = _RATIO.fullmatch(numerator.strip().lower())
    force = NEWTONS.get(denominator.strip().lower().strip("()[] "))
    if ratio is not None:
        numerator = ratio[1]
        force = force or NEWTONS[ratio[2]]
    found = motion_label(numerator)
    fits = found is not None and found[1] == DERIVATIVES[kind]
    # a label of a length at a rotation, or of a force at a moment, is none of its unit
    motion = found[0] if found is not None and fits and abs(function.direction) <= 3 else None
    return motion, force if abs(function.reference_direction) <= 3 else None


def _by_file(function: Function, units: Units) -> tuple[float, float] | None:
    """Return SI values of a file's units of this motion and force.

    None without the unit of force.
    """
    if math.isnan(units.newtons):
        return None
    return (
        units.metres if abs(function.direction) <= 3 else 1.0,
        units.newtons * (1.0 if abs(function.reference_direction) <= 3 else units.metres),
    )


def _units_at(function: Function, given: Sequence[Units]) -> Units | None:
    """Return the dataset 164 of a function: the last before it in its file, else the first."""
    own = [units for units in given if units.place.path == function.place.path]
    before = [units for units in own if units.place.line < function.place.line]
    return before[-1] if before else own[0] if own else None


def _label_text(function: Function) -> str:
    labels = (function.unit, function.denominator_unit)
    return " over ".join(repr(label) for label in labels if label and label.upper() != "NONE")


def histories(contents: Sequence[Content], path: Path, notes: list[str]) -> list[TimeHistories]:
    """Return the recordings of a file. A repeated channel begins a new recording.

    Adds to the notes. Raises CampaignError where channels differ in times or quantities.
    """
    functions = [
        item for item in contents if isinstance(item, Function) and item.kind == TIME_RESPONSE
    ]
    runs: list[list[Channel]] = []
    seen: set[tuple[int, ...]] = set()
    unknown = 0
    for item in functions:
        unit = channel_unit(item.unit)
        quantity = -1 if item.numerator in FORCE_KINDS else ORDERS.get(item.numerator)
        if (
            item.node < 1
            or not 1 <= abs(item.direction) <= 6
            or (unit is None and quantity is None)
        ):
            notes.append(
                f"{item.place}: a time history without node, direction or unit; passed over"
            )
            continue
        unknown += unit is None
        factor, order = unit or (1.0, quantity or 0)
        name = item.node, abs(item.direction), order < 0
        if not runs or name in seen:
            runs.append([])
            seen.clear()
        seen.add(name)
        sign = float(np.sign(item.direction))
        values = np.asarray(item.values.real, dtype=np.float64)
        runs[-1].append(
            (item.node, abs(item.direction), sign, factor, order, values, item.abscissae,
             str(item.place))
        )  # fmt: skip
    if unknown:
        notes.append(
            f"doubtful: {path}: {unknown} time histories are taken as SI: their labels state none"
        )
    return [recording(run) for run in runs]

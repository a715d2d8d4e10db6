"""Response functions of a test, with their coherences, out of all functions of its files."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from modetune.adapters.test_files.universal.contents import Function, UniversalFile
from modetune.adapters.test_files.universal.units import in_si, motion_label
from modetune.core.measurement.frf import Response
from modetune.core.measurement.measurement import MeasuredFrfs
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

#: Kinds of quantity that a force may have: not told, general, reaction force, excitation force.
FORCES = (0, 1, 9, 13)
#: What the others are called, for people.
MOTIONS = {8: "a displacement", 11: "a velocity", 12: "an acceleration"}

#: How a doubt begins about points of several components with one number.
UNNUMBERED = "whose point"

Dof = tuple[int, int, int, int]


def frfs(files: Sequence[UniversalFile], notes: list[str]) -> MeasuredFrfs | None:
    """All response functions over the same frequencies in SI, or nothing where there are none."""
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
    """Where they stand, of the first few."""
    lines = [str(function.place.line) for function in functions[:20]]
    return f": line{'s' * (len(lines) > 1)} {', '.join(lines)}{', ...' * (len(functions) > 20)}"


def _again(first: Function, second: Function) -> str:
    """Why a function at the node and direction of one before is passed over."""
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
    """Coherences of these functions, (n_lines, n_functions), empty where one has none."""
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
    """Why a response function cannot be used, or nothing."""
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
    """What was measured; by its unit where the file does not say."""
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

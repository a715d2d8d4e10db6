"""Corrections of sensors that were reversed, exchanged with each other, or failed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modetune.core.errors import ModesError
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement
from modetune.core.modes import Floats, Integers, MeasuredModes, dof_name
from modetune.core.near_names import suggestion


def correct_sensors(
    measurement: Measurement,
    reverse: Sequence[str] = (),
    exchange: Sequence[tuple[str, str]] = (),
    drop: Sequence[str] = (),
) -> Measurement:
    """Return the test without the dropped sensors, then with exchanged, then with reversed ones.

    A sensor's name is node.component (12.z); in `reverse` and `drop` a node means all its
    components. Shapes and responses change, forces do not. Raises ModesError for a name that the
    test does not have, or no longer has.
    """
    dofs = _sensors(measurement)
    dropped = {dof for name in drop for dof in _named(name, dofs)}
    dofs = [dof for dof in dofs if dof not in dropped]
    source = {dof: dof for dof in dofs}
    for first, second in exchange:
        (one,), (other,) = _named(first, dofs, nodes=False), _named(second, dofs, nodes=False)
        source[one], source[other] = source[other], source[one]
    negative = [dof for name in reverse for dof in _named(name, dofs)]
    signs = {dof: -1.0 if negative.count(dof) % 2 else 1.0 for dof in dofs}
    modes, shapes, frfs = measurement.modes, measurement.complex_shapes, measurement.frfs
    if modes is not None and modes.has_shapes:
        own = _dofs(modes.modes.nodes, modes.modes.components)
        places = [place for place, dof in enumerate(own) if dof in source]
        rows = [own.index(source[own[place]]) for place in places]
        sign = np.array([signs[own[place]] for place in places])[:, None]
        there = modes.modes.rows(places)
        there = replace(there, mode_shapes=sign * modes.modes.mode_shapes[rows])
        modes = MeasuredModes(modes.numbers, there)
        shapes = None if shapes is None else sign * shapes[rows]
    if frfs is not None:
        frfs = _corrected_frfs(frfs, {there: dof for dof, there in source.items()}, signs)
    return replace(measurement, modes=modes, complex_shapes=shapes, frfs=frfs)


def _corrected_frfs(
    frfs: MeasuredFrfs,
    target: dict[tuple[int, int], tuple[int, int]],
    signs: dict[tuple[int, int], float],
) -> MeasuredFrfs:
    """target: where the response labelled with a sensor's name was measured."""
    own = _dofs(frfs.nodes, frfs.components)
    orientation: dict[tuple[int, int], float] = dict(zip(own, frfs.signs.tolist(), strict=True))
    kept = [place for place, dof in enumerate(own) if dof in target]
    there = [target[own[place]] for place in kept]
    moved = np.array(there, dtype=np.int64).reshape(-1, 2)
    used = np.zeros(len(own), dtype=bool)
    used[kept] = True
    sign: Floats = np.array(
        [
            signs[dof] * orientation.get(dof, orientation[own[place]])
            for place, dof in zip(kept, there, strict=True)
        ]
    )
    return replace(frfs.of(used), nodes=moved[:, 0], components=moved[:, 1], signs=sign)


def _sensors(measurement: Measurement) -> list[tuple[int, int]]:
    modes, frfs = measurement.modes, measurement.frfs
    dofs = [] if modes is None else _dofs(modes.modes.nodes, modes.modes.components)
    more = [] if frfs is None else _dofs(frfs.nodes, frfs.components)
    return list(dict.fromkeys([*dofs, *more]))


def _dofs(nodes: Integers, components: Integers) -> list[tuple[int, int]]:
    return list(zip(nodes.tolist(), components.tolist(), strict=True))


def _named(name: str, dofs: Sequence[tuple[int, int]], nodes: bool = True) -> list[tuple[int, int]]:
    names = [dof_name(dof) for dof in dofs]
    if name in names:
        return [dofs[names.index(name)]]
    found = [dof for dof in dofs if nodes and str(dof[0]) == name]
    if not found:
        has = "no sensors" if not names else f"no sensor {name}{suggestion(name, names)}"
        raise ModesError(f"the test has {has}")
    return found

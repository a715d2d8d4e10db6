"""Stiffness and mass given as matrices: GENEL, and the DMIG that K2GG and M2GG select.

A symmetric matrix K with eigenvalues l_i and eigenvectors v_i has the energy of one spring l_i on
each form v_i' u. Rotations are multiplied by the model's size first, which makes the units alike. A
GENEL of flexibility Z has K = Z^-1; with support freedoms u_d the forms are those of u_l - S u_d,
where S, if it is not given, is the rigid motion that six of them determine. A mass matrix is
one mass for each form in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from modetune.adapters.translation.assembly import Assembly, Form, Freedoms, difference, total
from modetune.adapters.translation.concentrated_masses import add_scalar_mass
from modetune.adapters.translation.linear_constraints import Component, rigid_motions
from modetune.adapters.translation.springs import Deformations, add_springs
from modetune.core.modes import Floats

#: A symmetric square matrix, by its DMIG header.
SYMMETRIC = 6
#: Eigenvalues below this share of the largest are rounding of sixteen digits.
ROUNDING = 1e-13


#: DMIG with their factors.
Added = Sequence[tuple[float, str]]


def translate_matrices(model: Assembly, k2gg: Added) -> None:
    """Add all GENEL and the matrices of K2GG; after the constraints."""
    springs = add_springs(model, {"GENEL": _general})
    for factor, name in k2gg:
        try:
            forms = _direct(model.bulk, name, model.freedoms)
        except ValueError as reason:
            model.problems.append(f"K2GG = {name}: {reason}")
        else:
            springs.add([(form, factor * value) for form, value in forms], ())


def translate_added_mass(model: Assembly, m2gg: Added) -> None:
    """Add the matrices of M2GG, which WTMASS does not multiply; after all equations."""
    for factor, name in m2gg:
        try:
            forms = _direct(model.bulk, name, model.freedoms)
        except ValueError as reason:
            model.problems.append(f"M2GG = {name}: {reason}")
            continue
        for count, (form, mass) in enumerate(forms):
            add_scalar_mass(model, f"{name}_{count}", form, factor * mass)


def added_rotations(bulk: Any, k2gg: Added) -> set[int]:
    """Return the grid points whose rotations the matrices of K2GG hold."""
    cards = [bulk.dmig[name] for _, name in k2gg if name in bulk.dmig]
    return {int(node) for card in cards for node, component in card.GCj if component > 3}


def matrix_components(element: Any) -> list[Component]:
    """Return the grid points and components of a GENEL."""
    return [(int(node), int(c)) for part in (element.ul, element.ud) for node, c in part]


def _general(element: Any, freedoms: Freedoms) -> Deformations:
    components = matrix_components(element)
    count = len(element.ul)
    own, held = components[:count], components[count:]
    values = element.k if element.z is None else element.z
    if values is None or len(values) != count * (count + 1) // 2:
        raise ValueError(f"its K or Z requires {count * (count + 1) // 2} numbers")
    matrix = np.zeros((count, count))
    matrix[np.triu_indices(count)] = values
    matrix = matrix + np.triu(matrix, 1).T
    if element.z is not None:
        if not np.linalg.cond(matrix) < 1.0 / ROUNDING:
            raise ValueError("its Z has no inverse")
        matrix = np.linalg.inv(matrix)
    forms = _forms(freedoms, own)
    if held:
        supports = _forms(freedoms, held)
        shares = _shares(element, freedoms, own, held)
        forms = [
            difference(form, _weighted(supports, row))
            for form, row in zip(forms, shares.tolist(), strict=True)
        ]
    return _springs_of(matrix, forms, _lengths(freedoms, own))


def _shares(
    element: Any, freedoms: Freedoms, own: Sequence[Component], held: Sequence[Component]
) -> Floats:
    """Return S, (n_ul, n_ud). Raises ValueError where it neither is given nor follows."""
    if element.s is not None:
        if len(element.s) != len(own) * len(held):
            raise ValueError(f"its S requires {len(own) * len(held)} numbers")
        return np.asarray(element.s, dtype=np.float64).reshape(len(own), len(held))
    known = rigid_motions(freedoms, held, held[0][0])
    if len(held) != 6 or np.linalg.matrix_rank(known, tol=1e-9) < 6:
        raise ValueError("without S its UD requires six freedoms that determine a rigid motion")
    wanted = rigid_motions(freedoms, own, held[0][0])
    # Rotations in the motions are multiplied by the model's size.
    shares = np.linalg.solve(known.T, wanted.T).T
    return np.asarray(shares * _lengths(freedoms, held) / _lengths(freedoms, own)[:, None])


def _direct(bulk: Any, name: str, freedoms: Freedoms) -> Deformations:
    card = bulk.dmig.get(name)
    if card is None:
        raise ValueError("this DMIG is not there")
    if card.matrix_form != SYMMETRIC or card.tin not in (1, 2):
        raise ValueError("a stiffness or mass requires a real symmetric DMIG (IFO 6, TIN 1 or 2)")
    pairs = [(tuple(a), tuple(b)) for a, b in zip(card.GCi, card.GCj, strict=True)]
    components = sorted({end for pair in pairs for end in pair})
    places = {component: place for place, component in enumerate(components)}
    matrix = np.zeros((len(components),) * 2)
    for (row, column), value in zip(pairs, card.Real, strict=True):
        # One of a pair of equal terms is given; both where the writer did not know that.
        matrix[places[row], places[column]] = matrix[places[column], places[row]] = value
    own = [(int(node), int(component)) for node, component in components]
    return _springs_of(matrix, _forms(freedoms, own), _lengths(freedoms, own))


def _forms(freedoms: Freedoms, components: Sequence[Component]) -> list[Form]:
    """Return the form of each component in ccx. Raises ValueError for a missing one."""
    forms = []
    for node, component in components:
        if node not in freedoms.builder.coordinates:
            raise ValueError(f"point {node} is not there")
        form = freedoms.form(node, component)
        if not form:
            raise ValueError(f"point {node} is of solids and has no rotation {component}")
        forms.append(form)
    return forms


def _lengths(freedoms: Freedoms, components: Sequence[Component]) -> Floats:
    """Return the model's size where a component is a rotation, else 1."""
    return np.array([freedoms.builder.size if c > 3 else 1.0 for _, c in components])


def _springs_of(matrix: Floats, forms: Sequence[Form], lengths: Floats) -> Deformations:
    """Return forms and stiffnesses whose energies sum up to that of the matrix."""
    values, vectors = np.linalg.eigh(matrix / np.outer(lengths, lengths))
    least = ROUNDING * np.abs(values).max(initial=0.0)
    return [
        (_weighted(forms, row), float(value))
        for value, row in zip(values, (vectors.T * lengths).tolist(), strict=True)
        if abs(value) > least
    ]


def _weighted(forms: Sequence[Form], factors: Sequence[float]) -> Form:
    return total(
        {freedom: factor * value for freedom, value in form.items()}
        for form, factor in zip(forms, factors, strict=True)
    )

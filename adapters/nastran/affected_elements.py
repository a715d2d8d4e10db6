"""What of the matrices a parameter of a Nastran deck moves, and in which powers.

Stiffness is linear in moduli of whole elements, springs and constants of bars without shear, mass
in densities and masses (`NastranModel.is_linear`). What constraints and rigid elements eliminate
moves to the grid points that it depends on.

Of the thickness t of a plate MYSTRAN's elements have t in the plane, t^3 in bending, and of shear
t^3 / (t^2 + c), with c by the element's size: no polynomial, but one of six powers through six
thicknesses between half and double is off by 3e-6 of the stiffness and of the eigenvalues at most.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from modetune.adapters.nastran.places import ValuePlace
from modetune.adapters.nastran.structure import Structure
from modetune.adapters.solver import AffectedElements
from modetune.core.parameters import Parameter
from modetune.core.updating.matrix_samples import with_tied

#: Quantities that move one of the two matrices; the others may move both.
STIFFNESS_ALONE = frozenset(("youngs_modulus", "spring_stiffness"))
MASS_ALONE = frozenset(("density", "mass"))


#: Powers of a plate's thickness, and between which relative values they hold.
THICKNESS, HALF, DOUBLE = (1, 2, 3, 4, 5, 6), 0.5, 2.0


def powers_of(parameter: Parameter, places: Iterable[ValuePlace], linear: bool) -> tuple[int, ...]:
    """The powers of a parameter that the matrices are made of, none where they are not."""
    if linear:
        return (1,)
    plates = parameter.quantity == "thickness" and {p.card.name for p in places} == {"PSHELL"}
    within = parameter.lower >= HALF and parameter.upper <= DOUBLE
    return THICKNESS if plates and within else ()


def affected_elements_of(
    structure: Structure,
    parameters: Sequence[Parameter],
    places: Iterable[ValuePlace],
    powers: tuple[int, ...],
    whole: bool,
) -> AffectedElements:
    """What a parameter and those that follow it by expressions move in these powers.

    places: where they stand; whole: whether all stiffness of its elements is proportional to it.
    """
    moved = {item.quantity for item in parameters} - {"variable"}
    elements = frozenset[int]().union(*(_elements(structure, place) for place in places))
    known = structure.bulk.elements | structure.bulk.masses
    nodes = {node for number in elements for node in known[number].node_ids if node}
    return AffectedElements(
        elements=elements,
        nodes=frozenset(with_tied(nodes, _ties(structure))),
        stiffness=not moved <= MASS_ALONE,
        mass=not moved <= STIFFNESS_ALONE,
        powers=powers,
        proportional=whole and moved <= STIFFNESS_ALONE,
        related=len(parameters) > 1,
    )


def _elements(structure: Structure, place: ValuePlace) -> frozenset[int]:
    """Elements that have a number, or a property or material with it."""
    if place.card in structure.owners.materials.get(place.ident, ()):
        users = (n for n, used in structure.materials_of.items() if place.ident in used)
        rods = structure.rods_of.get(place.ident, frozenset())
        return rods.union(*(structure.elements_of[number] for number in users))
    if place.card in structure.owners.properties.get(place.ident, ()):
        return structure.elements_of[place.ident]
    return frozenset({place.ident})


def _ties(structure: Structure) -> Iterable[tuple[set[int], set[int]]]:
    """Grid points of each rigid element and multi-point constraint, and those they depend on."""
    for element in structure.bulk.rigid_elements.values():
        dependent = set(element.dependent_nodes)
        every = dependent.union(element.independent_nodes)
        # Of others components of any grid point may be dependent.
        one_way = element.type == "RBE2" or (element.type == "RBE3" and not element.Gmi)
        yield (dependent if one_way else every), every
    for constraints in structure.bulk.mpcs.values():
        for item in constraints:
            yield set(item.node_ids[:1]), set(item.node_ids)
